"""Rational arithmetic: what can be decided exactly is decided exactly."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

Matrix = list[list[Fraction]]
MAX_BITS = 2**14


def rational(array: NDArray[np.float64]) -> Matrix:
    """A binary64 matrix as exact fractions."""
    return [[Fraction(float(v)) for v in row] for row in array]


def congruence(T: Matrix, P: Matrix) -> Matrix:
    """`T' P T`."""
    n = len(P)
    PT = [[sum((P[i][k] * T[k][j] for k in range(n)), Fraction(0)) for j in range(n)] for i in range(n)]
    return [[sum((T[k][i] * PT[k][j] for k in range(n)), Fraction(0)) for j in range(n)] for i in range(n)]


def inverse_diagonal(A: Matrix) -> list[Fraction] | None:
    """Diagonal of `A^-1` for a symmetric A that is positive definite; None if it is not.

    Gauss-Jordan elimination without pivoting: a symmetric matrix is positive definite if and only if
    every pivot is positive (they are the D of its LDL' factorisation).
    """
    n = len(A)
    if any(A[i][j] != A[j][i] for i in range(n) for j in range(i)):
        return None
    rows = [[*A[i], *(Fraction(int(i == j)) for j in range(n))] for i in range(n)]
    for k in range(n):
        pivot = rows[k][k]
        if not pivot > 0:
            return None
        rows[k] = [v / pivot for v in rows[k]]
        for i in range(n):
            factor = rows[i][k]
            if i != k and factor != 0:
                rows[i] = [v - factor * w for v, w in zip(rows[i], rows[k], strict=True)]
    return [rows[i][n + i] for i in range(n)]


def gershgorin_lower(A: Sequence[Sequence[Fraction]]) -> Fraction:
    """A lower bound of the smallest eigenvalue of a symmetric matrix."""
    return min(row[i] - sum((abs(v) for j, v in enumerate(row) if j != i), Fraction(0)) for i, row in enumerate(A))


class Undecided(Exception):
    """The value is not a rational that this arithmetic can name."""


def _small(a: Fraction) -> Fraction:
    """`a` itself; powers of powers could grow without end."""
    if max(a.numerator.bit_length(), a.denominator.bit_length()) > MAX_BITS:
        raise Undecided(f"a number of more than {MAX_BITS} bits")
    return a


class RationalAlgebra:
    """Exact evaluation of a tape; sin and cos only at exact 0, no division by zero."""

    def const(self, q: Fraction) -> Fraction:
        return q

    def add(self, a: Fraction, b: Fraction) -> Fraction:
        return _small(a) + _small(b)

    def neg(self, a: Fraction) -> Fraction:
        return -a

    def mul(self, a: Fraction, b: Fraction) -> Fraction:
        return _small(a) * _small(b)

    def inv(self, a: Fraction) -> Fraction:
        if a == 0:
            raise Undecided("division by zero")
        return 1 / a

    def sin(self, a: Fraction) -> Fraction:
        if a != 0:
            raise Undecided("sin of a number that is not 0")
        return Fraction(0)

    def cos(self, a: Fraction) -> Fraction:
        if a != 0:
            raise Undecided("cos of a number that is not 0")
        return Fraction(1)
