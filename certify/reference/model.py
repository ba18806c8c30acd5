"""Models of a number on a ball, with a remainder that vanishes at the centre as the square of d.

Vdot vanishes at the origin, so that no remainder with a constant can show that it is negative next to it: here all that
is not known is a quadratic form, and forms can be compared with forms. The cubic part is written down, and what the
models of the inputs leave out has a name, so that it may cancel between equations as it does in truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from flint import arb, arb_mat

from .balls import ZERO, derivatives, finite, fourth, identity, norm
from .refusal import Refused
from .symmetric import linear_times_square, no_form, squared_norm


@dataclass(frozen=True)
class Model:
    """v(0) + a.d + d'Qd + K[d] + sum_j B_j e_j(d) + r(d) with |r(d)| <= d'Ed, for ||d|| <= 1.

    a is a column, K a row with a number for each triple. e_j is what the model of input j leaves out, |e_j(d)| <= d'U_j
    d with U_j of `errors`: these are the same in all models of a ball.
    """

    v: arb
    a: arb_mat
    Q: arb_mat
    K: arb_mat
    E: arb_mat
    B: tuple[arb, ...] = ()
    errors: tuple[arb_mat, ...] = ()

    @classmethod
    def affine(cls, v: arb, a: Sequence[arb], errors: tuple[arb_mat, ...] = ()) -> Model:
        n = len(a)
        square = arb_mat(n, n)
        return cls(v, arb_mat(n, 1, list(a)), square, no_form(n), square, (ZERO,) * len(errors), errors)

    @cached_property
    def slope(self) -> arb:
        return norm(self.a.entries())

    @cached_property
    def bend(self) -> arb:
        return norm(self.Q.entries())

    @cached_property
    def twist(self) -> arb:
        return arb(squared_norm(self.K, self.a.nrows()).upper()).sqrt()

    @cached_property
    def whole(self) -> arb_mat:
        """d'(whole)d is a bound of all errors together."""
        result = self.E
        for weight, U in zip(self.B, self.errors, strict=True):
            result = result + abs(weight) * U
        return result

    @cached_property
    def curve(self) -> arb:
        return self.bend + self.twist + norm(self.whole.entries())

    @property
    def radius(self) -> arb:
        return self.slope + self.curve

    def is_finite(self) -> bool:
        parts = (self.a, self.Q, self.K, self.E, *self.errors)
        return finite([self.v, *self.B]) and all(finite(part.entries()) for part in parts)

    def __add__(self, other: Model) -> Model:
        B = tuple(p + q for p, q in zip(self.B, other.B, strict=True))
        v, a, Q, K, E = self.v + other.v, self.a + other.a, self.Q + other.Q, self.K + other.K, self.E + other.E
        return Model(v, a, Q, K, E, B, self.errors)

    def shifted(self, step: arb) -> Model:
        """v + step."""
        return replace(self, v=self.v + step)

    def __neg__(self) -> Model:
        return Model(-self.v, -self.a, -self.Q, -self.K, self.E, tuple(-p for p in self.B), self.errors)

    def __mul__(self, other: Model) -> Model:
        """v w: of the products of a part of v - v(0) with one of w - w(0), those of up to three d are in Q and K."""
        v, w = self, other
        n, outer = v.a.nrows(), v.a * w.a.transpose()
        Q = v.v * w.Q + w.v * v.Q + (outer + outer.transpose()) / 2
        K = v.v * w.K + w.v * v.K + v.times_square(w) + w.times_square(v)
        B = tuple(v.v * q + w.v * p for p, q in zip(v.B, w.B, strict=True))
        known = v.slope * w.twist + w.slope * v.twist + (v.bend + v.twist) * (w.bend + w.twist)
        E = abs(v.v) * w.E + abs(w.v) * v.E + known * identity(n)
        E += v.radius * w.whole + (w.slope + w.bend + w.twist) * v.whole
        return Model(v.v * w.v, v.v * w.a + w.v * v.a, Q, K, E, B, v.errors)

    def times_square(self, other: Model) -> arb_mat:
        """(a.d)(d'Qd), a of this model and Q of the other."""
        nothing = self.slope.is_zero() or other.bend.is_zero()
        return no_form(self.a.nrows()) if nothing else linear_times_square(self.a, other.Q)

    def function(self, name: str) -> Model:
        """phi of v."""
        value, p, H, C, R = self.expanded(name)
        Q, K, E, B = p * self.Q + H, p * self.K + C, abs(p) * self.E + R, tuple(p * q for q in self.B)
        return Model(value, p * self.a, Q, K, E, B, self.errors)

    def expanded(self, name: str) -> tuple[arb, arb, arb_mat, arb_mat, arb_mat]:
        """phi and phi' at v(0), and H, C, R: what phi adds to its tangent there is d'Hd + C[d] within d'Rd.

        Whoever asked for the ball knows the rule and the place of a refusal, and puts them into it.
        """
        at = derivatives(name, self.v)
        most = fourth(name, at[0], self.v, self.radius)
        if most is None:
            raise Refused(
                "local",
                "ball",
                "a root of what may not be positive" if name == "sqrt" else "a division by what may be 0",
            )
        return at[0], at[1], *self.beyond_tangent(at[2] / 2, at[3] / 6, most / 24)

    def beyond_tangent(self, h: arb, g: arb, m: arb) -> tuple[arb_mat, arb_mat, arb_mat]:
        """H, C and R; h = phi''(v(0)) / 2, g = phi'''(v(0)) / 6, m >= |phi''''| / 24 on the range.

        With D = v - v(0), y = a.d and z = D - y, within curve and d'Wd: h D^2 is h y^2 and 2 h y d'Qd but for what is
        left of z in 2 h y z and for h z^2; g D^3 is g y^3 but for g z (3 y^2 + 3 y z + z^2); and D^4 is at most
        radius^2 (y^2 + (2 |y| + |z|) |z|).
        """
        n, slope, curve = self.a.nrows(), self.slope, self.curve
        outer = self.a * self.a.transpose()
        C = no_form(n) if slope.is_zero() else linear_times_square(self.a, 2 * h * self.Q + g * outer)
        quartic = m * self.radius * self.radius
        turned = abs(h) * curve + abs(g) * (3 * slope * (slope + curve) + curve * curve) + quartic * (2 * slope + curve)
        rest = 2 * abs(h) * slope
        R = (rest + turned) * self.whole + quartic * outer
        R += (rest * self.twist + turned * (self.bend + self.twist)) * identity(n)
        return h * outer, C, R
