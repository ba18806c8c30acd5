"""Leaves in several processes: the same answer as of one, and no acceptance where one is missing.

Batches are made small, so that the leaves of a small certificate are those of many processes.
"""

from __future__ import annotations

import ast
import json
import os
import pickle
import re
import shlex
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.certificates import checking, run_checker
from certify.checker import boxes, outer, processes, rules
from certify.checker.__main__ import main
from certify.checker.boxes import Batch, in_order
from certify.checker.case import Case
from certify.checker.errors import Rejected
from certify.checker.ring import Ring
from certify.errors import BackendError
from certify.reference import __main__ as second
from tests.checker.test_rules import HONEST, honest, scalar_claim
from tests.support import network_loops
from tests.support.balls import with_ball
from tests.support.certificates import Document, edited, grow, parse, with_tree, write
from tests.support.marks import slow_after
from tests.support.mutants import family
from tests.support.outer import uniform
from tests.support.outer_forgeries import forgeries

SIZE = 3  # of a batch
Refusal = tuple[str, str, str]


@pytest.fixture(autouse=True)
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Ring, "batch", SIZE)
    monkeypatch.setattr(outer, "_batch", lambda numbers: SIZE)


def refusal(data: Document, jobs: int = 1) -> Refusal | None:
    try:
        rules.check(parse(data), jobs)
    except Rejected as no:
        return no.rule, no.at, no.detail
    return None


def divided() -> Document:
    """A true certificate of 32 leaves: several batches for each of three processes."""
    return with_tree(honest("scalar"), uniform([0], 5))


def some(count: int, size: int = SIZE) -> Iterator[Batch]:
    """Batches of leaves that are nowhere, the last of one leaf."""
    for first in range(0, count, size):
        corners = np.zeros((1, min(size, count - first)))
        yield first, corners, corners


# ----------------------------------------------------------------------------------------------- acceptance and refusal


@pytest.mark.parametrize("jobs", [1, 3])
def test_every_refused_leaf_is_named_if_that_is_asked_for(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], jobs: int
) -> None:
    """Those whose bound is not negative, and the answer is otherwise the same; what is accepted has none to name."""
    data = with_tree(honest("rotor"), uniform(range(2), 6))
    ring = Ring.of(Case(parse(data)))
    found = [(leaves.numbers, leaves.hold) for leaves in (ring.examine(*batch) for batch in ring.leaves())]
    numbers, hold = (np.concatenate(each) for each in zip(*found, strict=True))
    names = [f"leaf {k}" for k in numbers[~hold]]
    assert SIZE < len(names) < len(numbers) - 2
    path, answers = str(write(data, tmp_path)), []
    for more in ([], ["--every"]):
        assert main([path, "--json", "--jobs", str(jobs), *more]) == 1
        answers.append(json.loads(capsys.readouterr().out))
    assert answers[1].pop("every") == names and answers[0] == answers[1] and answers[0]["at"] == names[0]
    assert main([str(write(divided(), tmp_path)), "--json", "--every"]) == 0
    assert "every" not in json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("jobs", slow_after(1, [3, 2, 7]))
@pytest.mark.parametrize("name", slow_after(4, HONEST))
def test_several_processes_find_what_one_finds(name: str, jobs: int) -> None:
    one, several = (rules.check(parse(honest(name)), count) for count in (1, jobs))
    assert several == one and list(several.rules) == list(one.rules)


def refused() -> Iterator[tuple[str, Document]]:
    """Certificates that are refused on leaves, by each rule for them, some on several leaves and by several rules."""
    narrow = edited(honest("linear"), "plant.input_bounds", [["-2", "2"]])
    flow = edited(honest("sampled"), "plant.domain.0", [f"-{2**20 + 1}/{2**21}", "1"])
    yield "the whole ring", with_tree(honest("rotor"), b"\xff")
    yield "beyond the region", grow(scalar_claim(c2=3.7))
    yield "inputs", narrow
    yield "inputs and ring", with_tree(narrow, uniform(range(2), 4))
    yield "flow", with_tree(flow, b"\xff")
    yield from ((what, data) for rule, what, data in [*forgeries(8)][::3] if rule in ("faces", "outer", "inputs"))
    trees = ((mutant.name, json.loads(mutant.raw)) for mutant in [*family("coarser_trees")][::10])
    yield from ((name, data) for name, data in trees if refusal(data))  # a few are true, and accepted


@pytest.mark.parametrize("each", slow_after(1, [1, 1000]), ids=["one of a rule", "all"])
def test_the_first_refusal_of_the_file_is_that_of_several_processes(each: int) -> None:
    seen, rules_met = Counter[str](), ("ring", "inputs", "flow", "faces", "outer")
    for what, data in refused():
        if each == 1 and all(seen[rule] for rule in rules_met):
            break
        alone = refusal(data)
        assert alone is not None, what
        if seen[alone[0]] < each:
            for jobs in (2, 5) if each > 1 else (2,):
                assert refusal(data, jobs) == alone, (what, jobs)
        seen[alone[0]] += "leaf " in alone[1]
    assert all(seen[rule] for rule in rules_met), seen


@pytest.mark.parametrize("jobs", slow_after(3, [1, 2, 3, 4, 5, 256]))
@pytest.mark.parametrize("leaves", [1, 3, 4, 12, 13])
def test_results_come_in_the_order_of_the_leaves(leaves: int, jobs: int) -> None:
    """Also if they are long, or the first to begin is the last to end."""

    def work(first: int, lo: Any, hi: Any) -> tuple[int, str]:
        time.sleep(0.05 * (first == 0))
        return first, "x" * 200_000 * (first % 2)

    before = _children()
    found = list(in_order(work, some(leaves), leaves, jobs))
    assert found == [(first, "x" * 200_000 * (first % 2)) for first in range(0, leaves, SIZE)]
    assert _children() <= before  # a child that nobody has waited for is still listed


def test_no_process_examines_what_another_does() -> None:
    answers = list(in_order(lambda first, lo, hi: (os.getpid(), first), some(30), 30, 4))
    by = {who: [first for other, first in answers if other == who] for who, _ in answers}
    assert sorted(by.values()) == [[0, 12, 24], [3, 15, 27], [6, 18], [9, 21]] and os.getpid() not in by


def test_one_batch_needs_no_process() -> None:
    assert list(in_order(lambda first, lo, hi: os.getpid(), some(SIZE), SIZE, 8)) == [os.getpid()]
    assert len(set(in_order(lambda first, lo, hi: os.getpid(), some(2 * SIZE), 2 * SIZE, 8))) == 2


def test_a_refusal_is_the_same_after_a_pipe() -> None:
    no = pickle.loads(pickle.dumps(Rejected("ring", "leaf 3", "the decrease is not shown: 0.1")))
    assert (no.rule, no.at, no.detail) == ("ring", "leaf 3", "the decrease is not shown: 0.1")
    assert str(no) == "REJECTED rule=ring at=leaf 3: the decrease is not shown: 0.1"


# -------------------------------------------------------------------------------------------------- processes that fail


def _dies() -> None:
    os._exit(3)


def _is_killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _leaves_quietly() -> None:
    os._exit(0)


def _raises() -> None:
    raise RuntimeError


def _exits() -> None:
    raise SystemExit(0)


def _ends_its_answers() -> None:
    raise EOFError


def _stops() -> None:
    raise StopIteration


class Unsendable(Exception):
    """An error that no pipe takes."""

    def __reduce__(self) -> Any:
        raise TypeError


def _raises_what_is_lost() -> None:
    raise Unsendable


FAULTS = [_dies, _is_killed, _leaves_quietly, _raises, _exits, _ends_its_answers, _stops, _raises_what_is_lost]


@pytest.mark.parametrize("batch", slow_after(1, [1, 0, 3]))
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", slow_after(1, ["accepted", "refused"]))
def test_a_process_that_does_not_answer_is_an_internal_error(
    name: str,
    fault: Callable[[], None],
    batch: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Unless what comes before in the file is refused."""
    data = divided() if name == "accepted" else refused_in_the_second_batch()
    alone, honestly, parent = refusal(data), Ring.examine, os.getpid()

    def examine(self: Ring, first: int, lo: Any, hi: Any) -> Any:
        if first == batch * SIZE:
            assert os.getpid() != parent
            fault()
        return honestly(self, first, lo, hi)

    monkeypatch.setattr(Ring, "examine", examine)
    before = _children()
    status = main([str(write(data, tmp_path)), "--json", "--jobs", "3"])
    answered = json.loads(capsys.readouterr().out)
    if alone is not None and int(alone[1].removeprefix("leaf ")) < batch * SIZE:
        assert (status, answered["rule"], answered["at"], answered["detail"]) == (1, *alone)
    else:
        assert status == 70 and "internal error of the checker" in answered["error"] and "result" not in answered
    assert _children() <= before


def refused_in_the_second_batch() -> Document:
    data = with_tree(honest("rotor"), uniform(range(2), 4))
    assert (refusal(data) or ("", "", ""))[1] in {f"leaf {leaf}" for leaf in range(SIZE, 2 * SIZE)}
    return data


Lie = Callable[[Iterator[Any]], Iterator[Any]]


def _altered(change: Callable[[int, int, Any], Any]) -> Lie:
    """The second answer of each process is another."""
    return lambda answers: (change(*answer) if k == 1 else answer for k, answer in enumerate(answers))


LIES: dict[str, Lie] = {
    "nothing": lambda answers: iter([]),
    "only the first": lambda answers: islice(answers, 1),
    "all but the first": lambda answers: islice(answers, 1, None),
    "every other": lambda answers: islice(answers, 0, None, 2),
    "each twice": lambda answers: (answer for answer in answers for _ in range(2)),
    "backwards": lambda answers: iter([*answers][::-1]),
    "none": _altered(lambda number, size, result: None),
    "a word": _altered(lambda number, size, result: "ACCEPTED"),
    "no result": _altered(lambda number, size, result: (number, size)),
    "two results": _altered(lambda number, size, result: (number, size, result, result)),
    "a result that is none": _altered(lambda number, size, result: (number, size, None)),
    "a result that is a number": _altered(lambda number, size, result: (number, size, 7)),
    "of the next leaf": _altered(lambda number, size, result: (number + 1, size, result)),
    "of the next batch": _altered(lambda number, size, result: (number + SIZE, size, result)),
    "of the first leaves": _altered(lambda number, size, result: (0, size, result)),
    "of no number": _altered(lambda number, size, result: (float("nan"), size, result)),
    "fewer leaves": _altered(lambda number, size, result: (number, size - 1, result)),
    "more leaves": _altered(lambda number, size, result: (number, size + 1, result)),
    "all other leaves": _altered(lambda number, size, result: (number, 10**6, result)),
    "no leaves": _altered(lambda number, size, result: (number, 0, result)),
    "an end": _altered(lambda number, size, result: EOFError()),
}  # fmt: skip


@pytest.mark.parametrize("what", slow_after(4, LIES))
def test_answers_that_cannot_be_are_an_internal_error(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    honestly = processes._send
    monkeypatch.setattr(processes, "_send", lambda answers, *ends: honestly(LIES[what](answers), *ends))
    for data in (divided(), honest("outer, a network")):
        assert main([str(write(data, tmp_path)), "--json", "--jobs", "3"]) == 70
        assert "internal error of the checker" in json.loads(capsys.readouterr().out)["error"]


def test_the_same_answers_of_all_processes_are_an_internal_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each examines the share of the first."""
    shares = processes.islice
    monkeypatch.setattr(processes, "islice", lambda over, *ends: shares(over, *(0 if e == 2 else e for e in ends)))
    assert main([str(write(divided(), tmp_path)), "--jobs", "3"]) == 70
    assert "passed over" in capsys.readouterr().err


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("name", slow_after(1, ["outer, a network", "scalar", "sampled"]))
@pytest.mark.parametrize("leaf", [0, 1, -1])
def test_a_leaf_that_is_passed_over_is_an_internal_error(
    leaf: int,
    name: str,
    jobs: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    honestly = boxes._walk

    def walk(tree: bytes, lo: Any, hi: Any) -> Iterator[Any]:
        corners = [*honestly(tree, lo, hi)]
        del corners[leaf]
        yield from corners

    monkeypatch.setattr(boxes, "_walk", walk)
    assert main([str(write(honest(name), tmp_path)), "--jobs", str(jobs)]) == 70
    assert "passed over" in capsys.readouterr().err


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("leaves", [0, 11, 13, 24])
def test_other_leaves_than_the_tree_has_are_an_error(leaves: int, jobs: int) -> None:
    with pytest.raises(ArithmeticError, match="passed over"):
        list(in_order(lambda first, lo, hi: None, some(12), leaves, jobs))


def _children() -> set[str]:
    """The child processes of this one, by number."""
    return {number for task in Path("/proc/self/task").glob("*/children") for number in task.read_text().split()}


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
        list(in_order(lambda first, lo, hi: time.sleep(60), some(12), 12, 3))
    assert len(started) == 2
    for child in started:
        with pytest.raises(ChildProcessError):
            os.waitpid(child, os.WNOHANG)


def test_no_process_outlives_one_that_stops_asking() -> None:
    before = _children()
    results = in_order(lambda first, lo, hi: time.sleep(60 * (first > 0)), some(12), 12, 3)
    assert next(results) is None and len(_children() - before) == 3
    results.close()
    assert _children() <= before


ENDLESS = """
import os, sys
import numpy as np
sys.path.insert(0, sys.argv[1])
from certify.checker.boxes import in_order
batches = ((first, np.zeros((1, 1)), np.zeros((1, 1))) for first in range(10**9))
for who in in_order(lambda first, lo, hi: (os.getpid(), "x" * 1000), batches, 10**9, 3):
    print(who[0], flush=True)
"""


def test_no_process_outlives_one_that_is_killed() -> None:
    """What they send to nobody ends them, even if they wait for room in a pipe."""
    root = Path(rules.__file__).parents[2]
    with subprocess.Popen(
        [sys.executable, "-c", ENDLESS, str(root)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    ) as child:
        assert child.stdout is not None
        workers = {int(child.stdout.readline()) for _ in range(3)}
        child.kill()
        assert len(workers) == 3
    until = time.monotonic() + 60
    while any(_is_alive(worker) for worker in workers):
        assert time.monotonic() < until
        time.sleep(0.05)


def _is_alive(pid: int) -> bool:
    """False of one that is gone, or dead and not yet waited for."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_a_caller_that_ignores_its_children_changes_nothing() -> None:
    before = signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    try:
        assert list(in_order(lambda first, lo, hi: first, some(12), 12, 2)) == [0, 3, 6, 9]
    finally:
        signal.signal(signal.SIGCHLD, before)


@pytest.mark.parametrize("arguments", [
    ["--jobs", "0"], ["--jobs", "-1"], ["--jobs", "257"], ["--jobs", "two"], ["--jobs", ""], ["--part", "1/2"],
])  # fmt: skip
def test_other_options_are_usage_errors(arguments: list[str], tmp_path: Path) -> None:
    assert main([str(write(honest("scalar"), tmp_path)), *arguments]) == 2


# --------------------------------------------------------------------------------------------------- the child process


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_checker_as_a_child_takes_jobs(jobs: int, tmp_path: Path) -> None:
    assert run_checker(write(honest("rotor"), tmp_path), jobs=jobs)["result"] == "ACCEPTED"
    answer = run_checker(write(with_tree(honest("linear"), b"\xff"), tmp_path), jobs=jobs)
    assert (answer["result"], answer["rule"], answer["at"]) == ("REJECTED", "ring", "leaf 0")


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


def test_an_answer_that_nobody_hears_is_no_refusal(tmp_path: Path) -> None:
    line = checking.command("checker", [str(write(honest("scalar"), tmp_path))])
    with open("/dev/full", "wb") as full:
        assert subprocess.run(line, stdout=full, stderr=subprocess.DEVNULL, check=False).returncode == 70
    shell = f"exec {shlex.join(line)} >&-"
    assert subprocess.run(["sh", "-c", shell], stderr=subprocess.DEVNULL, check=False).returncode == 70


@pytest.mark.parametrize("count", [100, 1000, 3000])
@pytest.mark.parametrize("name", ["scalar", "outer, a network"])
def test_constraints_count_where_leaves_are_examined_together(
    name: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All values of an expression are held on all leaves of a batch: 4096 leaves made 2,000 operations a gigabyte."""
    monkeypatch.undo()  # batches as large as they are
    terms = [["*", "0", "x", ["+", "x", str(k + 1)]] for k in range(count)]
    data = edited(honest(name), "claim", lambda c: c | {"keep": [["-", ["+", *terms], "1"]]})
    data = with_tree(data, uniform([0], 13))
    if name != "scalar":
        data = edited(data, "evidence.outer.tree", data["evidence"]["tree"])
    case = Case(parse(data))
    leaves = Ring.of(case) if name == "scalar" else outer.Beyond(case)
    _, lo, _ = next(leaves.leaves())
    assert (2 if count == 100 else 1) <= lo.shape[1] <= 2**25 // (4 * count * (leaves.symbols + 1) ** 2)


PROGRAMS = ["checker", "reference"]


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_program_of_its_own_may_not_fill_the_machine(program: str) -> None:
    """8 GiB are refused to a process that is bound as `python -m` binds it; who calls `main` alone is not bound."""
    lines = ["import numpy", f"from certify.{program}.__main__ import bound_memory", "numpy.empty(2**30)"]
    for bound, status in (("", 0), ("bound_memory()", 1)):
        done = subprocess.run(
            [sys.executable, "-I", "-c", "; ".join([*lines[:2], *([bound] if bound else []), lines[2]])],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == status and ("MemoryError" in done.stderr) is bool(status), done.stderr


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_check_without_memory_ends_without_a_verdict(
    program: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fails(*arguments: Any) -> Any:
        raise MemoryError

    place, name, run = {"checker": (rules, "check", main), "reference": (second, "judge", second.main)}[program]
    monkeypatch.setattr(place, name, fails)
    path = str(write(honest("scalar"), tmp_path))
    assert run([path]) == run([path, "--json"]) == 70
    said = capsys.readouterr()
    assert "more memory than there is" in said.err and "error" in json.loads(said.out)


@pytest.mark.slow
def test_the_reference_ends_after_seconds_without_a_verdict(tmp_path: Path) -> None:
    """A true certificate of 65,536 leaves; all that is asked about, and of one leaf, needs less than a minute."""
    path = write(with_tree(honest("scalar"), uniform([0], 16)), tmp_path)
    with pytest.raises(TimeoutError, match="no verdict after 1 s"):
        run_checker(path, "reference", seconds=1)
    assert run_checker(write(honest("scalar"), tmp_path), "reference", seconds=60)["result"] == "ACCEPTED"


PACKAGE = Path(boxes.__file__).parent
CHAPTERS = {  # the core page's table: the modules that a chapter is about
    name: set(re.findall(r"`(\w+)`", modules))
    for name, modules in re.findall(
        r"^\| \[(\w+)\]\(format/\1\.md\) \| [^|]* \|([^|]*)\|$", (PACKAGE / "FORMAT.md").read_text(), re.M
    )
}
SHARED = {"sections", "clauses", "processes"}  # by several features
FEATURES = SHARED.union(*CHAPTERS.values())


def test_each_feature_has_a_chapter_and_a_page_of_the_site() -> None:
    pages = {path.stem for path in (PACKAGE / "format").glob("*.md")}
    assert pages == {*CHAPTERS, "example"}
    root = PACKAGE.parent.parent
    nav = re.findall(r"- format/(\w+)\.md$", (root / "mkdocs.yml").read_text(), re.M)
    assert set(nav) == pages == {path.stem for path in (root / "docs" / "format").glob("*.md")}
    core = len((PACKAGE / "FORMAT.md").read_text().split())
    chapters = sum(len(path.read_text().split()) for path in (PACKAGE / "format").glob("*.md"))
    assert core <= 4_200 and core + chapters <= 13_000 and len(FEATURES) > 8


def test_a_chapter_names_all_modules_that_its_own_load() -> None:
    """By what they import when they are loaded themselves."""
    imported: dict[str, set[str]] = {}
    for path in PACKAGE.glob("*.py"):
        own = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ImportFrom) and node.level]
        imported[path.stem] = {name for node in own for name in ([node.module] if node.module else _names(node))}
    for chapter, modules in CHAPTERS.items():
        assert modules == {name for module in modules for name in imported[module] & FEATURES - SHARED} | modules, (
            chapter
        )


def _names(node: ast.ImportFrom) -> list[str]:
    return [alias.name for alias in node.names]


@pytest.mark.parametrize(
    ("name", "used"),
    [
        ("rotor", set()),
        ("enlarged", {"tube", "sections"}),
        ("sampled", {"flow", "ranges", "sections", "stepping"}),
        ("outer, a network", {"outer", "sections", "wiring", "elementary", "calls"}),
    ],
)
def test_an_answer_rests_on_the_modules_that_it_needs(name: str, used: set[str], tmp_path: Path) -> None:
    answer = run_checker(write(honest(name), tmp_path), "checker")
    assert answer["result"] == "ACCEPTED"
    modules = set(json.loads(run_alone(write(honest(name), tmp_path)))["modules"])
    assert modules & FEATURES == used
    assert modules - FEATURES == {path.stem for path in PACKAGE.glob("[a-z]*.py")} - FEATURES


def test_activations_are_loaded_where_a_network_or_an_equation_has_them(tmp_path: Path) -> None:
    """Nobody else has added them to the table in a process of its own."""
    plain, bent = honest("rotor"), network_loops.honest("relu")
    rise = ["*", ["abs", ["+", "2", "x"]], ["+", ["/", "x", "4"], ["/", "u", "2"]]]
    equation = grow(with_ball(edited(scalar_claim(c2=1.0, bias=0.0), "plant.dynamics", [rise])))
    for data, known in ((plain, False), (bent, True), (equation, True)):
        answer = json.loads(run_alone(write(data, tmp_path)))
        assert answer["result"] == "ACCEPTED" and ("activations" in answer["modules"]) is known


def run_alone(path: Path) -> str:
    command = [sys.executable, "-I", "-m", "certify.checker", "--json", str(path)]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout
