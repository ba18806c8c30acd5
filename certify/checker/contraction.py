"""The rule `contraction`: on a ball that holds {V <= c0} any two trajectories come closer, where q is constant, in the
norm of P: at all times, or with every step. So there is one equilibrium at most, to which those that stay in {V <= c0}
converge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from flint import fmpq, fmpq_mat

from . import ball
from .ball import Ball
from .case import Case, Failures, given
from .decrease import Models, are_finite, vectors
from .exact import diagonal, exactly, is_definite, quotient, rational, root_above
from .jets import unpacked
from .local import is_large_enough
from .near import Above, Array, Tensor, size
from .pairs import bound_of_pairs, in_binary64
from .sections import Contraction
from .stepping import lengths_of_forms

if TYPE_CHECKING:
    from .rules import Tally


@dataclass(frozen=True)
class Contracted(Ball):
    """The ball of the section `contraction`."""

    by: Contraction
    close = True

    @classmethod
    def of(cls, case: Case) -> Contracted:
        kind, by = cls, given(case.c.contraction)
        if case.c.sample is not None:
            from .held import HeldClose

            kind = HeldClose
        return kind(case, by.J, "contraction", by, directions=by.directions)


def fits(ball_: Contracted) -> Failures:
    """The ball contains {V <= c0}, and the weights are positive."""
    yield from is_large_enough(ball_, "levels.floor", "c0", ball_.case.c.c0)
    if not np.all(ball_.by.weights > 0):
        yield "evidence.contraction.weights", "must be positive"
    return 0


def contracts(ball_: Contracted) -> Failures:
    """V(e + h g) - V(e), over h, is negative for any two points of the ball; e is their difference, g that of G, and h
    is 0 in continuous time, where this is 2 e'P g, and the longest period where inputs are held."""
    P, step, count = exactly(ball_.case.c.P), ball_.case.c.step, 0
    h = quotient(step)
    for part, cell in ((part, cell) for part in ball_.on_cones() for cell in ball_.case.cells):
        G = part.change(cell)
        doubts = [g.lipschitz + g.slack for g in G]
        finite = bool(G) and are_finite(G) and all(np.isfinite(v.top) for v in doubts)
        models = Models(ball_.J, G, rest=True) if finite else None
        if models is not None:
            part.note_kinks(models)
        beyond = 0.0 if models is None or h == 0 else _size_beyond(models, doubts, ball_.case.c.P)
        if models is None or not np.isfinite(beyond):
            yield ball_.at, "F has no finite model"
            return count
        sizes = [rational(v.top) for v in doubts]
        b = P * models.J  # b_i is row i
        rest = _rest(models, b, sizes, ball_.by)
        for corner in models.corners():
            crossed = models.J.transpose() * P * corner.A
            form = crossed + crossed.transpose()
            if h != 0:
                most = sum((more.lengths(models, P)[1] for more in models.more), rational(beyond))
                form += h * (corner.A.transpose() * P * corner.A + diagonal([most**2] * b.ncols()))
                rest = _rest(models, P * (models.J + h * corner.A), sizes, ball_.by)
            count += 1
            if not is_definite(-form - rest):
                yield ball_.at, "it is not shown that trajectories come closer"
    return count


def examine(tally: Tally, case: Case) -> None:
    tally.hold(OF_CONTRACTION, Contracted.of(case))


OF_CONTRACTION = (("contraction", fits), ("contraction", ball.is_not_clipped), ("contraction", contracts))


def _rest(models: Models, b: fmpq_mat, doubts: Sequence[fmpq], by: Contraction) -> fmpq_mat:
    """A bound of twice the sum of b_i.e times what g_i has beyond a_i.e."""
    lengths = [root_above(sum((v * v for v in row), fmpq(0))) for row in b.tolist()]
    along = 2 * sum((length * doubt for length, doubt in zip(lengths, doubts, strict=True)), fmpq(0))
    found = _turning(models, b, by.weights.tolist()) + _twisting(models, b, by.weight) + diagonal([along] * b.ncols())
    return sum((more.bound(models, b, by.weight) for more in models.more), found)


def _size_beyond(models: Models, doubts: Sequence[Above], P: Array) -> float:
    """Gamma: an upper bound of the length, in the norm of P, of what g has beyond A e, ||e|| = 1; maybe infinite."""
    bent, twisted = lengths_of_forms(models, P)
    roots = (size(P[i, i]).root * doubt for i, doubt in enumerate(doubts))
    return float(sum(roots, bent * 2 + twisted * 3).top)


def _turning(models: Models, b: fmpq_mat, weights: list[float]) -> fmpq_mat:
    """(diag(g) + sum_j N_j diag(1/g) N_j)/2, N_j = 2 sum_i (b_i (Q_i)_j:' + (Q_i)_j: b_i')."""
    k, g = b.ncols(), [rational(w) for w in weights]
    inverse, found = diagonal([1 / w for w in g]), diagonal(g)
    columns = [fmpq_mat(k, 1, row) for row in b.tolist()]
    for j in range(k):
        halves = (column * fmpq_mat(1, k, Q.tolist()[j]) for column, Q in zip(columns, models.Q, strict=True))
        half = sum(halves, fmpq_mat(k, k))
        N = 2 * (half + half.transpose())
        found += N * inverse * N
    return found / 2


def _twisting(models: Models, b: fmpq_mat, weight: Array) -> fmpq_mat:
    """3 sum_i <b_i, T_i>, from above."""
    k = b.ncols()
    if not np.any(models.K):
        return fmpq_mat(k, k)
    row, power = in_binary64(b)
    T = Tensor(np.moveaxis(unpacked(models.K.T, k), 0, -1).reshape(k, k * k, -1))
    return 3 * bound_of_pairs(vectors(row), T, weight) * fmpq(2) ** power
