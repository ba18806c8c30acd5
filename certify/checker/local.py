"""The local rule: D + 2 lambda V < 0 on a ball around the origin that holds {V <= c1}, with no hole; under a practical
claim as far as c0 <= V, below which a step must not lead out of {V <= c0}."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from functools import cached_property
from math import prod
from typing import TYPE_CHECKING

import numpy as np
from flint import fmpq, fmpq_mat

from . import ball
from .ball import Ball
from .boxes import LEAF
from .case import AT_CORNERS, Case, Failures
from .decrease import Level, Models, are_finite, are_usable, rational, sides, size_beyond
from .document import Intervals
from .exact import contains_ball, exactly, fraction, is_definite, root_above
from .jets import Jet, uncertain
from .near import Array, Near, norm

if TYPE_CHECKING:
    from .kinks import Cone

_MOST_CORNERS = 2**16  # of all cells
_MOST_WORK = 2**26  # corners times n^4, which is what an inequality takes
_ATTEMPTS = 4  # at the a-priori enclosure
Way = tuple[Array, Array]  # the largest move of each state in a period: a number, and one times ||d||
Enclosed = tuple[Way, list[Jet]]  # and f on the way


class Local(Ball):
    """The ball of the section `local`."""

    def __init__(self, case: Case, cone: Cone | None = None) -> None:
        super().__init__(case, case.local.J, "local ball", cone=cone)
        object.__setattr__(self, "margins", list[float]())

    @classmethod
    def whole(cls, case: Case) -> Local:
        """The one of all d."""
        if case.local.directions is None:
            return cls(case)
        from .kinks import ALL

        return cls(case, ALL)

    @property
    def parts(self) -> Iterator[Local]:
        """It, or it on each cone of d."""
        if not self.case.local.directions:
            yield self
            return
        from .kinks import cones

        for cone in cones(self.case.local.directions, len(self.J)):
            yield Local(self.case, cone)

    margins: list[float]  # 1 - the largest share of the decay that the rest takes at a corner, in floats for people

    @property
    def margin(self) -> float:
        """The least margin so far."""
        return min(self.margins, default=float("nan"))

    @property
    def order(self) -> int:
        return self.case.local.order

    @property
    def at_rest(self) -> bool:
        """True if F vanishes at the origin, and so everything that is built from it."""
        return not self.case.c.practical

    @cached_property
    def enclosed(self) -> Enclosed | None:
        """The a-priori enclosure of the states during a period, and of f there, the first that holds of a few attempts:
        what f may come to, over the longest period, is less. None if none does."""
        n, h = len(self.J), self.case.longest
        far, along = np.zeros(n), np.zeros(n)
        for _ in range(1 + _ATTEMPTS):
            F = self.f(self.during((far, along)), self.ranges)
            most = np.array([0.0 if self.at_rest else (f.v0.size * h).top for f in F])
            steepest = np.array([(f.radius * h).top for f in F])
            if np.all((most < far) | self.at_rest) and np.all(steepest < along):
                return (far, along), F
            far, along = (0 * most if self.at_rest else 1.25 * most), 1.25 * steepest
        return None

    @property
    def way(self) -> Way | None:
        """The one of the enclosure, if there is one."""
        return None if self.enclosed is None else self.enclosed[0]

    def during(self, way: Way) -> list[Jet]:
        """The states within a way of the ball's."""
        moved = zip(self.states, *way, strict=True)
        return [replace(x, c=x.c.wider(far), a=x.a.wider(along)) for x, far, along in moved]

    def settled(self, v: Jet) -> Jet:
        """Set the value at d = 0 to exactly 0 at rest, where it is 0 in truth."""
        return replace(v, c=Near(np.float64(0)), c_y=Near(0 * v.c_y.value)) if self.at_rest else v

    @property
    def period(self) -> Jet:
        """h, by the last of the numbers y if it has a range."""
        lo, hi = self.case.c.sample or (Fraction(0), Fraction(0))
        return uncertain(lo, hi, self.units, self.count - 1, self.count) if lo < hi else self.constant(hi)

    @cached_property
    def later(self) -> list[Jet]:
        """The terms of G beyond x_1, divided by h; uncertain quantities enter them with their whole range alone."""
        if self.way is None or self.order == 1:
            return []
        from .flow import later

        start, during = self.shared(self.states), self.shared(self.during(self.way))
        held, dynamics = [*self.inputs, *self.ranges], self.case.c.dynamics
        return later(dynamics, self.constant, start, during, held, self.period, self.order, self.settled)

    def G(self, cell: Intervals) -> list[Jet]:
        """The increment of x per unit of time over a step. Within a period uncertain quantities may leave the cell: the
        cell counts only for their mean, in which D is convex."""
        c, symbols = self.case.c, self.symbols(cell)
        if c.sample is None or self.way is None:
            return self.change(cell)
        first = self.f(self.during(self.way) if self.order == 1 else self.states, symbols)
        rising = self.later or [self.constant(Fraction(0))] * len(first)
        return [self.settled(x) + self.period * more for x, more in zip(first, rising, strict=True)]

    def sides(self) -> Iterator[tuple[fmpq_mat, fmpq_mat] | None]:
        """For each corner of each cell the decay, and what has to stay below it; None, at the end, where G has no
        finite model."""
        c, by = self.case.c, self.case.local
        P, h = exactly(c.P), _fmpq(c.step)
        R = 2 * rational(c.rate) * P
        level = None if self.at_rest else Level(rational(c.c0), rational(by.edge))
        for cell in self.case.cells:
            G = self.G(cell)
            known = c.sample is None or self.way is not None  # on a cone it may not be found, though it is on all
            models = Models(self.J, G, self.at_rest) if known and are_finite(G) else None
            most = size_beyond(models, c.P) if models is not None and h > 0 else 0.0
            if models is None or not np.isfinite(most):
                yield None
                return
            if self.cone is not None:
                from .kinks import Kinks

                models.kinks = Kinks.of(self.cone, models, c.P)
            for corner in models.corners(c.P):
                decay, rest = sides(corner, P, R, by.multipliers, None, h, rational(most), level)
                yield (decay if self.cone is None else self.cone.within(decay, rest)), rest


def _margin(decay: fmpq_mat, rest: fmpq_mat) -> float:
    try:
        left, right = (np.array([[float(fraction(v)) for v in row] for row in M.tolist()]) for M in (decay, rest))
        return float(1 - np.max(np.linalg.eigvals(np.linalg.solve(left, right)).real))
    except (np.linalg.LinAlgError, OverflowError):
        return float("nan")


def is_large_enough(
    ball: Ball, place: str, name: str, level: float, directions: tuple[bytes, ...] | None, most: int = 64
) -> Failures:
    """The trees are trees; the ball contains {V <= level}, whose name and place are these; deciding an inequality at
    each corner of each cell on each cone, of `most` of the numbers y, does not take too long."""
    if directions:
        from .kinks import are_whole

        where = "local" if most < 64 else "contraction"
        yield from are_whole(directions, len(ball.J), f"evidence.{where}.directions")
    if not contains_ball(exactly(ball.J), exactly(ball.case.c.P), Fraction(level)):
        yield place, f"the ball must contain {{V <= {name}}}"
    corners = prod(ball.case.partition.cells) * 2 ** min(ball.count, most)
    corners *= max(1, sum(tree.count(LEAF) for tree in directions or ()))
    if corners > _MOST_CORNERS or corners * len(ball.J) ** 4 > _MOST_WORK:
        yield "evidence.cells", "there are too many cells for this rule"
    return 0


def fits(local: Local) -> Failures:
    """`local`: the ball contains {V <= c1}, and its jets take neither too much memory nor too much time."""
    c = local.case.c
    yield from is_large_enough(local, "levels.local", "c1", c.c1, local.case.local.directions, AT_CORNERS)
    if not are_usable(local.case.local.multipliers):
        yield "evidence.local", "no multiplier may be negative, none of g 0 where some beta is"
    if c.step > 0 and Fraction(local.case.local.edge) * c.step > 1:
        yield "evidence.local.edge", "a step may lead out of {V <= c0}: the edge must be at most 1/h"
    yield from ball.fits(local)
    return 0


def stays(local: Local) -> Failures:
    """`flow`: during a period the state stays in the interior of the domain."""
    c = local.case.c
    if c.sample is None:
        return 0
    if local.enclosed is None:
        yield local.at, "the state is not shown to stay near during a period"
        return 0
    _, F = local.enclosed
    for i, (f, name, (lo, hi)) in enumerate(zip(F, c.states, c.domain, strict=True)):
        reach, of_ball = root_above(rational(c.c1) * _fmpq(local.case.P_inverse[i])), float(norm(local.J[i]).top)
        reach = min(reach, rational(of_ball)) if np.isfinite(of_ball) else reach
        moved = float(((f.radius if local.at_rest else f.radius + f.v0.size) * local.case.longest).top)
        if not (np.isfinite(moved) and fraction(reach + rational(moved)) < min(-lo, hi)):
            yield local.at, f"{name} may leave the domain during a period"
    return len(c.states)


def keeps_constraints(local: Local) -> Failures:
    """`keep`: every constraint is negative on the ball, during a period too."""
    c, count = local.case.c, 0
    if c.keep is None:
        return 0
    whole = c.sample is not None and local.way is not None
    for cell in [None] if whole else local.case.cells:
        states = local.during(local.way) if local.way is not None and whole else local.states
        quantities = local.ranges if cell is None else local.symbols(cell)
        count += yield from ball.keeps_constraints(local, local.constraints(states, quantities))
    return count


def decreases(local: Local) -> Failures:
    """`local`: D + 2 lambda V < 0 on the ball without its centre, or as far as V >= c0."""
    count = 0
    for both in (both for part in local.parts for both in part.sides()):
        if both is None:
            yield "levels.local", "F has no finite model on the local ball"
            return count
        count, (decay, rest) = count + 1, both
        local.margins.append(_margin(decay, rest))
        if not is_definite(decay - rest):
            share = 1 - local.margins[-1]
            yield "levels.local", f"the decrease is not shown on the local ball: {share:.3g} of the decay"
    return count


def _fmpq(q: Fraction) -> fmpq:
    return fmpq(q.numerator, q.denominator)
