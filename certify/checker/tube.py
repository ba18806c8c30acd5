"""The tube: V(t, x) = x'P(t)x decreases along every trajectory in {V <= 1}, from {x'P_0 x <= 1} to inside {V <= c2}.

P(t) is linear in t on each slab, so that what has to be negative is affine in t for every x, and two ends are enough.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

from flint import fmpq, fmpq_mat

from . import ball
from .ball import Ball
from .case import Case, Failures
from .decrease import Models, are_finite, shows
from .document import Slab
from .exact import contains_ball, exactly, inverse_diagonal, is_definite


@dataclass(frozen=True)
class Piece(Ball):
    """A slab between two nodes, on its ball."""

    start: fmpq_mat
    end: fmpq_mat
    slab: Slab


def pieces(case: Case) -> Iterator[Piece]:
    """The slabs in their order."""
    nodes = [exactly(P) for P in case.nodes]
    for k, (slab, start, end) in enumerate(zip(case.tube, nodes[:-1], nodes[1:], strict=True)):
        yield Piece(case, slab.J, f"tube[{k}]", start, end, slab)


def lies_in_domain(case: Case) -> Failures:
    """`tube`: every node is positive definite, and its ellipsoid lies in the interior of the domain."""
    for k, P in enumerate(case.nodes):
        inverse = inverse_diagonal(exactly(P))
        limits = [min(-lo, hi) for lo, hi in case.c.domain]
        if not (inverse and all(p < limit**2 for p, limit in zip(inverse, limits, strict=True))):
            yield f"tube node {k}", "P_k must be positive definite, its ellipsoid in the interior of the domain"
    return 0


def ends_inside(case: Case) -> Failures:
    """`tube`: the last ellipsoid lies in {V <= c2}."""
    c2 = Fraction(case.c.c2)
    if not is_definite(exactly(case.nodes[-1]) - exactly(case.c.P) / fmpq(c2.numerator, c2.denominator)):
        yield f"tube node {len(case.nodes) - 1}", "the last ellipsoid must lie in {V <= c2}"
    return 0


def fits(piece: Piece) -> Failures:
    """`tube`: a positive duration, a ball that contains the ellipsoids at both ends, jets that are not too large."""
    J = exactly(piece.J)
    if not 0 < piece.slab.duration < float("inf"):
        yield piece.at, "the duration must be positive"
    if not all(contains_ball(J, P, Fraction(1)) for P in (piece.start, piece.end)):
        yield piece.at, "the ball must contain the ellipsoids at both ends"
    yield from ball.fits(piece)
    return 0


def decreases(piece: Piece) -> Failures:
    """`tube`: x'P(t)x decreases on the ball without its centre, at both ends of the slab."""
    if not are_finite(piece.F):
        yield piece.at, "F has no finite model"
    models = Models(piece.J, piece.F)
    rate = (piece.end - piece.start) / fmpq(*piece.slab.duration.as_integer_ratio())
    for P in (piece.start, piece.end):
        if not shows(models, P, rate, piece.slab.multipliers):
            yield piece.at, "the decrease of x'P(t)x is not shown"
    return 1
