"""Bounds of parameters by sums of rows: linear programs find the multipliers, weak duality makes bounds of them.

Rows R = alpha + g.z, |R| <= slack, of symbols z in [-1, 1]: for any weights w
`z_j = (e_j - sum w g).z - sum w alpha + sum w R`, so that z_j lies within `|e_j - sum w g|_1 + sum |w| slack` of
`-sum w alpha`. The best w are the multipliers of a linear program (Farkas, von Neumann); none that is a little off
gives a wrong bound.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.sparse import csr_matrix

from certify.provers.bounds.arrays import Array
from certify.provers.data.models import Rows

_SHORT = 2.0**-32  # of the largest multiplier: smaller ones are left out
_INFEASIBLE, _DONE = 2, 0  # answers of the solver


@dataclass(frozen=True)
class Program:
    """`|offset + matrix z| <= 1`, z in [-1, 1]: M rows in units of their `slack`, of which the first columns are
    parameters. Columns of errors of measurements come after them if these are shared; else errors are in the slack."""

    matrix: csr_matrix
    offset: Array
    slack: Array

    def extremes(self, a: Array, sign: float) -> Array | None:
        """Weights (M,) of rows with which weak duality bounds the sum a.d of the parameters' symbols, a (K,) of a size
        around 1, from below for sign 1 and from above for sign -1; None if no z obeys all rows."""
        cost = np.zeros(self.matrix.shape[1])
        cost[: len(a)] = sign * a
        reach = np.asarray(abs(self.matrix).sum(1)).ravel()
        above = np.flatnonzero(self.offset + reach > 1)  # others hold for all z
        below = np.flatnonzero(reach - self.offset > 1)
        weights = np.zeros(len(self.offset))
        if len(above) + len(below):
            A, b = self._sides(above, below)
            answer = linprog(cost, A_ub=A, b_ub=b, bounds=(-1.0, 1.0), method="highs")
            if answer.status == _INFEASIBLE:
                return None
            if answer.status == _DONE:
                multipliers = np.maximum(-answer.ineqlin.marginals, 0.0)
                np.add.at(weights, above, -multipliers[: len(above)])
                np.add.at(weights, below, multipliers[len(above) :])
        return sign * _short(weights) / self.slack

    def contradiction(self) -> Array:
        """Weights (M,) of rows that need all slacks to grow the most, by one factor, to allow a z."""
        every = np.arange(len(self.offset))
        A, b = self._sides(every, every)
        A = sparse.hstack([A, sparse.csr_matrix(-np.ones((A.shape[0], 1)))]).tocsr()
        bounds = [(-1.0, 1.0)] * self.matrix.shape[1] + [(None, None)]
        answer = linprog(np.eye(A.shape[1])[-1], A_ub=A, b_ub=b, bounds=bounds, method="highs")
        multipliers = np.maximum(-answer.ineqlin.marginals, 0.0)
        return _short(multipliers[len(every) :] - multipliers[: len(every)]) / self.slack

    def _sides(self, above: NDArray[np.intp], below: NDArray[np.intp]) -> tuple[csr_matrix, Array]:
        """The inequalities of the upper sides of some rows, and of the lower sides of some."""
        A = sparse.vstack([self.matrix[above], -self.matrix[below]]).tocsr()
        return A, np.concatenate([1 - self.offset[above], 1 + self.offset[below]])


def _short(weights: Array) -> Array:
    """Weights without those that hardly count."""
    return np.where(np.abs(weights) > _SHORT * np.abs(weights).max(initial=0.0), weights, 0.0)


def separate(rows: Rows, noise: Array) -> Program:
    """The program of rows whose errors are their own: a row for each state and transition, in the order (n, T)."""
    n = rows.alpha.shape[0]
    slack = rows.slack + np.abs(rows.slopes[:, :n]).sum(1) + noise[:, None]
    g = rows.slopes[:, n:].swapaxes(1, 2).reshape(rows.alpha.size, -1)
    return _in_units(sparse.csr_matrix(g), rows.alpha.ravel(), slack.ravel())


def joint(rows: Rows, noise: Array, begins: NDArray[np.intp]) -> Program:
    """The program of rows that share errors: `begins` (T,) are numbers of the measurements where transitions begin."""
    n, T = rows.alpha.shape
    K = rows.slopes.shape[1] - n
    numbers, place = np.unique(np.concatenate([begins, begins + 1]), return_inverse=True)
    first, second = place[:T], place[T:]
    i, t = np.indices((n, T)).reshape(2, -1)
    row = np.arange(n * T)
    entries = [(row, np.full(n * T, k), rows.slopes[i, n + k, t]) for k in range(K)]
    entries += [(row, K + first[t] * n + j, rows.slopes[i, j, t]) for j in range(n)]
    entries += [(row, K + second[t] * n + i, -noise[i])]
    at, column, value = (np.concatenate(part) for part in zip(*entries, strict=True))
    g = sparse.csr_matrix((value, (at, column)), shape=(n * T, K + n * len(numbers)))
    return _in_units(g, rows.alpha.ravel(), rows.slack.ravel())


def _in_units(matrix: csr_matrix, offset: Array, slack: Array) -> Program:
    return Program(sparse.csr_matrix(sparse.diags(1 / slack) @ matrix), offset / slack, slack)


def bound(rows: Rows, noise: Array, begins: NDArray[np.intp], weights: Array, a: Array) -> tuple[float, float]:
    """Between what a sum a.d of the parameters' symbols lies, by rows with weights (n, T), as the checkers bound it."""
    n = rows.alpha.shape[0]
    own = np.einsum("it,ist->s", weights, rows.slopes[:, n:])
    own -= a
    errors = np.zeros((n, int(begins.max()) + 2))
    errors[:, begins] += np.einsum("it,ijt->jt", weights, rows.slopes[:, :n])
    errors[:, begins + 1] -= noise[:, None] * weights
    reach = np.abs(own).sum() + np.abs(errors).sum() + (np.abs(weights) * rows.slack).sum()
    middle = -(weights * rows.alpha).sum()
    return float(middle - reach), float(middle + reach)


def miss(rows: Rows, noise: Array, begins: NDArray[np.intp], weights: Array) -> float:
    """By how much the sum of rows with weights (n, T) is away from all that it may be; positive if the rows contradict
    one another."""
    n = rows.alpha.shape[0]
    own = np.einsum("it,ist->s", weights, rows.slopes[:, n:])
    errors = np.zeros((n, int(begins.max()) + 2))
    errors[:, begins] += np.einsum("it,ijt->jt", weights, rows.slopes[:, :n])
    errors[:, begins + 1] -= noise[:, None] * weights
    reach = np.abs(own).sum() + np.abs(errors).sum() + (np.abs(weights) * rows.slack).sum()
    return float(abs((weights * rows.alpha).sum()) - reach)
