"""The rule for a box of a tree of a set that is never left: N falls where it is n2, and constraints hold where N <= n2.

N'F may have any sign where N is below n2, so that a proof for one level is none for another: a pass has one level, and
ends where that fails.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic
from certify.provers.bounds import Taylor, upper_bound
from certify.provers.bounds.arrays import Array, Mask, chosen
from certify.provers.boxes.lessening import lessened
from certify.provers.outer.rule import LoopOnN, OnBoxes, below


class StayBound(LoopOnN):
    """The rule for a loop and its constraints, each g of `keep` negative where N <= n2."""

    def __init__(self, loop: ClosedLoop, keep: Sequence[Expression], T: Array, function: Neural | Symbolic) -> None:
        super().__init__(loop, T, function, keep)

    def free(self, lo: Array, hi: Array) -> Mask:
        """False: there is no other set."""
        return np.zeros(lo.shape[1], dtype=bool)

    def asks(self, z: Array) -> Mask:
        """True everywhere."""
        return np.ones(z.shape[1], dtype=bool)

    def judged(self, on: OnBoxes, level: float) -> tuple[Mask, Array, Array, Mask]:
        """N'F where N = n2, and each constraint where N <= n2."""
        gap = below(on.N, level)
        bound, score, wrong = self._falls(on, gap)
        bound, score, broken = self.kept(on, bound, score, lambda g, index: [gap.at(index)])
        bound = np.where(on.smooth, bound, np.inf)
        return bound < 0, bound, score, wrong | broken

    def _falls(self, on: OnBoxes, gap: Taylor) -> tuple[Array, Array, Mask]:
        """A bound (B,) of N'F where N = n2, -inf where N is below n2; the score of the axes; and True where N'F is
        certainly not negative somewhere on the box where N = n2."""
        fall, N, n = on.fall, on.N, len(on.centre)
        bound, excess = upper_bound(fall)
        below = upper_bound(_negative(gap))[0] < 0
        for each in (gap, _negative(gap)):
            left = chosen(~(bound < 0) & ~below)
            if len(left):
                bound[left] = lessened(bound[left], fall.at(left), each.at(left), n)
        quantities = np.abs(fall.g[n + self.system.m :]).sum(0)
        whole = np.abs(fall.g[: n + self.system.m]).sum(0) + np.abs(fall.Q).sum((0, 1)) + fall.r
        bent = np.abs(N.Q).sum((0, 1)) + N.r
        crossed = np.abs(gap.c) < np.abs(N.g).sum(0) - bent
        return np.where(below, -np.inf, bound), on.score(excess, fall), crossed & (fall.c + quantities - whole >= 0)


def _negative(v: Taylor) -> Taylor:
    return Taylor(-v.c, -v.g, -v.Q, v.r)
