"""The interface of Lyapunov functions for claims and engines, and the quadratic one.

This module has the numbers and their evaluation in floats, for search and simulation. Bounds on boxes prove that a
function decreases along trajectories; these evaluations never do.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]


class LyapunovFunction(Protocol):
    """A function of the state for claims about its sublevel sets; its numbers are exact binary64."""

    @property
    def n(self) -> int:
        """Number of states."""

    def __call__(self, x: Array) -> Array:
        """The function in float64, shape (..., n) to (...)."""

    def gradient(self, x: Array) -> Array:
        """Its gradient in float64, shape (..., n) to (..., n)."""


@dataclass(frozen=True, slots=True)
class Quadratic:
    """`V(x) = x'Px`, the entries of P meaning exactly their binary64 values.

    Parameters
    ----------
    P : (n, n), symmetric, finite. Definiteness is a condition of the claim and is decided in rationals.

    Raises
    ------
    InputError : P is not a finite symmetric matrix.
    """

    P: Array

    def __post_init__(self) -> None:
        P = np.array(self.P, dtype=np.float64)
        if P.ndim != 2 or P.shape[0] != P.shape[1] or not np.all(np.isfinite(P)):
            raise InputError(f"`P` must be a finite square matrix; found shape {P.shape}.")
        if not np.array_equal(P, P.T):
            i, j = np.argwhere(P != P.T)[0]
            raise InputError(f"`P` must be symmetric; P[{i}, {j}] = {P[i, j]} but P[{j}, {i}] = {P[j, i]}.")
        P.setflags(write=False)
        object.__setattr__(self, "P", P)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.P)

    def __call__(self, x: Array) -> Array:
        """V in float64, shape (..., n) to (...)."""
        return np.asarray(x @ self.P @ x if x.ndim == 1 else ((x @ self.P) * x).sum(-1))

    def gradient(self, x: Array) -> Array:
        """2 P x in float64, shape (..., n) to (..., n)."""
        return np.asarray(2 * (x @ self.P))

    def exactly(self, x: Array) -> Fraction:
        """V at a binary64 point, shape (n,), as a rational."""
        exact = [Fraction(float(v)) for v in x]
        rows = (sum((Fraction(float(p)) * v for p, v in zip(row, exact, strict=True)), Fraction(0)) for row in self.P)
        return sum((v * r for v, r in zip(exact, rows, strict=True)), Fraction(0))
