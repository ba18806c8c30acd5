"""Rational arithmetic: what can be decided exactly is decided exactly."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from math import isqrt

import numpy as np
from flint import fmpq, fmpq_mat, fmpz
from numpy.typing import NDArray

from .document import Policy
from .expression import MAX_BITS
from .functions import FUNCTIONS, Undecided

MAX_INVERSE_BITS = 2**14  # of a number in a matrix all of whose inverse is wanted, times the matrix's size
MAX_MATRIX_BITS = 2**16  # of a number in a matrix, times the matrix's size: beyond, a decision takes minutes


def exactly(array: NDArray[np.float64]) -> fmpq_mat:
    """A finite binary64 matrix as it is."""
    return fmpq_mat([[fmpq(*v.as_integer_ratio()) for v in row] for row in array.tolist()])


def inverse_diagonal(A: fmpq_mat) -> list[Fraction]:
    """Diagonal of `A^-1` for a symmetric positive definite A; empty if A is not (or too large to tell soon)."""
    if A.transpose() != A or not is_definite(A):
        return []
    inverse = A.inv()
    return [fraction(inverse[i, i]) for i in range(A.nrows())]


def inverse(A: fmpq_mat) -> fmpq_mat | None:
    """`A^-1`; None if there is none, or A is too large to tell soon."""
    numerator, _ = A.numer_denom()
    if A.nrows() * max(v.height_bits() for v in numerator.entries()) > MAX_INVERSE_BITS or numerator.det() == 0:
        return None
    return A.inv()


def is_definite(A: fmpq_mat) -> bool:
    """True if d'A d > 0 for every d but 0; False as well if A is too large to decide quickly.

    It holds exactly if every leading principal minor of the symmetric part is positive (Sylvester). Fraction-free
    elimination leaves them on the diagonal one by one, and each of its divisions is exact (Bareiss). It keeps a
    symmetric matrix symmetric, so that the lower half is enough.
    """
    n, (S, _) = A.nrows(), (A + A.transpose()).numer_denom()
    if n * max(v.height_bits() for v in S.entries()) > MAX_MATRIX_BITS:
        return False
    rows, before = S.tolist(), fmpz(1)
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if not pivot > 0:
            return False
        for i in range(k + 1, n):
            for j in range(k + 1, i + 1):
                rows[i][j] = (rows[i][j] * pivot - rows[i][k] * rows[j][k]) // before
        before = pivot
    return True


def contains_ball(J: fmpq_mat, P: fmpq_mat, level: Fraction) -> bool:
    """True if {x'Px <= level} lies in {J d : ||d|| <= 1}: J'PJ - level I is positive definite."""
    n, c = J.nrows(), fmpq(level.numerator, level.denominator)
    identity = fmpq_mat([[fmpq(int(i == j)) for j in range(n)] for i in range(n)])
    return is_definite(J.transpose() * P * J - c * identity)


def gershgorin_lower(A: fmpq_mat) -> Fraction:
    """A lower bound of the smallest eigenvalue of a symmetric matrix."""
    rows = A.tolist()
    return fraction(
        min(row[i] - sum((abs(v) for j, v in enumerate(row) if j != i), fmpq(0)) for i, row in enumerate(rows))
    )


def root_above(q: fmpq) -> fmpq:
    """A rational at or above the square root of q >= 0, within 2^-60 of itself."""
    p, r = int(q.p), int(q.q)
    shift = max(0, 64 + (r.bit_length() - p.bit_length()) // 2 + 1)
    return fmpq(isqrt((p << 2 * shift) // r) + 1, 1 << shift) if p else fmpq(0)


def fraction(q: fmpq) -> Fraction:
    return Fraction(int(q.p), int(q.q))


@dataclass(frozen=True)
class Exact:
    """A number on the tape: a rational, or None for one that is none or is not known to be: functions are known at
    exact 0, roots of squares. Exact 0 times None is 0, because rule `local` has shown that None is a number."""

    value: Fraction | None

    def __post_init__(self) -> None:
        """Powers of powers could grow without end."""
        q = self.value
        if q is not None and max(q.numerator.bit_length(), q.denominator.bit_length()) > MAX_BITS:
            raise Undecided(f"a number of more than {MAX_BITS} bits")

    def __add__(self, other: Exact) -> Exact:
        return Exact(None if self.value is None or other.value is None else self.value + other.value)

    def __neg__(self) -> Exact:
        return Exact(None if self.value is None else -self.value)

    def __mul__(self, other: Exact) -> Exact:
        if self.value == 0 or other.value == 0:
            return Exact(Fraction(0))
        return Exact(None if self.value is None or other.value is None else self.value * other.value)

    def function(self, name: str) -> Exact:
        return self if self.value is None else Exact(FUNCTIONS[name].exact(self.value))


def raw_at_origin(policy: Policy) -> list[Fraction | None]:
    """raw(0), None where it is not known: tanh is known at exact 0 alone, and 0 times an unknown number is 0."""
    layers = [*zip(policy.weights, policy.biases, strict=True), (np.diag(policy.scale), policy.offset)]
    h: list[Fraction | None] = [Fraction(0)] * policy.weights[0].shape[1]
    for k, (W, b) in enumerate(layers):
        if 0 < k < len(policy.weights) or (k > 0 and policy.squash == "tanh"):
            h = [Fraction(0) if v == 0 else None for v in h]
        h = [_affine(row, bias, h) for row, bias in zip(W.tolist(), b.tolist(), strict=True)]
    return h


def policy_at_origin(policy: Policy) -> list[Fraction | None]:
    """pi(0) without centring: raw(0), clipped."""
    raw = raw_at_origin(policy)
    if policy.clip is None:
        return raw
    ends = ([Fraction(v) for v in end.tolist()] for end in policy.clip)
    return [None if v is None else min(max(v, lo), hi) for v, lo, hi in zip(raw, *ends, strict=True)]


def _affine(row: list[float], bias: float, h: list[Fraction | None]) -> Fraction | None:
    terms = [None if v is None else Fraction(w) * v for w, v in zip(row, h, strict=True) if w != 0]
    known = [v for v in terms if v is not None]
    return sum(known, Fraction(bias)) if len(known) == len(terms) else None
