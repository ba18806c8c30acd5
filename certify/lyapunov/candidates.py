"""Candidates for P. They need not be exact: the proof is about the resulting binary64 matrix."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]


def solve_lyapunov(A: Array, Q: Array, step: float = 0.0, decay: float = 0.0) -> Array:
    """Solve `A'P + PA + h A'PA + 2 alpha P = -Q` for the symmetric P: over a step, V falls by x'Qx + 2 alpha V by time.

    Parameters
    ----------
    A : (n, n), the rate of x over a step, x+ = x + h A x; in continuous time h = 0, and A + alpha I is Hurwitz (every
        eigenvalue has negative real part).
    Q : (n, n), symmetric positive definite.
    step : h, at least 0.
    decay : alpha, at least 0.

    Raises
    ------
    InputError : A is not stable, or not with this decay, or Q not symmetric positive definite.

    Notes
    -----
    SciPy solves `A X + X A' = Q`, so it is given A' and -Q, and `A X A' - X = -Q` in discrete time. Khalil, Nonlinear
    Systems, 3rd ed., theorem 4.6.

    >>> solve_lyapunov(np.array([[0.0, 1.0], [-2.0, -3.0]]), np.eye(2)).round(12)
    array([[1.25, 0.25],
           [0.25, 0.25]])
    """
    import scipy.linalg

    if not np.array_equal(Q, Q.T) or not np.min(np.linalg.eigvalsh(Q)) > 0:
        raise InputError("`Q` must be symmetric positive definite.")
    if step == 0:
        M = A + decay * np.eye(len(A)) if decay else A
        eigenvalues = np.linalg.eigvals(M)
        if not np.max(eigenvalues.real) < 0:
            raise InputError(f"`A` must be Hurwitz; its eigenvalues are {eigenvalues}.")
        P = _balanced(scipy.linalg.solve_continuous_lyapunov, M, -Q, 0.0)
    else:
        M = np.eye(len(A)) + step * A
        eigenvalues = np.linalg.eigvals(M)
        if not np.max(np.abs(eigenvalues)) ** 2 < 1 - 2 * decay * step:
            raise InputError(f"the map of a step must be stable; its eigenvalues are {eigenvalues}.")
        share = 1 - 2 * decay * step
        P = _balanced(scipy.linalg.solve_discrete_lyapunov, M / share**0.5, step * Q / share, 1.0)
    return np.asarray((P + P.T) / 2)


def _balanced(solve: Callable[[Array, Array], Array], M: Array, Q: Array, step: float) -> Array:
    """The solution for M' and Q; where states have units of very different sizes, and it is none in floats, that of a
    balanced M (Parlett and Reinsch, Numerische Mathematik 13, 1969)."""
    import scipy.linalg

    with warnings.catch_warnings(action="ignore"):  # of eigenvalues that are far apart
        P = solve(M.T, Q)
        if _is_definite(P) and _is_definite(P - M.T @ P @ M if step else -(M.T @ P + P @ M)):
            return P
        B, (scale, _) = scipy.linalg.matrix_balance(M, permute=False, separate=True)
        return np.asarray(solve(B.T, scale[:, None] * Q * scale) / scale[:, None] / scale)


def _is_definite(P: Array) -> bool:
    """True if a symmetric matrix is positive definite in floats, in whatever units its states are."""
    size = np.sqrt(np.maximum(np.diag(P), 0.0))
    return bool(
        np.all(size > 0) and np.all(np.isfinite(P)) and np.min(np.linalg.eigvalsh(P / size / size[:, None])) > 0
    )


def slowest_decay(A: Array, step: float = 0.0) -> float:
    """The largest alpha of `solve_lyapunov`, in 1/time: some V falls by 2 alpha V per unit of time.

    >>> round(slowest_decay(np.array([[-2.0]])), 12), round(slowest_decay(np.array([[-0.5]]), 1.0), 12)
    (2.0, 0.375)
    """
    eigenvalues = np.linalg.eigvals(A)
    if step == 0:
        return -float(np.max(eigenvalues.real))
    return float(np.min(1 - np.abs(1 + step * eigenvalues) ** 2)) / (2 * step)


def increment_matrix(P: Array, A: Array, step: float = 0.0) -> Array:
    """The matrix M of x'Mx, the increment of x'Px over a step of a linear loop, per unit of time.

    The loop is x' = A x, or where the step h is not 0 x+ = x + h A x.
    """
    M: Array = A.T @ P + P @ A
    return M + step * A.T @ P @ A if step else M
