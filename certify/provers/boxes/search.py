"""The ring: one best-first pass of branch and bound that finds the best provable level as it goes.

A pass outwards keeps the inner level and looks for the largest outer one: boxes are taken in the order of the lowest V
on them, and everything below the lowest undecided box is proved. A pass inwards keeps the outer level and looks for the
smallest inner one, in the order of the highest V. Either way the answer is ready whenever the pass stops: for a
violation, a budget, or because nothing is left. No trial level is ever proved again from scratch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np

from certify.certificates.claims import Problem
from certify.certificates.verdict import Stop
from certify.effort import Effort
from certify.errors import CertificateFormatError, InputError
from certify.provers.base import Budget, Report, SearchState
from certify.provers.bounds.arrays import Array
from certify.provers.boxes.account import Account
from certify.provers.boxes.ahead import ahead
from certify.provers.boxes.frontier import Frontier
from certify.provers.boxes.halving import split
from certify.provers.boxes.order import choose_order
from certify.provers.boxes.partition import LEAF, MOST_SPLITS, OPEN, Partition
from certify.provers.boxes.rule import BoxBounds, VdotBound
from certify.provers.boxes.sweep import Inwards, Outwards, RingGrowth, Sweep
from certify.provers.execution import Bound, Runner
from certify.provers.falsify import Witness

_BATCH = 4e6  # operations of a batch, however small
_LOOKS = 2.0  # operations to look at open boxes, relative to one look at each
_HIGHER = 8.0  # an inner level over one from below which a step may lead out


@dataclass(frozen=True, slots=True)
class RingProof:
    """D' < 0 is proved for `inner <= V <= outer` (equal if the ring is empty); `stop` says what ended the pass.

    `tree` is the partition in preorder: an axis for a split, 255 for a leaf; `root` its half-widths (n,) in z.
    `direction` and `left` are those of `Proof`.
    `witness` is the lowest violation found along the way. `covered` is False if a pass inwards left boxes inside
    the inner level on which F could not be enclosed, or a step might lead to the inner level. `order` is that of the
    series in time of the leaves.
    """

    inner: float
    outer: float
    stop: Stop
    tree: bytes
    root: Array
    boxes: int
    leaves: int
    witness: Witness | None
    covered: bool = True
    direction: tuple[float, ...] | None = None
    left: float | None = None
    order: int = 1


def prove_outwards(
    problem: Problem,
    T: Array,
    inner: float,
    target: float,
    budget: Budget,
    runner: Runner,
    report: Report | None = None,
    rule: VdotBound | None = None,
) -> RingProof:
    """Prove D' < 0 (and the input bounds) on `inner <= V <= level` for the largest level up to `target`.

    Parameters
    ----------
    T : (n, n), invertible; boxes are drawn in z, x = T z.
    inner, target : levels, 0 < inner <= target.
    report : called after every batch.
    rule : another bound for boxes, to compare with; None for `VdotBound`.

    Notes
    -----
    Deterministic: the budget is counted, and a box's bounds do not depend on those that are bounded with it.
    """
    if inner >= target:
        return empty_ring(problem, T, target)
    ring = outwards(problem, T, inner, target, runner, rule)
    return ring.proof(ring.advance(budget, report))


def outwards(
    problem: Problem, T: Array, inner: float, target: float, runner: Runner, rule: VdotBound | None = None
) -> Pass:
    """The pass of `prove_outwards` before its first box."""
    sweep = Outwards(problem, T, inner, target)
    if rule is None:
        order = choose_order(problem, T, inner, target)
        rule = VdotBound(problem, T, order=order)
    return Pass(sweep, _root(problem, T, target), runner, rule)


def empty_ring(problem: Problem, T: Array, level: float) -> RingProof:
    """The ring from a level to itself, of which nothing has to be proved."""
    return RingProof(level, level, Stop.REQUESTED, bytes([LEAF]), _root(problem, T, level), 0, 1, None)


def prove_inwards(
    problem: Problem,
    T: Array,
    floor: float,
    outer: float,
    budget: Budget,
    runner: Runner,
    report: Report | None = None,
) -> RingProof:
    """Prove D' < 0 on `level <= V <= outer` for the smallest level from `floor` on, and F and its inputs inside it.

    Parameters are those of `prove_outwards`. On {V < level} every leaf of the tree has a finite enclosure of F
    and inputs in their bounds, and where time has steps none leads from it to V >= level; if the budget ends before,
    the proof is not `covered`.
    """
    order = choose_order(problem, T, max(floor, 1e-3 * outer), outer)
    rule = VdotBound(problem, T, inside=True, order=order)
    while True:
        before = budget.effort.spent
        ring = Pass(Inwards(problem, T, floor, outer), _root(problem, T, outer), runner, rule)
        stop = ring.advance(budget, report)
        if stop is not None:
            ring.settle()
            ring.advance(replace(budget, effort=_to_close(ring, budget, budget.effort.spent - before)), report)
        found = ring.proof(stop)
        # A step from below may end above a level to which the ring reaches: then there is none from which it does not.
        floor = _HIGHER * max(floor, found.inner)
        if found.covered or not rule.step or floor >= outer or budget.effort.over:
            return found


def _to_close(ring: Pass, budget: Budget, took: float) -> Effort:
    """The effort in which a settled pass may close its open boxes, of a budget that it took so much of.

    Most need one look. Inside the inner level some need more, where inputs leave their bounds or steps lead far; for
    these it may take as much again as it took, unless the clock ended it.
    """
    looks = _LOOKS * (len(ring.frontier) * ring.rule.operations + _BATCH)
    more = looks if budget.effort.is_short_of_time else max(looks, took)
    return budget.effort if budget.effort.left == math.inf else budget.effort.part(more, even_if_over=True)


def _root(problem: Problem, T: Array, level: float) -> Array:
    """Half-widths (n,) of a box in z around {V <= level}, a hair larger for the checker's rounding."""
    S = T.T @ problem.V.P @ T
    return np.asarray(np.sqrt(level * np.diag(np.linalg.inv(S))) * (1 + 1e-9))


class Pass:
    """A pass that gives at any time what it has proved, and can be continued."""

    def __init__(self, sweep: Sweep, root: Array, runner: Runner, rule: VdotBound) -> None:
        self.sweep, self.root, self.runner, self.rule = sweep, root, runner, rule
        self.partition = Partition(root)
        self.frontier = Frontier(self.partition)
        self.half = root[:, None]
        self.growth = RingGrowth(sweep, rule, self.half)
        self.boxes = self.proved = 0
        self.covered = True
        self.halvings = 0.0
        self.lost = ""  # a sentence about a cluster that went away
        self._stop = Stop.REQUESTED
        self._account = Account()
        first = np.zeros(1, dtype=np.int64)
        self.frontier.add(-self.half, self.half, sweep.key(*rule.levels(-self.half, self.half)), first)

    @property
    def done(self) -> bool:
        """True if the pass has nothing left to gain: no box is open, or its levels have met."""
        return not len(self.frontier) or self.sweep.inner >= self.sweep.outer

    @property
    def levels(self) -> tuple[float, float]:
        """(inner, outer) between which all is proved; equal if nothing is."""
        inner, outer = self.sweep.reached(self.frontier.least())
        return inner, max(inner, outer)

    def advance(self, budget: Budget, report: Report | None = None) -> Stop | None:
        """Take boxes, bound them, give way to violations, halve undecided ones; the limit reached, or None if done."""
        most = self.boxes + budget.boxes
        with ahead(self.runner, self.growth, budget, alone=bool(self.lost)) as bound:
            while not self.done:
                if bound.lost:
                    self.lost = bound.lost
                    return Stop.CLUSTER
                if self.boxes >= most or self.partition.splits + 3 * budget.batch > MOST_SPLITS:
                    return Stop.BOXES
                if budget.effort.left <= self.proved * budget.check:
                    return budget.ended_by
                before = self.boxes
                with self._whole():
                    bound.offer(self.frontier, budget.effort.left)
                    self._step(bound, min(budget.batch, most - self.boxes), budget.least_width)
                work = _BATCH + (self.boxes - before) * self.rule.operations
                budget.effort.charge(work)
                self._account.spent += work
                if report is not None:
                    stand = self.sweep.stand(self.frontier.least())
                    report(replace(self._account.read(*stand, self.boxes, len(self.frontier)), down=self.sweep.down))
        return None

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """Do all of a step or nothing: what Ctrl-C cuts short leaves every box where it was, so that the search can be
        kept."""
        frontier, mark = self.frontier.copy(), self.partition.mark()
        done = False
        try:
            yield
            done = True
        finally:
            if not done:
                self.frontier = frontier
                self.partition.back_to(mark)

    def _step(self, bound: Bound, count: int, least_width: float) -> None:
        lo, hi, number, _ = self.frontier.take(count, self.sweep.reach(self.frontier.least()))
        sweep, rule = self.sweep, self.rule
        self.boxes += lo.shape[1]
        found = bound(lo, hi, sweep.inner, sweep.outer)
        self.proved += int(found.proved.sum())
        self.halvings = _halvings(found, len(self.root), self.halvings)
        centres = 0.5 * lo + 0.5 * hi
        if sweep.violated(centres, self.growth.levels_of(centres, found)):
            self._stop = Stop.WITNESS
        halves = split(self.partition, lo, hi, number, found, least_width * self.half)
        small = halves.small
        if small.any():
            self.covered = self.covered and bool(found.smooth[small].all())
            if sweep.stuck(*rule.levels(lo.compress(small, -1), hi.compress(small, -1))):
                self._stop = Stop.SMALL
        self.growth.reopen(self.frontier, halves, found, np.zeros(0))  # the order is known without the old keys
        self.frontier.drop_above(sweep.last())

    @property
    def expected(self) -> float:
        """Boxes that the search may need before it gains anything, by the last batch."""
        return len(self.frontier) * math.exp2(min(1000.0, self.halvings))

    def settle(self) -> None:
        """Take the levels that are proved for good: open boxes lie outside of them, and most need one look."""
        self.sweep.inner, self.sweep.outer = self.sweep.reached(self.frontier.least())

    def state(self) -> SearchState:
        """The search as it stands."""
        waiting, keys = self.frontier.waiting()
        tree = self.partition.preorder([(OPEN, waiting)])
        sweep = self.sweep
        keys = keys[self.partition.order(waiting)]
        return SearchState(sweep.inner, sweep.outer, self.boxes, self.proved, sweep.witness, tree, keys)

    def restore(self, state: SearchState) -> None:
        """Go on from a state, before the first box of this pass, whose inner level may have grown since.

        Raises
        ------
        InputError : it is not of a ring between these levels.
        """
        sweep = self.sweep
        try:
            opened = self.partition.graft(state.tree)
        except CertificateFormatError as error:
            raise InputError(f"the search cannot be resumed: {error}") from error
        fits = sweep.inner >= state.inner and state.outer <= sweep.outer
        if not fits or len(opened.number) != len(state.keys) or np.isnan(state.keys).any():
            raise InputError("the search cannot be resumed: it is of another ring.")
        self.frontier = Frontier(self.partition)
        self.frontier.add(opened.lo, opened.hi, state.keys, opened.number)
        sweep.outer, sweep.witness = state.outer, state.witness
        self.boxes, self.proved = state.boxes, state.proved
        self._stop = Stop.REQUESTED if state.witness is None else Stop.WITNESS

    def proof(self, stop: Stop | None = None) -> RingProof:
        """The ring that is proved; `stop` is the limit that was reached."""
        stop = stop or self._stop
        (inner, outer), witness, covered = self.levels, self.sweep.witness, self.covered and self.done
        if outer <= inner:  # nothing beyond the inner level
            empty = empty_ring(self.sweep.problem, self.sweep.T, inner)
            found = replace(empty, stop=stop, boxes=self.boxes, witness=witness, covered=covered)
            return replace(found, direction=_direction(self.partition, self.sweep.T, self.root))
        tree = self.partition.preorder()
        leaves = tree.count(bytes([LEAF]))
        found = RingProof(inner, outer, stop, tree, self.root, self.boxes, leaves, witness, covered)
        direction, left = _direction(self.partition, self.sweep.T, self.root), self._account.left
        return replace(found, direction=direction, left=None if self.done else left, order=self.rule.order)


def _halvings(found: BoxBounds, n: int, before: float) -> float:
    """The halvings that a box of a batch needs which is not proved, so that the bound exceeds the value at its centre
    by less than the decay there: a bound's excess of second order falls fourfold when all n axes are halved once.

    `before` is the number by an earlier batch, for a batch that gives none.
    """
    excess = found.bound + found.decay
    wanted = ~found.proved & (found.decay > 0) & np.isfinite(excess)
    if not wanted.any():
        return before
    share = np.sort(excess[wanted] / found.decay[wanted])[(np.count_nonzero(wanted) - 1) // 2]
    return n / 2 * math.log2(max(1.0, float(share)))


def _direction(partition: Partition, T: Array, root: Array) -> tuple[float, ...] | None:
    """The coordinate that was halved most often, in the states, as long as the root box in it; None at first."""
    if not partition.splits:
        return None
    axis = int(np.argmax(partition.halvings()))
    return tuple((T[:, axis] * root[axis]).tolist())
