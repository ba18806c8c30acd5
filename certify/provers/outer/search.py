"""One best-first pass over a box, at whose end a rule holds on each leaf for a level that only falls.

Boxes are taken in the order of the lowest N known of them, so that there is an answer whenever the pass stops: the
boxes still open have N above the level that is left. A violation, or a box too small to halve, takes the level below
it. No leaf is proved twice, because a proof for a level holds for each lower one; and none is left unproved, because
an open box that a lower level settles is looked at once more for itself: a bound of the box from which it was cut is
none of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from certify.certificates.verdict import Stop
from certify.provers.base import Budget, Report
from certify.provers.bounds.arrays import Array, Mask
from certify.provers.boxes.account import Account
from certify.provers.boxes.ahead import Growth, ahead
from certify.provers.boxes.frontier import Frontier
from certify.provers.boxes.halving import Halves, split
from certify.provers.boxes.partition import LEAF, MOST_SPLITS, Partition
from certify.provers.execution import Bound, Counted, Runner
from certify.provers.outer.rule import OuterBounds

_SLACK = 1e-9  # share of the level's span that the level stays below a bound
_LAST_LOOK = 0.5  # operations of a box that a lower level settles, in those of one of all that were looked at
_BATCH = 4e6  # operations of a batch, however small


class _CoverGrowth(Growth):
    """A rule for a level, the second of its two."""

    def __init__(self, rule: Counted, half: Array, level: float) -> None:
        super().__init__(rule, half)
        self.level = level

    @property
    def levels(self) -> tuple[float, float]:
        return -math.inf, self.level

    def at(self, inner: float, outer: float) -> _CoverGrowth:
        return _CoverGrowth(self.bound, self.half, outer)

    def gives_way(self, lo: Array, hi: Array, found: OuterBounds) -> Mask:
        gives_way: Mask = found.violated <= self.level
        return gives_way

    def opened(self, halves: Halves, found: OuterBounds, key: Array) -> tuple[Mask, Array]:
        # a box's place in the order still bounds N where its own bound does not
        keys = np.maximum(found.lowest, key)[halves.origin]
        return np.ones_like(keys, dtype=np.bool_), keys


class Cover:
    """A pass over `lower <= z <= upper`.

    Parameters
    ----------
    rule : bounds of boxes; the second of its two levels is n2.
    level, floor : where n2 starts, and that below which it is of no use.
    beside : how far n2 goes below a violation.
    deepen : from a violating centre (n,) in z to the lowest N of a violation found from there.
    """

    def __init__(
        self,
        rule: Counted,
        lower: Array,
        upper: Array,
        runner: Runner,
        level: float,
        floor: float,
        beside: float,
        deepen: Callable[[Array], float] | None = None,
    ) -> None:
        self.rule, self.runner, self.deepen = rule, runner, deepen
        self.level, self.target, self.floor, self.beside = level, level, floor, beside
        self.slack = _SLACK * max(abs(level), level - floor)
        self.partition = Partition(upper, lower)
        self.frontier = Frontier(self.partition)
        lo, hi = lower[:, None], upper[:, None]
        self.width = np.where(hi > lo, (hi - lo) / 2, 1.0)
        self.boxes = self.leaves = 0
        self.done_share = 0.0
        self.stop = Stop.REQUESTED
        self._account = Account()
        self.frontier.add(lo, hi, np.full(1, -math.inf), np.zeros(1, dtype=np.int64))

    @property
    def proved(self) -> float:
        """The level for which all but the open boxes is proved; -inf at first."""
        return min(self.level, self.frontier.least() - self.slack)

    @property
    def growth(self) -> _CoverGrowth:
        """The rule at the level of now."""
        return _CoverGrowth(self.rule, self.width, self.level)

    def advance(self, budget: Budget, report: Report | None = None) -> Stop:
        """Prove what there is for the level, or what the budget allows for a lower one; what limits it."""
        most, ended = self.boxes + budget.boxes, None
        with ahead(self.runner, self.growth, budget) as bound:
            while len(self.frontier) and self.level > self.floor:
                if ended is None:
                    ended = Stop.CLUSTER if bound.lost else self._ended(budget, most)
                    if ended is not None:  # the boxes left have N above this
                        self.stop, self.level = ended, self.proved
                        continue
                before = self.boxes
                bound.offer(self.frontier, math.inf if ended is not None else budget.effort.left)
                self._step(bound, budget)
                work = _BATCH + (self.boxes - before) * self.rule.operations
                budget.effort.charge(work)
                self._account.spent += work
                if report is not None:
                    level = min(max(self.proved, self.floor), self.target)
                    report(self._account.read(level, self.target, self.done_share, self.boxes, len(self.frontier)))
        return self.stop

    def _ended(self, budget: Budget, most: int) -> Stop | None:
        if self.boxes >= most or self.partition.splits + 3 * budget.batch + len(self.frontier) > MOST_SPLITS:
            return Stop.BOXES
        kept = _LAST_LOOK * self.rule.operations * len(self.frontier) + budget.check * self.leaves
        return budget.ended_by if kept >= budget.effort.left else None

    def _share(self, lo: Array, hi: Array) -> float:
        """The volume of boxes (n, B), of that of the whole."""
        return float(np.where(hi > lo, (hi - lo) / (2 * self.width), 1.0).prod(0).sum())

    def _step(self, bound: Bound, budget: Budget) -> None:
        lo, hi, number, key = self.frontier.take(budget.batch, math.inf)
        self.boxes += lo.shape[1]
        found: OuterBounds = bound(lo, hi, -math.inf, self.level)
        lowest = float(found.violated.min())
        if lowest <= self.level:
            if self.deepen is not None:
                centre = (0.5 * lo + 0.5 * hi)[:, int(found.violated.argmin())]
                lowest = min(lowest, self.deepen(centre))
            self.level, self.stop = lowest - self.beside, Stop.WITNESS
            found = found._replace(proved=found.proved | (found.lowest > self.level))
        halves = split(self.partition, lo, hi, number, found, budget.least_width * self.width)
        if halves.small.any():
            bottom = float(found.lowest[halves.small].min())
            if bottom <= self.level:
                self.level, self.stop = bottom - self.slack, Stop.SMALL
        self.done_share += self._share(lo.compress(found.proved, -1), hi.compress(found.proved, -1))
        self.leaves += int(found.proved.sum())
        self.growth.reopen(self.frontier, halves, found, key)

    def tree(self) -> bytes:
        """The partition in preorder."""
        return self.partition.preorder()


def count(tree: bytes) -> int:
    """Leaves of a tree."""
    return tree.count(bytes([LEAF]))
