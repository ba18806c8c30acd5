"""Arb balls, shared by the rules on balls of states and on leaves.

This module avoids some traps: a comparison of balls is True only if it is certain, so a condition is written such
that True is needed to continue; `min`, `max` and `sorted` of Python compare midpoints at best, so balls have methods
for that; and a number that is not finite is compared with nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING

from flint import arb, arb_mat, fmpq

from .fields import exact

if TYPE_CHECKING:
    from .document import Certificate

PRECISION = 128  # bits
ON_LEAVES = 64  # the same on leaves, of which there are many
ZERO, ONE = arb(0), arb(1)
SPREAD = arb(0, 1)  # every number from -1 to 1


def lesser(a: arb, b: arb) -> arb:
    """One of two bounds, the first if it is certainly the lesser."""
    return a if a < b else b


def cube(v: arb) -> arb:
    """By products: flint's power of a ball whose middle and radius are infinite does not come back."""
    return v * v * v


def total(terms: Iterable[arb]) -> arb:
    return sum(terms, ZERO)


def absolute(A: arb_mat) -> arb_mat:
    return arb_mat(A.nrows(), A.ncols(), [abs(v) for v in A.entries()])


def columns_scaled(A: arb_mat, factors: Sequence[arb]) -> arb_mat:
    """A times a diagonal matrix."""
    scale = list(factors) * A.nrows()
    return arb_mat(A.nrows(), A.ncols(), [a * s for a, s in zip(A.entries(), scale, strict=True)])


def finite(values: Iterable[arb]) -> bool:
    return all(v.is_finite() for v in values)


def norm(values: Sequence[arb]) -> arb:
    """The largest 2-norm of a vector of balls; no upper bound of a sum of squares is negative, so the root exists."""
    row = arb_mat(1, len(values), list(values))
    return arb((row * row.transpose())[0, 0].upper()).sqrt()


def spectral_norm(W: arb_mat) -> arb:
    """A bound of ||W||_2, whose 64th power is that of (W'W)^32 and at most its Frobenius norm."""
    G = W if W.nrows() >= W.ncols() else W.transpose()
    for _ in range(6):
        G = G.transpose() * G
    whole = norm(G.entries())
    return whole if whole.is_zero() else whole.root(64)  # of 0 that is no number


@cache
def identity(n: int) -> arb_mat:
    """The identity matrix, shared: callers must not change it."""
    return arb_mat(n, n, [int(i == j) for i in range(n) for j in range(n)])


def certainly_definite(A: arb_mat) -> bool:
    """True if every symmetric matrix in A is positive definite: each pivot of L diag L' is certainly positive.

    Only entries on and below the diagonal are read. A pivot must be finite: +inf > 0 is certain, and shows nothing.
    """
    rows = A.tolist()
    for k, row in enumerate(rows):
        pivot = row[k]
        if not (pivot.is_finite() and pivot > 0):
            return False
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / pivot
            for j in range(k + 1, i + 1):
                rows[i][j] -= factor * rows[j][k]
    return True


def beta(c: Certificate) -> list[arb]:
    """atanh((u_eq - offset) / scale)."""
    each = zip(c.plant.u_eq, c.policy.scale, c.policy.offset, strict=True)
    return [arb((q - exact(b)) / exact(s)).atanh() for q, s, b in each]


def lies_within(values: Iterable[arb], lo: fmpq, hi: fmpq) -> bool:
    """True if all of these numbers certainly lie between the ends."""
    return all(v >= arb(lo) and v <= arb(hi) for v in values)


def within_bounds(c: Certificate, ranges: Sequence[tuple[arb, arb]]) -> bool:
    """True if every input, given by centre and radius, certainly lies in its bounds."""
    return all(
        lies_within((centre - radius, centre + radius), lo, hi)
        for (centre, radius), (lo, hi) in zip(ranges, c.plant.input_bounds, strict=True)
    )


def bounded_by_form(c: Certificate) -> bool:
    """True if each input lies in its bounds by form: by the range that squash, centring and clip leave it."""
    squashed = c.policy.centre != "output" and c.policy.squash == "tanh"
    each = zip(c.policy.scale, c.policy.offset, c.plant.input_bounds, strict=True)
    for j, (s, b, (lo, hi)) in enumerate(each):
        limits = c.policy.limits(j)
        ends = (exact(b) - abs(exact(s)), exact(b) + abs(exact(s))) if squashed else limits
        if ends is not None and limits is not None:
            ends = (min(max(ends[0], limits[0]), limits[1]), min(max(ends[1], limits[0]), limits[1]))
        if ends is None or not (lo <= ends[0] and ends[1] <= hi):
            return False
    return True
