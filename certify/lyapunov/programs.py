"""The semidefinite program of the optimised candidate, as rows of numbers that Clarabel takes.

The program is about one symmetric matrix of the plant's size. A modelling language takes a few times as long to be
loaded, and to find these rows out, than the solver takes for all of them, and the program is the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from certify.errors import BackendError

Array = NDArray[np.float64]
Inequality = tuple[Callable[[Array], Array], Array]
"""L and C of `L(M) - C >= 0`, positive semidefinite; L is linear, and takes matrices (..., n, n) to symmetric ones."""


def smallest_trace(matrices: Sequence[Inequality], rows: Array, least: Array, tolerance: float) -> Array | None:
    """The symmetric M, (n, n), of the smallest trace with `L(M) - C >= 0` for each pair and `<G, M> >= c` for each row.

    Parameters
    ----------
    matrices : the pairs.
    rows, least : (N, n, n), G, and (N,), c.
    tolerance : of the solver, absolute and relative.

    Returns
    -------
    Array : None if a number of the program is not finite, or the solver's status is anything but solved.

    Raises
    ------
    BackendError : Clarabel is missing.

    >>> twice = (lambda M: 2 * M, np.diag([2.0, 6.0]))
    >>> found = smallest_trace([twice], np.array([[[0.0, 0.5], [0.5, 0.0]]]), np.array([1.0]), 1e-8)
    >>> found is not None and [round(float(v), 4) for v in found.ravel()]
    [2.0, 1.0, 1.0, 4.0]
    """
    try:
        import clarabel
        from scipy import sparse
    except ImportError as error:
        raise BackendError(f"the candidate 'optimised' needs clarabel: {error}. Install it, or use another.") from error
    n = rows.shape[-1]
    basis, (down, across) = _basis(n), np.triu_indices(n)
    held = rows[:, down, across] + np.where(down == across, 0.0, rows[:, across, down])
    A = np.concatenate([-held, *(-_triangle(L(basis)).T for L, _ in matrices)])
    b = np.concatenate([-least, *(-_triangle(C) for _, C in matrices)])
    if not (np.all(np.isfinite(A)) and np.all(np.isfinite(b))):
        return None
    settings = clarabel.DefaultSettings()
    settings.verbose = False
    settings.tol_gap_abs = settings.tol_gap_rel = settings.tol_feas = tolerance
    cones = [clarabel.NonnegativeConeT(len(rows)), *(clarabel.PSDTriangleConeT(n) for _ in matrices)]
    nothing, trace = sparse.csc_array((len(down), len(down))), np.where(down == across, 1.0, 0.0)
    found = clarabel.DefaultSolver(nothing, trace, sparse.csc_array(A), b, cones, settings).solve()
    if found.status != clarabel.SolverStatus.Solved:
        return None
    return np.asarray(np.tensordot(np.asarray(found.x, dtype=np.float64), basis, axes=1))


def _basis(n: int) -> Array:
    """The symmetric matrices (N, n, n) with one entry 1 on or above the diagonal, row by row."""
    down, across = np.triu_indices(n)
    found, which = np.zeros((len(down), n, n)), np.arange(len(down))
    found[which, down, across] = found[which, across, down] = 1.0
    return found


def _triangle(matrices: Array) -> Array:
    """The entries on and above the diagonals of symmetric matrices (..., n, n), column by column; those off it count
    twice in a product of two matrices, and are scaled for that."""
    across, down = np.tril_indices(matrices.shape[-1])
    return np.asarray(matrices[..., down, across] * np.where(down == across, 1.0, np.sqrt(2.0)))
