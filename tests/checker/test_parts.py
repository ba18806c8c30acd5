"""Leaves in parts and in several processes: the same answer as of one, and no acceptance where one is missing.

Batches are made small, so that the leaves of a small certificate are those of many parts.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from certify.certificates import checking, run_checker
from certify.checker import outer, rules
from certify.checker.__main__ import main
from certify.checker.errors import Rejected
from certify.checker.parts import Part, in_processes
from certify.checker.ring import Ring
from certify.errors import BackendError, InputError
from tests.checker.test_rules import HONEST, honest, scalar_claim
from tests.support.certificates import Document, edited, grow, parse, with_tree, write
from tests.support.marks import slow_after
from tests.support.mutants import family
from tests.support.outer import uniform
from tests.support.outer_forgeries import forgeries

MANY = tuple(name for name in HONEST if name != "local only")
Refusal = tuple[str, str, str]


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ring, "batch", 3)
    monkeypatch.setattr(outer, "_batch", lambda numbers: 3)


def refusal(data: Document, part: Part | None = None, jobs: int = 1) -> Refusal | None:
    try:
        rules.check(parse(data), part, jobs)
    except Rejected as no:
        return no.rule, no.at, no.detail
    return None


# ---------------------------------------------------------------------------------------------------------- acceptance


@pytest.mark.parametrize("jobs", slow_after(1, [3, 2, 7]))
@pytest.mark.parametrize("name", slow_after(8, HONEST))
def test_several_processes_count_what_one_counts(name: str, jobs: int) -> None:
    one, several = (rules.check(parse(honest(name)), None, count) for count in (1, jobs))
    assert several.rules == one.rules and list(several.rules) == list(one.rules)
    assert +several.by_leaf == +one.by_leaf
    margins = [(v.local_margin, v.ring_margin, v.outer_margin) for v in (one, several)]
    assert margins[0] == margins[1]


@pytest.mark.parametrize("of", slow_after(1, [5, 1, 2, 2**16]))
@pytest.mark.parametrize("name", slow_after(6, MANY))
def test_parts_are_all_of_the_leaves(name: str, of: int) -> None:
    whole = Part()
    one = rules.check(parse(honest(name)), whole)
    assert whole.leaves == whole.all_leaves > 0
    by_leaf, leaves = Counter[str](), 0
    for number in range(1, min(of, whole.passed + 1) + 1):
        part = Part(number, of)
        tally = rules.check(parse(honest(name)), part, 1 + number % 2)
        assert (part.all_leaves, part.passed) == (whole.all_leaves, whole.passed)
        assert tally.elsewhere() == one.elsewhere()
        by_leaf, leaves = by_leaf + tally.by_leaf, leaves + part.leaves
    assert leaves == whole.leaves and by_leaf == +one.by_leaf


def test_a_part_without_leaves_accepts_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(scalar_claim(c1=0.25, c2=0.25), tmp_path)
    for part in ("1/1", "2/2", "65536/65536"):
        assert main([str(path), "--part", part]) == 4
        *_, rest, verdict = capsys.readouterr().out.splitlines()
        assert "accepts nothing" in rest and verdict.startswith(f"PART {part} ")


# ------------------------------------------------------------------------------------------------------------- refusal


@cache
def refused() -> dict[str, Document]:
    """Certificates that are refused on leaves, by each rule for them, some on several leaves and by several rules."""
    narrow = edited(honest("linear"), "plant.input_bounds", [["-2", "2"]])
    trees = {mutant.name: json.loads(mutant.raw) for mutant in [*family("coarser_trees")][::10]}
    trees = {name: data for name, data in trees.items() if refusal(data)}  # a few are true, and accepted
    flow = edited(honest("sampled"), "plant.domain.0", [f"-{2**20 + 1}/{2**21}", "1"])
    others = {what: data for rule, what, data in [*forgeries(8)][::3] if rule in ("faces", "outer", "inputs")}
    return {
        "the whole ring": with_tree(honest("rotor"), b"\xff"),
        "beyond the region": grow(scalar_claim(c2=3.7)),
        "inputs": narrow,
        "inputs and ring": with_tree(narrow, uniform(range(2), 4)),
        "flow": flow,
    } | trees | others  # fmt: skip


@pytest.mark.parametrize("each", slow_after(1, [1, 1000]), ids=["one of a rule", "all"])
def test_the_first_refusal_of_the_file_is_that_of_several_processes(each: int) -> None:
    seen = Counter[str]()
    for what, data in refused().items():
        alone = refusal(data)
        assert alone is not None, what
        if seen[alone[0]] < each:
            for jobs in (2, 5) if each > 1 else (2,):
                assert refusal(data, None, jobs) == alone, (what, jobs)
        seen[alone[0]] += "leaf " in alone[1]
    assert all(seen[rule] for rule in ("ring", "inputs", "flow", "faces", "outer")), seen


@pytest.mark.parametrize("of", slow_after(1, [5, 2]))
def test_what_is_forged_is_refused_in_the_part_that_holds_it(of: int) -> None:
    """The part whose turn it was when one process refused; what is no leaf, in every part."""
    for what, data in refused().items():
        whole = Part()
        alone = refusal(data, whole)
        assert alone is not None
        found = [refusal(data, Part(number, of)) for number in range(1, of + 1)]
        assert found[whole.passed % of] == alone, what
        if "leaf " not in alone[1]:
            assert set(found) == {alone}, what


# -------------------------------------------------------------------------------------------------- processes that fail


def _dies() -> None:
    os._exit(3)


def _is_killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _leaves_quietly() -> None:
    os._exit(0)


def _raises() -> None:
    raise MemoryError


def _exits() -> None:
    raise SystemExit(0)


@pytest.mark.parametrize("index", slow_after(1, [0, 2]))
@pytest.mark.parametrize("fault", [_dies, _is_killed, _leaves_quietly, _raises, _exits])
@pytest.mark.parametrize("name", ["scalar", "refused"])
def test_a_process_that_does_not_answer_is_an_internal_error(
    name: str,
    fault: Callable[[], None],
    index: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Also if another one refuses: nobody knows which comes first."""
    honestly = rules._answer

    def answer(tally: Any, case: Any, which: int, jobs: int) -> Any:
        if which == index:
            fault()
        return honestly(tally, case, which, jobs)

    monkeypatch.setattr(rules, "_answer", answer)
    path = write(honest("scalar") if name == "scalar" else refused()["beyond the region"], tmp_path)
    assert main([str(path), "--json", "--jobs", "3"]) == 70
    answered = json.loads(capsys.readouterr().out)
    assert "internal error" in answered["error"] and "result" not in answered


def altered(path: str, value: Any) -> Callable[[Any], Any]:
    return lambda answer: edited(answer, path, value)


GARBAGE: dict[str, Callable[[Any], Any]] = {
    "nothing": lambda answer: None,
    "a list": lambda answer: [],
    "an empty object": lambda answer: {},
    "accepted": lambda answer: {"result": "ACCEPTED"},
    "no refusal": lambda answer: {key: value for key, value in answer.items() if key != "refusal"},
    "a refusal of one word": altered("refusal", ["ring"]),
    "the part of another": altered("part.number", 2),
    "another count of parts": altered("part.of", 4),
    "an unknown key": altered("part.more", 1),
    "fewer leaves": altered("part.leaves", lambda n: n - 1),
    "more leaves": altered("part.leaves", lambda n: n + 1),
    "fewer in all": altered("part.all_leaves", lambda n: n - 1),
    "fewer batches": altered("part.passed", lambda n: n - 1),
    "another tree": altered("tally.rules.tree", lambda n: n + 1),
    "a rule not counted": altered("tally.rules.ring", lambda n: n + 1),
    "words for counts": altered("tally.rules.ring", "many"),
    "no tally": altered("tally", None),
}  # fmt: skip


@pytest.mark.parametrize("what", slow_after(9, GARBAGE))
def test_an_answer_that_cannot_be_is_an_internal_error(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    honestly = rules._answer

    def answer(tally: Any, case: Any, which: int, jobs: int) -> Any:
        true = json.loads(json.dumps(honestly(tally, case, which, jobs)))
        return GARBAGE[what](true) if which == 0 else true

    monkeypatch.setattr(rules, "_answer", answer)
    assert main([str(write(honest("scalar"), tmp_path)), "--json", "--jobs", "3"]) == 70
    assert "internal error" in json.loads(capsys.readouterr().out)["error"]


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_batch_that_is_passed_over_is_an_internal_error(
    jobs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def own(self: Part, batches: Any) -> Iterator[Any]:
        for batch in batches:
            self.all_leaves += batch[1].shape[1]
            if self.passed % self.of == self.number - 1 and self.passed != 1:
                self.leaves += batch[1].shape[1]
                yield batch
            self.passed += 1

    monkeypatch.setattr(Part, "own", own)
    assert main([str(write(honest("scalar"), tmp_path)), "--jobs", str(jobs)]) == 70
    assert "passed over" in capsys.readouterr().err


def test_processes_answer_in_their_order_and_leave_nothing_behind() -> None:
    before = _children()
    assert in_processes(5, lambda index: [index, "x" * 200_000 * (index % 2)]) == [
        [index, "x" * 200_000 * (index % 2)] for index in range(5)
    ]
    assert _children() <= before  # a child that nobody has waited for is still listed


def _children() -> set[str]:
    """The child processes of this one, by number."""
    return {number for task in Path("/proc/self/task").glob("*/children") for number in task.read_text().split()}


@pytest.mark.parametrize("arguments", [
    ["--jobs", "0"], ["--jobs", "-1"], ["--jobs", "257"], ["--jobs", "two"], ["--part", "0/2"], ["--part", "3/2"],
    ["--part", "1/65537"], ["--part", "1"], ["--part", "1/2/3"], ["--part", "-1/2"], ["--part", "1/0"], ["--part", ""],
])  # fmt: skip
def test_other_shares_are_usage_errors(arguments: list[str], tmp_path: Path) -> None:
    assert main([str(write(honest("scalar"), tmp_path)), *arguments]) == 2


# --------------------------------------------------------------------------------------------------- the child process


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_checker_as_a_child_takes_jobs(jobs: int, tmp_path: Path) -> None:
    assert run_checker(write(honest("rotor"), tmp_path), jobs=jobs)["result"] == "ACCEPTED"
    answer = run_checker(write(with_tree(honest("linear"), b"\xff"), tmp_path), jobs=jobs)
    assert (answer["result"], answer["rule"], answer["at"]) == ("REJECTED", "ring", "leaf 0")


def test_the_reference_has_one_process(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one process"):
        run_checker(write(honest("scalar"), tmp_path), "reference", jobs=2)


@pytest.mark.parametrize(
    ("said", "status"), [("PART", 4), ("PART", 0), ("ACCEPTED", 4), ("ACCEPTED", 1), ("REJECTED", 0)]
)
def test_an_answer_of_another_kind_is_no_verdict(
    said: str, status: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A status without its answer accepts nothing, nor does an answer without its status."""
    program = f"import json, sys; print(json.dumps({{'result': {said!r}}})); sys.exit({status})"
    monkeypatch.setattr(checking, "command", lambda program_, arguments: ["python3", "-c", program])
    with pytest.raises(BackendError, match=said):
        checking.ask(tmp_path)


def test_no_process_outlives_an_examination_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    fork, started = os.fork, []

    def scarce() -> int:
        if len(started) == 2:
            raise OSError("no more processes")
        child = fork()
        if child:
            started.append(child)
        return child

    monkeypatch.setattr(os, "fork", scarce)
    with pytest.raises(OSError, match="no more"):
        in_processes(3, lambda _: time.sleep(60))
    assert len(started) == 2
    for child in started:
        with pytest.raises(ChildProcessError):
            os.waitpid(child, os.WNOHANG)


def test_a_caller_that_ignores_its_children_changes_nothing() -> None:
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        assert in_processes(2, lambda index: index) == [0, 1]
    finally:
        signal.signal(signal.SIGCHLD, before)


def test_an_answer_that_nobody_hears_is_no_refusal(tmp_path: Path) -> None:
    line = checking.command("checker", [str(write(honest("scalar"), tmp_path))])
    with open("/dev/full", "wb") as full:
        assert subprocess.run(line, stdout=full, stderr=subprocess.DEVNULL, check=False).returncode == 70
    shell = f"exec {shlex.join(line)} >&-"
    assert subprocess.run(["sh", "-c", shell], stderr=subprocess.DEVNULL, check=False).returncode == 70
