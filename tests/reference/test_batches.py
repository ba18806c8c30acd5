"""Leaves in several processes of the reference: the answer of one, and no verdict where a process is missing."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from certify.certificates import run_checker
from certify.reference import batches
from certify.reference.__main__ import line
from certify.reference.refusal import Refused
from certify.reference.rules import judge
from tests.checker.test_rules import HONEST
from tests.checker.test_rules import honest as of_version_3
from tests.support.balls import with_ball
from tests.support.certificates import Document, dump, with_tree, write
from tests.support.marks import slow_after
from tests.support.outer import uniform

FAST = ("scalar", "rotor", "sampled", "practical, clipped", "local only", "outer, an expression")
COMMAND = [sys.executable, "-I", "-m", "certify.reference"]
JUDGE = """
import json, sys
from certify.reference import batches
from certify.reference.__main__ import line
from certify.reference.rules import judge
batches.COLUMNS = 1
for asked in sys.stdin:
    raw, jobs = json.loads(asked)
    print(json.dumps(line(judge(raw.encode(), jobs=jobs))), flush=True)
"""


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "COLUMNS", 1)


@pytest.fixture(scope="module")
def judged() -> Iterator[Callable[[bytes, int], str]]:
    """The answer of a process that has loaded only the reference, with small batches: copies of it cost a tenth of
    copies of this one."""
    command = [sys.executable, "-I", "-c", JUDGE]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None and process.stdout is not None
        ask, answer = process.stdin, process.stdout

        def judged(raw: bytes, jobs: int) -> str:
            ask.write(json.dumps((raw.decode(), jobs)) + "\n")
            ask.flush()
            found: str = json.loads(answer.readline())
            return found

        yield judged


def honest(name: str) -> Document:
    return with_ball(of_version_3(name))


@pytest.mark.parametrize("name", slow_after(len(FAST), [*FAST, *(name for name in HONEST if name not in FAST)]))
def test_the_answer_is_that_of_one_process(name: str, judged: Callable[[bytes, int], str]) -> None:
    """Of one leaf and of many, on some of which a rule refuses: the first of these is named."""
    data = honest(name)
    n = len(data["plant"]["states"])
    for tree in (None, b"\xff", *(uniform(range(n), depth * n) for depth in (1, 2, 3))):
        raw = dump(data if tree is None else with_tree(data, tree))
        one = judged(raw, 1)
        assert one == line(judge(raw))
        for jobs in (2, 3, 7):
            assert judged(raw, jobs) == one


@pytest.mark.parametrize("jobs", [2, 5])
def test_a_process_that_ends_without_an_answer_is_no_verdict(jobs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed, or by an error that is no refusal."""
    raw = dump(honest("scalar"))
    for end in (lambda *_: os._exit(0), lambda *_: 1 / 0):
        monkeypatch.setattr(batches, "share", end)
        with pytest.raises(EOFError):
            judge(raw, jobs=jobs)


def test_the_first_of_several_refusals_is_raised() -> None:
    def check(some: list[int]) -> None:
        if some[0] in (5, 8, 9):
            raise Refused("ring", f"leaf {some[0]}", "")

    c = judge(dump(honest("scalar"))).certificate
    assert c is not None
    for jobs in (1, 2, 3, 4, 20):
        with pytest.raises(Refused, match="leaf 5"):
            batches.in_batches(c, 1, iter(range(12)), check, jobs)


@pytest.mark.parametrize("jobs", ["0", "-1", "257", "two", ""])
def test_other_numbers_of_processes_are_usage_errors(jobs: str, tmp_path: Path) -> None:
    path = write(honest("scalar"), tmp_path)
    assert subprocess.run([*COMMAND, path, "--jobs", jobs], capture_output=True, check=False).returncode == 2


def test_as_a_child(tmp_path: Path) -> None:
    assert run_checker(write(honest("rotor"), tmp_path), "reference", jobs=2)["result"] == "ACCEPTED"
    answer = run_checker(write(with_tree(honest("linear"), b"\xff"), tmp_path), "reference", jobs=2)
    assert (answer["result"], answer["rule"], answer["at"]) == ("REJECTED", "ring", "leaf 0")
