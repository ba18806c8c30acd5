"""The baseline: plain interval propagation through the network and the plant, in the same branch and bound.

What a first implementation would do, and what every interval library offers: each operation on intervals, no relation
kept between the parts of an expression. Rounding is left out, which only helps the baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from certify.loop.expressions import Algebra, evaluate
from certify.provers.boxes.rule import BoxBounds, VdotBound

Array = NDArray[np.float64]
Interval = tuple[Array, Array]
_RISING = {"tanh": np.tanh, "exp": np.exp, "atan": np.arctan, "sqrt": np.sqrt}


class PlainIntervals(VdotBound):
    """Vdot = 2 x'P f(x, u) in natural interval extension; boxes are split on their widest axis."""

    @np.errstate(all="ignore")
    def __call__(self, lo: Array, hi: Array, inner: float, outer: float) -> BoxBounds:
        """Bounds on boxes lo, hi (n, B)."""
        x = affine(self.T, (lo, hi))
        u = self._policy(x)
        values = {s: (x[0][i], x[1][i]) for i, s in enumerate(self.system.states)}
        values |= {s: (u[0][j], u[1][j]) for j, s in enumerate(self.system.inputs)}
        gradient = affine(2 * self.P, x)
        total: Interval | None = None
        for i, expression in enumerate(self.dynamics):
            term = times((gradient[0][i], gradient[1][i]), evaluate(expression, values, Intervals(x[0][0])))
            total = term if total is None else (total[0] + term[0], total[1] + term[1])
        if total is None:
            raise ValueError("a plant has at least one state")
        proved = total[1] < 0
        if self.check_inputs:
            for j, (low, high) in enumerate(self.system.input_bounds):
                proved = proved & (u[0][j] > float(low)) & (u[1][j] < float(high))
        return BoxBounds(proved, total[1], hi - lo, total[0] > 0, np.isfinite(total[1]))

    def _policy(self, x: Interval) -> Interval:
        h = x
        for k, (W, b) in enumerate((layer.W, layer.bias) for layer in self.policy.layers):
            if k:
                h = np.tanh(h[0]), np.tanh(h[1])
            h = affine(W, h)
            h = h[0] + b[:, None], h[1] + b[:, None]
        if self.policy.squash:
            h = np.tanh(h[0]), np.tanh(h[1])
        ends = np.stack([self.policy.scale[:, None] * h[0], self.policy.scale[:, None] * h[1]])
        u = ends.min(0) + self.policy.offset[:, None], ends.max(0) + self.policy.offset[:, None]
        if self.policy.clip is None:
            return u
        least, most = self.policy.clip
        return u[0].clip(least, most), u[1].clip(least, most)


def affine(W: Array, x: Interval) -> Interval:
    """W x."""
    mid, radius = W @ ((x[0] + x[1]) / 2), np.abs(W) @ ((x[1] - x[0]) / 2)
    return mid - radius, mid + radius


def times(a: Interval, b: Interval) -> Interval:
    """a b."""
    ends = np.stack([a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]])
    return ends.min(0), ends.max(0)


def cosine(x: Interval) -> Interval:
    """cos x."""
    values = np.stack([np.cos(x[0]), np.cos(x[1])])
    period = 2 * np.pi
    top = np.ceil(x[0] / period) * period <= x[1]
    bottom = np.ceil((x[0] - np.pi) / period) * period + np.pi <= x[1]
    return np.where(bottom, -1.0, values.min(0)), np.where(top, 1.0, values.max(0))


class Intervals(Algebra[Interval]):
    """Natural interval extension in the shape of `like`; a division by an interval around 0 gives NaN."""

    def __init__(self, like: Array) -> None:
        self.like = like

    def constant(self, q: Fraction) -> Interval:
        value = np.full_like(self.like, float(q))
        return value, value

    def total(self, constant: Fraction | None, terms: Sequence[Interval]) -> Interval:
        first = [] if constant is None else [self.constant(constant)]
        return reduce(lambda a, b: (a[0] + b[0], a[1] + b[1]), [*first, *terms])

    def product(self, constant: Fraction | None, factors: Sequence[Interval]) -> Interval:
        first = [] if constant is None else [self.constant(constant)]
        return reduce(times, [*first, *factors])

    def power(self, base: Interval, exponent: int) -> Interval:
        ends = np.stack([base[0] ** exponent, base[1] ** exponent])
        low = ends.min(0)
        if exponent % 2 == 0:
            low = np.where((base[0] <= 0) & (base[1] >= 0), 0.0, low)
        return low, ends.max(0)

    def inverse(self, value: Interval) -> Interval:
        safe = (value[0] > 0) | (value[1] < 0)
        return np.where(safe, 1 / value[1], np.nan), np.where(safe, 1 / value[0], np.nan)

    def function(self, name: str, value: Interval) -> Interval:
        if name == "tan":
            return super().function(name, value)
        if name in _RISING:  # they rise; the root of a negative number is NaN
            return _RISING[name](value[0]), _RISING[name](value[1])
        return cosine((value[0] - np.pi / 2, value[1] - np.pi / 2) if name == "sin" else value)
