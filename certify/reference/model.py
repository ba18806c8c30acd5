"""Models of a number on a ball, with a remainder that vanishes at the centre as the square of d.

Vdot vanishes at the origin, so that no remainder with a constant can show that it is negative next to it: here all that
is not known is a quadratic form, and forms can be compared with forms. The cubic part is written down, and what the
models of the inputs leave out has a name, so that it may cancel between equations as it does in truth.

Where something is uncertain, with symbols y, the value and the gradient at the centre are affine in y but for an error.
All else is written down for y = 0, and the remainder takes in by how much it differs for other y.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from typing import TypeVar

from flint import arb, arb_mat

from . import functions, lipschitz
from .balls import ZERO, finite, identity, norm, total
from .symmetric import linear_times_square, no_form, squared_norm

T = TypeVar("T")


@dataclass(frozen=True)
class Model:
    """v(0) + a'.d + d'Qd + K[d] + sum_j B_j e_j(d) + r(d) with |r(d)| <= d'Ed, for ||d|| <= 1.

    a is a column, K a row with a number for each triple. e_j is what the model of input j, or of an entry of a
    call, leaves out, |e_j(d)| <= d'U_j d with U_j of `errors`: these are the same in all models of a ball.

    v(0) is within `off` of `v` + sum_j y_j `dv_j`, and the gradient a' within `slack`, in the 2-norm, of `a` + sum_j
    y_j `da_j`, for every y in [-1, 1]^N; without `dv` there is no y in them.

    `lip`, where it is asked for, is a Lipschitz constant on the ball of what there is beyond v(0) + a'.d + d'Qd + K[d].

    With kinks e_j has besides a part of at most `rhos`_j ||d||, as if the gradient differed by that much from place to
    place; where there is a `lip`, its Lipschitz constant is no more. Behind the last of `rhos` there are none.
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
    off: arb = ZERO
    slack: arb = ZERO
    rhos: tuple[arb, ...] = ()

    @classmethod
    def affine(cls, v: arb, a: Sequence[arb], errors: tuple[arb_mat, ...] = (), lip: arb | None = None) -> Model:
        n = len(a)
        square = arb_mat(n, n)
        return cls(v, arb_mat(n, 1, list(a)), square, no_form(n), square, (ZERO,) * len(errors), errors, lip=lip)

    @cached_property
    def sway(self) -> arb:
        """The largest |sum_j y_j dv_j|."""
        return total(abs(v) for v in self.dv)

    @cached_property
    def tilt(self) -> arb:
        """A bound of the norm of sum_j y_j da_j, and of what kinks add to the gradient."""
        return self.tilt_of_y + self.kinked

    @cached_property
    def tilt_of_y(self) -> arb:
        return total(norm(part.entries()) for part in self.da)

    @cached_property
    def kinked(self) -> arb:
        """sum_j |B_j| rho_j."""
        return total(abs(weight) * rho for weight, rho in zip(self.B, self.rhos, strict=False))

    @cached_property
    def doubt(self) -> arb:
        """A bound of |v(0) - v|."""
        return self.off + self.sway

    @cached_property
    def turn(self) -> arb:
        """A bound of the gradient's distance from a."""
        return self.slack + self.tilt

    @cached_property
    def size(self) -> arb:
        """A bound of |v(0)|."""
        return abs(self.v) + self.doubt

    @cached_property
    def slope(self) -> arb:
        return norm(self.a.entries()) + self.turn

    @cached_property
    def bend(self) -> arb:
        return norm(self.Q.entries())

    @cached_property
    def twist(self) -> arb:
        return arb(squared_norm(self.K, self.a.nrows()).upper()).sqrt()

    @cached_property
    def shares(self) -> arb_mat:
        """d'(shares)d is a bound of the inputs' errors together."""
        result = arb_mat(self.a.nrows(), self.a.nrows())
        for weight, U in zip(self.B, self.errors, strict=False):  # B may end where all that follows is 0
            result = result + abs(weight) * U
        return result

    @cached_property
    def whole(self) -> arb_mat:
        """d'(whole)d is a bound of all errors together."""
        return self.E + self.shares

    @cached_property
    def curve(self) -> arb:
        return self.bend + self.twist + norm(self.whole.entries())

    @property
    def radius(self) -> arb:
        return self.slope + self.curve

    @property
    def reach(self) -> arb:
        """A bound of |v(d) - v| on the ball."""
        return self.doubt + self.radius

    def is_finite(self) -> bool:
        parts = (self.a, self.Q, self.K, self.E, *self.errors, *self.da)
        single = finite([self.v, self.off, self.slack, *self.B, *self.dv, *self.rhos])
        single = single and (self.lip is None or self.lip.is_finite())
        return single and all(finite(part.entries()) for part in parts)

    def whatever(self) -> Model:
        """The same without y, whose every value is within the errors."""
        return replace(self, dv=(), da=(), off=self.doubt, slack=self.slack + self.tilt_of_y) if self.dv else self

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

    def of_y(self, symbols: int) -> list[tuple[arb, arb_mat]]:
        """dv_j and da_j for each of so many y."""
        if self.dv:
            return list(zip(self.dv, self.da, strict=True))
        return [(ZERO, arb_mat(self.a.nrows(), 1))] * symbols

    def __add__(self, other: Model) -> Model:
        B = tuple(p + q for p, q in zip_longest(self.B, other.B, fillvalue=ZERO))
        v, a, Q, K, E = self.v + other.v, self.a + other.a, self.Q + other.Q, self.K + other.K, self.E + other.E
        dv, da = self.dv or other.dv, self.da or other.da
        if self.dv and other.dv:
            dv = tuple(p + q for p, q in zip(self.dv, other.dv, strict=True))
            da = tuple(p + q for p, q in zip(self.da, other.da, strict=True))
        lip = None if self.lip is None or other.lip is None else self.lip + other.lip
        off, slack = self.off + other.off, self.slack + other.slack
        errors, rhos = longer(self.errors, other.errors), longer(self.rhos, other.rhos)
        return Model(v, a, Q, K, E, B, errors, dv, da, lip, off, slack, rhos)

    def among(self, errors: tuple[arb_mat, ...], rhos: tuple[arb, ...]) -> Model:
        """The same with all the errors that there are."""
        return replace(self, B=(*self.B, *((ZERO,) * (len(errors) - len(self.B)))), errors=errors, rhos=rhos)

    def sign(self) -> int:
        """1 or -1 where it certainly has this sign on all of the ball, else 0."""
        return 1 if self.v > self.reach else -1 if -self.v > self.reach else 0

    def shifted(self, step: arb) -> Model:
        """v + step."""
        return replace(self, v=self.v + step)

    def at_rest(self) -> Model:
        """The same where it is known that v(0) is 0 for every y."""
        return replace(self, v=ZERO, dv=(ZERO,) * len(self.dv), off=ZERO)

    def __neg__(self) -> Model:
        v, a, B, dv, da = -self.v, -self.a, *(tuple(-p for p in part) for part in (self.B, self.dv, self.da))
        return replace(self, v=v, a=a, Q=-self.Q, K=-self.K, B=B, dv=dv, da=da)

    def scaled(self, k: arb) -> Model:
        size, lip = abs(k), None if self.lip is None else abs(k) * self.lip
        B, dv, da = (tuple(k * p for p in part) for part in (self.B, self.dv, self.da))
        v, a, Q, K, E = k * self.v, k * self.a, k * self.Q, k * self.K, size * self.E
        return Model(v, a, Q, K, E, B, self.errors, dv, da, lip, size * self.off, size * self.slack, self.rhos)

    def __mul__(self, other: Model) -> Model:
        """v w: of the products of a part of v - v(0) with one of w - w(0), those of up to three d are in Q and K."""
        v, w = self, other
        n, outer = v.a.nrows(), v.a * w.a.transpose()
        Q = v.v * w.Q + w.v * v.Q + (outer + outer.transpose()) / 2
        K = v.v * w.K + w.v * v.K + times_square(v, w) + times_square(w, v)
        B = tuple(v.v * q + w.v * p for p, q in zip_longest(v.B, w.B, fillvalue=ZERO))
        known = v.slope * w.twist + w.slope * v.twist + (v.bend + v.twist) * (w.bend + w.twist)
        of_Q = v.doubt * w.bend + w.doubt * v.bend + v.turn * w.slope + w.turn * (v.slope - v.turn)
        of_K = v.doubt * w.twist + w.doubt * v.twist + v.turn * w.bend + w.turn * v.bend
        E = v.size * w.E + w.size * v.E + v.doubt * w.shares + w.doubt * v.shares
        E += (known + of_Q + of_K) * identity(n)
        E += v.radius * w.whole + (w.slope + w.bend + w.twist) * v.whole
        off = v.size * w.off + w.size * v.off + v.sway * w.sway
        slack = v.size * w.slack + v.off * w.slope + w.size * v.slack + w.off * v.slope
        slack += v.sway * w.tilt + w.sway * v.tilt + v.doubt * w.kinked + w.doubt * v.kinked
        symbols = max(len(v.dv), len(w.dv))
        each = list(zip(v.of_y(symbols), w.of_y(symbols), strict=True))
        dv = tuple(v.v * q + w.v * p for (p, _), (q, _) in each)
        da = tuple(v.v * b + w.v * a + p * w.a + q * v.a for (p, a), (q, b) in each)
        lip = lipschitz.of_product(v, w, 2 * of_Q + 3 * of_K)
        a, errors, rhos = v.v * w.a + w.v * v.a, longer(v.errors, w.errors), longer(v.rhos, w.rhos)
        return Model(v.v * w.v, a, Q, K, E, B, errors, dv, da, lip, off, slack, rhos)

    def function(self, name: str) -> Model:
        """phi of v."""
        return functions.function_of(self, name)


def times_square(v: Model, w: Model) -> arb_mat:
    """(a.d)(d'Qd), a of v and Q of w."""
    nothing = v.slope.is_zero() or w.bend.is_zero()
    return no_form(v.a.nrows()) if nothing else linear_times_square(v.a, w.Q)


def longer(one: tuple[T, ...], other: tuple[T, ...]) -> tuple[T, ...]:
    """Errors of both: calls add to them in the order of the equations, so that one has those of the other."""
    return max(one, other, key=len)
