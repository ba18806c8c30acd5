"""Jets on a ball where something is uncertain: value and gradient are affine in it, all else is as at its worst.

In a cell of the box of ranges each quantity is its middle plus half its width times y_j in [-1, 1]; the length of a
period may be one more of them. A stiff loop is decided by the way the gradients of F move with y: they move in
directions that the decay can afford, which a norm of them does not know.
So `v(0) = c + moves.y` within `error`, the gradient is `a + turns.y` within `slack`, and the motion of the second and
third order, which the ball makes small, is part of E (checker/FORMAT.md, cells).

A quantity that may differ from place to place, and a state that is only known to be near another, are errors without
a y_j.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from certify.loop.activations import CERTAIN, TANH4, TANH5
from certify.loop.expressions import Algebra
from certify.provers.ball.jets import (
    ATAN4,
    Sizes,
    basis,
    beyond_tangent,
    is_extreme,
    of_inputs,
    remainder,
    sizes,
)
from certify.provers.bounds.taylor import EXP_END

Array = NDArray[np.float64]
Four = tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class RangedJet:
    """A value on M balls around the same middle: c, `moves` (N,) and `error` (M,) of v(0); a (M, k), `turns` (N, M, k)
    and `slack` (M,) of the gradient; the rest as a Jet has it.
    Kinks among e_j add at most `tilts` ||d||, (m, M)."""

    c: float
    moves: Array
    error: Array
    a: Array
    turns: Array
    slack: Array
    Q: Array
    K: Array
    B: Array
    E: Array
    errors: Array
    tilts: Array

    @property
    def away(self) -> Array:
        """The largest distance of v(0) from c, (M,)."""
        return np.asarray(np.sum(np.abs(self.moves)) + self.error)

    @property
    def tilt(self) -> Array:
        """The largest turn of the gradient by y, and by kinks, (M,)."""
        by_kinks: Array = (np.abs(self.B) @ self.tilts)[0]
        if not len(self.turns):
            return by_kinks
        return np.asarray(np.sum(np.linalg.norm(self.turns, axis=2), axis=0) + by_kinks)

    @property
    def turned(self) -> Array:
        """The largest distance of the gradient from a, (M,)."""
        return self.tilt + self.slack

    @property
    def rest(self) -> Array:
        return self.E + of_inputs(self.B, self.errors, self.E)

    @property
    def sizes(self) -> Sizes:
        """Bounds for every value of the uncertain quantities."""
        found = sizes(self.a, self.Q, self.K, self.rest)
        return replace(found, slope=found.slope + self.turned)

    @property
    def radius(self) -> Array:
        return self.sizes.radius

    @property
    def value(self) -> Array:
        """No |v(0)| is larger, (M,)."""
        return abs(self.c) + self.away

    def _spread(self, size: Sizes) -> Array:
        """The sizes of Q, K and the errors e_j added up."""
        e = np.linalg.norm(of_inputs(self.B, self.errors, self.E), axis=1)
        return np.asarray(size.bend + size.twist + e)

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
            x.tilts,
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
            self.tilts,
        )

    def __mul__(self, other: RangedJet) -> RangedJet:
        x, y, b, rows = self, other, basis(self.a.shape[1]), np.newaxis
        p, q, xv, yv = x.sizes, y.sizes, x.value, y.value
        xm, ym = (float(np.sum(np.abs(v.moves))) for v in (x, y))
        xt, yt = x.tilt, y.tilt
        error = xv * y.error + yv * x.error + xm * ym  # the last is of second order in y
        slack = xv * y.slack + x.error * q.slope + yv * x.slack + y.error * p.slope + xm * yt + ym * xt
        Q = x.c * y.Q + y.c * x.Q + b.between(x.a, y.a)
        K = x.c * y.K + y.c * x.K + b.times(x.a, y.Q) + b.times(y.a, x.Q)
        left = p.slope * q.twist + p.twist * q.slope + (p.bend + p.twist) * (q.bend + q.twist)
        moved = x.away * y._spread(q) + y.away * x._spread(p)
        moved += (xt + x.slack) * (q.slope + q.bend) + (yt + y.slack) * (p.slope + p.bend)
        E = xv[:, rows] * y.E + yv[:, rows] * x.E
        E += p.radius[:, rows] * y.rest + (q.slope + q.bend + q.twist)[:, rows] * x.rest
        return RangedJet(
            x.c * y.c,
            x.c * y.moves + y.c * x.moves,
            error,
            x.c * y.a + y.c * x.a,
            x.c * y.turns + y.c * x.turns + x.moves[:, rows, rows] * y.a + y.moves[:, rows, rows] * x.a,
            slack,
            Q,
            K,
            x.c * y.B + y.c * x.B,
            E + (left + moved)[:, rows] * b.eye,
            x.errors,
            x.tilts,
        )

    def compose(self, f: Four, e: Sequence[Array], fourth: Array) -> RangedJet:
        """A function's phi, phi', phi''/2 and phi'''/6 at c, how far they are from those at v(0), and at least
        |phi''''|/24 on the ranges, one for each ball or for all."""
        (f0, f1, half, sixth), (e0, e1, e2, e3) = f, e
        size, far, rows = self.sizes, self.away, np.newaxis
        slope, bend = size.slope, size.bend
        h, g = abs(half) + e2, abs(sixth) + e3
        second, third = np.array([half]), np.array([sixth])
        squares = basis(self.a.shape[1]).square(self.a)
        H, cubic = beyond_tangent(self.a, squares, self.Q, self.K, second, third)
        R = remainder(squares, size, self.rest, h, g, fourth)
        moved = e1 * self._spread(size) + e2 * (slope**2 + 2 * slope * bend) + e3 * slope**3
        bent = 2 * (h + fourth * size.radius**2 + 3 * g * size.curve) * slope + 2 * h * bend + 3 * g * slope**2
        if len(self.moves):
            by_y = 2 * abs(half) * float(np.sum(np.abs(self.moves)))
            error = abs(f1) * self.error + h * far**2
            slack = (2 * h * self.error + 3 * g * far**2) * slope + (abs(f1) + by_y) * self.slack + by_y * self.tilt
        else:
            error, slack = e0, e1 * slope + (abs(f1) + e1) * self.slack
        return RangedJet(
            f0,
            f1 * self.moves,
            error,
            f1 * self.a,
            f1 * self.turns + 2 * half * self.moves[:, rows, rows] * self.a,
            slack,
            f1 * self.Q + H,
            f1 * self.K + cubic,
            f1 * self.B,
            (abs(f1) + e1)[:, rows] * self.E + R + (moved + bent * self.turned)[:, rows] * basis(self.a.shape[1]).eye,
            self.errors,
            self.tilts,
        )


def _nowhere(v: RangedJet) -> RangedJet:
    """No model of any ball, where one of them has no finite model."""
    return replace(v, c=math.nan, E=v.E + math.inf)


def _inverse(v: RangedJet) -> RangedJet:
    c, far = v.c, v.away
    close = abs(c) - far
    least = close - v.radius
    if not np.all(least > 0) or is_extreme(c):
        return _nowhere(v)
    f = 1 / c, -1 / c**2, 1 / c**3, -1 / c**4
    e = far / close**2, 2 * far / close**3, 3 * far / close**4, 4 * far / close**5
    return v.compose(f, e, 1 / (close**4 * least))


def _sqrt(v: RangedJet) -> RangedJet:
    far = v.away
    close = v.c - far
    if not np.all(close - v.radius > 0) or is_extreme(v.c):
        return _nowhere(v)
    r, s, w = math.sqrt(v.c), np.sqrt(close), np.sqrt(close - v.radius)
    f = r, 1 / (2 * r), -1 / (8 * r**3), 1 / (16 * r**5)
    e = far / (2 * s), far / (4 * s**3), 0.1875 * far / s**5, 0.15625 * far / s**7
    return v.compose(f, e, (5 * s**2 + 4 * s * w + w**2) / (16 * s**5 * (s + w) ** 4))


def _abs(v: RangedJet) -> RangedJet:
    """|v| where v(0) may be 0, to first order: as if it had some gradient of at most v's radius."""
    if _is_certain(v):
        return v.scaled(math.copysign(1.0, v.c))
    if np.all(abs(v.c) > CERTAIN * v.away):
        return _nowhere(v)
    return replace(v.scaled(0.0), c=abs(v.c), error=v.away, slack=v.radius)


def _sign(v: RangedJet) -> RangedJet:
    return v.scaled(0.0).shifted(math.copysign(1.0, v.c)) if _is_certain(v) else _nowhere(v)


def _is_certain(v: RangedJet) -> bool:
    """True if v has one sign on all balls, whatever is uncertain."""
    return bool(np.all(abs(v.c) > CERTAIN * (v.away + v.radius)))


def _exp(v: RangedJet) -> RangedJet:
    end = v.c + v.away + v.radius
    if not np.all(end < EXP_END):
        return _nowhere(v)
    here, most = math.exp(v.c), np.exp(end)
    e = v.away * most
    return v.compose((here, here, here / 2, here / 6), (e, e, e, e), most / 24)


def _tanh(v: RangedJet) -> RangedJet:
    t, far = math.tanh(v.c), v.away
    slope = 1 - t * t
    e1 = 2 * far * (1 + far)
    e = far, e1, far * (slope + e1) + abs(t) * e1, 1.4 * far
    there = abs(8 * t * (2 - 3 * t**2) * slope)
    fourth = np.minimum(TANH4, there + TANH5 * (far + v.radius)) / 24
    return v.compose((t, slope, -t * slope, (t * t - 1 / 3) * slope), e, fourth)


def _atan(v: RangedJet) -> RangedJet:
    slope, far = 1 / (1 + v.c**2), v.away
    f = math.atan(v.c), slope, -v.c * slope**2, (v.c**2 - 1 / 3) * slope**3
    return v.compose(f, (far, far, far, far), np.array([ATAN4 / 24]))


def _sin(v: RangedJet) -> RangedJet:
    return _nowhere(v) if math.isinf(v.c) else _wave(v, math.sin(v.c), math.cos(v.c))


def _cos(v: RangedJet) -> RangedJet:
    return _nowhere(v) if math.isinf(v.c) else _wave(v, math.cos(v.c), -math.sin(v.c))


def _wave(v: RangedJet, value: float, slope: float) -> RangedJet:
    far = v.away
    fourth = np.minimum(1.0, abs(value) + far + v.radius) / 24
    return v.compose((value, slope, -value / 2, -slope / 6), (far, far, far, far), fourth)


_FUNCTIONS = {
    **{"abs": _abs, "sign": _sign},
    **{"sqrt": _sqrt, "exp": _exp, "tanh": _tanh, "atan": _atan, "sin": _sin, "cos": _cos},
}


class RangedJets(Algebra[RangedJet]):
    """Ranged jets on M balls, in k variables and N uncertain quantities, with the errors that they share."""

    def __init__(self, M: int, k: int, N: int, errors: Array, tilts: Array | None = None) -> None:
        b = basis(k)
        self._nothing = RangedJet(
            0.0,
            np.zeros(N),
            np.zeros(M),
            np.zeros((M, k)),
            np.zeros((N, M, k)),
            np.zeros(M),
            np.zeros((M, len(b.eye))),
            np.zeros((M, len(b.scale3))),
            np.zeros((1, len(errors))),
            np.zeros((M, len(b.eye))),
            errors,
            np.zeros((len(errors), M)) if tilts is None else tilts,
        )

    def constant(self, q: Fraction) -> RangedJet:
        return replace(self._nothing, c=float(q))

    def total(self, constant: Fraction | None, terms: Sequence[RangedJet]) -> RangedJet:
        result = reduce(lambda x, y: x + y, terms)
        return result if constant is None else result.shifted(float(constant))

    def product(self, constant: Fraction | None, factors: Sequence[RangedJet]) -> RangedJet:
        result = reduce(lambda x, y: x * y, factors)
        return result if constant is None else result.scaled(float(constant))

    def inverse(self, value: RangedJet) -> RangedJet:
        return _inverse(value)

    def function(self, name: str, value: RangedJet) -> RangedJet:
        return super().function(name, value) if name == "tan" else _FUNCTIONS[name](value)

    def quantity(self, lo: Fraction, hi: Fraction, number: int | None) -> RangedJet:
        """One of [lo, hi], at the same place as y of its number; None: at any place."""
        middle, half = float((lo + hi) / 2), float((hi - lo) / 2)
        if number is None:
            return replace(self._nothing, c=middle, error=np.full_like(self._nothing.error, half))
        moves = np.zeros_like(self._nothing.moves)
        moves[number] = half
        return replace(self._nothing, c=middle, moves=moves)

    def state(self, value: float, rows: Array, error: Array | None = None, slack: Array | None = None) -> RangedJet:
        """A value at the middle and its gradients (M, k), or one that is near, (M,) each."""
        error, slack = (self._nothing.error if v is None else v for v in (error, slack))
        return replace(self._nothing, c=value, a=rows, error=error, slack=slack)

    def input(self, number: int, value: float, a: Array, Q: Array, K: Array) -> RangedJet:
        """An input's model, without its error, which is e of its number."""
        B = np.zeros_like(self._nothing.B)
        B[0, number] = 1.0
        return replace(self._nothing, c=value, a=a, Q=Q, K=K, B=B)
