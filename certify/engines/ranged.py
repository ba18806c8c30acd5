"""Jets on a ball where something is uncertain: value and gradient are affine in it, all else is as good as at its worst.

In a cell of the box of ranges each quantity is its middle plus half its width times y_j in [-1, 1]. What decides a stiff
loop is how the gradients of F move with y: they move in directions that the decay can afford, which a norm of them does
not know. So `v(0) = c + moves.y` within `error`, the gradient is `a + turns.y` within `slack`, and what moves in the
second and third order, where the ball is what makes it small, is part of E (checker/FORMAT.md, cells).

An error without a y_j is also what a quantity is that may differ from place to place, and what a state is that is only
known to be near another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from certify.enclosures.taylor import EXP_END
from certify.engines.jets import ATAN4, TANH4, TANH5, Sizes, basis, beyond_tangent, remainder, sizes
from certify.expressions import Algebra

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RangedJet:
    """A value: c, `moves` (N,) and `error` of v(0); a (1, k), `turns` (N, k) and `slack` of the gradient; the rest as a
    Jet has it."""

    c: float
    moves: Array
    error: float
    a: Array
    turns: Array
    slack: float
    Q: Array
    K: Array
    B: Array
    E: Array
    errors: Array

    @property
    def away(self) -> float:
        """How far v(0) may be from c."""
        return float(np.sum(np.abs(self.moves))) + self.error

    @property
    def turned(self) -> float:
        """How far the gradient may be from a."""
        return float(np.sum(np.linalg.norm(self.turns, axis=1))) + self.slack

    @property
    def rest(self) -> Array:
        return self.E + np.abs(self.B) @ self.errors

    @property
    def sizes(self) -> Sizes:
        """For every value of what is uncertain."""
        found = sizes(self.a, self.Q, self.K, self.rest)
        return replace(found, slope=found.slope + self.turned)

    @property
    def radius(self) -> float:
        return float(self.sizes.radius[0])

    @property
    def value(self) -> float:
        """No |v(0)| is larger."""
        return abs(self.c) + self.away

    def _spread(self, size: Sizes) -> float:
        """What Q, K and the errors e_j come to together."""
        return float(size.bend[0] + size.twist[0] + np.linalg.norm(np.abs(self.B) @ self.errors))

    def __add__(self, other: RangedJet) -> RangedJet:
        x, y = self, other
        return RangedJet(
            x.c + y.c,
            x.moves + y.moves,
            x.error + y.error,
            x.a + y.a,
            x.turns + y.turns,
            x.slack + y.slack,
            x.Q + y.Q,
            x.K + y.K,
            x.B + y.B,
            x.E + y.E,
            x.errors,
        )

    def shifted(self, by: float) -> RangedJet:
        """The value plus a number."""
        return replace(self, c=self.c + by)

    def scaled(self, s: float) -> RangedJet:
        """The value times a number."""
        m = abs(s)
        return RangedJet(
            s * self.c,
            s * self.moves,
            m * self.error,
            s * self.a,
            s * self.turns,
            m * self.slack,
            s * self.Q,
            s * self.K,
            s * self.B,
            m * self.E,
            self.errors,
        )

    def __mul__(self, other: RangedJet) -> RangedJet:
        x, y, b = self, other, basis(self.a.shape[1])
        p, q = x.sizes, y.sizes
        xm, ym = (float(np.sum(np.abs(v.moves))) for v in (x, y))
        xt, yt = (v.turned - v.slack for v in (x, y))
        ps, qs = float(p.slope[0]), float(q.slope[0])
        error = xm * ym + x.error * y.value + (abs(x.c) + xm) * y.error
        slack = xm * yt + ym * xt + x.error * qs + y.error * ps + (abs(x.c) + xm) * y.slack + (abs(y.c) + ym) * x.slack
        Q = x.c * y.Q + y.c * x.Q + b.between(x.a, y.a)
        K = x.c * y.K + y.c * x.K + b.times(x.a, y.Q) + b.times(y.a, x.Q)
        left = p.slope * q.twist + p.twist * q.slope + (p.bend + p.twist) * (q.bend + q.twist)
        moved = x.away * y._spread(q) + y.away * x._spread(p)
        moved += x.turned * (qs + float(q.bend[0])) + y.turned * (ps + float(p.bend[0]))
        E = x.value * y.E + y.value * x.E + p.radius * y.rest + (q.slope + q.bend + q.twist) * x.rest
        return RangedJet(
            x.c * y.c,
            x.c * y.moves + y.c * x.moves,
            error,
            x.c * y.a + y.c * x.a,
            x.c * y.turns + y.c * x.turns + x.moves[:, None] * y.a + y.moves[:, None] * x.a,
            slack,
            Q,
            K,
            x.c * y.B + y.c * x.B,
            E + (left + moved) * b.eye,
            x.errors,
        )

    def compose(self, f0: float, f1: float, f2: float, f3: float, near: float, fourth: float) -> RangedJet:
        """A function's value and derivatives at c; at least |phi''''| for all v(0), and |phi''''|/24 on the range."""
        size, D = self.sizes, self.away
        slope, bend = float(size.slope[0]), float(size.bend[0])
        third = abs(f3) + D * near
        second = abs(f2) + D * abs(f3) + D**2 / 2 * near
        first = abs(f1) + D * second
        one = np.array([1.0])
        H, cubic = beyond_tangent(self.a, self.Q, self.K, f2 / 2 * one, f3 / 6 * one)
        R = remainder(self.a, size, self.rest, second / 2 * one, third / 6 * one, fourth * one)
        moved = D * second * self._spread(size)
        moved += D * third / 2 * (slope**2 + 2 * slope * bend) + D * near / 6 * slope**3
        moved += self.turned * (2 * (second / 2 + fourth * float(size.radius[0]) ** 2) * slope + second * bend + third / 2 * slope**2)
        slack = first * self.slack + D * second * (self.turned - self.slack)
        slack += (abs(f2) * self.error + third / 2 * D**2) * float(np.linalg.norm(self.a))
        return RangedJet(
            f0,
            f1 * self.moves,
            abs(f1) * self.error + second / 2 * D**2,
            f1 * self.a,
            f1 * self.turns + f2 * self.moves[:, None] * self.a,
            slack,
            f1 * self.Q + H,
            f1 * self.K + cubic,
            f1 * self.B,
            first * self.E + R + moved * basis(self.a.shape[1]).eye,
            self.errors,
        )

    def _nowhere(self) -> RangedJet:
        return replace(self, c=math.nan, E=self.E + math.inf)

    def inverse(self) -> RangedJet:
        c, close = self.c, abs(self.c) - self.away
        least = close - self.radius
        if not least > 0:
            return self._nowhere()
        return self.compose(1 / c, -1 / c**2, 2 / c**3, -6 / c**4, 24 / close**5, 1 / (close**4 * least))

    def sqrt(self) -> RangedJet:
        close = self.c - self.away
        if not close - self.radius > 0:
            return self._nowhere()
        r, s, w = math.sqrt(self.c), math.sqrt(close), math.sqrt(close - self.radius)
        fourth = (5 * s**2 + 4 * s * w + w**2) / (16 * s**5 * (s + w) ** 4)
        return self.compose(r, 1 / (2 * r), -1 / (4 * r**3), 3 / (8 * r**5), 15 / (16 * s**7), fourth)

    def exp(self) -> RangedJet:
        end = self.c + self.away + self.radius
        if not end < EXP_END:
            return self._nowhere()
        e = math.exp(self.c)
        return self.compose(e, e, e, e, math.exp(self.c + self.away), math.exp(end) / 24)

    def tanh(self) -> RangedJet:
        t = math.tanh(self.c)
        slope = 1 - t * t
        there = abs(8 * t * (2 - 3 * t**2) * slope)
        near, far = (min(TANH4, there + TANH5 * r) for r in (self.away, self.away + self.radius))
        return self.compose(t, slope, -2 * t * slope, (6 * t * t - 2) * slope, near, far / 24)

    def atan(self) -> RangedJet:
        slope = 1 / (1 + self.c**2)
        f3 = (6 * self.c**2 - 2) * slope**3
        return self.compose(math.atan(self.c), slope, -2 * self.c * slope**2, f3, ATAN4, ATAN4 / 24)

    def sin(self) -> RangedJet:
        s, c = math.sin(self.c), math.cos(self.c)
        near, far = (min(1.0, abs(s) + r) for r in (self.away, self.away + self.radius))
        return self.compose(s, c, -s, -c, near, far / 24)

    def cos(self) -> RangedJet:
        s, c = math.sin(self.c), math.cos(self.c)
        near, far = (min(1.0, abs(c) + r) for r in (self.away, self.away + self.radius))
        return self.compose(c, -s, -c, s, near, far / 24)


class RangedJets(Algebra[RangedJet]):
    """Such jets in k variables and N uncertain quantities, with the errors that they share."""

    def __init__(self, k: int, N: int, errors: Array) -> None:
        b = basis(k)
        nothing = RangedJet(
            0.0,
            np.zeros(N),
            0.0,
            np.zeros((1, k)),
            np.zeros((N, k)),
            0.0,
            np.zeros((1, len(b.eye))),
            np.zeros((1, len(b.scale3))),
            np.zeros((1, len(errors))),
            np.zeros((1, len(b.eye))),
            errors,
        )
        self._nothing = nothing

    def constant(self, q: Fraction) -> RangedJet:
        return replace(self._nothing, c=float(q))

    def total(self, constant: Fraction | None, terms: Sequence[RangedJet]) -> RangedJet:
        result = reduce(lambda x, y: x + y, terms)
        return result if constant is None else result.shifted(float(constant))

    def product(self, constant: Fraction | None, factors: Sequence[RangedJet]) -> RangedJet:
        result = reduce(lambda x, y: x * y, factors)
        return result if constant is None else result.scaled(float(constant))

    def quantity(self, lo: Fraction, hi: Fraction, number: int | None) -> RangedJet:
        """One of [lo, hi], at the same place as y of its number; None: at any place."""
        middle, half = float((lo + hi) / 2), float((hi - lo) / 2)
        if number is None:
            return replace(self._nothing, c=middle, error=half)
        moves = np.zeros_like(self._nothing.moves)
        moves[number] = half
        return replace(self._nothing, c=middle, moves=moves)

    def state(self, value: float, row: Array, error: float = 0.0, slack: float = 0.0) -> RangedJet:
        """A value at the middle and its gradient (k,), or one that is near."""
        return replace(self._nothing, c=value, a=row[None], error=error, slack=slack)

    def input(self, number: int, value: float, a: Array, Q: Array, K: Array) -> RangedJet:
        """An input's model, without its error, which is e of its number."""
        B = np.zeros_like(self._nothing.B)
        B[0, number] = 1.0
        return replace(self._nothing, c=value, a=a[None], Q=Q[None], K=K[None], B=B)
