"""Leaves in parts and in several processes: the same answer as of one, and no acceptance where one is missing.

Batches are made small, so that the leaves of a small certificate are those of many parts.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from certify.certificates import checking, join_parts, joining, run_checker, run_part
from certify.checker import outer, rules
from certify.checker.__main__ import main
from certify.checker.errors import Rejected
from certify.checker.parts import Part, in_processes
from certify.checker.ring import Ring
from certify.errors import BackendError, InputError
from tests.checker.test_rules import HONEST, honest, scalar_claim
from tests.support.certificates import Document, dump, edited, grow, parse, with_tree, write
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


# --------------------------------------------------------------------------------------------- the answers of all parts


@cache
def answers(name: str, of: int) -> tuple[bytes, tuple[dict[str, Any], ...]]:
    """The certificate, and what the checker says of each part, in processes of its own and in batches of its own."""
    raw = dump(with_tree(honest(name), uniform([0], 14)) if name == "scalar" else honest(name))
    path = Path(os.environ["PYTEST_PARTS"]) / f"{hashlib.sha256(raw).hexdigest()}.json"
    path.write_bytes(raw)
    return raw, tuple(run_part(path, number, of) for number in range(1, of + 1))


@pytest.fixture(autouse=True, scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTEST_PARTS", str(tmp_path_factory.mktemp("parts")))
        yield


def parts_of(name: str, of: int) -> tuple[bytes, list[dict[str, Any]]]:
    raw, found = answers(name, of)
    return raw, deepcopy(list(found))


@pytest.mark.parametrize(
    "name", slow_after(3, ["scalar", "sampled", "outer, a network", "enlarged", "practical, clipped"])
)
def test_all_parts_together_are_the_answer_of_one(name: str, tmp_path: Path) -> None:
    raw, parts = parts_of(name, 3)
    whole = run_checker(write(raw, tmp_path))
    for order in (parts, parts[::-1]):
        joined = join_parts(raw, order)
        assert joined["result"] == "ACCEPTED" and joined["parts"] == 3
        apart = ("seconds", "text", "parts")
        assert {k: v for k, v in joined.items() if k not in apart} == {k: v for k, v in whole.items() if k not in apart}
        json.dumps(joined)


def test_one_part_of_one_is_joined_too() -> None:
    raw, parts = parts_of("scalar", 1)
    assert join_parts(raw, parts)["result"] == "ACCEPTED"


JOINS: dict[str, Callable[[list[Any]], list[Any]]] = {
    "none": lambda parts: [],
    "one is missing": lambda parts: parts[:2],
    "one is there twice": lambda parts: [parts[0], parts[1], parts[1]],
    "one more": lambda parts: [*parts, parts[0]],
    "one of another N": lambda parts: [*parts[:2], parts_of("scalar", 4)[1][2]],
    "all but one of another N": lambda parts: parts_of("scalar", 4)[1][:3],
    "of another file": lambda parts: [*parts[:2], parts_of("sampled", 3)[1][2]],
    "all of another file": lambda parts: parts_of("sampled", 3)[1],
    "no part but an acceptance": lambda parts: [*parts[:2], parts[2] | {"result": "ACCEPTED"}],
    "a solver's word": lambda parts: [*parts[:2], parts[2] | {"result": "TRUSTED"}],
    "a refusal": lambda parts: [*parts[:2], {"result": "REJECTED", "rule": "ring", "at": "leaf 1", "detail": ""}],
    "an error": lambda parts: [*parts[:2], {"error": "internal error"}],
    "an empty object": lambda parts: [*parts[:2], {}],
    "null": lambda parts: [*parts[:2], None],
    "a word": lambda parts: [*parts[:2], "PART"],
    "a number": lambda parts: [*parts[:2], 3],
}  # fmt: skip


@pytest.mark.parametrize("what", JOINS)
def test_other_answers_are_not_joined(what: str) -> None:
    raw, parts = parts_of("scalar", 3)
    with pytest.raises(BackendError):
        join_parts(raw, JOINS[what](parts))


EDITS: dict[str, tuple[str, Any]] = {
    "part, as truth": ("part", [True, 3]),
    "part, as floats": ("part", [1.0, 3.0]),
    "part, as words": ("part", "1/3"),
    "part, too long": ("part", [1, 3, 3]),
    "part, null": ("part", None),
    "sha256": ("certificate_sha256", "0" * 64),
    "sha256, null": ("certificate_sha256", None),
    "policy": ("policy_sha256", "0" * 64),
    "claim": ("claim", "practical"),
    "rate": ("rate", 0.1),
    "rate, an integer": ("rate", 0),
    "discrete": ("discrete", True),
    "discrete, as a number": ("discrete", 0),
    "sample": ("sample", ["0", "1"]),
    "c2": ("levels.roa", lambda c: c * 0.5),
    "c2, the next number": ("levels.roa", lambda c: c * (1 + 2.0**-52)),
    "c2, as words": ("levels.roa", str),
    "one more level": ("levels.floor", 0.1),
    "levels, null": ("levels", None),
    "leaves": ("leaves", lambda n: n - 1),
    "leaves in all": ("leaves_in_all", lambda n: n - 1),
    "no spans": ("spans", []),
    "a span more": ("spans", lambda spans: [*spans, [0, 1]]),
    "spans, the other way": ("spans", lambda spans: [span[::-1] for span in spans]),
    "spans, not so far": ("spans", lambda spans: [[first, beyond - 1] for first, beyond in spans]),
    "spans, as truth": ("spans", [[False, True]]),
    "a margin beyond binary64": ("margins.ring", 10**400),
    "fewer examined": ("examined", lambda n: n - 1),
    "more examined": ("examined", lambda n: n + 1),
    "less than none": ("examined", lambda n: -n),
    "examined, as truth": ("examined", True),
    "examined, as a float": ("examined", float),
    "tree": ("rules.tree", lambda n: n + 1),
    "a rule on leaves": ("rules.ring", lambda n: n + 1),
    "a rule on leaves, by leaf": ("by_leaf.ring", lambda n: n + 1),
    "a rule on the whole": ("rules.local", 2),
    "a rule that is none": ("rules.ours", 1),
    "a rule that is none, by leaf": ("by_leaf.ours", 0),
    "by leaf, a list": ("by_leaf", []),
    "by leaf, negative": ("by_leaf.ring", -1),
    "by leaf, nan": ("by_leaf.ring", float("nan")),
    "rules, null": ("rules", None),
    "an outer set": ("outer", {"level": 1.0, "leaves": 1, "face_leaves": 1}),
    "margins, null": ("margins", None),
    "margins, words": ("margins.ring", "large"),
    "seconds, words": ("seconds.check", "few"),
    "centre": ("centre", [0.0]),
}  # fmt: skip


@pytest.mark.parametrize("which", [0, 2])
@pytest.mark.parametrize("what", EDITS)
def test_answers_that_are_altered_are_not_joined(what: str, which: int) -> None:
    raw, parts = parts_of("scalar", 3)
    assert json.dumps(parts[which]) != json.dumps(edited(parts[which], *EDITS[what]))
    parts[which] = edited(parts[which], *EDITS[what])
    with pytest.raises(BackendError):
        join_parts(raw, parts)


NEEDED = ("part", "certificate_sha256", "policy_sha256", "claim", "rate", "discrete", "levels", "leaves", "rules",
          "by_leaf", "examined", "leaves_in_all", "spans", "margins", "seconds", "result")  # fmt: skip


@pytest.mark.parametrize("key", NEEDED)
def test_answers_with_something_missing_are_not_joined(key: str) -> None:
    raw, parts = parts_of("scalar", 3)
    del parts[1][key]
    with pytest.raises(BackendError):
        join_parts(raw, parts)


@pytest.mark.parametrize("what", ["certificate_sha256", "levels.roa", "leaves", "leaves_in_all"])
def test_what_all_parts_say_alike_is_compared_with_the_file(what: str) -> None:
    raw, parts = parts_of("scalar", 3)
    lied = [edited(part, what, {"certificate_sha256": "0" * 64, "levels.roa": 9.0}.get(what, 1)) for part in parts]
    with pytest.raises(BackendError):
        join_parts(raw, lied)


def test_fewer_leaves_than_the_file_has_are_not_enough() -> None:
    """Also where all parts agree about how many there are."""
    raw, parts = parts_of("scalar", 3)
    fewer = sum(part["examined"] for part in parts) - parts[0]["examined"]
    lied = [edited(part, "leaves_in_all", fewer) for part in parts]
    lied[0]["examined"] = 0
    with pytest.raises(BackendError):
        join_parts(raw, lied)


@pytest.mark.parametrize("sizes", [(4, 3), (3, 4), (1, 5)])
def test_parts_that_were_dealt_differently_are_not_joined(
    sizes: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two versions of the checker may differ in the size of a batch: each is honest, and between them lie leaves that
    nobody has looked at, while others are looked at twice."""
    raw = dump(with_tree(honest("scalar"), uniform([0], 5)))
    certificate, met = parse(json.loads(raw)), []
    for number, size in enumerate(sizes, 1):
        monkeypatch.setattr(Ring, "batch", property(lambda _, size=size: size))
        part = Part(number, 2)
        tally = rules.check(certificate, part)
        met.append((part, tally))
    spans = [span for part, _ in met for span in part.spans]
    assert sorted(spans) != [[k, k + 1] for k in range(32)]
    with pytest.raises(BackendError, match=r"each once|have done"):
        joining._require_all([{"spans": part.spans, "examined": part.leaves} for part, _ in met], met[0][0].all_leaves)


def test_what_is_not_of_the_file_is_not_handed_on() -> None:
    for name, what, value in (
        ("enlarged", "start", [[1e-4]]),
        ("outer, a network", "outer.level", 1e9),
        ("outer, a network", "outer.leaves", 1),
        ("outer, a network", "by_leaf.faces", 1),
    ):
        raw, parts = parts_of(name, 2)
        with pytest.raises(BackendError):
            join_parts(raw, [edited(part, what, value) for part in parts])
    raw, parts = parts_of("scalar", 2)
    joined = join_parts(raw, [part | {"solver": "ours", "error": "none", "text": ["PROVED"]} for part in parts])
    assert not {"solver", "error"} & set(joined) and joined["text"][0].startswith("ACCEPTED by 2 parts")


def test_another_file_with_the_same_claim_is_another_file() -> None:
    raw, parts = parts_of("scalar", 3)
    assert all(part["examined"] > 0 for part in parts)
    for other in (raw + b"\n", dump(edited(json.loads(raw), "provenance", {"by": "another"}))):
        with pytest.raises(BackendError, match="sha256"):
            join_parts(other, parts)


# --------------------------------------------------------------------------------------------------- the child process


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_checker_as_a_child_takes_jobs(jobs: int, tmp_path: Path) -> None:
    assert run_checker(write(honest("rotor"), tmp_path), jobs=jobs)["result"] == "ACCEPTED"
    path = write(with_tree(honest("linear"), b"\xff"), tmp_path)
    for answer in (run_checker(path, jobs=jobs), run_part(path, 1, 1, jobs)):
        assert (answer["result"], answer["rule"], answer["at"]) == ("REJECTED", "ring", "leaf 0")


def test_the_reference_knows_of_no_shares(tmp_path: Path) -> None:
    path = write(honest("scalar"), tmp_path)
    with pytest.raises(InputError, match="one process"):
        run_checker(path, "reference", jobs=2)
    with pytest.raises(InputError, match="one process"):
        checking.ask(path, "reference", part=(1, 2))


@pytest.mark.parametrize(("said", "status", "part"), [
    ("PART", 4, None), ("ACCEPTED", 0, (1, 2)), ("PART", 0, (1, 2)), ("PART", 0, None), ("ACCEPTED", 4, None),
])  # fmt: skip
def test_an_answer_of_another_kind_is_no_verdict(
    said: str, status: int, part: tuple[int, int] | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A part is never an acceptance, nor is an acceptance one of a part."""
    program = f"import json, sys; print(json.dumps({{'result': {said!r}}})); sys.exit({status})"
    monkeypatch.setattr(checking, "command", lambda program_, arguments: ["python3", "-c", program])
    with pytest.raises(BackendError, match=said):
        checking.ask(tmp_path, part=part)


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
