"""Second-order Taylor models on a box, batched: the arithmetic of the ring rule.

A model of a function v over symbols d in [-1, 1]^N is `v(d) in c + g.d + d'Q d + [-r, r]`. The symbols are the box
coordinates of the leaf and one error symbol for each input. c, g and Q are binary64 numbers that mean themselves;
the roundings made in computing them, and all terms of third order, are bounded in r. In the bounds below G = sum
|g_i|, Q = sum |Q_ij| and N = |c| + G + Q. Arrays carry the batch on their last axis.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from .float64 import EPS, Array, float_with_error, gamma, sin_cos, total, up


@dataclass(frozen=True)
class Taylor:
    """`c` (B,), `g` (N, B), `Q` (N, N, B) and remainder `r` (B,), r >= 0."""

    c: Array
    g: Array
    Q: Array
    r: Array

    @property
    def linear(self) -> Array:
        """Upper bound of the linear part on the box."""
        return np.asarray(total(np.abs(self.g), 0))

    @property
    def quadratic(self) -> Array:
        """Upper bound of the quadratic part on the box."""
        return np.asarray(total(total(np.abs(self.Q), 0), 0))

    def __add__(self, other: Taylor) -> Taylor:
        return Taylor(
            self.c + other.c,
            self.g + other.g,
            self.Q + other.Q,
            up(self.r + other.r + EPS * (_size(self) + _size(other))),
        )

    def at(self, index: NDArray[np.intp]) -> Taylor:
        """The models of some members of the batch."""
        return Taylor(self.c[index], self.g[:, index], self.Q[:, :, index], self.r[index])

    def scaled(self, value: float | Array, error: float) -> Taylor:
        """Product with a constant in value +- error; `value` may differ over the batch (B,)."""
        size, k = _size(self), np.abs(value)
        return Taylor(
            value * self.c, value * self.g, value * self.Q, up(k * self.r + error * (size + self.r) + EPS * k * size)
        )

    def __mul__(self, other: Taylor) -> Taylor:
        a, b = self, other
        Ga, Gb, Qa, Qb = a.linear, b.linear, a.quadratic, b.quadratic
        ca, cb = np.abs(a.c), np.abs(b.c)
        r = (
            ca * b.r + cb * a.r  # constant times remainder
            + Ga * Qb + Gb * Qa + Qa * Qb  # third and fourth order
            + a.r * (Gb + Qb + b.r) + b.r * (Ga + Qa)
            + EPS * ((ca + Ga + Qa) * (cb + Gb + Qb))  # rounding of all coefficients; infinite if one overflows
        )  # fmt: skip
        Q = a.c * b.Q + b.c * a.Q + a.g[:, None] * b.g[None, :]
        return Taylor(a.c * b.c, a.c * b.g + b.c * a.g, Q, up(r))

    def compose(self, f0: Array, f1: Array, f2: Array, third: Array, error: Array) -> Taylor:
        """phi(v) from phi(c), phi'(c), phi''(c)/2 (each within `error`) and `third` >= sup |phi'''|/6.

        With v = c + D, |D| <= rho = G + Q + r: `phi(v) = f0 + f1 D + f2 D^2 + R`, |R| <= third rho^3, and D^2 differs
        from (g.d)^2 by at most 2 G q + q^2, q = Q + r.
        """
        G, q = self.linear, up(self.quadratic + self.r)
        rho = up(G + q)
        r = (
            np.abs(f1) * self.r
            + np.abs(f2) * (2 * G * q + q * q)
            + third * rho * rho * rho
            + error * (1 + rho + rho * rho)
            + EPS * (np.abs(f0) + np.abs(f1) * rho + np.abs(f2) * G * G)
        )
        Q = f1 * self.Q + f2 * (self.g[:, None] * self.g[None, :])
        return Taylor(f0, f1 * self.g, Q, up(r))

    def radius(self) -> Array:
        """Upper bound of |v - c| on the box."""
        return np.asarray(up(self.linear + self.quadratic + self.r))


def _size(a: Taylor) -> Array:
    return np.asarray(up(np.abs(a.c) + a.linear + a.quadratic))


class TaylorAlgebra:
    """Evaluates the plant's tape on Taylor models of N symbols over a batch."""

    def __init__(self, symbols: int, batch: int) -> None:
        self.shape = symbols, batch

    def affine(self, c: Array, g: Array) -> Taylor:
        """The exact affine function c + g.d."""
        symbols, batch = self.shape
        return Taylor(c, g, np.zeros((symbols, symbols, batch)), np.zeros(batch))

    def const(self, q: Fraction) -> Taylor:
        symbols, batch = self.shape
        value, error = float_with_error(q)
        model = self.affine(np.full(batch, value), np.zeros((symbols, batch)))
        return Taylor(model.c, model.g, model.Q, np.full(batch, error))

    def add(self, a: Taylor, b: Taylor) -> Taylor:
        return a + b

    def neg(self, a: Taylor) -> Taylor:
        return Taylor(-a.c, -a.g, -a.Q, a.r)

    def mul(self, a: Taylor, b: Taylor) -> Taylor:
        return a * b

    def inv(self, a: Taylor) -> Taylor:
        """1/v; NaN unless the range of v certainly excludes 0."""
        least = np.abs(a.c) - a.radius()
        least = np.where(least > 0, least * (1 - 2.0**-40), np.nan)
        f0 = 1 / a.c
        f1, f2 = -f0 * f0, f0 * f0 * f0
        third = up(up(np.abs(f2)) / least)
        return a.compose(f0, f1, f2, third, EPS * (np.abs(f0) + np.abs(f1) + np.abs(f2)))

    def sin(self, a: Taylor) -> Taylor:
        s, c, error = sin_cos(a.c)
        third = up(np.minimum(1.0, np.abs(c) + error + a.radius()) / 6)
        return a.compose(s, c, -s / 2, third, error)

    def cos(self, a: Taylor) -> Taylor:
        s, c, error = sin_cos(a.c)
        third = up(np.minimum(1.0, np.abs(s) + error + a.radius()) / 6)
        return a.compose(c, -s, -c / 2, third, error)


def upper_bound(model: Taylor) -> Array:
    """An upper bound of the model over the box, shape (B,); the separable part is maximised exactly.

    max over |t| <= 1 of `g t + q t^2` is g^2 / (-4q) if q < 0 and |g| < -2q (and never more, if q < 0), else |g| + q.
    """
    g = np.abs(model.g)
    N = g.shape[0]
    q = np.array([model.Q[i, i] for i in range(N)])
    inside = (q < 0) & (g < -2 * q)
    ratio = g / np.where(inside, -q, 1.0)  # below 2; squaring g first could underflow, and 4 q overflow
    axes = np.where(inside, 0.25 * (g * ratio), g + q)
    cross = np.zeros_like(model.c)
    for i in range(N):
        for j in range(i):
            cross = cross + np.abs(model.Q[i, j] + model.Q[j, i])
    value = model.c + np.sum(axes, axis=0) + cross + model.r
    size = np.abs(model.c) + total(np.abs(axes) + 2 * g + np.abs(q), 0) + cross + model.r  # infinite if any part is
    return np.asarray(value + up((gamma(N * N) + EPS) * size))
