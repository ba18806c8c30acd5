"""A and B of an unknown plant by least squares on transitions near the origin."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from controllers.options import Terms

Array = NDArray[np.float64]


def fit_A(x: Array, x_next: Array, terms: Terms = "linear") -> Array:
    """Least-squares A of `x+ = A x`; rows of `x` and `x_next` (N, n) are transitions with u = u_eq.

    With quadratic terms it is that of `x+ = A x + (a quadratic form of x)`, which takes n + n (n + 1) / 2 rows.

    >>> fit_A(np.array([[1.0, 0.0], [0.0, 2.0]]), np.array([[1.0, 3.0], [4.0, 0.0]]))
    array([[1., 2.],
           [3., 0.]])
    """
    if terms == "linear":
        return _least_squares(x, x_next, "A")
    n = x.shape[1]
    i, j = np.triu_indices(n)
    regressors = np.hstack([x, x[:, i] * x[:, j]])
    # In one unit: products are so much smaller than states that small ones would pass for zero.
    size = np.linalg.norm(regressors, axis=0)
    size[size == 0] = 1.0
    fitted = _least_squares(regressors / size, x_next, "A and the quadratic terms")
    return np.asarray(fitted[:, :n] / size[:n])


def fit_B(x: Array, v: Array, x_next: Array, A: Array) -> Array:
    """Least-squares B of `x+ - A x = B v` given A; `v = u - u_eq` has shape (N, m)."""
    return _least_squares(v, x_next - x @ A.T, "B")


def _least_squares(regressors: Array, targets: Array, name: str) -> Array:
    solution, _, rank, _ = np.linalg.lstsq(regressors, targets, rcond=None)
    if rank < regressors.shape[1]:
        raise InputError(
            f"the transitions do not determine {name}: they span {rank} of {regressors.shape[1]} directions. "
            "Collect more of them, or from a larger ball."
        )
    return np.ascontiguousarray(solution.T)  # as a checkpoint gives it back: products depend on the order in memory
