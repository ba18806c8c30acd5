"""Rational arithmetic: what can be decided exactly is decided exactly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from math import isqrt
from operator import add

import numpy as np
from flint import fmpq, fmpq_mat, fmpz
from numpy.typing import NDArray

from .document import Policy
from .expression import MAX_BITS
from .functions import FUNCTIONS, Undecided
from .near import Near, all_near
from .networks import Affine, OnNumbers

MAX_MATRIX_BITS = 2**16  # of a number in a matrix, times the matrix's size: beyond, a decision takes minutes
_MOST_BITS = 2**14  # the same where all of an inverse is wanted


def rational(value: float) -> fmpq:
    """A finite binary64 number as it is."""
    return fmpq(*float(value).as_integer_ratio())


def exactly(array: NDArray[np.float64]) -> fmpq_mat:
    """A finite binary64 matrix as it is."""
    return fmpq_mat([[rational(v) for v in row] for row in array.tolist()])


def diagonal(entries: Sequence[fmpq]) -> fmpq_mat:
    n = len(entries)
    return fmpq_mat([[entries[i] if i == j else fmpq(0) for j in range(n)] for i in range(n)])


def near_matrix(A: fmpq_mat) -> Near:
    """A rational matrix in binary64."""
    a, shape = all_near(fraction(v) for v in A.entries()), (A.nrows(), A.ncols())
    return Near(a.value.reshape(shape), a.error.shaped(*shape))


def inverse_diagonal(A: fmpq_mat) -> list[Fraction]:
    """Diagonal of `A^-1` for a symmetric positive definite A; empty if A is not (or too large to tell soon)."""
    if A.transpose() != A or not is_definite(A):
        return []
    inverse = A.inv()
    return [fraction(inverse[i, i]) for i in range(A.nrows())]


def inverse(A: fmpq_mat) -> fmpq_mat | None:
    """`A^-1`; None if there is none, or A is too large to tell soon."""
    numerator, _ = A.numer_denom()
    if A.nrows() * max(v.height_bits() for v in numerator.entries()) > _MOST_BITS or numerator.det() == 0:
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
    return is_definite(J.transpose() * P * J - diagonal([quotient(level)] * J.nrows()))


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


def quotient(q: Fraction) -> fmpq:
    return fmpq(q.numerator, q.denominator)


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


class Exactly(OnNumbers):
    """Networks of such numbers."""

    def affine(self, step: Affine, v: list[Exact]) -> list[Exact]:
        return [_row(row, bias, v) for row, bias in zip(step.weight.tolist(), step.bias.tolist(), strict=True)]


def policy_at_origin(policy: Policy) -> list[Fraction | None]:
    """pi(0) without centring, None where it is not known."""
    values, u = Exactly().run(policy.network, [Exact(Fraction(0))] * policy.network.reads), list[Exact]()
    for j, (v, scale, offset) in enumerate(zip(values, policy.scale.tolist(), policy.offset.tolist(), strict=True)):
        raw = Exact(Fraction(offset)) + Exact(Fraction(scale)) * (v.function("tanh") if policy.squash == "tanh" else v)
        u.append(clipped(raw, *(end.tolist()[j] for end in policy.clip)) if policy.clip else raw)
    return [x.value for x in u]


def clipped(x: Exact, lo: float, hi: float) -> Exact:
    return x if x.value is None else Exact(min(max(x.value, Fraction(lo)), Fraction(hi)))


def _row(row: list[float], bias: float, v: list[Exact]) -> Exact:
    terms = (Exact(Fraction(w)) * x for w, x in zip(row, v, strict=True) if w != 0)
    return reduce(add, terms, Exact(Fraction(bias)))
