"""One best-first pass over a box, at whose end a rule holds on each leaf for a level that only falls.

Boxes are taken in the order of the lowest N known of them, so that there is an answer whenever the pass stops: what is
still open has N above the level that is left. What cannot be proved, a violation or a box too small to halve, takes the
level below it. No leaf is proved twice, because what holds for a level holds for each lower one; and none is left
unproved, because an open box that a lower level settles is looked at once more for itself: a bound of the box from
which it was cut is none of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from certify.engines.base import Budget, Report
from certify.engines.bounds.clock import Clock
from certify.engines.bounds.frontier import Frontier
from certify.engines.bounds.halving import split
from certify.engines.bounds.partition import LEAF, Partition
from certify.engines.outer.rule import OuterBounds
from certify.running import Bound, Runner
from certify.verdict import Stop

Array = NDArray[np.float64]
_SLACK = 1e-9  # of the level's span: how far below a bound the level stays
_MOST_SPLITS = 40_000_000  # what a certificate can hold, and two gibibytes
_LAST_LOOK = 0.5  # seconds of a box that a lower level settles, in those of one of all that were looked at


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
        rule: Bound,
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
        self.frontier = Frontier(self.partition, runner.device)
        lo, hi = (torch.tensor(side[:, None], dtype=torch.float64, device=runner.device) for side in (lower, upper))
        self.width = torch.where(hi > lo, (hi - lo) / 2, 1.0)
        self.boxes = self.leaves = 0
        self.done_share = 0.0
        self.stop = Stop.REQUESTED
        self._clock = Clock()
        first = torch.zeros(1, dtype=torch.int64, device=runner.device)
        self.frontier.add(lo, hi, torch.full((1,), -math.inf, dtype=torch.float64, device=runner.device), first)

    @property
    def proved(self) -> float:
        """The level for which all is proved but what is open; -inf at first."""
        return min(self.level, self.frontier.least() - self.slack)

    def advance(self, budget: Budget, report: Report | None = None) -> Stop:
        """Prove what there is for the level, or what the budget allows for a lower one; what limits it."""
        most, ended = self.boxes + budget.boxes, None
        with self._clock, self.runner.start(self.rule) as bound:
            while len(self.frontier) and self.level > self.floor:
                if ended is None:
                    ended = self._ended(budget, most)
                    if ended is not None:  # what is left has N above this
                        self.stop, self.level = ended, self.proved
                        continue
                self._step(bound, budget)
                if report is not None:
                    level = min(max(self.proved, self.floor), self.target)
                    report(self._clock.read(level, self.target, self.done_share, self.boxes, len(self.frontier)))
        return self.stop

    def _ended(self, budget: Budget, most: int) -> Stop | None:
        if self.boxes >= most or self.partition.splits + 3 * budget.batch + len(self.frontier) > _MOST_SPLITS:
            return Stop.BOXES
        each = _LAST_LOOK * self._clock.spent / max(1, self.boxes)
        spent = self._clock.spent + each * len(self.frontier) + budget.check * self.leaves
        return Stop.TIME if spent > budget.seconds else None

    def _step(self, bound: Bound, budget: Budget) -> None:
        least = self.frontier.least()  # what a box's bound leaves unknown, its place in the order still says
        lo, hi, number = self.frontier.take(budget.batch, math.inf)
        self.boxes += lo.shape[1]
        found: OuterBounds = bound(lo, hi, -math.inf, self.level)
        lowest = float(found.violated.min())
        if lowest <= self.level:
            if self.deepen is not None:
                centre = (0.5 * lo + 0.5 * hi)[:, int(found.violated.argmin())]
                lowest = min(lowest, self.deepen(centre.cpu().numpy()))
            self.level, self.stop = lowest - self.beside, Stop.WITNESS
            found = found._replace(proved=found.proved | (found.lowest > self.level))
        halves = split(self.partition, lo, hi, number, found, budget.least_width * self.width)
        if bool(halves.small.any()):
            bottom = float(found.lowest[halves.small].min())
            if bottom <= self.level:
                self.level, self.stop = bottom - self.slack, Stop.BOXES
        whole = torch.where(hi > lo, (hi - lo) / (2 * self.width), 1.0).prod(0)
        self.done_share += float(whole[found.proved].sum())
        self.leaves += int(found.proved.sum())
        self.frontier.add(halves.lo, halves.hi, found.lowest[halves.origin].clamp(min=least), halves.number)

    def tree(self) -> bytes:
        """The partition in preorder."""
        return self.partition.preorder()


def without_time(budget: Budget) -> Budget:
    """The same budget without an end in time."""
    return replace(budget, seconds=math.inf)


def count(tree: bytes) -> int:
    """Leaves of a tree."""
    return tree.count(bytes([LEAF]))
