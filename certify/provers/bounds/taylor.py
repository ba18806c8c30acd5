"""Second-order Taylor models `v(d) in c + g.d + d'Q d + [-r, r]`, d in [-1, 1]^N, batched on the last axis.

Why not an interval Hessian: carrying Q at the centre with a third-order remainder keeps the second derivatives close
to the centre's value however the expression is written, which saves tenfold in boxes. Why N = n + m symbols: the
policy's error in each input is a symbol of its own, so that it cancels between equations as the input itself does.
Makino and Berz (2003) describe Taylor models; here the order is fixed at two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Protocol, Self, TypeVar

import numpy as np

from certify.loop.expressions import Algebra
from certify.provers.bounds.arrays import Array, Index, chosen, product

EPS = 2.0**-50
TINY = 2.0**-900
CERTAIN = 1 + 2.0**-30  # share of its range by which a number must be away from 0 for its sign, beyond all rounding
NOISE = 2.0**-30  # of all coefficients of first order
_PAIRED = (
    3.0  # times what a symbol's terms in two symbols come to is what splitting it may take away, besides: measured
)
EXP_END = 64.0  # the exponent beyond which the checker knows nothing of exp


@dataclass(frozen=True, slots=True)
class Taylor:
    """`c` (B,), `g` (N, B), `Q` (N, N, B), remainder `r` (B,)."""

    c: Array
    g: Array
    Q: Array
    r: Array

    def norms(self) -> tuple[Array, Array, Array]:
        """|c|, sum |g_i|, sum |Q_ij|."""
        return np.abs(self.c), np.abs(self.g).sum(0), np.abs(self.Q).sum((0, 1))

    def at(self, index: Index) -> Taylor:
        """The models of some boxes of the batch."""
        return Taylor(*(part.take(index, -1) for part in (self.c, self.g, self.Q, self.r)))

    def __add__(self, other: Taylor) -> Taylor:
        c, g, Q = self.c + other.c, self.g + other.g, self.Q + other.Q
        rounding = np.abs(self.c) + np.abs(other.c) + sum(n for v in (self, other) for n in v.norms()[1:])
        return Taylor(c, g, Q, self.r + other.r + EPS * rounding + TINY)

    def scaled(self, k: float) -> Taylor:
        """Product with a constant that is k up to one rounding."""
        size = abs(k) * sum(self.norms())
        return Taylor(k * self.c, k * self.g, k * self.Q, abs(k) * self.r * (1 + EPS) + EPS * size + TINY)

    def shifted(self, k: float) -> Taylor:
        """Sum with a constant that is k up to one rounding."""
        return Taylor(self.c + k, self.g, self.Q, self.r + EPS * (np.abs(self.c) + abs(k)) + TINY)

    def __mul__(self, other: Taylor) -> Taylor:
        a, b = self, other
        (ca, Ga, Qa), (cb, Gb, Qb) = a.norms(), b.norms()
        r = ca * b.r + cb * a.r + Ga * Qb + Gb * Qa + Qa * Qb + a.r * (Gb + Qb + b.r) + b.r * (Ga + Qa)
        r = r + EPS * ((ca + Ga + Qa) * (cb + Gb + Qb) + r) + TINY
        joint = 0.5 * (a.g[:, None] * b.g[None])
        Q = a.c * b.Q + b.c * a.Q + (joint + joint.swapaxes(0, 1))
        return Taylor(a.c * b.c, a.c * b.g + b.c * a.g, Q, r)

    def compose(self, f0: Array, f1: Array, f2: Array, third: Array) -> Taylor:
        """phi(v), from phi(c), phi'(c), phi''(c)/2 and `third` >= sup |phi'''|/6 on the range."""
        _, G, q = self.norms()
        q = q + self.r
        rho = G + q
        r = np.abs(f1) * self.r + np.abs(f2) * (2 * G * q + q * q) + third * (rho * rho * rho)
        r = r + 2 * EPS * (np.abs(f0) + np.abs(f1) * (1 + rho) + np.abs(f2) * (1 + rho * rho) + r) + TINY
        return Taylor(f0, f1 * self.g, f1 * self.Q + f2 * self.g[:, None] * self.g[None], r)

    def radius(self) -> Array:
        """Bound of |v - c|."""
        _, G, q = self.norms()
        return (G + q + self.r) * (1 + EPS)

    def inverse(self) -> Taylor:
        """1/v; the remainder is NaN where the range of v may contain 0."""
        least = np.abs(self.c) - self.radius()
        least = np.where(least > 0, least, np.nan)
        f0 = 1 / self.c
        f2 = f0 * f0 * f0
        return self.compose(f0, -f0 * f0, f2, np.abs(f2) / least * (1 + EPS) + TINY)

    def sqrt(self) -> Taylor:
        """The square root; the remainder is NaN where the range of v may reach 0.

        With s and w the roots of c and of the range's lower end, the remainder is at most |v - c|^3 times
        (3 s + w) / (8 s^3 (s + w)^3), which is exact at the lower end.
        """
        least = self.c - self.radius()
        least = np.where(least > 0, least, np.nan)
        s, w = np.sqrt(self.c), np.sqrt(least)
        p, q = 1 / s, 1 / (s + w)
        third = p * p * q * q * (2 * q + p) / 8
        return self.compose(s, p / 2, -p * p * p / 8, third * (1 + 32 * EPS) + TINY)

    def abs(self) -> Taylor:
        """|v|, on a range c +- R that holds 0 by its chord's slope s: |v| - s v lies between 0 and what it is at an
        end, whatever s in [-1, 1]."""
        c, R = self.c, self.radius()
        s = np.where(c >= R, 1.0, np.where(c <= -R, -1.0, c / (R + TINY)))
        half = np.where(np.abs(c) >= R, 0.0, np.maximum((R - c) * (1 + s), (R + c) * (1 - s)) / 2 * (1 + EPS))
        line = self.compose(s * c + half, s, np.zeros_like(s), np.zeros_like(s))
        return Taylor(line.c, line.g, line.Q, (line.r + half) * (1 + EPS))

    def sign(self) -> Taylor:
        """1 or -1; the remainder is NaN where the range of v may contain 0."""
        r = np.where(np.abs(self.c) > self.radius() * CERTAIN, 0.0, np.nan)
        return Taylor(np.where(self.c < 0, -1.0, 1.0), np.zeros_like(self.g), np.zeros_like(self.Q), r)

    def exp(self) -> Taylor:
        e, most = np.exp(self.c), self.c + self.radius()
        third = np.where(most < EXP_END, np.exp(most) / 6 * (1 + 128 * EPS) + TINY, np.nan)
        return self.compose(e, e, e / 2, third)

    def tanh(self) -> Taylor:
        t = np.tanh(self.c)
        slope = 1 - t * t
        return self.compose(t, slope, -t * slope, np.full_like(t, 1 / 3 + EPS))

    def atan(self) -> Taylor:
        slope = 1 / (1 + self.c * self.c)
        return self.compose(np.arctan(self.c), slope, -self.c * slope * slope, np.full_like(slope, 1 / 3 + EPS))

    def sin(self) -> Taylor:
        s, c = np.sin(self.c), np.cos(self.c)
        return self.compose(s, c, -s / 2, np.minimum(np.abs(c) + self.radius() + EPS, 1.0) / 6)

    def cos(self) -> Taylor:
        s, c = np.sin(self.c), np.cos(self.c)
        return self.compose(c, -s, -c / 2, np.minimum(np.abs(s) + self.radius() + EPS, 1.0) / 6)


class Arithmetic(Protocol):
    """The operations that models and their placeholders share."""

    def __add__(self, other: Self, /) -> Self: ...

    def __mul__(self, other: Self, /) -> Self: ...

    def scaled(self, k: float) -> Self: ...

    def shifted(self, k: float) -> Self: ...


V = TypeVar("V", bound=Arithmetic)


class ConstantsLast(Algebra[V]):
    """An arithmetic in which constants enter sums and products last, each by one operation on a value."""

    def total(self, constant: Fraction | None, terms: Sequence[V]) -> V:
        result = super().total(None, terms)
        return result if constant is None else result.shifted(float(constant))

    def product(self, constant: Fraction | None, factors: Sequence[V]) -> V:
        result = super().product(None, factors)
        return result if constant is None else result.scaled(float(constant))

    def combined(self, matrix: Array, values: Sequence[V]) -> list[V]:
        """`matrix` (p, q), of numbers up to one rounding, times q values."""
        rows = [[value.scaled(float(k)) for k, value in zip(row, values, strict=True)] for row in matrix]
        return [super(ConstantsLast, self).total(None, row) for row in rows]


class Models(ConstantsLast[Taylor]):
    """Expressions of the plant on Taylor models of the shape of `like`."""

    def __init__(self, like: Taylor) -> None:
        self.zero = Taylor(*(np.zeros_like(t) for t in (like.c, like.g, like.Q, like.r)))

    def constant(self, q: Fraction) -> Taylor:
        return self.zero.shifted(float(q))

    def combined(self, matrix: Array, values: Sequence[Taylor]) -> list[Taylor]:
        """`matrix` (p, q) times q values, in one product."""
        parts = zip(*((v.c, v.g, v.Q, v.r + 2 * len(values) * EPS * sum(v.norms())) for v in values), strict=True)
        c, g, Q, r = (np.stack(part) for part in parts)
        c, g, Q = (product(matrix, part) for part in (c, g, Q))
        r = product(np.abs(matrix), r) * (1 + len(values) * EPS) + TINY
        return [Taylor(*row) for row in zip(c, g, Q, r, strict=True)]


def upper_bound(model: Taylor) -> tuple[Array, Array]:
    """(bound (B,), excess (N, B)): an upper bound over the box, and how much each symbol matters to it.

    The lesser of two: each bounds the terms in two symbols by terms in one. Here `2 |d_i d_j| <= d_i^2 + d_j^2`; the
    other is `at_a_corner`.
    """
    g = np.abs(model.g)
    q = np.einsum("iib->ib", model.Q)
    cross = (np.abs(model.Q + model.Q.swapaxes(0, 1)) / 2).sum(1) - np.abs(q)
    axes = _largest(g, q + cross)
    size = np.abs(model.c) + g.sum(0) + (np.abs(q) + cross).sum(0) + model.r
    bound = model.c + axes.sum(0) + model.r + 1e-11 * size + TINY
    left = chosen(~(bound < 0))
    if len(left):
        bound[left] = np.fmin(bound[left], at_a_corner(model.at(left)))
    return bound, axes + _PAIRED * cross


def at_a_corner(model: Taylor) -> Array:
    """Upper bounds (B,) around the corner s to which the gradient points, d_i = s_i e_i.

    A term in two symbols is bounded by `2 e_i e_j <= e_i^2 + e_j^2` where s_i s_j Q_ij is positive, and elsewhere by
    `-e_i e_j <= 1 - e_i - e_j`, since (1 - e_i) (1 - e_j) >= 0. Multipliers make coefficients of about 0, whose signs
    are noise, and other ones in the checker: there the terms of second order decide, with the other signs.
    """
    Q, g = model.Q + model.Q.swapaxes(0, 1), model.g
    q = np.einsum("iib->ib", model.Q)
    np.einsum("iib->ib", Q)[:] = 0.0
    s = np.where(np.abs(g) <= NOISE * np.abs(g).sum(0), 0.0, np.where(g < 0, -1.0, 1.0))
    slope = np.einsum("ijb,jb->ib", Q, s)
    s = np.where(s == 0, np.where(slope < 0, -1.0, 1.0), s)
    Q *= s[:, None] * s
    down, up = np.maximum(-Q, 0.0).sum(1), np.maximum(Q, 0.0).sum(1) / 2
    size = np.abs(model.c) + np.abs(g).sum(0) + (np.abs(q) + down + up).sum(0) + model.r
    most = down / 2 + _largest(np.abs(s * g - down), q + up)
    bound: Array = model.c + most.sum(0) + model.r + 1e-11 * size + TINY
    return bound


def _largest(g: Array, q: Array) -> Array:
    """The largest value of g t + q t^2 over |t| <= 1, g >= 0."""
    inside = g < -2 * q
    return np.where(inside, 0.25 * (g * (g / np.where(inside, -q, 1.0))), g + q)
