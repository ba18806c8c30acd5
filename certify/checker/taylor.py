"""Second-order Taylor models on a box, batched: what the rules for leaves evaluate the plant in.

A model of a function v over symbols d in [-1, 1]^N is `v(d) in c + g.d + d'Q d + [-r, r]`. The symbols are the box
coordinates of the leaf and one error symbol for each input. c, g and Q are numbers that mean themselves;
the roundings made in computing them, and all terms of third order, are bounded in r. In the bounds below G = sum
|g_i|, Q = sum |Q_ij| and N = |c| + G + Q. Arrays carry the batch on their last axis, or on their last two.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from typing import Any

import numpy as np

from .elementary import Expansion, elementary
from .float64 import EPS, Array, float_with_error, gamma, total, up


@dataclass(frozen=True)
class Taylor:
    """`c` (B,), `g` (N, B), `Q` (N, N, B) and remainder `r` (B,), r >= 0."""

    c: Array
    g: Array
    Q: Array
    r: Array

    @cached_property
    def linear(self) -> Array:
        """Upper bound of the linear part on the box."""
        return total(np.abs(self.g), 0)

    @cached_property
    def quadratic(self) -> Array:
        """Upper bound of the quadratic part on the box."""
        return total(total(np.abs(self.Q), 0), 0)

    @cached_property
    def size(self) -> Array:
        """Upper bound of |c| + G + Q."""
        return up(np.abs(self.c) + self.linear + self.quadratic)

    def at(self, index: Array) -> Taylor:
        """The models of some members of the batch."""
        return Taylor(self.c[..., index], self.g[..., index], self.Q[..., index], self.r[..., index])

    def scaled(self, k: Any) -> Taylor:
        """Product with a number, or with one for each member of the batch (B,)."""
        r = up(np.abs(k) * self.r + EPS * (np.abs(k) * self.size))
        return Taylor(k * self.c, k * self.g, k * self.Q, r)

    def __add__(self, other: Taylor) -> Taylor:
        r = up(self.r + other.r + EPS * (self.size + other.size))
        return Taylor(self.c + other.c, self.g + other.g, self.Q + other.Q, r)

    def __neg__(self) -> Taylor:
        return Taylor(-self.c, -self.g, -self.Q, self.r)

    def __mul__(self, other: Taylor) -> Taylor:
        a, b = self, other
        Ga, Gb, Qa, Qb = a.linear, b.linear, a.quadratic, b.quadratic
        ca, cb = np.abs(a.c), np.abs(b.c)
        r = (
            ca * b.r
            + cb * a.r  # constant times remainder
            + Ga * Qb
            + Gb * Qa
            + Qa * Qb  # third and fourth order
            + a.r * (Gb + Qb + b.r)
            + b.r * (Ga + Qa)
            + EPS * ((ca + Ga + Qa) * (cb + Gb + Qb))  # rounding of all coefficients; infinite if one overflows
        )
        joint = 0.5 * (a.g[:, None] * b.g[None, :])
        Q = a.c * b.Q + b.c * a.Q + (joint + joint.swapaxes(0, 1))
        return Taylor(a.c * b.c, a.c * b.g + b.c * a.g, Q, up(r))

    @cached_property
    def reach(self) -> Array:
        """Upper bound of |v - c| on the box."""
        return up(self.linear + up(self.quadratic + self.r))

    def widened(self, symbols: int) -> Taylor:
        """The same among so many symbols, of which those that come after its own do not matter to it."""
        more = symbols - len(self.g)
        flat = [(0, 0)] * self.c.ndim
        return Taylor(self.c, np.pad(self.g, [(0, more), *flat]), np.pad(self.Q, [(0, more), (0, more), *flat]), self.r)

    def function(self, name: str) -> Taylor:
        """phi(v) for a function phi that elementary.py knows."""
        return self.composed(elementary(name, self.c, 0.0, self.reach))

    def composed(self, phi: Expansion) -> Taylor:
        """phi(v) = f0 + f1 D + f2 D^2 + R, v = c + D, |R| <= third |D|^3, for phi expanded at c where |D| <= `reach`.

        |D| <= rho = G + Q + r, and D^2 differs from (g.d)^2 by at most 2 G q + q^2, q = Q + r.
        """
        G, q = self.linear, up(self.quadratic + self.r)
        rho = self.reach
        (f0, f1, f2, _), (e0, e1, e2, _) = phi.f, phi.e
        r = (
            np.abs(f1) * self.r
            + np.abs(f2) * up(2 * G * q + q * q)
            + phi.third * rho * rho * rho
            + e0
            + e1 * rho
            + e2 * rho * rho
            + EPS * (np.abs(f0) + np.abs(f1) * rho + np.abs(f2) * up(G * G))
        )
        Q = f1 * self.Q + f2 * (self.g[:, None] * self.g[None, :])
        return Taylor(f0, f1 * self.g, Q, up(r))


def affine(c: Array, g: Array, r: Array | float = 0.0) -> Taylor:
    """c + g.d within r, c (B,), g (N, B)."""
    return Taylor(c, g, np.zeros((len(g), *g.shape)), r + np.zeros_like(c))


def constant(q: Fraction, symbols: int, batch: int) -> Taylor:
    """A rational, the same over the batch."""
    value, error = float_with_error(q)
    return affine(np.full(batch, value), np.zeros((symbols, batch)), error)


def upper_bound(model: Taylor) -> Array:
    """An upper bound of the model over the box, shape (B,); the separable part is maximised exactly.

    max over |t| <= 1 of `g t + q t^2` is at most g^2 / (-4q) if q < 0, and at most max(|g|, -2q) + q; the first is the
    maximum if |g| < -2q, the second otherwise.
    """
    g = np.abs(model.g)
    N = g.shape[0]
    q = np.array([model.Q[i, i] for i in range(N)])
    inside = (q < 0) & (g < -2 * q)
    ratio = g / np.where(inside, -q, 1.0)  # below 2; squaring g first could underflow, and 4 q overflow
    axes = np.where(inside, 0.25 * (g * ratio), np.maximum(g, -2 * q) + q)
    cross = np.zeros_like(model.c)
    for i in range(N):
        for j in range(i):
            cross = cross + np.abs(model.Q[i, j] + model.Q[j, i])
    value = model.c + np.sum(axes, axis=0) + cross + model.r
    size = np.abs(model.c) + total(np.abs(axes) + 2 * g + np.abs(q), 0) + cross + model.r  # infinite if any part is
    return value + up((gamma(N * N) + EPS) * size)
