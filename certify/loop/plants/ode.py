"""The Runge-Kutta step that simulates plants for training, falsification and pictures, never for a proof; the
eigenvalues of plants at simulated states, and the time that runs last.

There is one copy, so that training is reproducible bit by bit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
LATE, DOUBLINGS = 0.01, 6
"""Share of the runs that has to converge in twice their time for it to be doubled, and how often it is."""
_APART = 1e-5  # of the states' widths, between the points of a difference
T = TypeVar("T")


def rk4_step(field: Callable[[T], T], x: T, step: Any) -> T:
    """One step of the classical Runge-Kutta method of order four for `xdot = field(x)`.

    Parameters
    ----------
    field : states (..., n) to their derivatives (..., n), numpy arrays or torch tensors.
    x : states, of any leading shape. The first stage is `field(x)` with this very object, so that a caller who knows
        the field there need not compute it again.
    step : seconds; a number, or an array or tensor that broadcasts against x, such as one step per state (..., 1).

    Notes
    -----
    The step does not mix the states of a batch, unless `field` does. With torch the step can be differentiated in x, in
    `step` and in the parameters of `field`.

    >>> rk4_step(lambda x: -x, 1.0, 0.1)  # exp(-0.1) = 0.90483742, and 0.1^5 / 120 = 8e-8
    0.9048375
    """
    f: Callable[[Any], Any] = field
    y: Any = x
    k1 = f(y)
    k2 = f(y + (step / 2) * k1)
    k3 = f(y + (step / 2) * k2)
    k4 = f(y + step * k3)
    after: T = y + (step / 6) * (k1 + 2 * k2 + 2 * k3 + k4)
    return after


def eigenvalues_of(field: Callable[[Array], Array], x: Array, widths: Array) -> NDArray[np.complex128]:
    """Eigenvalues of the Jacobians of `field` at states (N, n), by central differences; without states that have none.

    Parameters
    ----------
    field : states (..., n) to their derivatives (..., n), numpy arrays.
    widths : (n,), positive: the widths of the region of interest, which scale a difference.

    >>> eigenvalues_of(lambda x: -2 * x, np.zeros((1, 1)), np.ones(1)).real.round(6).tolist()
    [[-2.0]]
    """
    J = _jacobians(field, x, widths)
    return np.asarray(np.linalg.eigvals(J[np.all(np.isfinite(J), axis=(1, 2))]), dtype=np.complex128)


def fastest_at(field: Callable[[Array], Array], x: Array, widths: Array) -> Array:
    """The largest modulus (N,) of an eigenvalue of the Jacobian at each state (N, n), as `eigenvalues_of` has them;
    infinite where there is none.

    >>> fastest_at(lambda x: -(x**3), np.array([[1.0], [2.0]]), np.ones(1)).round(6).tolist()
    [3.0, 12.0]
    """
    J = _jacobians(field, x, widths)
    finite = np.all(np.isfinite(J), axis=(1, 2))
    found = np.full(len(x), np.inf)
    found[finite] = np.abs(np.linalg.eigvals(J[finite])).max(-1)
    return found


def lengthened(
    found: Mask, undecided: Mask, again: Callable[[NDArray[np.int64], int], tuple[Mask, Mask] | None], most: int
) -> int:
    """Double the time of runs as long as that lets more of them converge, and say how often that was, at most `most`.

    Where an input saturates the way to the origin may take far longer than the motion about it.

    Parameters
    ----------
    found, undecided : of each run (N,): that it converges, that it does neither this nor leave; both are brought up to
        date.
    again : the same of some runs, by their numbers, in 2^k times the time; None where that costs too much.

    >>> found, needed = np.zeros(4, dtype=bool), np.array([1, 2, 3, 40])
    >>> lengthened(found, ~found, lambda at, k: (needed[at] <= 2**k, needed[at] > 2**k), DOUBLINGS), found.tolist()
    (2, [True, True, True, False])
    """
    least = max(LATE * len(found), 1)
    for k in range(most):
        at = np.flatnonzero(undecided)
        longer = again(at, k + 1) if len(at) >= least else None
        if longer is None or longer[0].sum() < least:
            return k
        found[at], undecided[at] = longer
    return most


def _jacobians(field: Callable[[Array], Array], x: Array, widths: Array) -> Array:
    """Jacobians (N, n, n), transposed, by central differences."""
    delta = _APART * widths
    shifted = x[:, None, None, :] + np.array([1.0, -1.0])[:, None, None] * np.diag(delta)
    with np.errstate(all="ignore"):
        F = field(shifted)
        return np.asarray((F[:, 0] - F[:, 1]) / (2 * delta)[:, None])
