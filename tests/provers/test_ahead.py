"""Boxes that are bounded elsewhere: the same search whoever bounds them, and nothing false whatever comes back."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Iterable, Sequence
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
from certify.provers.boxes import ahead, search
from certify.provers.boxes.ahead import Ahead
from certify.provers.boxes.partition import MAX_DEPTH, Partition
from certify.provers.boxes.search import Pass, RingProof, outwards, prove_inwards, prove_outwards
from certify.provers.execution import ThreadRunner, rows
from certify.provers.outer import Nothing, prove_outer
from tests.provers.test_outer import planar, wells
from tests.provers.test_steps import held, stepped, uncertain_pendulum
from tests.provers.test_vdot import cartpole_case
from tests.support.cases import case_of
from tests.support.jobs import Play, PlayedJobs, PlayedRunner, Troupe, counts_of, parts, row_of, sealed
from tests.support.loops import box, pendulum_network
from tests.support.marks import slow_after

HERE = ThreadRunner()
ADDRESS = "tcp://nowhere:1"
SMALL = Budget(batch=16, effort=Effort(60 * UNIT))
SLOW = pytest.mark.slow
DEEP = 10**6
WIDE = dataclasses.replace(get_system("pendulum"), domain=box(7, 30))  # whose level ends at a violation
CASES: dict[str, tuple[Callable[[], Any], float, float]] = {
    "two states": (lambda: case_of(get_system("pendulum"), pendulum_network()), 1e-6, 3.0),
    "four states": (cartpole_case, 2.5e-4, 7e-4),
    "uncertain": (lambda: case_of(uncertain_pendulum(), pendulum_network()), 0.02, 0.5),
    "sampled": (lambda: stepped(swung(sample=held("1/50")), pendulum_network()), 0.02, 0.5),
    "violated": (lambda: case_of(WIDE, pendulum_network()), 1e-6, 30.0),
    "any period": (lambda: stepped(swung(sample=held("1/100", "1/50")), pendulum_network()), 0.02, 0.5),
}


def swung(**more: Any) -> Any:
    return dataclasses.replace(get_system("pendulum"), **more)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs of one batch, which leave much open, as soon as there are two boxes."""
    monkeypatch.setattr(ahead, "_TURN", (0.0, 0.0))
    monkeypatch.setattr(ahead, "_FEW", 1)
    monkeypatch.setattr(ahead, "_LEAST", 4)


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


# ------------------------------------------------------------------------------------------------------ the same search

EFFORTS = (0.012, 0.05, 60.0)
MORE_EFFORTS = (0.02, 0.03, 0.04, 0.07, 0.09)
"""In units: most of these end in the middle of a ring."""
TROUPES: dict[str, Callable[[], Troupe]] = {
    "one place": lambda: Troupe(places=lambda _: 1),
    "two places": lambda: Troupe(places=lambda _: 2),
    "three places": lambda: Troupe(places=lambda _: 3),
    "any order": lambda: Troupe(places=lambda _: 3, seed=1),
    "any other order": lambda: Troupe(places=lambda _: 2, seed=2),
    "one of two is lost": lambda: Troupe(places=lambda asked: 2 if asked < 9 else 1, seed=3),
    "both are lost": lambda: Troupe(places=lambda asked: 2 if asked < 9 else 0, seed=4),
    "jobs are lost": lambda: Troupe(seed=5, play=lambda job, answer: answer if job[-1] % 2 else None),
}

FEW = ("one place", "any order", "both are lost")


def differences(
    prove: Callable[[Budget, Any], Any], names: Iterable[str] = FEW, efforts: Sequence[float] = EFFORTS
) -> tuple[list[str], set[Stop], int]:
    """Where a proof by a troupe is not the proof without one; how the latter ended; and the answers that came."""
    found, stops, answered = [], set(), 0
    for effort in efforts:
        expected = prove(Budget(batch=16, effort=Effort(effort * UNIT)), HERE)
        stops.add(expected[-1])
        for name in names:
            made = TROUPES[name]()
            if prove(Budget(batch=16, effort=Effort(effort * UNIT)), PlayedRunner(made)) != expected:
                found.append(f"{effort:g} {name}")
            answered += made.answered
    return found, stops, answered


def outwards_of(name: str) -> Callable[[Budget, Any], Any]:
    make, inner, outer = CASES[name]
    case = make()

    def prove(budget: Budget, runner: Any) -> Any:
        ring = outwards(case.problem, case.T, inner, outer, runner)
        stop = ring.advance(budget)
        proof = ring.proof(stop)
        left = budget.effort.left
        witness = None if proof.witness is None else proof.witness.level
        return proof.inner, proof.outer, proof.tree, proof.boxes, witness, ring.expected, left, proof.stop

    return prove


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW) if name == "any period" else name for name in CASES])
def test_a_proof_is_the_same_whoever_bounds_its_boxes(name: str) -> None:
    """Its levels, tree, count, effort and end, also where the effort ends in the middle of it, or a level moves."""
    found, stops, answered = differences(outwards_of(name))
    assert not found and answered > 30
    assert Stop.EFFORT in stops and len(stops) > 1 and (Stop.WITNESS in stops) == (name == "violated")


@SLOW
@pytest.mark.parametrize("name", CASES)
def test_so_it_is_whoever_comes_and_goes(name: str) -> None:
    found, _, answered = differences(outwards_of(name), TROUPES, MORE_EFFORTS)
    assert not found and answered > 30


@pytest.mark.slow
@pytest.mark.parametrize("name", ["uncertain", pytest.param("sampled", marks=SLOW)])
def test_so_it_is_on_the_way_inwards(name: str) -> None:
    make, inner, outer = CASES[name]
    case = make()

    def prove(budget: Budget, runner: Any) -> Any:
        proof = prove_inwards(case.problem, case.T, inner, outer, budget, runner)
        return proof.inner, proof.outer, proof.tree, proof.boxes, proof.covered, proof.stop

    found, stops, answered = differences(prove)
    assert not found and answered > 30 and Stop.EFFORT in stops and len(stops) > 1


@pytest.mark.slow
def test_so_it_is_of_a_set_beyond_the_ellipsoid() -> None:
    """The effort ends on a face, and in the middle of the leaves, with a smaller set."""
    problem, N = planar(), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)

    def prove(budget: Budget, runner: Any) -> Any:
        proof = prove_outer(problem, 0.25, np.eye(2), N, None, budget, runner)
        if isinstance(proof, Nothing):
            return proof.why, Stop.FLOOR
        return proof.outer.level, proof.evidence.tree, proof.evidence.faces, proof.boxes, proof.stop

    found, stops, answered = differences(prove, efforts=(0.1, 0.15, 0.3, 60.0))
    assert not found and answered > 30 and stops == {Stop.FLOOR, Stop.EFFORT, Stop.DOMAIN}


@pytest.mark.parametrize("name", ["two states", "violated"])
def test_a_pass_in_pieces_is_the_same_pass(name: str) -> None:
    """As candidates are compared: a little effort at a time, after which nothing that is out stays out."""
    make, inner, outer = CASES[name]
    case = make()
    stands_: list[list[Any]] = []
    for runner in (HERE, PlayedRunner(Troupe(seed=6))):
        ring = outwards(case.problem, case.T, inner, outer, runner)
        stands_.append([])
        while not ring.done and ring.boxes < 2000:
            ring.advance(Budget(batch=16, effort=Effort(0.01 * UNIT)))
            stands_[-1].append((ring.levels, ring.boxes, ring.expected, ring.state().tree))
    assert stands_[0] == stands_[1] and len(stands_[0]) > 5


def test_long_jobs_give_the_same_proof(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ahead, "_TURN", (60.0, 60.0))
    troupe = Troupe()
    found = proved_by(troupe)
    assert stands(found, alone()) and found.boxes == alone().boxes and 0 < troupe.answered < 10


def test_what_is_known_ahead_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where more than so many boxes are known or out, no more go out until some were asked for."""
    most: list[int] = []

    def send(self: Ahead, *args: Any) -> None:
        original(self, *args)
        most.append(len(self._known) + len(self._out))

    original = Ahead._send
    monkeypatch.setattr(Ahead, "_send", send)
    monkeypatch.setattr(ahead, "_KNOWN", 24)
    found = proved_by(Troupe(places=lambda _: 3))
    assert stands(found, alone()) and 0 < max(most) < 200


def by_arrival(name: str, patched: pytest.MonkeyPatch) -> None:
    """A search in which something hangs on what has arrived."""
    offer, step, forget = Ahead.offer, Pass._step, Ahead._forget

    def in_another_order(self: Ahead, frontier: Any, left: float) -> None:
        offer(self, frontier, left)
        known = np.array([box in self._known for box in rows.boxes_of(frontier.lo, frontier.hi)], dtype=bool)
        frontier.key = np.where(known, 0.9 * frontier.key, frontier.key)

    def another_count(self: Pass, bound: Any, *args: Any) -> None:
        step(self, bound, *args)
        self.boxes += bool(bound._known)

    def still_known(self: Ahead) -> None:
        known = getattr(self, "_known", {})
        forget(self)
        self._known = known

    if name == "order":
        patched.setattr(Ahead, "offer", in_another_order)
    elif name == "count":
        patched.setattr(Pass, "_step", another_count)
    else:
        patched.setattr(Ahead, "_forget", still_known)


@pytest.mark.parametrize(
    ("name", "case"), slow_after(1, [("order", "two states"), ("count", "sampled"), ("levels", "violated")])
)
def test_what_hangs_on_arrival_would_show(name: str, case: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The order of boxes, the count of effort, and bounds that were made for levels of before."""
    by_arrival(name, monkeypatch)
    efforts = EFFORTS[2:] if name == "levels" else EFFORTS[:2]  # a level moves late
    found, _, _ = differences(outwards_of(case), ["two places"], efforts)
    assert found


# -------------------------------------------------------------------------------------------------------------- garbage


def flipped(job: bytes, answer: bytes) -> bytes:
    """One bit, somewhere in it."""
    at = len(answer) // 3
    return answer[:at] + bytes([answer[at] ^ 1]) + answer[at + 1 :]


def told(change: Callable[[np.ndarray], None]) -> Play:
    """Rows by somebody who seals them well."""

    def play(job: bytes, answer: bytes) -> bytes:
        boxes, found, opened, keys = parts(job, answer)
        changed = np.frombuffer(found, row_of(counts_of(job)[0])).copy()
        change(changed)
        return sealed(job, boxes, changed.tobytes(), opened, keys)

    return play


def scored(value: float) -> Play:
    return told(lambda row: row["score"].fill(value))


def keyed(change: Callable[[np.ndarray], np.ndarray]) -> Play:
    def play(job: bytes, answer: bytes) -> bytes:
        boxes, found, opened, keys = parts(job, answer)
        return sealed(job, boxes, found, opened, change(keys))

    return play


def boxes_in(job: bytes) -> bytes:
    n, count = counts_of(job)
    both = np.frombuffer(job, offset=ahead._JOB.size)[: 2 * n * count].reshape(2 * n, count)
    return both.T.tobytes()


def all_open(key: float) -> Play:
    """The boxes of the job are open as they were; one was bounded that nobody asked for."""

    def play(job: bytes, answer: bytes) -> bytes:
        n, count = counts_of(job)
        return sealed(job, bytes(16 * n), bytes(row_of(n).itemsize), boxes_in(job), np.full(count, key))

    return play


def counted(bounded: int, opened: int) -> Play:
    def play(job: bytes, answer: bytes) -> bytes:
        return rows.sealed(job, ahead._COUNTS.pack(bounded, opened) + rows.unsealed(job, answer)[ahead._COUNTS.size :])

    return play


def of_another_version(job: bytes, answer: bytes) -> bytes:
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(rows, "_sources", lambda: b"those of before")
        return rows.sealed(job, answer[rows._SEAL :])


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
    "another version's": of_another_version,
    "another job's": of_another_job,
    "the job itself": lambda job, answer: job,
    "noise": lambda job, answer: np.random.default_rng(len(job)).bytes(len(answer)),
    "an empty body": lambda job, answer: rows.sealed(job, b""),
    "no box": lambda job, answer: sealed(job, b"", b"", b"", np.zeros(0)),
    "more boxes than bytes": counted(2**63, 0),
    "more open than bytes": counted(1, 2**60),
    "keys that are no numbers": keyed(lambda keys: np.full_like(keys, math.nan)),
    "scores that are no numbers": scored(math.nan),
    "all open": all_open(0.0),
    "all open, with keys below all": all_open(-math.inf),
}


@pytest.mark.parametrize("name", slow_after(4, GARBAGE))
def test_garbage_changes_nothing(name: str) -> None:
    """The second answer, the fourth and so on are garbage: their boxes are bounded here, and the proof is the same."""
    troupe = Troupe()
    troupe.play = lambda job, answer: GARBAGE[name](job, answer) if troupe.answered % 2 else answer
    begin = time.monotonic()
    found = proved_by(troupe)
    assert stands(found, alone()) and found.boxes == alone().boxes
    accepted_ = name in ("nothing", "all open", "all open, with keys below all")
    assert (troupe.refused >= 1) is not accepted_ and troupe.answered > 3
    assert time.monotonic() - begin < 20


@pytest.mark.parametrize("name", ["nothing", "zero length", "all open"])
def test_who_never_answers_well_is_of_no_use_and_no_harm(name: str) -> None:
    troupe = Troupe(play=GARBAGE[name])
    assert stands(proved_by(troupe), alone()) and troupe.answered > 3


def test_a_job_without_an_answer_is_done_here_in_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    class Silent(PlayedJobs):
        def ended(self, seconds: float) -> list[tuple[int, bytes | None]]:
            return []

    monkeypatch.setattr("tests.support.jobs.PlayedJobs", Silent)
    monkeypatch.setattr(ahead, "_LATE", 0.0)
    troupe, case = Troupe(), pendulum()
    found = prove_outwards(case.problem, case.T, 1e-6, 3.0, SMALL, PlayedRunner(troupe))
    assert stands(found, alone()) and troupe.given > 3 and troupe.forgotten == troupe.given


def test_a_row_is_what_was_bounded_bit_for_bit() -> None:
    case = pendulum()
    ring = outwards(case.problem, case.T, 1e-6, 3.0, HERE)
    lo, hi = -ring.half * np.array([[1.0, 0.5, 1.0]]), ring.half * np.array([[1.0, 0.25, 0.0]])
    found = ring.rule(lo, hi, 1e-6, 3.0)
    found.bound[1], found.score[0, 1] = math.nan, -0.0
    layout = rows.Layout.of(found)
    again = layout.read(layout.write(found))
    assert type(again) is type(found)
    for one, other in zip(found, again, strict=True):
        assert one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    boxes = rows.boxes_of(lo, hi)
    assert [side.tobytes() for side in rows.corners_of(boxes, 2)] == [lo.tobytes(), hi.tobytes()]
    assert row_of(2) == layout.row


@given(st.integers(0, 2**32 - 1), st.integers(1, 3))
def test_a_graft_that_is_refused_leaves_the_partition_as_it_was(seed: int, n: int) -> None:
    """Random bytes, most of them nearly a tree: a partition takes all of them in or nothing."""
    generator = np.random.default_rng(seed)
    partition = Partition(np.ones(n))
    nodes: list[int] = []
    open_ = 1
    while open_ and len(nodes) < 60:
        nodes.append(int(generator.choice([int(generator.integers(0, n + 1)), 254, 255], p=[0.4, 0.2, 0.4])))
        open_ += 1 if nodes[-1] < 254 else -1
    tree = bytes(nodes) + bytes(generator.integers(0, 256, int(generator.integers(0, 2)), dtype=np.uint8))
    before = partition.preorder()
    try:
        opened = partition.graft(tree)
    except CertificateFormatError:
        assert partition.preorder() == before and partition.splits == 0
        return
    assert partition.preorder([(254, opened.number)]) == tree
    lo, hi = partition.corners(opened.number)
    assert np.array_equal(lo, opened.lo) and np.array_equal(hi, opened.hi)


def test_a_chain_is_as_deep_as_a_certificate_may_be_and_no_deeper() -> None:
    leaf = b"\xff"
    for depth, fits in ((MAX_DEPTH, True), (MAX_DEPTH + 1, False)):
        for chain_ in (b"\0" * depth + leaf * (depth + 1), (b"\0" + leaf) * depth + leaf):
            partition = Partition(np.ones(1))
            if fits:
                partition.graft(chain_)
            else:
                with pytest.raises(CertificateFormatError, match="deeper"):
                    partition.graft(chain_)
            assert partition.splits == (depth if fits else 0)


# ----------------------------------------------------------------------------------------------------------------- lies


LIES: dict[str, Play] = {
    "all is proved": told(lambda row: row["proved"].fill(1)),
    "all is violated": told(lambda row: row["violated"].fill(1)),
    "nothing is proved": told(lambda row: row["proved"].fill(0)),
    "scores without an end": scored(math.inf),
    "what is open lies below all": keyed(lambda keys: np.full_like(keys, -math.inf)),
    "what is open lies beyond all": keyed(lambda keys: np.full_like(keys, math.inf)),
}


def certified(folder: Path, troupe: Troupe, monkeypatch: pytest.MonkeyPatch, **more: Any) -> RoaResult:
    """A run of the pipeline whose cluster is the troupe."""

    class Told(PlayedRunner):
        remark = "told"

    monkeypatch.setattr("certify.analysis.run.runner_at", lambda *_: nullcontext(Told(troupe)))
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


@pytest.mark.parametrize("effort", [0.004, 0.24])
def test_a_run_has_the_same_certificate(effort: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From its candidates to its file, also where the effort ends in the middle of the ring."""
    for place in ("certify.analysis.stages.candidate", "certify.analysis.stages.ring", "certify.analysis.selection"):
        monkeypatch.setattr(f"{place}.Budget", partial(Budget, batch=16))
    expected = certify_roa(WIDE, pendulum_network(), tmp_path / "alone", RoaOptions(Q=(1.0, 1.0), effort=effort))
    troupe = Troupe(places=lambda _: 3, seed=7)
    found = certified(tmp_path / "shared", troupe, monkeypatch, effort=effort)
    assert expected.stop is found.stop is (Stop.WITNESS if effort > 0.2 else Stop.EFFORT) and troupe.answered > 3
    assert found.verdict is expected.verdict and found.levels == expected.levels and found.boxes == expected.boxes
    files = [json.loads(each.certificate.read_text()) for each in (expected, found) if each.certificate is not None]
    for file in files:
        file.pop("provenance", None)
    assert len(files) == 2 and files[0] == files[1]


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
    if name.startswith("what is open"):  # an order that nothing hangs on
        assert found.levels == expected.levels


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


def test_a_set_beyond_the_ellipsoid_ends_with_workers_that_leave_all_open() -> None:
    """When its boxes are spent a cover goes on until nothing is open, without an end in time: it must come to one."""
    problem, N = planar(), wells([[1.0, 0.0], [-0.5, 0.875], [-0.5, -0.875]], 0.75)
    for play in (GARBAGE["all open"], GARBAGE["nothing"]):
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
    assert stands(found, alone()) and found.boxes == alone().boxes
    assert (troupe.answered > 0) is any(places(k) for k in range(1, 10))


# ------------------------------------------------------------------------------------------------ the scheduler is gone


@pytest.mark.parametrize("answers", [0, 1, 3, 6])
def test_a_scheduler_that_goes_takes_nothing_with_it(answers: int) -> None:
    case, troupe = pendulum(), Troupe(lost_after=answers)
    ring = outwards(case.problem, case.T, 1e-6, 3.0, PlayedRunner(troupe))
    assert ring.advance(SMALL) is Stop.CLUSTER and "tcp://nowhere:1" in ring.lost
    assert not ring.done
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
        options = RoaOptions(resume=True, candidate="ellipsoid", effort=0.24)
        end = certify_roa(WIDE, pendulum_network(), tmp_path, options)
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
