"""Polynomial Lyapunov functions, term by term: what sums of squares and fits give.

Terms are kept as they are given. Nothing is collected or factored: the exact numbers that somebody chose are the
function that is proved, and every reader of them evaluates the same sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import prod

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]
MAX_DEGREE, MAX_TERMS = 12, 4096


@dataclass(frozen=True, slots=True)
class Polynomial:
    """`N(x) = sum over k of c_k x_1^a_k1 ... x_n^a_kn`, the coefficients meaning exactly their binary64 values.

    Parameters
    ----------
    exponents : (k, n), integers a of at least 0, no two rows alike; at most 4096 rows. The largest sum of a row, the
        degree, is 1 to 12; a constant term is a row of zeros.
    coefficients : (k,), finite.

    Raises
    ------
    InputError : one of these does not hold.

    Examples
    --------
    >>> N = Polynomial(np.array([[2, 0], [1, 1], [0, 4]]), np.array([1.0, -0.5, 3.0]))
    >>> N.degree, float(N(np.array([2.0, 1.0]))), N.gradient(np.array([2.0, 1.0])).tolist()
    (4, 6.0, [3.5, 11.0])
    """

    exponents: NDArray[np.int64]
    coefficients: Array

    def __post_init__(self) -> None:
        exponents, coefficients = np.array(self.exponents), np.array(self.coefficients, dtype=np.float64)
        if exponents.ndim != 2 or 0 in exponents.shape or exponents.dtype.kind not in "iu":
            raise InputError(
                "`exponents` must be integers of shape (terms, states), at least one of each; "
                f"found {exponents.dtype} of shape {exponents.shape}."
            )
        if len(exponents) > MAX_TERMS:
            raise InputError(f"a polynomial must have at most {MAX_TERMS} terms; found {len(exponents)}.")
        if np.any(exponents < 0) or np.any(exponents > MAX_DEGREE):  # so that no sum of a row overflows
            found = exponents[(exponents < 0) | (exponents > MAX_DEGREE)][0]
            raise InputError(f"`exponents` must lie between 0 and {MAX_DEGREE}; found {found}.")
        exponents = exponents.astype(np.int64)
        degree = int(exponents.sum(axis=1).max())
        if not 1 <= degree <= MAX_DEGREE:
            raise InputError(f"the degree of a polynomial must be 1 to {MAX_DEGREE}; found {degree}.")
        rows, counts = np.unique(exponents, axis=0, return_counts=True)
        if np.any(counts > 1):
            twice = rows[np.argmax(counts > 1)].tolist()
            raise InputError(f"no two rows of `exponents` may be alike; {twice} stands there twice. Add up its terms.")
        if coefficients.shape != (len(exponents),) or not np.all(np.isfinite(coefficients)):
            raise InputError(
                f"`coefficients` must be {len(exponents)} finite numbers, one for each row of `exponents`; "
                f"found shape {coefficients.shape}{'' if np.all(np.isfinite(coefficients)) else ', not all finite'}."
            )
        for name, array in (("exponents", exponents), ("coefficients", coefficients)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def n(self) -> int:
        """Number of states."""
        return int(self.exponents.shape[1])

    @property
    def degree(self) -> int:
        """The largest sum of a term's exponents."""
        return int(self.exponents.sum(axis=1).max())

    def __call__(self, x: Array) -> Array:
        """N in float64, shape (..., n) to (...)."""
        return np.asarray(monomials(x, self.exponents) @ self.coefficients)

    def gradient(self, x: Array) -> Array:
        """dN/dx in float64, shape (..., n) to (..., n)."""
        columns = []
        for i, unit in enumerate(np.eye(self.n, dtype=np.int64)):
            rows = self.exponents[:, i] > 0
            factors = self.coefficients[rows] * self.exponents[rows, i]
            columns.append(monomials(x, self.exponents[rows] - unit) @ factors)
        return np.stack(columns, axis=-1)

    def exactly(self, x: Array) -> Fraction:
        """N at a binary64 point, shape (n,), as a rational."""
        exact = [Fraction(float(v)) for v in x]
        terms = zip(self.exponents.tolist(), self.coefficients.tolist(), strict=True)
        return sum((Fraction(c) * prod(v**a for v, a in zip(exact, row, strict=True)) for row, c in terms), Fraction(0))


def monomials(x: Array, exponents: NDArray[np.int64]) -> Array:
    """Products of powers, shapes (..., n) and (k, n) to (..., k)."""
    result = np.ones((*x.shape[:-1], len(exponents)))
    for i, column in enumerate(exponents.T):
        powers = [np.ones(x.shape[:-1])]
        for _ in range(int(column.max(initial=0))):
            powers.append(powers[-1] * x[..., i])
        result *= np.stack(powers, axis=-1)[..., column]
    return result
