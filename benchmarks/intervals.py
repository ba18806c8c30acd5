"""The baseline: plain interval propagation through the network and the plant, in the same branch and bound.

What a first implementation would do, and what every interval library offers: each operation on intervals, no relation
kept between the parts of an expression. Rounding is left out, which only helps the baseline.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from functools import reduce

import torch
from torch import Tensor

from certify.loop.expressions import Algebra, evaluate
from certify.provers.boxes.rule import BoxBounds, VdotBound

Interval = tuple[Tensor, Tensor]


class PlainIntervals(VdotBound):
    """Vdot = 2 x'P f(x, u) in natural interval extension; boxes are split on their widest axis."""

    def __call__(self, lo: Tensor, hi: Tensor, inner: float, outer: float) -> BoxBounds:
        """Bounds on boxes lo, hi (n, B)."""
        x = affine(self.T, (lo, hi))
        u = self._policy(x)
        values = {s: (x[0][i], x[1][i]) for i, s in enumerate(self.system.states)}
        values |= {s: (u[0][j], u[1][j]) for j, s in enumerate(self.system.inputs)}
        gradient = affine(2 * torch.tensor(self.P.copy()), x)
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
        return BoxBounds(proved, total[1], hi - lo, total[0] > 0, torch.isfinite(total[1]))

    def _policy(self, x: Interval) -> Interval:
        h = x
        for k, (W, b) in enumerate(zip(self.policy.weights, self.policy.biases, strict=True)):
            if k:
                h = h[0].tanh(), h[1].tanh()
            h = affine(W, h)
            h = h[0] + b[:, None], h[1] + b[:, None]
        if self.policy.squash:
            h = h[0].tanh(), h[1].tanh()
        ends = torch.stack([self.policy.scale[:, None] * h[0], self.policy.scale[:, None] * h[1]])
        u = ends.amin(0) + self.policy.offset[:, None], ends.amax(0) + self.policy.offset[:, None]
        if self.policy.clip is None:
            return u
        least, most = self.policy.clip
        return u[0].clamp(least, most), u[1].clamp(least, most)


def affine(W: Tensor, x: Interval) -> Interval:
    """W x."""
    mid, radius = W @ ((x[0] + x[1]) / 2), W.abs() @ ((x[1] - x[0]) / 2)
    return mid - radius, mid + radius


def times(a: Interval, b: Interval) -> Interval:
    """a b."""
    ends = torch.stack([a[0] * b[0], a[0] * b[1], a[1] * b[0], a[1] * b[1]])
    return ends.amin(0), ends.amax(0)


def cosine(x: Interval) -> Interval:
    """cos x."""
    values = torch.stack([x[0].cos(), x[1].cos()])
    period = 2 * torch.pi
    top = torch.ceil(x[0] / period) * period <= x[1]
    bottom = torch.ceil((x[0] - torch.pi) / period) * period + torch.pi <= x[1]
    return torch.where(bottom, -1.0, values.amin(0)), torch.where(top, 1.0, values.amax(0))


class Intervals(Algebra[Interval]):
    """Natural interval extension in the shape of `like`; a division by an interval around 0 gives NaN."""

    def __init__(self, like: Tensor) -> None:
        self.like = like

    def constant(self, q: Fraction) -> Interval:
        value = torch.full_like(self.like, float(q))
        return value, value

    def total(self, constant: Fraction | None, terms: Sequence[Interval]) -> Interval:
        first = [] if constant is None else [self.constant(constant)]
        return reduce(lambda a, b: (a[0] + b[0], a[1] + b[1]), [*first, *terms])

    def product(self, constant: Fraction | None, factors: Sequence[Interval]) -> Interval:
        first = [] if constant is None else [self.constant(constant)]
        return reduce(times, [*first, *factors])

    def power(self, base: Interval, exponent: int) -> Interval:
        ends = torch.stack([base[0] ** exponent, base[1] ** exponent])
        low = ends.amin(0)
        if exponent % 2 == 0:
            low = torch.where((base[0] <= 0) & (base[1] >= 0), 0.0, low)
        return low, ends.amax(0)

    def inverse(self, value: Interval) -> Interval:
        safe = (value[0] > 0) | (value[1] < 0)
        return torch.where(safe, 1 / value[1], torch.nan), torch.where(safe, 1 / value[0], torch.nan)

    def function(self, name: str, value: Interval) -> Interval:
        if name == "tan":
            return super().function(name, value)
        if name in ("tanh", "exp", "atan", "sqrt"):  # they rise; the root of a negative number is NaN
            return getattr(value[0], name)(), getattr(value[1], name)()
        return cosine((value[0] - torch.pi / 2, value[1] - torch.pi / 2) if name == "sin" else value)
