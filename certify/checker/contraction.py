"""The rule `contraction`: on a ball that holds {V <= c0} any two trajectories come closer, where q is constant, in the
norm of P. So there is one equilibrium at most, to which those that stay in {V <= c0} converge."""

from __future__ import annotations

import numpy as np
from flint import fmpq, fmpq_mat

from . import ball
from .ball import Ball
from .case import Case, Failures
from .decrease import Models, are_finite, diagonal, rational, vectors
from .document import Contraction
from .exact import exactly, is_definite, root_above
from .jets import unpacked
from .local import is_large_enough
from .near import Array, Tensor
from .pairs import bound_of_pairs, in_binary64


class Contracted(Ball):
    """The ball of the section `contraction`."""

    def __init__(self, case: Case, evidence: Contraction) -> None:
        super().__init__(case, evidence.J, "contraction")
        object.__setattr__(self, "by", evidence)

    by: Contraction


def fits(ball_: Contracted) -> Failures:
    """The ball contains {V <= c0}, and its jets take neither too much memory nor too much time."""
    yield from is_large_enough(ball_, "levels.floor", "c0", ball_.case.c.c0)
    if not np.all(ball_.by.weights > 0):
        yield "evidence.contraction.weights", "must be positive"
    yield from ball.fits(ball_)
    return 0


def contracts(ball_: Contracted) -> Failures:
    """2 (x - y)'P (F(x) - F(y)) < 0 for any two points of the ball."""
    P, count = exactly(ball_.case.c.P), 0
    for cell in ball_.case.cells:
        F = ball_.F(cell)
        lips = [float(f.lipschitz.top) for f in F]
        if not (are_finite(F) and np.all(np.isfinite(lips))):
            yield ball_.at, "F has no finite model"
            return count
        models = Models(ball_.J, F, rest=True)
        b = P * models.J  # b_i is row i
        rest = _turning(models, b, ball_.by.weights.tolist()) + _twisting(models, b, ball_.by.weight)
        for i, lip in enumerate(lips):
            size = root_above(sum((v * v for v in b.tolist()[i]), rational(0.0)))
            rest += diagonal([2 * size * (rational(F[i].slack.top) + rational(lip))] * b.ncols())
        for corner in models.corners():
            crossed = models.J.transpose() * P * corner.A
            count += 1
            if not is_definite(-(crossed + crossed.transpose()) - rest):
                yield ball_.at, "it is not shown that trajectories come closer"
    return count


OF_CONTRACTION = (("contraction", fits), ("contraction", ball.is_not_clipped), ("contraction", contracts))


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
