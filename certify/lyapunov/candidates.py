"""Candidates for P. They need not be exact: whatever binary64 matrix comes out is the one that is proved."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]


def solve_lyapunov(A: Array, Q: Array) -> Array:
    """Solve `A'P + PA = -Q` for the symmetric P.

    Parameters
    ----------
    A : (n, n), Hurwitz (every eigenvalue has negative real part).
    Q : (n, n), symmetric positive definite.

    Raises
    ------
    InputError : A is not Hurwitz or Q not symmetric positive definite.

    Notes
    -----
    SciPy solves `A X + X A' = Q`, so it is given A' and -Q. Khalil, Nonlinear Systems, 3rd ed., theorem 4.6.

    >>> solve_lyapunov(np.array([[0.0, 1.0], [-2.0, -3.0]]), np.eye(2)).round(12)
    array([[1.25, 0.25],
           [0.25, 0.25]])
    """
    eigenvalues = np.linalg.eigvals(A)
    if not np.max(eigenvalues.real) < 0:
        raise InputError(f"`A` must be Hurwitz; its eigenvalues are {eigenvalues}.")
    if not np.array_equal(Q, Q.T) or not np.min(np.linalg.eigvalsh(Q)) > 0:
        raise InputError("`Q` must be symmetric positive definite.")
    P = scipy.linalg.solve_continuous_lyapunov(A.T, -Q)
    return np.asarray((P + P.T) / 2)
