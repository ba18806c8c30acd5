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

from . import lipschitz
from .balls import ZERO, absolute, derivatives, finite, fourth, identity, norm, total
from .refusal import Refused
from .symmetric import linear_times_square, no_form, squared_norm

Form = tuple[arb_mat, tuple[arb_mat, ...]]  # a column that is affine in y: c + sum_j y_j c_j; without c_j it is c
SPREAD, SHARE = arb(0, 1), arb(0.5, 0.5)  # the ranges of a product of two y, and of a square


@dataclass(frozen=True)
class Model:
    """v(0) + a.d + d'Qd + K[d] + sum_j B_j e_j(d) + r(d) with |r(d)| <= d'Ed, for ||d|| <= 1.

    a is a column, K a row with a number for each triple. e_j is what the model of input j leaves out, |e_j(d)| <= d'U_j
    d with U_j of `errors`: these are the same in all models of a ball.

    Where something is uncertain v(0) and a are affine in its symbols y in [-1, 1]^N: `v` + sum_j y_j `dv_j`, and `a`
    with `da` likewise; all other numbers are balls that hold what they are for every y. Without `dv` there is no y in
    them.

    `lip`, where it is asked for, is a Lipschitz constant on the ball of what there is beyond v(0) + a.d + d'Qd + K[d].
    """

    v: arb
    a: arb_mat
    Q: arb_mat
    K: arb_mat
    E: arb_mat
    B: tuple[arb, ...] = ()
    errors: tuple[arb_mat, ...] = ()
    dv: tuple[arb, ...] = ()
    da: tuple[arb_mat, ...] = ()
    lip: arb | None = None

    @classmethod
    def affine(cls, v: arb, a: Sequence[arb], errors: tuple[arb_mat, ...] = (), lip: arb | None = None) -> Model:
        n = len(a)
        square = arb_mat(n, n)
        return cls(v, arb_mat(n, 1, list(a)), square, no_form(n), square, (ZERO,) * len(errors), errors, lip=lip)

    @cached_property
    def reach(self) -> arb:
        """The largest |sum_j y_j dv_j|."""
        return total(abs(v) for v in self.dv)

    @cached_property
    def range(self) -> arb:
        """v(0) for every y."""
        return self.v + self.reach * SPREAD if self.dv else self.v

    @cached_property
    def gradient(self) -> arb_mat:
        """a for every y."""
        return spread_out((self.a, self.da))

    @cached_property
    def slope(self) -> arb:
        return norm(self.gradient.entries())

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
        single = finite([self.v, *self.B, *self.dv]) and (self.lip is None or self.lip.is_finite())
        return single and all(finite(part.entries()) for part in (*parts, *self.da))

    def whatever(self) -> Model:
        """The same without y, whose every value is in the balls."""
        return replace(self, v=self.range, a=self.gradient, dv=(), da=()) if self.dv else self

    def without(self, j: int) -> bool:
        """True if none of its numbers depends on y_j."""
        return not self.dv or (self.dv[j].is_zero() and all(v.is_zero() for v in self.da[j].entries()))

    def where(self, y: Sequence[int] | Sequence[arb]) -> Model:
        """The same at one y."""
        if not self.dv:
            return self
        v = self.v + total(s * p for s, p in zip(y, self.dv, strict=True))
        a = sum((s * p for s, p in zip(y, self.da, strict=True)), self.a)
        return replace(self, v=v, a=a, dv=(), da=())

    def __add__(self, other: Model) -> Model:
        B = tuple(p + q for p, q in zip(self.B, other.B, strict=True))
        v, a, Q, K, E = self.v + other.v, self.a + other.a, self.Q + other.Q, self.K + other.K, self.E + other.E
        dv, da = self.dv or other.dv, self.da or other.da
        if self.dv and other.dv:
            dv = tuple(p + q for p, q in zip(self.dv, other.dv, strict=True))
            da = tuple(p + q for p, q in zip(self.da, other.da, strict=True))
        lip = None if self.lip is None or other.lip is None else self.lip + other.lip
        return Model(v, a, Q, K, E, B, self.errors, dv, da, lip)

    def shifted(self, step: arb) -> Model:
        """v + step."""
        return replace(self, v=self.v + step)

    def at_rest(self) -> Model:
        """The same where it is known that v(0) is 0 for every y."""
        return replace(self, v=ZERO, dv=(ZERO,) * len(self.dv))

    def __neg__(self) -> Model:
        v, a, B, dv, da = -self.v, -self.a, *(tuple(-p for p in part) for part in (self.B, self.dv, self.da))
        return Model(v, a, -self.Q, -self.K, self.E, B, self.errors, dv, da, self.lip)

    def scaled(self, k: arb) -> Model:
        v, a, B, dv = k * self.v, k * self.a, tuple(k * p for p in self.B), tuple(k * p for p in self.dv)
        da, lip = tuple(k * p for p in self.da), None if self.lip is None else abs(k) * self.lip
        return Model(v, a, k * self.Q, k * self.K, abs(k) * self.E, B, self.errors, dv, da, lip)

    def __mul__(self, other: Model) -> Model:
        """v w: of the products of a part of v - v(0) with one of w - w(0), those of up to three d are in Q and K."""
        v, w = self, other
        n, outer = v.a.nrows(), v.gradient * w.gradient.transpose()
        Q = v.range * w.Q + w.range * v.Q + (outer + outer.transpose()) / 2
        K = v.range * w.K + w.range * v.K + v.times_square(w) + w.times_square(v)
        B = tuple(v.range * q + w.range * p for p, q in zip(v.B, w.B, strict=True))
        known = v.slope * w.twist + w.slope * v.twist + (v.bend + v.twist) * (w.bend + w.twist)
        E = abs(v.range) * w.E + abs(w.range) * v.E + known * identity(n)
        E += v.radius * w.whole + (w.slope + w.bend + w.twist) * v.whole
        lip = lipschitz.of_product(v, w)
        if not (v.dv or w.dv):
            return Model(v.v * w.v, v.v * w.a + w.v * v.a, Q, K, E, B, v.errors, lip=lip)
        value, dv = times((v.v, v.dv), (arb_mat([[w.v]]), tuple(arb_mat([[p]]) for p in w.dv)))
        one, two = times((v.v, v.dv), (w.a, w.da)), times((w.v, w.dv), (v.a, v.da))
        a, da = one[0] + two[0], tuple(p + q for p, q in zip(one[1], two[1], strict=True))
        return Model(value[0, 0], a, Q, K, E, B, v.errors, tuple(p[0, 0] for p in dv), da, lip)

    def times_square(self, other: Model) -> arb_mat:
        """(a.d)(d'Qd), a of this model and Q of the other."""
        nothing = self.slope.is_zero() or other.bend.is_zero()
        return no_form(self.a.nrows()) if nothing else linear_times_square(self.gradient, other.Q)

    def function(self, name: str) -> Model:
        """phi of v."""
        value, p, H, C, R, beyond = self.expanded(name)
        lip = None if self.lip is None or beyond is None else abs(p) * self.lip + beyond
        Q, K, E, B = p * self.Q + H, p * self.K + C, abs(p) * self.E + R, tuple(p * q for q in self.B)
        if not self.dv:
            return Model(value, p * self.a, Q, K, E, B, self.errors, lip=lip)
        v, dv, slope = self.tangent(name)
        a, da = times(slope, (self.a, self.da))
        return Model(v, a, Q, K, E, B, self.errors, dv, da, lip)

    def tangent(self, name: str) -> tuple[arb, tuple[arb, ...], tuple[arb, tuple[arb, ...]]]:
        """phi(v(0)), its coefficients of y, and phi'(v(0)) with its own, where phi is known to be defined on the range.

        What an affine function of y leaves out is the square of sum_j y_j dv_j, times half of the second derivative of
        phi or of phi' somewhere on the range of v(0).
        """
        at, on_range = derivatives(name, self.v), derivatives(name, self.range)
        square = self.reach * self.reach * SHARE
        v, slope = at[0] + on_range[2] * square / 2, at[1] + on_range[3] * square / 2
        return v, tuple(at[1] * p for p in self.dv), (slope, tuple(at[2] * p for p in self.dv))

    def expanded(self, name: str) -> tuple[arb, arb, arb_mat, arb_mat, arb_mat, arb | None]:
        """phi and phi' at v(0), for every y, and H, C, R: what phi adds to its tangent is d'Hd + C[d] within d'Rd.

        The last is a Lipschitz constant of what phi adds beyond d'Hd + C[d], where this model has one of its own.

        Whoever asked for the ball knows the rule and the place of a refusal, and puts them into it.
        """
        at = derivatives(name, self.range)
        most = fourth(name, at[0], self.range, self.radius)
        if most is None:
            what = "a root of what may not be positive" if name == "sqrt" else "a division by what may be 0"
            raise Refused("local", "ball", what)
        H, C, R = self.beyond_tangent(at[2] / 2, at[3] / 6, most / 24)
        return at[0], at[1], H, C, R, lipschitz.beyond_tangent(self, name, at)

    def beyond_tangent(self, h: arb, g: arb, m: arb) -> tuple[arb_mat, arb_mat, arb_mat]:
        """H, C and R; h = phi''(v(0)) / 2, g = phi'''(v(0)) / 6, m >= |phi''''| / 24 on the range.

        With D = v - v(0), y = a.d and z = D - y, within curve and d'Wd: h D^2 is h y^2 and 2 h y d'Qd but for what is
        left of z in 2 h y z and for h z^2; g D^3 is g y^3 but for g z (3 y^2 + 3 y z + z^2); and D^4 is at most
        radius^2 (y^2 + (2 |y| + |z|) |z|).
        """
        n, slope, curve = self.a.nrows(), self.slope, self.curve
        a = self.gradient
        outer = a * a.transpose()
        C = no_form(n) if slope.is_zero() else linear_times_square(a, 2 * h * self.Q + g * outer)
        quartic = m * self.radius * self.radius
        turned = abs(h) * curve + abs(g) * (3 * slope * (slope + curve) + curve * curve) + quartic * (2 * slope + curve)
        rest = 2 * abs(h) * slope
        R = (rest + turned) * self.whole + quartic * outer
        R += (rest * self.twist + turned * (self.bend + self.twist)) * identity(n)
        return h * outer, C, R


def spread_out(form: Form) -> arb_mat:
    """Every value of a column that is affine in y."""
    c, parts = form
    if not parts:
        return c
    return c + magnitudes(parts, c) * SPREAD


def magnitudes(parts: Sequence[arb_mat], like: arb_mat) -> arb_mat:
    """The sum of the parts' absolute values."""
    return sum((absolute(p) for p in parts), arb_mat(like.nrows(), like.ncols()))


def times(s: tuple[arb, tuple[arb, ...]], form: Form) -> Form:
    """The product of a number and a column that are affine in y: affine in y, with balls for what else there is.

    That is of second order in y: the squares y_j^2 lie in [0, 1], the products of two others in [-1, 1].
    """
    (v, dv), (w, dw) = s, form
    c, nothing = v * w, arb_mat(w.nrows(), w.ncols())
    if dv and dw:
        own = nothing
        for p, q in zip(dv, dw, strict=True):
            both = p * q
            own, c = own + absolute(both), c + both * SHARE
        c += (total(abs(p) for p in dv) * magnitudes(dw, w) - own) * SPREAD
    parts = [v * q for q in dw] if dw else [nothing for _ in dv]
    if dv:
        parts = [part + p * w for part, p in zip(parts, dv, strict=True)]
    return c, tuple(parts)
