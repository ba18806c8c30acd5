"""The geometry of the sublevel set `{x'Px <= c}`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]


def domain_limit(P: Array, domain: Sequence[tuple[Fraction, Fraction]]) -> float:
    """Supremum of the levels whose sublevel set lies in the box: `min_i d_i^2 / (P^-1)_ii`, d_i the nearer side."""
    inverse = np.linalg.inv(P)
    return min(float(min(-lo, hi)) ** 2 / float(p) for (lo, hi), p in zip(domain, np.diag(inverse), strict=True))


def leaves_domain(P: Array, level: float, domain: Sequence[tuple[Fraction, Fraction]]) -> bool:
    return level >= domain_limit(P, domain)


def semi_axes(P: Array, level: float) -> Array:
    """`sqrt(c / P_ii)`: how far the set reaches along each coordinate axis, shape (n,)."""
    return np.asarray(np.sqrt(level / np.diag(P)))


def extents(P: Array, level: float) -> Array:
    """`sqrt(c (P^-1)_ii)`: half-widths of the set's bounding box, shape (n,)."""
    return np.asarray(np.sqrt(level * np.diag(np.linalg.inv(P))))


def volume(P: Array, level: float) -> float:
    """Volume of the ellipsoid, `pi^(n/2) / Gamma(n/2 + 1) c^(n/2) / sqrt(det P)`."""
    n = len(P)
    unit = math.pi ** (n / 2) / math.gamma(n / 2 + 1)
    return float(unit * level ** (n / 2) / math.sqrt(np.linalg.det(P)))


def diagonalising_coordinates(P: Array, A: Array) -> Array:
    """T with `T'PT = I` and `T'(A'P + PA)T` diagonal, up to rounding; columns sorted by decay rate.

    In the coordinates `x = T z` sublevel sets are balls, so a smaller inner level costs only logarithmically many
    boxes, and the quadratic part of Vdot is separable.

    Raises
    ------
    InputError : P is not numerically positive definite.
    """
    try:
        L = np.linalg.cholesky(P)
    except np.linalg.LinAlgError as error:
        raise InputError("`P` must be positive definite; Cholesky failed. Try another --Q.") from error
    inverse = np.linalg.inv(L)
    rate = inverse @ (A.T @ P + P @ A) @ inverse.T
    _, U = np.linalg.eigh((rate + rate.T) / 2)
    return np.asarray(inverse.T @ U)
