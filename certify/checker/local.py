"""First-order models with a quadratic remainder on the unit ball: what the local rule evaluates the plant in.

A jet of v over d in R^n says: `v(d) = v(0) + a.d + R(d)` with |R(d)| <= k ||d||^2 for *all* ||d|| <= 1, so the
bound holds on every smaller ball too. v(0) lies within `error` of c, and the true gradient within `slack` of a in the
2-norm.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from .arithmetic import Number, lesser, norm, sin_cos, up
from .float64 import EPS, float_with_error


@dataclass(frozen=True)
class Jet:
    """`c` +- `error`, gradient `a` (n,) +- `slack`, quadratic remainder `k`."""

    c: Number
    error: Number
    a: Number
    slack: Number
    k: Number

    @property
    def size(self) -> Number:
        """Upper bound of |v(0)|."""
        return up(abs(self.c) + self.error)

    @property
    def slope(self) -> Number:
        """Upper bound of the gradient's 2-norm."""
        return up(norm(self.a, 0) + self.slack)

    @property
    def radius(self) -> Number:
        """Upper bound of |v(d) - v(0)| / ||d|| on the unit ball."""
        return up(self.slope + self.k)

    def __add__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c + y.c
        error = up(x.error + y.error + EPS * abs(c))
        return Jet(c, error, x.a + y.a, up(x.slack + y.slack + EPS * (x.slope + y.slope)), up(x.k + y.k))

    def __neg__(self) -> Jet:
        return Jet(-self.c, self.error, -self.a, self.slack, self.k)

    def __mul__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c * y.c
        error = up(x.size * y.error + y.size * x.error + EPS * abs(c))
        slack = up(
            x.size * y.slack + x.error * y.slope + y.size * x.slack + y.error * x.slope
            + EPS * (x.size * y.slope + y.size * x.slope)
        )  # fmt: skip
        k = up(x.size * y.k + y.size * x.k + x.radius * y.radius)
        return Jet(c, error, x.c * y.a + y.c * x.a, slack, k)

    def _compose(self, f0: Number, f1: Number, error: Number, first: Number, second: Number) -> Jet:
        """phi(v) from phi(c), phi'(c) within `error`; first >= sup |phi'|, second >= sup |phi''| on the range."""
        slack = up((error + second * self.error) * self.slope + abs(f1) * self.slack + EPS * abs(f1) * self.slope)
        k = up(first * self.k + 0.5 * second * self.radius * self.radius)
        return Jet(f0, up(error + first * self.error), f1 * self.a, slack, k)

    def inv(self) -> Jet:
        """1/v; NaN unless the range of v certainly excludes 0."""
        least = abs(self.c) - up(self.error + self.radius)
        least = least * (1 - 2.0**-40) if least > 0 else np.float64(np.nan)
        f0 = 1 / self.c
        first = up(1 / least * (1 / least))
        return self._compose(f0, -f0 * f0, EPS * (abs(f0) + f0 * f0), first, up(2 * first / least))

    def sin(self) -> Jet:
        s, c, s_error, c_error = sin_cos(self.c)
        second = up(lesser(abs(s) + s_error + self.error + self.radius, 1.0))
        return self._compose(s, c, up(s_error + c_error), 1.0, second)

    def cos(self) -> Jet:
        s, c, s_error, c_error = sin_cos(self.c)
        second = up(lesser(abs(c) + c_error + self.error + self.radius, 1.0))
        return self._compose(c, -s, up(s_error + c_error), 1.0, second)


def constant(q: Fraction, n: int) -> Jet:
    """A rational over R^n."""
    value, error = float_with_error(q)
    return Jet(np.float64(value), error, np.zeros(n), 0.0, 0.0)
