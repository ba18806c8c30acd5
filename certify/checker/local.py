"""First-order models with a quadratic remainder on the unit ball: the arithmetic of the local rule.

A jet of v over d in R^n says: `v(d) = v(0) + a.d + R(d)` with |R(d)| <= k ||d||^2 for *all* ||d|| <= 1, so the
bound holds on every smaller ball too. v(0) lies within `error` of c, and the true gradient within `slack` of a in the
2-norm.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from .float64 import EPS, Array, float_with_error, norm, sin_cos, up


@dataclass(frozen=True)
class Jet:
    """`c` +- `error`, gradient `a` (n,) +- `slack`, quadratic remainder `k`."""

    c: float
    error: float
    a: Array
    slack: float
    k: float

    @property
    def size(self) -> float:
        """Upper bound of |v(0)|."""
        return float(up(abs(self.c) + self.error))

    @property
    def slope(self) -> float:
        """Upper bound of the gradient's 2-norm."""
        return float(up(norm(self.a, 0) + self.slack))

    @property
    def radius(self) -> float:
        """Upper bound of |v(d) - v(0)| / ||d|| on the unit ball."""
        return float(up(self.slope + self.k))


class JetAlgebra:
    """Evaluates the plant's tape on jets over R^n."""

    def __init__(self, n: int) -> None:
        self.n = n

    def const(self, q: Fraction) -> Jet:
        value, error = float_with_error(q)
        return Jet(value, error, np.zeros(self.n), 0.0, 0.0)

    def add(self, x: Jet, y: Jet) -> Jet:
        c = x.c + y.c
        error = up(x.error + y.error + EPS * abs(c))
        slack = up(x.slack + y.slack + EPS * (x.slope + y.slope))
        return Jet(c, float(error), x.a + y.a, float(slack), float(up(x.k + y.k)))

    def neg(self, x: Jet) -> Jet:
        return Jet(-x.c, x.error, -x.a, x.slack, x.k)

    def mul(self, x: Jet, y: Jet) -> Jet:
        c = x.c * y.c
        error = up(x.size * y.error + y.size * x.error + EPS * abs(c))
        slack = up(
            x.size * y.slack + x.error * y.slope + y.size * x.slack + y.error * x.slope
            + EPS * (x.size * y.slope + y.size * x.slope)
        )  # fmt: skip
        k = up(x.size * y.k + y.size * x.k + x.radius * y.radius)
        return Jet(c, float(error), x.c * y.a + y.c * x.a, float(slack), float(k))

    def compose(self, x: Jet, f0: float, f1: float, error: float, first: float, second: float) -> Jet:
        """phi(v) from phi(c), phi'(c) within `error`; first >= sup |phi'|, second >= sup |phi''| on the range."""
        slack = up((error + second * x.error) * x.slope + abs(f1) * x.slack + EPS * abs(f1) * x.slope)
        k = up(first * x.k + 0.5 * second * x.radius * x.radius)
        return Jet(f0, float(up(error + first * x.error)), f1 * x.a, float(slack), float(k))

    def inv(self, x: Jet) -> Jet:
        """1/v; NaN unless the range of v certainly excludes 0."""
        least = np.float64(abs(x.c) - up(x.error + x.radius))
        least = least * (1 - 2.0**-40) if least > 0 else np.float64(np.nan)
        f0 = float(np.float64(1.0) / x.c)
        first = up(1 / least * (1 / least))
        second = up(2 * first / least)
        return self.compose(x, f0, -f0 * f0, EPS * (abs(f0) + f0 * f0), float(first), float(second))

    def sin(self, x: Jet) -> Jet:
        s, c, e = (float(v) for v in sin_cos(np.float64(x.c)))  # type: ignore[arg-type]
        return self.compose(x, s, c, e, 1.0, float(up(min(1.0, abs(s) + e + x.error + x.radius))))

    def cos(self, x: Jet) -> Jet:
        s, c, e = (float(v) for v in sin_cos(np.float64(x.c)))  # type: ignore[arg-type]
        return self.compose(x, c, -s, e, 1.0, float(up(min(1.0, abs(c) + e + x.error + x.radius))))
