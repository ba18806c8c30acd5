"""Models of a number on a ball, with a remainder that vanishes at the centre as the square of d.

Vdot vanishes at the origin, so that no remainder with a constant can show that it is negative next to it: here all that
is not known is a quadratic form, and forms can be compared with forms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from flint import arb, arb_mat

from .balls import derivatives, identity, norm, third
from .refusal import Refused


@dataclass(frozen=True)
class Model:
    """v(0) + a.d + d'Qd + r(d) with |r(d)| <= d'Ed, for ||d|| <= 1; a is a column."""

    v: arb
    a: arb_mat
    Q: arb_mat
    E: arb_mat

    @classmethod
    def affine(cls, v: arb, a: Sequence[arb]) -> Model:
        n = len(a)
        return cls(v, arb_mat(n, 1, list(a)), arb_mat(n, n), arb_mat(n, n))

    @cached_property
    def slope(self) -> arb:
        return norm(self.a.entries())

    @cached_property
    def bend(self) -> arb:
        return norm(self.Q.entries())

    @cached_property
    def curve(self) -> arb:
        return self.bend + norm(self.E.entries())

    @property
    def radius(self) -> arb:
        return self.slope + self.curve

    def __add__(self, other: Model) -> Model:
        return Model(self.v + other.v, self.a + other.a, self.Q + other.Q, self.E + other.E)

    def __neg__(self) -> Model:
        return Model(-self.v, -self.a, -self.Q, self.E)

    def __mul__(self, other: Model) -> Model:
        """v w = v(0) w(0) + v(0) dw + w(0) dv + (a_v.d)(a_w.d) + dv (dw - a_w.d) + (dv - a_v.d)(a_w.d)."""
        v, w, outer = self, other, self.a * other.a.transpose()
        Q = v.v * w.Q + w.v * v.Q + (outer + outer.transpose()) / 2
        E = (abs(v.v) + v.radius) * w.E + (abs(w.v) + w.slope) * v.E
        E += (v.radius * w.bend + w.slope * v.bend) * identity(outer.nrows())
        return Model(v.v * w.v, v.v * w.a + w.v * v.a, Q, E)

    def function(self, name: str) -> Model:
        """phi of v; whoever asked for the ball knows the rule and the place, and puts them into the refusal."""
        at = derivatives(name, self.v)
        most = third(name, at[3], self.v, self.radius)
        if most is None:
            raise Refused(
                "local",
                "ball",
                "a root of what may not be positive" if name == "sqrt" else "a division by what may be 0",
            )
        H, R = self.beyond_tangent(at[2] / 2, most)
        return Model(at[0], at[1] * self.a, at[1] * self.Q + H, abs(at[1]) * self.E + R)

    def beyond_tangent(self, half: arb, most: arb) -> tuple[arb_mat, arb_mat]:
        """(H, R): a function of v less its tangent at v(0) is d'Hd within d'Rd.

        half = phi''(v(0)) / 2, most >= |phi'''| on the range. (v - v(0))^2 is d'aa'd but for (v - v(0) - a.d)(v - v(0)
        + a.d), that is within (2 slope + curve) d'(bend I + E)d, and |v - v(0)|^3 <= radius (v - v(0))^2.
        """
        square, cubic = self.a * self.a.transpose(), most * self.radius / 6
        spread = (abs(half) + cubic) * (2 * self.slope + self.curve)
        return half * square, spread * self.E + cubic * square + spread * self.bend * identity(square.nrows())

    def beyond_tanh(self, t: arb) -> tuple[arb_mat, arb_mat]:
        """(H, R) of tanh, t its value at v(0): half of tanh'' is -t (1 - t^2), and |tanh'''| <= 2."""
        return self.beyond_tangent(-t * (1 - t * t), arb(2))
