"""The bounds engine: local proof, ring, and for practical stability the smallest level that a ring can start from."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import PartitionTree
from certify.certificates.claims import Asymptotic, Claim, Practical, Problem
from certify.certificates.verdict import Stop
from certify.effort import UNLIMITED, Effort
from certify.errors import InputError
from certify.provers.ball.local import corners_in_a_period, local_ball, prove_band, prove_local
from certify.provers.ball.models import meets_corner, paths
from certify.provers.base import FEW, MANY, Attempt, Budget, Engine, Once, Proof, Report, SearchState, Task
from certify.provers.boxes.search import Pass, RingProof, empty_ring, outwards, prove_inwards, prove_outwards
from certify.provers.execution import Runner
from certify.provers.falsify import Band, Witness, survey

Array = NDArray[np.float64]
_SHARE = 0.6  # share of the effort for finding c2 before c0
_FOR_BALL = 0.5  # share of the effort for a ring from a ball, and of that for the ball
_EQUAL = 0.01  # share of a level
_NOTHING = 1e-9  # share of a level: no smaller floor is looked for
_ABOVE = (1.5, 1.1)  # factors of the least floor, in few and in many states, where leaves do not lower it any more
_BESIDE = (0.0, 1e-3)  # shares of the ball's level that a floor may have, in few and in many states
_TRIES = 4  # inner levels from which c2 is looked for, each with half of the effort that is left


class BoundsEngine(Engine):
    """Branch and bound in the coordinates `x = T z`, T (n, n), on a runner.

    An attempt begins with the largest local level that `first`, an effort, finds.
    """

    def __init__(self, T: Array, runner: Runner, first: Effort = UNLIMITED) -> None:
        self.T, self.runner, self.first = T, runner, first

    def begin(self, task: Task) -> Attempt:
        """An attempt at the largest c2 up to the task's target; with claim `practical`, at the smallest c0 for it."""
        if task.kind == "asymptotic":
            return _Outwards(self, task)
        return Once(lambda budget, report: self._practical(task, budget, report))

    def _practical(self, task: Task, budget: Budget, report: Report | None) -> Proof:
        """The better of two: a ring from a ball around a level, and in few states one carried by leaves alone."""
        start = time.perf_counter()
        whole, alone = budget.effort.left, self.T.shape[0] > FEW
        for_ball = budget.effort.share(1.0 if alone else _FOR_BALL)
        first = self._from_ball(task, replace(budget, effort=for_ball), report)
        if task.exactly and first is not None and first.claim is not None and first.claim.roa < task.target:
            first = None
        if first is not None and _is_ample(first, task.target):
            return first
        if alone:
            why = _corner_in_a_period(task.problem) or "no ball shows V to fall around any level; try another P"
            return first or Proof(None, None, Stop.LOCAL, why)
        if first is not None and budget.effort.left < _FOR_BALL * whole:
            return first
        second = self._by_leaves(task, budget, report)
        found = second if first is None or _is_better(second, first) else first
        return replace(found, seconds={"ring": time.perf_counter() - start})

    def _from_ball(self, task: Task, budget: Budget, report: Report | None) -> Proof | None:
        """A ring that grows from the ball whose floor is about the least; None without such a ball."""
        start = time.perf_counter()
        many = len(self.T) > FEW
        effort, above, beside = budget.effort.share(_FOR_BALL), _ABOVE[many], _BESIDE[many]
        found = prove_band(task.problem, self.T, task.target, effort=effort, above=above, beside=beside)
        if found is None:
            return None
        (floor, inner), stop = found, None
        if inner < task.target and (task.exactly or len(self.T) <= MANY):
            grown = outwards(task.problem, self.T, inner, task.target, self.runner)
            stop = grown.advance(budget, report)
            ring = grown.proof(stop)
        else:
            ring = empty_ring(task.problem, self.T, inner)
            stop = None if inner >= task.target else Stop.EFFORT
        claim = Practical(roa=ring.outer, local=inner, floor=floor, **_beside(task.problem))
        return self.stated(task.problem, ring, claim, {"ring": time.perf_counter() - start})

    def _by_leaves(self, task: Task, budget: Budget, report: Report | None) -> Proof:
        """The bands of a survey in turn, the highest first, until one holds a proof."""
        start = time.perf_counter()
        bands = survey(task.problem, self.T, task.target, effort=budget.effort)
        if task.exactly:
            bands = [band for band in bands if band.top >= task.target]
        where = "near" if task.exactly else "around"
        plain = not (task.problem.rate or task.problem.loop.system.in_steps)
        what = "Vdot >= 0" if plain else "a V that does not fall enough"
        why = f"{what} or an input out of bounds was sampled {where} every level"
        found = Proof(None, None, Stop.FLOOR, why)
        for k, band in enumerate(bands):
            share = budget.effort.share(1.0 if k == len(bands) - 1 else 0.5)
            proof = self._in_band(task, band, replace(budget, effort=share), report)
            found = proof if k == 0 or proof.claim is not None else found
            if proof.claim is not None:
                break
        return replace(found, seconds={"ring": time.perf_counter() - start})

    def _in_band(self, task: Task, band: Band, budget: Budget, report: Report | None) -> Proof:
        """The largest c2, then the smallest c0 for it, from levels between which no violation was sampled."""
        outer, stop, witness = task.target, Stop.REQUESTED, None
        if not task.exactly:
            outer, stop, witness = self._outer_level(
                task, band, replace(budget, effort=budget.effort.share(_SHARE)), report
            )
        ring = prove_inwards(task.problem, self.T, band.below, outer, budget, self.runner, report)
        if not ring.inner < ring.outer:
            why = f"no ring below V = {outer:.6g} is proved"
            return Proof(None, None, _cut_short(ring) or Stop.FLOOR, why, boxes=ring.boxes)
        if not ring.covered:
            why = f"F and its inputs are not enclosed on all of V <= {ring.inner:.6g}"
            return Proof(None, None, _cut_short(ring) or Stop.SMOOTH, why, boxes=ring.boxes)
        claim = Practical(roa=ring.outer, local=ring.inner, floor=ring.inner, **_beside(task.problem))
        stop = Stop.CLUSTER if ring.stop is Stop.CLUSTER else stop
        return replace(self.stated(task.problem, ring, claim, {}), stop=stop, witness=witness)

    def _outer_level(
        self, task: Task, band: Band, budget: Budget, report: Report | None
    ) -> tuple[float, Stop, Witness | None]:
        """The largest c2 that a ring from somewhat above the floor reaches, and what stopped it."""
        inner = min(4 * band.floor, math.sqrt(band.floor * band.top))
        for _ in range(_TRIES):
            part = replace(budget, effort=budget.effort.share(0.5))
            ring = prove_outwards(task.problem, self.T, inner, band.above, part, self.runner, report)
            if ring.outer > inner:
                break
            inner = math.sqrt(inner * band.top)
        return ring.outer, ring.stop, ring.witness

    def stated(self, problem: Problem, ring: RingProof, claim: Claim, seconds: dict[str, float]) -> Proof:
        """The proof of a claim from a ring's."""
        local, cells = None, (1,) * len(problem.loop.system.ranges)
        if claim.floor is None or claim.floor < claim.local:
            local, cells = local_ball(problem, self.T, claim.local, claim.floor)
        return Proof(
            claim,
            PartitionTree(self.T, ring.root, ring.tree, local, cells=cells, order=ring.order),
            ring.stop,
            witness=ring.witness,
            boxes=ring.boxes,
            leaves=ring.leaves,
            seconds=seconds,
            direction=ring.direction,
            left=ring.left,
        )


def _beside(problem: Problem) -> dict[str, Any]:
    """The parts of a claim about a problem beside its levels."""
    return {"rate": problem.rate, "keep": problem.keep}


def _cut_short(ring: RingProof) -> Stop | None:
    """The stop that ended the search of a ring before its time; None if none did."""
    return ring.stop if ring.stop is Stop.CLUSTER or ring.stop.ran_out else None


def _is_better(one: Proof, other: Proof) -> bool:
    """True if a practical claim is about a larger set, or about nearly the same with a lower floor."""
    a, b = one.claim, other.claim
    if a is None or a.floor is None or b is None or b.floor is None:
        return a is not None
    if abs(a.roa - b.roa) <= _EQUAL * b.roa:
        return a.floor < b.floor
    return a.roa > b.roa


def _is_ample(proof: Proof, target: float) -> bool:
    """True if a practical claim is about all that is within reach, with a floor that is next to nothing."""
    claim = proof.claim
    if claim is None or claim.floor is None:
        return False
    return claim.roa >= (1 - _EQUAL) * target and claim.floor <= _NOTHING * claim.roa


class _Outwards:
    """The local proof, and a ring that grows from it."""

    def __init__(self, engine: BoundsEngine, task: Task) -> None:
        start = time.perf_counter()
        self.engine, self.task = engine, task
        self.inner = prove_local(task.problem, engine.T, task.target, None, engine.first)
        self.hurried = self.inner is None and engine.first.over
        self.seconds: dict[str, float] = {"local": time.perf_counter() - start, "ring": 0.0}
        self.ring: Pass | None = None
        self.stop: Stop | None = None
        if self.inner is not None and self.inner < task.target:
            self.ring = outwards(task.problem, engine.T, self.inner, task.target, engine.runner)

    @property
    def done(self) -> bool:
        return self.ring is None or self.ring.done

    @property
    def boxes(self) -> int:
        return 0 if self.ring is None else self.ring.boxes

    @property
    def expected(self) -> float:
        return 0.0 if self.ring is None else self.ring.expected

    @property
    def level(self) -> float | None:
        return self.inner if self.ring is None else self.ring.levels[1]

    @property
    def reach(self) -> float:
        return self.task.target if self.ring is None else self.ring.sweep.outer

    @property
    def gained(self) -> bool:
        return self.ring is None or self.ring.levels[1] > self.ring.levels[0]

    def advance(self, budget: Budget, report: Report | None = None) -> None:
        start = time.perf_counter()
        if self.ring is not None:
            self.stop = self.ring.advance(budget, report)
        self.seconds["ring"] += time.perf_counter() - start

    def state(self) -> SearchState | None:
        return None if self.ring is None else self.ring.state()

    def restore(self, state: SearchState) -> None:
        if self.inner is None or self.inner < state.inner:
            raise InputError("the search cannot be resumed: the local set is smaller here; run without --resume.")
        if self.ring is None or state.outer <= self.inner:
            return  # the local set is as large as what the search could still reach, or larger
        self.ring.restore(state)

    def proof(self) -> Proof:
        if self.hurried:
            return Proof(None, None, Stop.EFFORT, "it ended before a local level was found", seconds=self.seconds)
        if self.inner is None:
            return Proof(None, None, Stop.LOCAL, _why_no_ball(self.task.problem), seconds=self.seconds)
        if self.ring is None:
            ring = empty_ring(self.task.problem, self.engine.T, self.inner)
        else:
            ring = self.ring.proof(self.stop)
        claim = Asymptotic(roa=ring.outer, local=self.inner, **_beside(self.task.problem))
        lost = "" if self.ring is None or self.stop is not Stop.CLUSTER else self.ring.lost
        return replace(self.engine.stated(self.task.problem, ring, claim, dict(self.seconds)), detail=lost)


def _why_no_ball(problem: Problem) -> str:
    """The reason why no ball around the origin shows V to fall, and what may help."""
    if meets_corner(paths(problem.loop)):
        return (
            "a unit of relu has its corner at the operating point, and V is not shown to fall in all "
            "directions there; try another P, or --claim practical"
        )
    smaller = ", or a smaller --rate" if problem.rate else ""
    dominates = f"the linearisation does not dominate on any ball; try another --Q{smaller}"
    return _corner_in_a_period(problem) or dominates


def _corner_in_a_period(problem: Problem) -> str:
    """The sentence about a corner at the operating point that a state may pass while an input is held; empty without
    one."""
    corners = corners_in_a_period(problem.loop.system)
    if not corners:
        return ""
    return (
        f"{corners[0]} has its corner at the operating point, where too little is known of what a held input does; try "
        "--claim practical or a much shorter --sample-time, or round it off, as sqrt(v**2 + 1e-2) does with abs(v)"
    )
