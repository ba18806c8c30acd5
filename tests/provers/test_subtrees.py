"""Boxes that are grown elsewhere: the same tree whoever grows it, and nothing false whatever comes back."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from certify.analysis.results import RoaResult
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import run_checker
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.errors import BackendError, CertificateFormatError
from certify.loop.plants import get_system
from certify.provers.base import Budget
from certify.provers.boxes import search, subtrees
from certify.provers.boxes.partition import MAX_DEPTH, Partition
from certify.provers.boxes.search import Pass, RingProof, outwards, prove_inwards, prove_outwards
from certify.provers.execution import ThreadRunner
from certify.provers.outer import Nothing, OuterProof, prove_outer
from tests.provers.test_outer import planar, wells
from tests.provers.test_steps import held, stepped, uncertain_pendulum
from tests.provers.test_vdot import cartpole_case
from tests.support.cases import case_of
from tests.support.jobs import LEAF, LOOK, OPEN, Play, PlayedJobs, PlayedRunner, Troupe, boxes_of, parts, sealed
from tests.support.loops import box, chain, pendulum_network
from tests.support.marks import slow_after

HERE = ThreadRunner()
ADDRESS = "tcp://nowhere:1"
SMALL = Budget(batch=16, effort=Effort(60 * UNIT))
SLOW = pytest.mark.slow
DEEP = 10**6
WIDE = dataclasses.replace(get_system("pendulum"), domain=box(7, 30))  # whose level ends at a violation
CASES: dict[str, tuple[Callable[[], Any], float, float]] = {
    "two states": (lambda: case_of(get_system("pendulum"), pendulum_network()), 1e-6, 3.0),
    "three states": (lambda: case_of(*chain(3, [-1, -2, -3])), 1e-3, 1e-2),
    "four states": (cartpole_case, 2.5e-4, 1e-3),
    "uncertain": (lambda: case_of(uncertain_pendulum(), pendulum_network()), 0.02, 0.5),
    "sampled": (lambda: stepped(swung(sample=held("1/50")), pendulum_network()), 0.02, 0.5),
    "any period": (lambda: stepped(swung(sample=held("1/100", "1/50")), pendulum_network()), 0.02, 0.5),
}


def swung(**more: Any) -> Any:
    return dataclasses.replace(get_system("pendulum"), **more)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs of one batch, which leave much open, as soon as there are two boxes."""
    monkeypatch.setattr(subtrees, "_TURN", (0.0, 0.0))
    monkeypatch.setattr(subtrees, "_FEW", 1)
    monkeypatch.setattr(subtrees, "_LEAST", 4)


@cache
def pendulum() -> Any:
    return CASES["two states"][0]()


def proved_by(troupe: Troupe, budget: Budget = SMALL) -> RingProof:
    case = pendulum()
    return prove_outwards(case.problem, case.T, 1e-6, 3.0, budget, PlayedRunner(troupe))


@cache
def alone() -> RingProof:
    case = pendulum()
    return prove_outwards(case.problem, case.T, 1e-6, 3.0, SMALL, HERE)


def stands(proof: RingProof, other: RingProof) -> bool:
    """Whether two proofs have the same levels and the very same tree."""
    return (proof.inner, proof.outer, proof.tree) == (other.inner, other.outer, other.tree)


# -------------------------------------------------------------------------------------------------------- the same tree


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=SLOW) if name in ("four states", "any period") else name for name in CASES]
)
def test_the_tree_is_the_same_whoever_grows_it(name: str) -> None:
    make, inner, outer = CASES[name]
    case, troupe = make(), Troupe(places=lambda _: 3)
    expected = prove_outwards(case.problem, case.T, inner, outer, SMALL, HERE)
    found = prove_outwards(case.problem, case.T, inner, outer, SMALL, PlayedRunner(troupe))
    assert stands(found, expected) and found.outer == outer
    assert found.boxes == expected.boxes and troupe.answered >= 1 and not troupe.refused


def test_so_it_is_on_the_way_inwards() -> None:
    case, troupe = CASES["uncertain"][0](), Troupe()
    expected = prove_inwards(case.problem, case.T, 0.02, 0.5, SMALL, HERE)
    found = prove_inwards(case.problem, case.T, 0.02, 0.5, SMALL, PlayedRunner(troupe))
    assert stands(found, expected) and found.covered and found.inner == 0.02 and troupe.answered > 3


def test_so_it_is_of_a_set_beyond_the_ellipsoid() -> None:
    problem, N, troupe = planar(), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75), Troupe()
    level = -2.4
    expected, found = (
        prove_outer(problem, 0.25, np.eye(2), N, level, Budget(batch=16), runner)
        for runner in (HERE, PlayedRunner(troupe))
    )
    assert isinstance(expected, OuterProof) and isinstance(found, OuterProof) and troupe.answered > 3
    assert expected.outer.level == found.outer.level == level
    assert expected.evidence.tree == found.evidence.tree and expected.evidence.faces == found.evidence.faces


def test_long_jobs_give_the_same_tree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subtrees, "_TURN", (60.0, 60.0))
    troupe = Troupe()
    assert stands(proved_by(troupe), alone()) and troupe.answered < 10


# -------------------------------------------------------------------------------------------------------------- garbage


def flipped(job: bytes, answer: bytes) -> bytes:
    """One bit of the trees."""
    at = subtrees._ANSWER.size + len(answer[subtrees._ANSWER.size :]) // 3
    return answer[:at] + bytes([answer[at] ^ 1]) + answer[at + 1 :]


def lying(boxes: int, proved: int) -> Play:
    def play(job: bytes, answer: bytes) -> bytes:
        _, trees, keys = parts(answer)
        return sealed(job, boxes, proved, trees, keys)

    return play


def grown(trees: Callable[[int, int], bytes], key: float = 0.0) -> Play:
    """Trees by somebody who seals them well, with one key for all."""

    def play(job: bytes, answer: bytes) -> bytes:
        made = trees(*boxes_of(job))
        keys = np.full(made.count(OPEN), key)
        return sealed(job, min(1, len(made)), 0, made, keys)

    return play


last: dict[str, bytes] = {}


def of_another_job(job: bytes, answer: bytes) -> bytes:
    before = last.get("answer", b"")
    last["answer"] = answer
    return before


GARBAGE: dict[str, Play] = {
    "nothing": lambda job, answer: None,
    "zero length": lambda job, answer: b"",
    "cut off": lambda job, answer: answer[:-1],
    "cut in the head": lambda job, answer: answer[:20],
    "too long": lambda job, answer: answer + b"\0",
    "a flipped bit": flipped,
    "another format": lambda job, answer: b"subtree2" + answer[8:],
    "another job's": of_another_job,
    "the job itself": lambda job, answer: job,
    "noise": lambda job, answer: np.random.default_rng(len(job)).bytes(len(answer)),
    "boxes that were not bounded": lying(2**63, 0),
    "more proved than bounded": lying(1, 2),
    "more proved than leaves": lying(5, 2**40),
    "no trees": grown(lambda n, count: b""),
    "one tree too few": grown(lambda n, count: LEAF * (count - 1)),
    "one tree too many": grown(lambda n, count: LEAF * (count + 1)),
    "a tree without its end": grown(lambda n, count: LEAF * (count - 1) + b"\0" + LEAF),
    "an axis that does not exist": grown(lambda n, count: LEAF * (count - 1) + bytes([n]) + 2 * LEAF),
    "keys that are no numbers": grown(lambda n, count: OPEN + LEAF * (count - 1), math.nan),
    "a chain of lower halves": grown(lambda n, count: LEAF * (count - 1) + b"\0" * DEEP + LEAF * (DEEP + 1)),
    "a chain of upper halves": grown(lambda n, count: LEAF * (count - 1) + (b"\0" + LEAF) * DEEP + LEAF),
    "finer than it may be": grown(lambda n, count: LEAF * (count - 1) + (b"\0" + LEAF) * 60 + LEAF),
    "all open": grown(lambda n, count: OPEN * count),
    "all open, with keys below all": grown(lambda n, count: OPEN * count, -math.inf),
}


@pytest.mark.parametrize("name", slow_after(4, GARBAGE))
def test_garbage_changes_nothing(name: str) -> None:
    """The second answer, the fourth and so on are garbage: these jobs are done here, and the tree is what it was."""
    troupe = Troupe()

    def play(job: bytes, answer: bytes) -> bytes | None:
        turn = troupe.answered == 1 if name.startswith("a chain") else troupe.answered % 2 == 1
        return GARBAGE[name](job, answer) if turn else answer

    troupe.play = play
    begin = time.monotonic()
    found = proved_by(troupe)
    assert stands(found, alone()) and found.boxes == alone().boxes
    assert troupe.refused >= (name != "nothing") and troupe.answered > 3
    assert time.monotonic() - begin < 20


@pytest.mark.parametrize("name", ["nothing", "zero length", "all open"])
def test_who_never_answers_well_is_of_no_use_and_no_harm(name: str) -> None:
    troupe = Troupe(play=GARBAGE[name])
    assert stands(proved_by(troupe), alone())


def test_a_job_without_an_answer_is_done_here_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(PlayedJobs):
        def ended(self, seconds: float) -> list[tuple[int, bytes | None]]:
            return []

    monkeypatch.setattr("tests.support.jobs.PlayedJobs", Silent)
    monkeypatch.setattr(subtrees, "_LATE", 0.0)
    troupe, case = Troupe(), pendulum()
    found = prove_outwards(case.problem, case.T, 1e-6, 3.0, SMALL, PlayedRunner(troupe))
    assert stands(found, alone()) and troupe.given > 3 and troupe.forgotten == troupe.given


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 4))
def test_a_graft_that_is_refused_leaves_the_partition_as_it_was(seed: int, n: int, count: int) -> None:
    """Random bytes, most of them nearly trees: a partition takes all of them in or nothing."""
    generator = np.random.default_rng(seed)
    root = np.ones((n, count))
    partition = Partition(root)
    numbers = np.arange(count, dtype=np.int64)
    nodes: list[int] = []
    open_ = count
    while open_ and len(nodes) < 60:
        nodes.append(int(generator.choice([generator.integers(0, n + 1), 253, 254, 255], p=[0.3, 0.1, 0.2, 0.4])))
        open_ += 1 if nodes[-1] < 253 else -1
    trees = bytes(nodes) + bytes(generator.integers(0, 256, int(generator.integers(0, 2)), dtype=np.uint8))
    before = partition.preorder()
    try:
        opened, looked = partition.graft(numbers, -root, root.copy(), trees, np.full(n, 0.2))
    except CertificateFormatError:
        assert partition.preorder() == before and partition.splits == 0
        return
    marks = [(254, opened.number), (253, looked.number)]
    assert partition.preorder(marks) == trees
    for grafted in (opened, looked):
        lo, hi = partition.corners(grafted.number)
        assert np.array_equal(lo, grafted.lo) and np.array_equal(hi, grafted.hi)
        assert not grafted.number.size or (hi - lo).min() >= 0.2


def test_a_chain_is_as_deep_as_a_certificate_may_be_and_no_deeper() -> None:
    one = np.zeros(1, dtype=np.int64)
    for depth, fits in ((MAX_DEPTH, True), (MAX_DEPTH + 1, False)):
        for chain_ in (b"\0" * depth + LEAF * (depth + 1), (b"\0" + LEAF) * depth + LEAF):
            partition = Partition(np.ones(1))
            if fits:
                partition.graft(one, -np.ones((1, 1)), np.ones((1, 1)), chain_)
            else:
                with pytest.raises(CertificateFormatError, match="deeper"):
                    partition.graft(one, -np.ones((1, 1)), np.ones((1, 1)), chain_)
            assert partition.splits == (depth if fits else 0)


# ----------------------------------------------------------------------------------------------------------------- lies


def nothing_done(job: bytes, answer: bytes) -> bytes:
    """One box of the job is split, the others are open as they were: as little as passes for an answer."""
    _, count = boxes_of(job)
    return sealed(job, 1, 0, b"\0" + OPEN * (count + 1), np.full(count + 1, -math.inf))


def keyed(change: Callable[[np.ndarray], np.ndarray]) -> Play:
    def play(job: bytes, answer: bytes) -> bytes:
        (boxes, proved, _, _), trees, keys = parts(answer)
        return sealed(job, boxes, proved, trees, change(keys))

    return play


LIES: dict[str, Play] = {
    "all is proved": lambda job, answer: sealed(job, boxes_of(job)[1], boxes_of(job)[1], LEAF * boxes_of(job)[1]),
    "what is open lies beyond all": keyed(lambda keys: np.full_like(keys, math.inf)),
    "what is open is a thousand times higher": keyed(lambda keys: keys * 1000),
    "what is open lies below all": keyed(lambda keys: np.full_like(keys, -math.inf)),
    "look at all": lambda job, answer: sealed(job, boxes_of(job)[1], 0, LOOK * boxes_of(job)[1]),
}


def certified(folder: Path, troupe: Troupe, monkeypatch: pytest.MonkeyPatch, **more: Any) -> RoaResult:
    """A run of the pipeline whose cluster is the troupe."""

    class Told(PlayedRunner):
        remark = "told"

    monkeypatch.setattr("certify.analysis.run._runner_for", lambda *_: nullcontext(Told(troupe)))
    resume = more.get("resume", False)
    options = RoaOptions(cluster=ADDRESS, **({} if resume else {"Q": (1.0, 1.0)}) | {"effort": 0.24} | more)
    return certify_roa(WIDE, pendulum_network(), folder, options)


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> RoaResult:
    """The same without a cluster."""
    folder = tmp_path_factory.mktemp("honest")
    return certify_roa(WIDE, pendulum_network(), folder, RoaOptions(Q=(1.0, 1.0), effort=0.24))


def accepted(result: RoaResult) -> bool:
    return result.certificate is not None and run_checker(result.certificate)["result"] == "ACCEPTED"


@pytest.mark.parametrize("name", [name if name == "all is proved" else pytest.param(name, marks=SLOW) for name in LIES])
def test_a_lie_never_makes_a_larger_set(
    name: str, honest: RoaResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = honest
    assert expected.stop is Stop.WITNESS  # there is a violation to lie about
    troupe = Troupe(play=LIES[name])
    found = certified(tmp_path / "lies", troupe, monkeypatch)
    assert expected.verdict is found.verdict is Verdict.PROVED and troupe.answered
    assert expected.levels.roa is not None and found.levels.roa is not None and accepted(found)
    assert found.levels.roa <= expected.levels.roa * 1.002
    if name == "all is proved":
        assert found.stop is Stop.REFUSED and found.levels.roa < expected.levels.roa
        assert ADDRESS in (found.notice or "") and "may be at fault" in (found.notice or "")
    if name in ("what is open lies below all", "look at all"):
        assert found.levels.roa >= expected.levels.roa * 0.99


@SLOW
def test_a_level_that_was_asked_for_is_not_had_by_lying(
    honest: RoaResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Above a violation that sampling did not find: the claim is false, and no worker's word makes it PROVED."""
    assert honest.levels.sampled_limit is not None
    monkeypatch.setattr("certify.analysis.candidates.trials.falsify", lambda *args, **more: None)
    troupe = Troupe(play=LIES["all is proved"])
    found = certified(tmp_path, troupe, monkeypatch, level=1.01 * honest.levels.sampled_limit, Q=None)
    assert found.verdict is Verdict.UNKNOWN and found.stop is Stop.REFUSED and troupe.answered


@SLOW
def test_what_cannot_be_mended_is_not_called_a_fault_of_this_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certify.analysis.acceptance._lowered", lambda *args: None)
    with pytest.raises(BackendError, match=f"workers of {ADDRESS}, who may be at fault") as told:
        certified(tmp_path, Troupe(play=LIES["all is proved"]), monkeypatch)
    assert "run without the cluster" in str(told.value)
    assert not (tmp_path / "certificate.json").exists() and list(tmp_path.glob("*.unchecked.json"))


def test_a_worker_that_hardly_works_does_not_outlive_the_time() -> None:
    begin, troupe = time.monotonic(), Troupe(play=nothing_done)
    found = proved_by(troupe, Budget(batch=16, effort=Effort(1 * UNIT)))
    assert time.monotonic() - begin < 10 and troupe.answered > 3
    assert stands(found, alone()) or found.outer <= 3.0


def test_looking_at_everything_comes_to_an_end() -> None:
    """Where a job is only to be looked at, all is bounded here, and the tree is what it was."""
    found = proved_by(Troupe(play=LIES["look at all"]))
    assert stands(found, alone())


def test_a_set_beyond_the_ellipsoid_ends_with_workers_that_leave_all_open() -> None:
    """When its boxes are spent a cover goes on until nothing is open, without an end in time: it must come to one."""
    problem, N = planar(), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)
    for play in (GARBAGE["all open"], LIES["look at all"], GARBAGE["nothing"]):
        troupe = Troupe(play=play)
        budget = Budget(batch=4, boxes=150)
        found = prove_outer(problem, 0.25, np.eye(2), N, -2.4, budget, PlayedRunner(troupe))
        assert troupe.answered and (isinstance(found, Nothing) or found.outer.level <= -2.4)


# ----------------------------------------------------------------------------------------------------- coming and going


@pytest.mark.parametrize(
    "places",
    [
        lambda asked: 0,
        lambda asked: 0 if asked < 8 else 2,
        lambda asked: 2 if asked < 5 else 0,
        lambda asked: 2 * (asked // 5 % 2),
        lambda asked: (asked * 7919) % 4,
    ],
    ids=["nobody", "somebody comes late", "all leave", "by turns", "at random"],
)
def test_places_come_and_go(places: Callable[[int], int]) -> None:
    troupe = Troupe(places=places)
    found = proved_by(troupe)
    assert stands(found, alone()) and found.boxes >= alone().boxes
    assert (troupe.answered > 0) is any(places(k) for k in range(1, 10))


def test_boxes_that_are_out_come_back_when_a_heat_ends() -> None:
    """A pass in pieces, some of whose boxes are out at each end, is the pass in one."""
    case, troupe = pendulum(), Troupe()
    ring = outwards(case.problem, case.T, 1e-6, 3.0, PlayedRunner(troupe))
    while not ring.done:
        before = ring.boxes
        assert ring.advance(Budget(boxes=40, batch=16)) in (Stop.BOXES, None)
        assert ring.abroad is None and ring.boxes > before
    assert stands(ring.proof(), alone()) and troupe.forgotten


# ------------------------------------------------------------------------------------------------ the scheduler is gone


@pytest.mark.parametrize("answers", [0, 1, 3, 6])
def test_a_scheduler_that_goes_takes_nothing_with_it(answers: int) -> None:
    case, troupe = pendulum(), Troupe(lost_after=answers)
    ring = outwards(case.problem, case.T, 1e-6, 3.0, PlayedRunner(troupe))
    assert ring.advance(SMALL) is Stop.CLUSTER and "tcp://nowhere:1" in ring.lost
    assert not ring.done and ring.abroad is None
    state = ring.state()
    other = outwards(case.problem, case.T, 1e-6, 3.0, HERE)
    other.restore(state)
    assert other.advance(SMALL) is None and stands(other.proof(), alone())
    assert ring.advance(SMALL) is None and stands(ring.proof(), alone())  # a pass that lost one goes on here


def test_so_it_is_of_a_set_inwards_and_beyond() -> None:
    case = CASES["uncertain"][0]()
    found = prove_inwards(case.problem, case.T, 0.02, 0.5, SMALL, PlayedRunner(Troupe(lost_after=9)))
    assert found.stop is Stop.CLUSTER and found.covered and (0.02 <= found.inner < 0.5 or found.inner == found.outer)
    problem, N = planar(), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)
    troupe = Troupe(lost_after=8)
    outer = prove_outer(problem, 0.25, np.eye(2), N, -2.4, Budget(batch=16), PlayedRunner(troupe))
    assert isinstance(outer, Nothing) or outer.outer.level <= -2.4


@pytest.mark.parametrize(("answers", "again"), slow_after(1, [(6, False), (0, False), (2, True)]))
def test_a_run_that_lost_its_cluster_is_gone_on_with(
    answers: int, again: bool, honest: RoaResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is proved so far is accepted and the search kept; resumed, with a cluster or without, it comes to its
    end."""
    for place in ("certify.analysis.stages.candidate", "certify.analysis.stages.ring", "certify.analysis.selection"):
        monkeypatch.setattr(f"{place}.Budget", partial(Budget, batch=16))
    monkeypatch.setattr("certify.analysis.stages.candidate._HEAT", 1e-9)
    troupe = Troupe(lost_after=answers)
    found = certified(tmp_path, troupe, monkeypatch)
    assert found.verdict is Verdict.PROVED and found.stop is Stop.CLUSTER and accepted(found)
    assert found.search is not None and "told" in (found.notice or "") and troupe.answered >= answers
    if again:
        end = certified(tmp_path, Troupe(), monkeypatch, resume=True)
    else:
        end = certify_roa(WIDE, pendulum_network(), tmp_path, RoaOptions(resume=True, effort=0.24))
    assert end.verdict is Verdict.PROVED and end.search is None and accepted(end)
    assert end.levels.roa is not None and honest.levels.roa is not None and found.levels.roa is not None
    assert end.levels.roa >= found.levels.roa
    assert end.levels.roa == pytest.approx(honest.levels.roa, rel=2e-3)


# ------------------------------------------------------------------------------------------------------------ cut short


class Cut(Exception):
    """Like Ctrl-C, where a test wants it."""


@pytest.mark.parametrize("after", [2, 8])
@pytest.mark.parametrize("abroad", [False, True])
@pytest.mark.parametrize("where", ["levels", "split", "add"])
def test_what_is_cut_short_leaves_every_box_where_it_was(
    after: int, abroad: bool, where: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A step that ends in the middle is no step: a search that is kept then holds every box that is open."""
    case = pendulum()
    ring = outwards(case.problem, case.T, 1e-6, 3.0, PlayedRunner(Troupe()) if abroad else HERE)
    calls = 0

    def counted(function: Any) -> Any:
        def call(*args: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls == after:
                raise Cut
            return function(*args)

        return call

    with monkeypatch.context() as patched:
        if where == "levels":
            patched.setattr(type(ring.rule), "levels", counted(type(ring.rule).levels))
        elif where == "split":
            patched.setattr(Partition, "split", counted(Partition.split))
        else:
            patched.setattr(search.Frontier, "add", counted(search.Frontier.add))
        try:
            ring.advance(SMALL)
        except Cut:
            assert not ring.done
    state = ring.state()
    kept = np.frombuffer(state.tree, dtype=np.uint8)
    assert (kept == 254).sum() == len(state.keys)
    other: Pass = outwards(case.problem, case.T, 1e-6, 3.0, HERE)
    other.restore(state)
    assert other.advance(SMALL) is None and stands(other.proof(), alone())
