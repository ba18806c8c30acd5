"""The tube: V(t, x) = x'P(t)x decreases along every trajectory in {V <= 1}, from {x'P_0 x <= 1} to inside {V <= c2}.

Around a path c(t) it is V(t, x) = e'P(t)e, e = x - c(t), that decreases where it is 1, so that nothing leaves {V <= 1}.

On each slab P(t) is a polynomial of degree 2 in Bernstein's form, with the coefficients (start, middle, end). What has
to be negative is one as well, for every x, and is so if its three coefficients are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from flint import fmpq, fmpq_mat

from . import ball
from .ball import Ball
from .case import Case, Failures, given
from .decrease import Inequality, Models, Multipliers, are_finite, are_usable
from .exact import contains_ball, exactly, inverse_diagonal, is_definite, quotient, rational, root_above
from .near import Array
from .sections import Path, Slab

if TYPE_CHECKING:
    from .rules import Tally


@dataclass(frozen=True)
class Piece(Ball):
    """A slab on its ball, after the node `start` and its `centre`, which is None at rest."""

    start: Array
    centre: Array | None
    slab: Slab

    @property
    def coefficients(self) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat]:
        """The coefficients of P(t)."""
        return exactly(self.start), exactly(self.slab.middle), exactly(self.slab.end)

    @property
    def rates(self) -> tuple[fmpq_mat, fmpq_mat, fmpq_mat]:
        """Coefficients of its derivative, also of degree 2."""
        (start, middle, end), h = self.coefficients, rational(self.slab.duration)
        return 2 * (middle - start) / h, (end - start) / h, 2 * (end - middle) / h

    @property
    def centres(self) -> list[tuple[Fraction, Fraction]]:
        """The centres at the slab's start and end, state by state; 0 without a path."""
        if self.centre is None or self.slab.path is None:
            return [(Fraction(0), Fraction(0))] * len(self.J)
        ends = zip(self.centre.tolist(), self.slab.path.centre.tolist(), strict=True)
        return [(Fraction(a), Fraction(b)) for a, b in ends]

    @property
    def motion(self) -> tuple[list[Fraction], list[Fraction]] | None:
        if self.slab.path is None:
            return None
        twice = 2 * Fraction(self.slab.path.share)
        return [(a + b) / 2 for a, b in self.centres], [(b - a) / twice for a, b in self.centres]

    @property
    def velocity(self) -> list[fmpq]:
        """The centre's velocity; empty without a path."""
        if self.slab.path is None:
            return []
        moves = [(b - a) / Fraction(self.slab.duration) for a, b in self.centres]
        return [quotient(v) for v in moves]


def pieces(case: Case) -> Iterator[Piece]:
    """The slabs in their order."""
    tube = given(case.c.tube)
    node, centre = tube.start, tube.centre
    for k, slab in enumerate(tube.slabs):
        yield Piece(case, slab.J, f"tube[{k}]", node, centre, slab)
        node, centre = slab.end, None if slab.path is None else slab.path.centre


def nodes_are_sound(case: Case) -> Failures:
    """`tube`: positive definite matrices, whose ellipsoids lie in the interior of the domain, the last in {V <= c2}."""
    for piece in pieces(case):
        for P in piece.coefficients:
            if not lies_in(case, P, piece.centres):
                yield piece.at, "P must be positive definite, and its ellipsoid lie in the interior of the domain"
    if not is_attracted(case, exactly(piece.slab.end), [b for _, b in piece.centres]):
        yield "tube", "the last ellipsoid must lie in {V <= c2}"
    return 0


def lies_in(case: Case, P: fmpq_mat, centres: list[tuple[Fraction, Fraction]]) -> bool:
    """True if P is symmetric and positive definite, and the ellipsoids around both centres lie in the interior of the
    domain; then those around all centres between them do, too."""
    inverse = inverse_diagonal(P)
    sides = zip(inverse, centres, case.c.domain, strict=True) if inverse else ()
    return bool(inverse) and all(
        lo < c < hi and p < min(c - lo, hi - c) ** 2 for p, both, (lo, hi) in sides for c in both
    )


def is_attracted(case: Case, P_N: fmpq_mat, centre: list[Fraction]) -> bool:
    """True if {(x - c)'P_N (x - c) <= 1} lies in {V <= c2}: by the triangle inequality for (x'Px)^(1/2)."""
    P, c2 = exactly(case.c.P), Fraction(case.c.c2)
    c = fmpq_mat(len(centre), 1, [quotient(q) for q in centre])
    level = fmpq(c2.numerator, c2.denominator)
    left = 1 - root_above((c.transpose() * P * c)[0, 0] / level)
    return left > 0 and is_definite(P_N - P / (level * left * left))


def fits(piece: Piece) -> Failures:
    """`tube`: a positive duration, a ball that contains the three ellipsoids, multipliers that may be used."""
    J, path, room = exactly(piece.J), piece.slab.path, Fraction(1)
    if not 0 < piece.slab.duration < np.inf:
        yield piece.at, "the duration must be positive"
    if path is not None:
        if not 0 < path.share < 1:
            yield piece.at, "the share of the motion must lie between 0 and 1"
        room = 1 / (1 - Fraction(path.share) ** 2)
    if not all(contains_ball(J, P, room) for P in piece.coefficients):
        yield piece.at, "the ball must contain the ellipsoids of start, middle and end"
    if not are_all_usable(Multipliers.of(piece.slab), path):
        yield piece.at, "no multiplier may be negative, none of g 0 where some beta is"
    return 0


class AlongPath(Inequality):
    """The inequality z'J'RJ z + 2 z'J'P (F - v) < 0 where z'J'PJ z = 1, over (1, d), d = (z, sigma)."""

    share = fmpq(1)
    path: Path

    def position(self) -> fmpq_mat:
        return padded(self.models.J, 0, 1)

    @property
    def joint(self) -> list[fmpq]:
        return [*self.by.joint, rational(self.path.joint)]

    def form(self) -> fmpq_mat:
        """With the multipliers of edge and motion."""
        path, k = self.path, self.k
        share, edge, motion = rational(path.share), rational(path.edge), rational(path.motion)
        inner = padded(self.models.J.transpose() * self.P * self.models.J, 1, 1)
        form = super().form() + edge * fmpq_mat([[0] * (k + 1), *([0, *row] for row in inner.tolist())])
        form[k, k] -= motion
        form[0, 0] += motion * share * share - edge
        return form


def are_all_usable(by: Multipliers, path: Path | None) -> bool:
    """None is negative, and g is positive where it is used, that of the motion too."""
    if path is None:
        return are_usable(by)
    signs = all(v >= 0 for v in (path.edge, path.motion, path.joint))
    return are_usable(by) and signs and (path.joint > 0 or all(beta > 0 for beta in by.apart))


def inequality(models: Models, P: fmpq_mat, R: fmpq_mat, by: Multipliers, path: Path | None) -> Inequality:
    """The inequality that is asked of models."""
    if path is None:
        return Inequality(models, P, R, by)
    made = AlongPath(models, P, R, by)
    made.path = path
    return made


def padded(A: fmpq_mat, rows: int, columns: int) -> fmpq_mat:
    """A with that many rows and columns of zeros more."""
    wider = [[*row, *[0] * columns] for row in A.tolist()]
    return fmpq_mat([*wider, *([0] * (A.ncols() + columns) for _ in range(rows))])


def decreases(piece: Piece) -> Failures:
    """`tube`: x'P(t)x decreases on the ball without its centre; along a path e'P(t)e where it is 1."""
    by = Multipliers.of(piece.slab)
    for cell in piece.case.cells:
        F = piece.F(cell)
        if not are_finite(F):
            yield piece.at, "F has no finite model"
            return 1
        models = Models(piece.J, F, piece.slab.path is None, piece.velocity)
        for corner in models.corners(piece.case.c.P):
            for P, rate in zip(piece.coefficients, piece.rates, strict=True):
                if not inequality(corner, P, rate, by, piece.slab.path).holds:
                    yield piece.at, "the decrease of x'P(t)x is not shown"
    return 1


def keeps_constraints(piece: Piece) -> Failures:
    """`keep`: every constraint is negative on the ball, and so on the ellipsoids between nodes, which lie in it."""
    if piece.case.c.keep is None:
        return 0
    from .keep import on_ball

    count = 0
    for cell in piece.case.cells:
        count += yield from on_ball(piece, piece.states, piece.symbols(cell))
    return count


def examine(tally: Tally, case: Case) -> None:
    tally.hold(OF_THE_TUBE, case)
    for piece in pieces(case):
        tally.hold(ON_SLABS, piece)


OF_THE_TUBE = (("tube", nodes_are_sound),)
ON_SLABS = (
    ("tube", fits),
    ("inputs", ball.keeps_inputs),
    ("tube", ball.is_not_clipped),
    ("keep", keeps_constraints),
    ("tube", decreases),
)
