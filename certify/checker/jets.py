"""Second-order models on the unit ball: what the local rule evaluates the plant and the policy in.

A jet of v over d in R^n says, for *all* ||d|| <= 1: `v(d) = v(0) + a.d + d'Q d + r(d)` with |r(d)| <= d'E d. It
holds on every smaller ball too. v(0) lies within `error` of c, and the true gradient within `slack` of a in the 2-norm;
Q is the matrix that is stored, and whatever it leaves out lies in E. E dominates a sum of positive semidefinite
matrices with weights >= 0, so it is one, and knows the directions in which v is far from its linearisation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

import numpy as np

from .elementary import elementary
from .float64 import EPS, float_with_error, frobenius, norm, total, up


def widen(E: Any, extra: Any, relative: float = EPS) -> Any:
    """E (..., n, n) enlarged by its own rounding errors, at most `relative` a term, and by `extra` ||d||^2.

    E sums semidefinite matrices with weights >= 0. The Frobenius norm of each is at most its trace, so the 2-norm of
    all rounding errors is at most `relative` times the trace of the sum.
    """
    trace = total(np.diagonal(E, axis1=-2, axis2=-1), -1)
    return E + each(up(2 * relative * trace + extra)) * np.eye(E.shape[-1])


def each(x: Any) -> Any:
    """Numbers (...,) as factors of matrices (..., n, n)."""
    return np.asarray(x)[..., None, None]


def outer(a: Any, b: Any) -> Any:
    return a[..., :, None] * b[..., None, :]


@dataclass(frozen=True)
class Jet:
    """`c` +- `error`, gradient `a` (n,) +- `slack`, half the Hessian `Q` (n, n), remainder `E` (n, n); or a batch."""

    c: Any
    error: Any
    a: Any
    slack: Any
    Q: Any
    E: Any

    @property
    def size(self) -> Any:
        """Upper bound of |v(0)|."""
        return up(abs(self.c) + self.error)

    @property
    def slope(self) -> Any:
        """Upper bound of the gradient's 2-norm."""
        return up(norm(self.a, -1) + self.slack)

    @property
    def bend(self) -> Any:
        """Upper bound of ||Q||_2."""
        return frobenius(self.Q)

    @property
    def curve(self) -> Any:
        """Upper bound of |v(d) - v(0) - a.d| / ||d||^2, a being the true gradient."""
        return up(self.bend + frobenius(self.E))

    @property
    def radius(self) -> Any:
        """Upper bound of |v(d) - v(0)| / ||d|| on the unit ball."""
        return up(self.slope + self.curve)

    def __add__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c + y.c
        error = up(x.error + y.error + EPS * abs(c))
        slack = up(x.slack + y.slack + EPS * (x.slope + y.slope))
        return Jet(c, error, x.a + y.a, slack, x.Q + y.Q, widen(x.E + y.E, EPS * (x.bend + y.bend)))

    def __neg__(self) -> Jet:
        return Jet(-self.c, self.error, -self.a, self.slack, -self.Q, self.E)

    def __mul__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c * y.c
        error = up(x.size * y.error + y.size * x.error + EPS * abs(c))
        slack = x.size * y.slack + x.error * y.slope + y.size * x.slack + y.error * x.slope
        slack = up(slack + EPS * (x.size * y.slope + y.size * x.slope))
        ab = outer(x.a, y.a)
        Q = x.c * y.Q + y.c * x.Q + (ab + ab.T) / 2
        # (x.a.d) s_y + (y.a.d) s_x + s_x s_y, s what each adds to its linearisation: |s| <= d'(bend I + E)d
        third = x.radius * y.bend + y.slope * x.bend
        wrong = x.error * y.bend + y.error * x.bend + x.slack * y.slope + y.slack * x.slope
        wrong = wrong + EPS * (x.size * y.bend + y.size * x.bend + x.slope * y.slope)
        E = widen((x.size + x.radius) * y.E + (y.size + y.slope) * x.E, third + wrong)
        return Jet(c, error, x.c * y.a + y.c * x.a, slack, Q, E)

    def beyond_tangent(self, half: Any, half_error: Any, third: Any) -> tuple[Any, Any]:
        """(H, R): phi(v) less its tangent at v(0) is d'H d within d'R d.

        half is phi''/2 at v(0), within half_error, and third as in elementary.py. With delta = v - v(0) what is left is
        half delta^2 within third |delta|^3, where |delta| <= radius and, a being the true gradient, |delta^2 -
        (a.d)^2| <= (2 slope + curve) d'(bend I + E)d.
        """
        cubic = up(third * self.radius)
        square = up(np.abs(half) + half_error + cubic)
        spread = up(square * (2 * self.slope + self.curve))
        aa = outer(self.a, self.a)
        wrong = up(half_error + EPS * np.abs(half)) * self.slope * self.slope + 2 * up(square * self.slope) * self.slack
        R = widen(each(spread) * self.E + each(cubic) * aa, spread * self.bend + wrong)
        return each(half) * aa, R

    def function(self, name: str) -> Jet:
        """phi(v) for a function phi that elementary.py knows."""
        (f0, f1, f2), (e0, e1, e2), third = elementary(name, self.c, self.error, self.radius)
        H, R = self.beyond_tangent(f2, e2, third)
        steepest = up(np.abs(f1) + e1)
        slack = e1 * self.slope + steepest * self.slack + EPS * (steepest * self.slope)
        wrong = e1 * self.bend + EPS * (steepest * self.bend + frobenius(H))
        a, Q, E = np.asarray(f1)[..., None] * self.a, each(f1) * self.Q + H, each(steepest) * self.E + R
        return Jet(f0, e0, a, up(slack), Q, widen(E, wrong))


def uncertain(lo: Fraction, hi: Fraction, n: int) -> Jet:
    """A number of [lo, hi] over R^n, the same for all d."""
    middle, (reach, error) = constant((lo + hi) / 2, n), float_with_error((hi - lo) / 2)
    return replace(middle, error=up(middle.error + reach + error))


def constant(q: Fraction, n: int) -> Jet:
    """A rational over R^n."""
    value, error = float_with_error(q)
    return Jet(np.float64(value), error, np.zeros(n), 0.0, np.zeros((n, n)), np.zeros((n, n)))
