"""The local rule: Vdot < 0 on a ball around the origin that holds {V <= c1}, with no hole."""

from __future__ import annotations

from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import fmpq_mat

from . import ball
from .ball import Ball
from .case import Case, Failures
from .decrease import Models, are_finite, are_usable, sides
from .exact import contains_ball, exactly, fraction, is_definite


class Local(Ball):
    """The ball of the section `local`."""

    def __init__(self, case: Case) -> None:
        super().__init__(case, case.local.J, "local ball")

    @cached_property
    def sides(self) -> tuple[fmpq_mat, fmpq_mat]:
        """The decay, and what has to stay below it."""
        P = exactly(self.case.c.P)
        nothing = fmpq_mat(P.nrows(), P.nrows())
        return sides(Models(self.J, self.F, self.units), P, nothing, self.case.local.multipliers)

    @cached_property
    def margin(self) -> float:
        """1 - the largest share of the decay that the rest may take, in floats for people."""
        try:
            decay, rest = (np.array([[float(fraction(v)) for v in row] for row in M.tolist()]) for M in self.sides)
            return float(1 - np.max(np.linalg.eigvals(np.linalg.solve(decay, rest)).real))
        except (np.linalg.LinAlgError, OverflowError):
            return float("nan")


def fits(local: Local) -> Failures:
    """`local`: the ball contains {V <= c1}, and its jets take neither too much memory nor too much time."""
    if not contains_ball(exactly(local.J), exactly(local.case.c.P), Fraction(local.case.c.c1)):
        yield "levels.local", "the ball must contain {V <= c1}"
    if not are_usable(local.case.local.multipliers):
        yield "evidence.local", "no multiplier may be negative, none of g 0 where some beta is"
    yield from ball.fits(local)
    return 0


def decreases(local: Local) -> Failures:
    """`local`: Vdot < 0 on the ball without its centre."""
    if not are_finite(local.F, local.units):
        yield "levels.local", "F has no finite model on the local ball"
    decay, rest = local.sides
    if not is_definite(decay - rest):
        yield "levels.local", f"Vdot < 0 is not shown on the local ball: {1 - local.margin:.3g} of the decay"
    return 1
