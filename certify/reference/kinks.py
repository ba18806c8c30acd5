"""Kinks on a ball: entries of relu and of clips whose side is not certain, known to first order on a cone of d.

An entry phi(v) is phi(v(0)) + m (v - v(0)) + e, and where all chord slopes of phi from v(0) lie in a sector [p, q], |e|
is at most w |v - v(0)|, w = max(q - m, m - p). So e vanishes with d but no faster, and it is no part of a remainder.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from flint import arb, arb_mat, fmpq

from .balls import ONE, ZERO, finite, norm, total
from .refusal import Refused

if TYPE_CHECKING:
    from .model import Model

HALVINGS = 40  # of an interval of multipliers


@dataclass(frozen=True)
class Cone:
    """All d with c.d >= t ||d||, t^2 = |c|^2 - |r|^2; all d without a centre, or where t^2 is not positive.

    c and r are exact: `centre` has c, `square` is |r|^2.
    """

    centre: tuple[fmpq, ...] = ()
    square: fmpq | int = 0

    @cached_property
    def length(self) -> fmpq:
        """|c|^2."""
        return sum((v * v for v in self.centre), fmpq(0))

    @cached_property
    def turns(self) -> tuple[arb, arb]:
        """sin and cos of the angle between the axis and the surface."""
        length = arb(self.length)
        return (arb(self.square) / length).sqrt(), (arb(self.length - self.square) / length).sqrt()

    @property
    def is_all(self) -> bool:
        return not bool(self.length > self.square)

    @cached_property
    def axis(self) -> arb_mat:
        """c, a column."""
        return arb_mat(len(self.centre), 1, [arb(v) for v in self.centre])

    @cached_property
    def weight(self) -> arb_mat:
        """c c' + |r|^2 I."""
        return self.form(self.square)

    @cached_property
    def slack(self) -> arb_mat:
        """c c' - t^2 I, a form that is nowhere negative on the cone."""
        return self.form(self.square - self.length)

    def form(self, along: fmpq | int) -> arb_mat:
        outer, n = self.axis * self.axis.transpose(), len(self.centre)
        return outer + arb_mat(n, n, [arb(along) if i == j else ZERO for i in range(n) for j in range(n)])

    def reach(self, a: arb_mat, off: arb) -> tuple[arb, arb]:
        """(below, above): on the cone a.d and an error of off ||d|| are within ||d|| [-below, above].

        At an angle phi to c a.d is g cos(phi) and at most g' sin(phi) more or less.
        """
        if self.is_all:
            size = largest(norm(a.entries()) + off)
            return size, size
        c, length = self.axis, arb(self.length)
        along, (sin, cos) = (a.transpose() * c)[0, 0], self.turns
        g, rest = along / length.sqrt(), norm((a - c * (along / length)).entries())
        sideways, other = off + rest * sin, g * cos
        below = largest((sideways - g.min(other)).max(ZERO))
        above = largest((sideways + g.max(other)).max(ZERO))
        one_sided = off.is_zero() and bool(along * along >= total(v * v for v in a.entries()) * arb(self.square))
        if one_sided and along >= 0:  # the cone may touch where a.d is 0
            return ZERO, above
        return (below, ZERO) if one_sided and along <= 0 else (below, above)


ALL = Cone()


@dataclass(frozen=True)
class Kink:
    """An error e with |e(d)| <= |alpha.d| + beta ||d||, and <= rho ||d||; alpha is a column."""

    alpha: arb_mat
    beta: arb
    rho: arb

    def is_finite(self) -> bool:
        return finite([*self.alpha.entries(), self.beta, self.rho])


@dataclass(frozen=True)
class Entry:
    """phi(v): its value at d = 0, within `off`, and m times what v adds to v(0), with a kink if that is not all."""

    value: arb
    slope: arb
    off: arb
    slack: arb
    kink: Kink | None = None


def entry(cone: Cone, v: Model, lo: arb, hi: arb | None) -> Entry:
    """min(max(v, lo), hi) on a cone, without an upper end where there is none; `lip` of v where it is asked for.

    A value at d = 0 moves by no more than that of v, whichever slope the entry has.
    """
    known = v.turn + v.curve
    below, above = cone.reach(v.a, known)
    p, q = sector(v, lo, hi, below, above)
    value = v.v.max(lo) if hi is None else v.v.max(lo).min(hi)
    if p == q:
        return Entry(value, p, p * v.doubt, p * v.slack)
    if v.lip is not None:
        p, q = ZERO, ONE
    m = arb(((p + q) / 2).mid())
    w, size = largest((q - m).max(m - p)), below.max(above)
    if v.lip is not None:
        known = v.turn + 2 * v.bend + 3 * v.twist + v.lip
        size = norm(v.a.entries()) + known
    return Entry(value, m, v.doubt, m * v.slack, Kink(w * v.a, largest(w * known), largest(w * size)))


def on_one_side(v: Model, lo: arb, hi: arb) -> Entry:
    """The same without kinks, where v itself or one of the ends is all that there is on the ball; else a refusal."""
    below, above = v.v - v.reach, v.v + v.reach
    if below > lo and above < hi:
        return Entry(v.v, ONE, v.off, v.slack)
    if above < lo or below > hi:
        return Entry(lo if above < lo else hi, ZERO, ZERO, ZERO)
    raise Refused("local", "ball", "a clip in a network may begin to act")


def sector(v: Model, lo: arb, hi: arb | None, below: arb, above: arb) -> tuple[arb, arb]:
    """Bounds of (phi(v) - phi(v(0)))/(v - v(0)) where v - v(0) lies in [-below, above], exact numbers."""
    least, most = v.v - v.doubt, v.v + v.doubt
    if least > lo and (hi is None or most < hi):
        p = share(least - lo, below)
        p = p if hi is None else p.min(share(hi - most, above))
        return arb(p.lower()), ONE
    if most < lo:
        return ZERO, arb((ONE - share(lo - most, above)).upper())
    if hi is not None and least > hi:
        return ZERO, arb((ONE - share(least - hi, below)).upper())
    if hi is None and v.v.is_zero() and v.doubt.is_zero() and lo.is_zero():
        if below.is_zero():
            return ONE, ONE
        if above.is_zero():
            return ZERO, ZERO
    return ZERO, ONE


def share(distance: arb, reach: arb) -> arb:
    """A lower bound of distance / reach, 1 where the distance is certainly the larger; both are positive then."""
    least = arb(distance.lower())
    return ONE if reach < least else least / reach


def largest(value: arb) -> arb:
    return arb(value.upper())


# ------------------------------------------------------------------------------------------------------ the multiplier


def multiplier(left: arb_mat, slack: arb_mat, cone: Cone) -> arb:
    """A number mu >= 0 for which left - mu slack is positive definite, if one is found; it decides nothing.

    Where the matrix of some mu is not, a vector shows it, and the sign of the slack's form there tells on which side of
    this mu all others are for which it may be. `left` is symmetric, `slack` that of the cone, perhaps with a row for 1.
    """
    A, N = floats(left), floats(slack)
    axis = [0.0] * (len(A) - len(cone.centre)) + [row[0] for row in floats(cone.axis)]
    most = top(A, N, axis)
    inside = search(A, N, 0.0, most)
    if inside is None:
        return ZERO
    return arb((last(A, N, inside, 0.0) + last(A, N, inside, most)) / 2)


def search(A: list[list[float]], N: list[list[float]], lo: float, hi: float) -> float | None:
    for _ in range(HALVINGS):
        tried = (lo + hi) / 2
        z = witness(A, N, tried)
        if z is None:
            return tried
        lo, hi = (lo, tried) if form(N, z) > 0 else (tried, hi)
    return None


def last(A: list[list[float]], N: list[list[float]], good: float, bad: float) -> float:
    """Nearly the last mu towards another one for which the matrix is positive definite."""
    for _ in range(HALVINGS):
        tried = (good + bad) / 2
        good, bad = (tried, bad) if witness(A, N, tried) is None else (good, tried)
    return good


def top(A: list[list[float]], N: list[list[float]], axis: list[float]) -> float:
    """A number beyond which no mu need be tried, by the forms along the cone's axis.

    If the cone is a ray nothing limits mu, and one that outweighs all of A is enough.
    """
    size, along = sum(abs(v) for row in A for v in row), form(N, axis)
    return min(2.0**20 * size, abs(form(A, axis)) / along if along > 0 else math.inf)


def witness(A: list[list[float]], N: list[list[float]], mu: float) -> list[float] | None:
    """A vector at which the form of A - mu N is not positive, by the first pivot that is not; None without one."""
    n = len(A)
    L = [[a - mu * b for a, b in zip(x, y, strict=True)] for x, y in zip(A, N, strict=True)]
    factors = [[0.0] * n for _ in range(n)]
    for k in range(n):
        if not L[k][k] > 0:
            z = [0.0] * n
            z[k] = 1.0
            for i in reversed(range(k)):
                z[i] = -sum(factors[j][i] * z[j] for j in range(i + 1, k + 1))
            return z
        for i in range(k + 1, n):
            factors[i][k] = L[i][k] / L[k][k]
            for j in range(k + 1, n):
                L[i][j] -= factors[i][k] * L[k][j]
    return None


def form(N: Sequence[Sequence[float]], z: Sequence[float]) -> float:
    return sum(v * sum(a * w for a, w in zip(row, z, strict=True)) for v, row in zip(z, N, strict=True))


def floats(A: arb_mat) -> list[list[float]]:
    return [[float(v.mid()) for v in row] for row in A.tolist()]
