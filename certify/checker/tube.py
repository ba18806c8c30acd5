"""The tube: V(t, x) = x'P(t)x decreases along every trajectory in {V <= 1}, from {x'P_0 x <= 1} to inside {V <= c2}.

On each slab P(t) is a polynomial of degree 2 in Bernstein's form, with the coefficients (start, middle, end). What has
to be negative is one as well, for every x, and is so if its three coefficients are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from flint import fmpq, fmpq_mat

from . import ball
from .ball import Ball
from .case import Case, Failures
from .decrease import Models, are_finite, are_usable, shows
from .document import Slab
from .exact import contains_ball, exactly, inverse_diagonal, is_definite
from .float64 import Array

_MOST_WORK = 2**26  # slabs times n^4, which is what an inequality takes


@dataclass(frozen=True)
class Piece(Ball):
    """A slab on its ball, after the node `start`."""

    start: Array
    slab: Slab

    @property
    def coefficients(self) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat]:
        """Of P(t)."""
        return exactly(self.start), exactly(self.slab.middle), exactly(self.slab.end)

    @property
    def rates(self) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat]:
        """Coefficients of its derivative, also of degree 2."""
        (start, middle, end), h = self.coefficients, fmpq(*self.slab.duration.as_integer_ratio())
        return 2 * (middle - start) / h, (end - start) / h, 2 * (end - middle) / h


def pieces(case: Case) -> Iterator[Piece]:
    """The slabs in their order."""
    node = case.c.start
    for k, slab in enumerate(case.tube):
        if node is not None:
            yield Piece(case, slab.J, f"tube[{k}]", node, slab)
        node = slab.end


def nodes_are_sound(case: Case) -> Failures:
    """`tube`: positive definite matrices, whose ellipsoids lie in the interior of the domain, the last in {V <= c2}."""
    if len(case.tube) * len(case.c.states) ** 4 > _MOST_WORK:
        yield "tube", "the tube is too long for this rule"
    limits = [min(-lo, hi) ** 2 for lo, hi in case.c.domain]
    start = [] if case.c.start is None else [("start", case.c.start)]
    middles_and_ends = [(f"tube[{k}]", P) for k, slab in enumerate(case.tube) for P in (slab.middle, slab.end)]
    for at, P in (*start, *middles_and_ends):
        inverse = inverse_diagonal(exactly(P))
        if not (inverse and all(p < limit for p, limit in zip(inverse, limits, strict=True))):
            yield at, "P must be positive definite, and its ellipsoid lie in the interior of the domain"
    last, c2 = exactly(case.tube[-1].end), Fraction(case.c.c2)
    if not is_definite(last - exactly(case.c.P) / fmpq(c2.numerator, c2.denominator)):
        yield "tube", "the last ellipsoid must lie in {V <= c2}"
    return 0


def fits(piece: Piece) -> Failures:
    """`tube`: a positive duration, a ball that contains the three ellipsoids, jets that are not too large."""
    J = exactly(piece.J)
    if not 0 < piece.slab.duration < np.inf:
        yield piece.at, "the duration must be positive"
    if not all(contains_ball(J, P, Fraction(1)) for P in piece.coefficients):
        yield piece.at, "the ball must contain the ellipsoids of start, middle and end"
    if not are_usable(piece.slab.multipliers):
        yield piece.at, "no multiplier may be negative, none of g 0 where some beta is"
    yield from ball.fits(piece)
    return 0


def decreases(piece: Piece) -> Failures:
    """`tube`: x'P(t)x decreases on the ball without its centre."""
    if not are_finite(piece.F):
        yield piece.at, "F has no finite model"
    models = Models(piece.J, piece.F)
    for P, rate in zip(piece.coefficients, piece.rates, strict=True):
        if not shows(models, P, rate, piece.slab.multipliers):
            yield piece.at, "the decrease of x'P(t)x is not shown"
    return 1
