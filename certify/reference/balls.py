"""Arb balls, shared by the rules on balls of states and on leaves.

This module avoids some traps: a comparison of balls is True only if it is certain, so a condition is written such
that True is needed to continue; `min`, `max` and `sorted` of Python compare midpoints at best, so balls have methods
for that; and a number that is not finite is compared with nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache
from typing import TYPE_CHECKING

from flint import arb, arb_mat

from .fields import exact

if TYPE_CHECKING:
    from .document import Certificate

PRECISION = 128  # bits
ON_LEAVES = 64  # the same on leaves, of which there are many
ZERO, ONE = arb(0), arb(1)
SPREAD = arb(0, 1)  # every number from -1 to 1


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
    return norm(G.entries()).root(64)


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


def derivatives(name: str, y: arb) -> tuple[arb, arb, arb, arb]:
    """phi, phi', phi'', phi''' on a ball."""
    if name == "1/":
        p = 1 / y
        return p, -(p * p), 2 * p * p * p, -6 * p * p * p * p
    if name == "tanh":
        t = y.tanh()
        slope = 1 - t * t
        return t, slope, -2 * t * slope, (6 * t * t - 2) * slope
    if name == "exp":
        e = y.exp()
        return e, e, e, e
    if name == "atan":
        p = 1 / (1 + y * y)
        return y.atan(), p, -2 * y * p * p, (6 * y * y - 2) * p * p * p
    if name == "sqrt":
        root = y.sqrt()
        p = 1 / root
        return root, p / 2, -p * p * p / 4, 3 * p * p * p * p * p / 8
    if name not in ("sin", "cos"):
        raise ValueError(f"nothing is known of {name}")
    s, k = y.sin(), y.cos()
    return (s, k, -s, -k) if name == "sin" else (k, -s, -k, s)


def third(name: str, at: arb, y: arb, reach: arb) -> arb | None:
    """A bound of |phi'''| on |v - y| <= reach, its value at y being `at`; None where phi may be undefined.

    For 1/v and sqrt it is six times the remainder's own factor. 1/v is its parabola at y less D^3 / (y^3 v), D = v - y.
    The root w of v is its parabola at y and D^3 (3 s + w) / (8 s^3 (s + w)^3), s the root of y, most where w is least.
    Both fall as |y| rises, and are taken where it is least. For tanh and atan |phi'''| is largest at 0.

    A division by a ball that contains 0, or a root of one that contains numbers that are not positive, must be refused
    here, whatever the use of the result: 0 times it is 0.
    """
    if name == "1/":
        size = arb(abs(y).lower())  # a number: the power of a wide ball may hold 0 where the ball does not
        least = arb((size - reach).lower())
        return 6 / (size * size * size * least) if least > 0 else None
    if name == "sqrt":
        least = arb((y - reach).lower())
        if not (least > 0 and y > 0):
            return None
        s, w = arb(y.lower()).sqrt(), least.sqrt()
        return 6 * (3 * s + w) / (8 * s * s * s * (s + w) * (s + w) * (s + w))
    if name in ("tanh", "atan"):
        return arb(2)
    if name == "exp":
        return (y + reach).exp()
    if name not in ("sin", "cos"):
        raise ValueError(f"nothing is known of {name}")
    return (abs(at) + reach).min(ONE)


def fourth_of_tanh(here: arb, reach: arb) -> arb:
    """A bound of |tanh''''| within a reach of where it is `here`: it is below 4.1, and the fifth is at most 16."""
    return (here + 16 * reach).min(arb(41) / 10)


def fourth(name: str, at: arb, y: arb, reach: arb) -> arb | None:
    """A bound of |phi''''| on |v - y| <= reach, phi being `at` at y; None where phi may be undefined, as in `third`.

    For 1/v and sqrt it is again the remainder's own factor, 24 times: what 1/v adds to its cubic at y is D^4 / (y^4 v),
    and a root w -D^4 (5 s^2 + 4 s w + w^2) / (16 s^5 (s + w)^4). The fourth derivative of tanh is below 4.1 and the
    fifth at most 16, in magnitude, and the fourth of atan below 4.7.
    """
    if name == "1/":
        size = arb(abs(y).lower())  # as in `third`
        least = arb((size - reach).lower())
        return 24 / (size * size * size * size * least) if least > 0 else None
    if name == "sqrt":
        least = arb((y - reach).lower())
        if not (least > 0 and y > 0):
            return None
        s, w = arb(y.lower()).sqrt(), least.sqrt()
        return 24 * (5 * s * s + 4 * s * w + w * w) / (16 * s**5 * (s + w) ** 4)
    if name == "tanh":
        return fourth_of_tanh(abs(8 * at * (2 - 3 * at * at) * (1 - at * at)), reach)
    if name == "atan":
        return arb(47) / 10
    if name == "exp":
        return (y + reach).exp()
    if name not in ("sin", "cos"):
        raise ValueError(f"nothing is known of {name}")
    return (abs(at) + reach).min(ONE)


def largest_fourth(name: str, at: arb, y: arb, reach: arb) -> arb | None:
    """Six times the factor of |D|^3 in the derivative of what phi adds to its cubic at y; None as in `fourth`.

    A bound of |phi''''| is one. For 1/v and sqrt, where `fourth` is of the remainder, its derivative is
    D^3 (3 v + y) / (y^4 v^2), and -D^3 (8 s^2 + 9 s w + 3 w^2) / (16 s^5 w (s + w)^3); both fall as v rises.
    """
    bound = fourth(name, at, y, reach)
    if bound is None or name not in ("1/", "sqrt"):
        return bound
    least = arb((abs(y) - reach).lower())
    if name == "1/":
        nearest, farthest = arb(abs(y).lower()), arb(abs(y).upper())
        return 6 * (3 * least + farthest) / (nearest**4 * least * least)
    s, w, far = arb(y.lower()).sqrt(), least.sqrt(), arb(y.upper()).sqrt()
    return 6 * (8 * far * far + 9 * far * w + 3 * w * w) / (16 * s**5 * w * (s + w) ** 3)


def beta(c: Certificate) -> list[arb]:
    """atanh((u_eq - offset) / scale)."""
    each = zip(c.plant.u_eq, c.policy.scale, c.policy.offset, strict=True)
    return [arb((q - exact(b)) / exact(s)).atanh() for q, s, b in each]


def within_bounds(c: Certificate, ranges: Sequence[tuple[arb, arb]]) -> bool:
    """True if every input, given by centre and radius, certainly lies in its bounds."""
    return all(
        centre - radius >= arb(lo) and centre + radius <= arb(hi)
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
