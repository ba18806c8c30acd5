"""The local rule: Vdot < 0 on a ball around the origin that holds {V <= c1}, with no hole."""

from __future__ import annotations

from fractions import Fraction
from functools import cached_property
from math import prod

import numpy as np
from flint import fmpq_mat

from . import ball
from .ball import Ball
from .case import Case, Failures
from .decrease import Models, are_finite, are_usable, sides
from .exact import contains_ball, exactly, fraction, is_definite

_MOST_WORK = 2**26  # cells times n^4, which is what an inequality takes


class Local(Ball):
    """The ball of the section `local`."""

    def __init__(self, case: Case) -> None:
        super().__init__(case, case.local.J, "local ball")

    @cached_property
    def sides(self) -> list[tuple[fmpq_mat, fmpq_mat] | None]:
        """For each cell the decay, and what has to stay below it; None where F has no finite model."""
        P = exactly(self.case.c.P)
        nothing, found = fmpq_mat(P.nrows(), P.nrows()), []
        for cell in self.case.cells:
            F, by = self.F(cell), self.case.local.multipliers
            finite = are_finite(F, self.units)
            found.append(sides(Models(self.J, F, self.units), P, nothing, by) if finite else None)
        return found

    @cached_property
    def margin(self) -> float:
        """1 - the largest share of the decay that the rest may take in any cell, in floats for people."""
        return min(_margin(*both) if both is not None else float("nan") for both in self.sides)


def _margin(decay: fmpq_mat, rest: fmpq_mat) -> float:
    try:
        left, right = (np.array([[float(fraction(v)) for v in row] for row in M.tolist()]) for M in (decay, rest))
        return float(1 - np.max(np.linalg.eigvals(np.linalg.solve(left, right)).real))
    except (np.linalg.LinAlgError, OverflowError):
        return float("nan")


def fits(local: Local) -> Failures:
    """`local`: the ball contains {V <= c1}, and its jets take neither too much memory nor too much time."""
    if not contains_ball(exactly(local.J), exactly(local.case.c.P), Fraction(local.case.c.c1)):
        yield "levels.local", "the ball must contain {V <= c1}"
    if prod(local.case.partition.cells) * len(local.J) ** 4 > _MOST_WORK:
        yield "evidence.cells", "there are too many cells for this rule"
    if not are_usable(local.case.local.multipliers):
        yield "evidence.local", "no multiplier may be negative, none of g 0 where some beta is"
    yield from ball.fits(local)
    return 0


def decreases(local: Local) -> Failures:
    """`local`: Vdot < 0 on the ball without its centre."""
    for both in local.sides:
        if both is None:
            yield "levels.local", "F has no finite model on the local ball"
            return 0
        decay, rest = both
        if not is_definite(decay - rest):
            yield "levels.local", f"Vdot < 0 is not shown on the local ball: {1 - local.margin:.3g} of the decay"
    return len(local.sides)
