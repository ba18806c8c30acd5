"""Functions of models on a ball: the series of phi at the value of v in the centre, and what it leaves out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

from flint import arb, arb_mat

from .balls import SPREAD, ZERO, cube, identity, total
from .lipschitz import beyond_linear, beyond_square
from .refusal import Refused
from .rows import Four
from .symmetric import linear_times_square, no_form
from .table import FUNCTIONS

if TYPE_CHECKING:
    from .model import Model


@dataclass(frozen=True)
class Expansion:
    """phi, phi', phi''/2 and phi'''/6 at v, and how far they have `moved` from there at any v(0).

    On the ball phi is within fourth D^4 of its cubic at v(0), D = v - v(0), and the derivative of what it adds to that
    is within last |D|^3.
    """

    at: Four
    moved: Four
    fourth: arb
    last: arb
    cut: bool = False

    @cached_property
    def flat(self) -> Expansion:
        """Without the second and third derivative where it is cut by a corner on the ball: there phi is within fourth
        radius^2 D^2 of its tangent."""
        if not self.cut:
            return self
        return replace(self, at=(*self.at[:2], ZERO, ZERO), moved=(*self.moved[:2], ZERO, ZERO), cut=False)

    @cached_property
    def bent(self) -> arb:
        return abs(self.at[2]) + self.moved[2]

    @cached_property
    def twisted(self) -> arb:
        return abs(self.at[3]) + self.moved[3]


@dataclass(frozen=True)
class Beyond:
    """The part of a number beyond its tangent, d'Hd + C[d] within d'Rd; `lip`, if needed, is a constant of the rest."""

    H: arb_mat
    C: arb_mat
    R: arb_mat
    lip: arb | None


def function_of(v: Model, name: str) -> Model:
    """The model of phi of v."""
    if name == "abs" and not (abs(v.v) > v.doubt):
        return magnitude(v)
    phi = expansion(v, name)
    beyond, (off, slack) = beyond_tangent(v, phi), unsure(v, phi)
    value, p, half, _ = phi.at
    B, dv = tuple(p * q for q in v.B), tuple(p * q for q in v.dv)
    da = tuple(p * a + (2 * half * q) * v.a for q, a in zip(v.dv, v.da, strict=True))
    lip = None if v.lip is None or beyond.lip is None else abs(p) * v.lip + beyond.lip
    Q, K, E = p * v.Q + beyond.H, p * v.K + beyond.C, abs(p) * v.E + beyond.R
    return replace(v, v=value, a=p * v.a, Q=Q, K=K, E=E, B=B, dv=dv, da=da, lip=lip, off=off, slack=slack)


def magnitude(v: Model) -> Model:
    """|v| where v may vanish at the centre: it differs from its value there by no more than v does from its own, which
    a gradient does that is another one at each d. Where Lipschitz constants are asked for, the gradient is 0."""
    lip = None if v.lip is None else v.slope + beyond_linear(v, v.lip).steep
    nothing = v.scaled(ZERO)
    return replace(nothing, v=abs(v.v), off=v.doubt, slack=v.radius, lip=lip)


def unsure(v: Model, phi: Expansion) -> tuple[arb, arb]:
    """off and slack of phi of v."""
    _, p, half, _ = phi.at
    by_y, square = 2 * abs(half) * v.sway, v.doubt * v.doubt
    slack = (2 * abs(half) * v.off + 3 * phi.twisted * square) * v.slope
    slack += (abs(p) + by_y) * v.slack + by_y * v.tilt + phi.moved[1] * v.kinked
    return abs(p) * v.off + phi.bent * square, slack


def expansion(v: Model, name: str) -> Expansion:
    """The function's series at v, or a refusal.

    Whoever asked for the ball knows the rule and the place of a refusal, and puts them into it.
    """
    row = FUNCTIONS[name]
    at = there = row.derivatives(v.v)
    anywhere, moved = v.v, (ZERO, ZERO, ZERO, ZERO)
    if not v.doubt.is_zero():
        anywhere += v.doubt * SPREAD
        there = row.derivatives(anywhere)
        a, b, c, d = (arb((p - q).abs_upper()) for p, q in zip(there, at, strict=True))
        moved = a, b, c / 2, d / 6
    most, last = row.fourth(anywhere, there, v.radius), row.last(anywhere, there, v.radius)
    value, first, second, third = at
    series = value, first, second / 2, third / 6
    if most is not None and last is not None:
        return Expansion(series, moved, most / 24, last / 6)
    corner = row.corner(anywhere)
    if corner is None:
        raise Refused("local", "ball", row.undefined)
    if not (anywhere > 0 or anywhere < 0):  # one ball has the second derivatives of all v(0), on both sides
        series, moved = (value, first, there[2] / 2, there[3]), (*moved[:2], ZERO, ZERO)
    far = arb(v.radius.abs_upper())
    if far.is_zero():
        return Expansion(series, moved, ZERO, ZERO, cut=True)
    return Expansion(series, moved, corner[0] / (far * far), corner[1], cut=True)


def beyond_tangent(v: Model, phi: Expansion) -> Beyond:
    """The part of phi of v beyond phi(v(0)) and phi' times what v adds to v(0); what is beyond v's K counts with phi'.

    With D = v - v(0), y = a.d and z = D - y, within curve and d'Wd: h D^2 is h y^2 and 2 h y d'Qd but for what is
    left of z in 2 h y z and for h z^2; g D^3 is g y^3 but for 3 g z y^2 and g z (3 y z + z^2); and D^4 is at most
    radius^2 (y^2 + (2 |y| + |z|) |z|). Here phi', h, g and a are those at y = 0: by what they differ R is larger.
    """
    n, slope, curve, a, phi = v.a.nrows(), v.slope, v.curve, v.a, phi.flat
    _, _, h, g = phi.at
    outer = a * a.transpose()
    C = no_form(n) if slope.is_zero() else linear_times_square(a, 2 * h * v.Q + g * outer)
    quartic = phi.fourth * v.radius * v.radius
    rest = 2 * phi.bent * slope
    turned = phi.bent * curve + phi.twisted * curve * (3 * slope + curve)
    turned += quartic * (2 * slope + curve) + phi.moved[1]
    known = rest * v.twist + turned * (v.bend + v.twist) + total(mistaken(v, phi))
    R = (rest + turned) * v.whole + of_squares(v, phi) * outer + known * identity(n)
    return Beyond(h * outer, C, R, steepness(v, phi))


def of_squares(v: Model, phi: Expansion) -> arb:
    """The factor of y^2 in R: D^4 has one of radius^2, and 3 g z y^2 one of 3 |g| curve."""
    return phi.fourth * v.radius * v.radius + 3 * phi.twisted * v.curve


def mistaken(v: Model, phi: Expansion) -> tuple[arb, arb, arb]:
    """Bounds of what differs in H, in C and in R's multiple of a a' for other y, on the ball."""
    s, a = v.slope, v.slope - v.turn
    square, cube = s * s - a * a, s * s * s - a * a * a
    of_H = phi.moved[2] * s * s + (phi.bent - phi.moved[2]) * square
    of_C = 2 * (phi.moved[2] * s + (phi.bent - phi.moved[2]) * v.turn) * v.bend
    of_C += phi.moved[3] * s * s * s + (phi.twisted - phi.moved[3]) * cube
    return of_H, of_C, of_squares(v, phi) * square


def steepness(v: Model, phi: Expansion) -> arb | None:
    """The Lipschitz constant of phi''/2 (D^2 - y^2 - 2 y d'Qd) + phi'''/6 (D^3 - y^3) and the rest of the series.

    D = y + z, y = a.d. The derivative of the rest by D is at most `last` |D|^3. By what phi' differs z counts too.
    """
    if v.lip is None:
        return None
    beyond, left = beyond_linear(v, v.lip), beyond_square(v, v.lip)
    y, z, steep = v.slope, beyond.size, beyond.steep
    second = 2 * phi.bent * (y * left.both + z * steep)
    third = 3 * phi.twisted * (y * y * (steep + 2 * z) + y * z * (2 * steep + z) + z * z * steep)
    of_H, of_C, _ = mistaken(v, phi)
    wrong = phi.moved[1] * steep + 2 * of_H + 3 * of_C
    return second + third + phi.last * cube(v.radius) * (y + steep) + wrong
