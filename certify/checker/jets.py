"""Third-order models on the unit ball, in which the local rule evaluates the plant and the policy.

A jet of v over d in R^k says, for *all* ||d|| <= 1: `v(d) = v(0) + a.d + d'Q d + K[d] + sum_j B_j e_j(d) + r(d)` with
|r(d)| <= d'E d, K[d] being the sum of all K_hij d_h d_i d_j. It holds on every smaller ball too. The errors e_j are the
same in all jets of one family, so that they cancel as they do in truth: |e_j(d)| <= d'U_j d. With numbers y_j in
[-1, 1] that are uncertain v(0) is near c + sum_j y_j c_j, and the gradient near a + sum_j y_j a_j; Q, K, B and E are
near what is stored. All of this is meant for each d by itself: nothing asks how v(0) and the gradient at two d belong
together. But `lip`, a Lipschitz constant of what v has beyond v(0) + a.d + d'Q d + K[d], is meant where v(0) and the
gradient are the same for all d. E and U_j are matrices that know the directions in which v is far from what is known.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import permutations

import numpy as np

from .functions import FUNCTIONS, Expansion
from .near import ZERO, Above, Array, Cubic, Near, Square, Vector, mixed, near, outer, symmetric, triples


def unpacked(K: Array, k: int) -> Array:
    """The whole tensors (..., k, k, k) of what is stored (..., k (k + 1) (k + 2) / 6)."""
    place, (h, i, j, _) = np.zeros((k, k, k), dtype=np.intp), triples(k)
    for p, q, r in permutations((h, i, j)):
        place[p, q, r] = np.arange(len(h))
    return K[..., place]


def times(E: Square, k: Above) -> Square:
    """E k for an upper bound k."""
    return E * Near(k.top)


@dataclass(frozen=True)
class First:
    """Kinks among N units: |e_q(d)| is at most |alpha_q.d| + beta_q ||d||, and at most rho_q ||d||; alpha (k, N), beta
    and rho (N,), 0 of other units. In rule `contraction` so is the difference at any two d, d being theirs."""

    alpha: Array
    beta: Array
    rho: Array

    def beside(self, other: First) -> First:
        """These, and then others."""
        parts = zip((self.alpha, self.beta, self.rho), (other.alpha, other.beta, other.rho), strict=True)
        return First(*(np.concatenate(pair, -1) for pair in parts))

    def of(self, count: int) -> First:
        """So many of them."""
        return First(self.alpha[:, :count], self.beta[:count], self.rho[:count])


def no_kinks(k: int, count: int) -> First:
    """Units that are no kinks."""
    return First(np.zeros((k, count)), np.zeros(count), np.zeros(count))


@dataclass(frozen=True)
class Units:
    """The errors e_j that a family of jets has in common, |e_j(d)| <= d'U_j d, U (k, k, m); with kinks, `first`, of
    which U knows nothing, at most `tilts` ||d|| more.

    They are sums of those of units: e_j = sum_q L_jq e_q, L (m, N), |e_q(d)| <= d'R_q d, R (k, k, N). A family that was
    made of another one by further errors, after its own, has it as `base`.
    """

    R: Array
    L: Array | None = None  # None if each unit's error is one of the common ones
    base: Units | None = None
    first: First | None = None

    @cached_property
    def tilts(self) -> Above:
        """Upper bounds of what kinks add to each of the common errors, over ||d||; ZERO without any."""
        if self.first is None:
            return ZERO
        return Above(self.first.rho) if self.L is None else Above(self.first.rho).through(self.L)

    @cached_property
    def U(self) -> Array:
        """Bounds of the errors as matrices."""
        if self.L is None:
            return self.R
        found: Square = mixed(Square(self.R), Near(np.abs(self.L.T)))
        return found.majorant

    @property
    def reach(self) -> Array:
        """L."""
        return np.eye(self.R.shape[2]) if self.L is None else self.L

    @property
    def count(self) -> int:
        """m."""
        return int(self.R.shape[2]) if self.L is None else len(self.L)

    def with_more(self, more: Units) -> Units:
        """The family with further errors, of units of their own."""
        if self.L is None or more.L is None:
            raise TypeError("the errors of each of these families must be sums")
        (m, N), (others, own) = self.L.shape, more.L.shape
        L = np.block([[self.L, np.zeros((m, own))], [np.zeros((others, N)), more.L]])
        first = None if self.first is None or more.first is None else self.first.beside(more.first)
        return Units(np.concatenate([self.R, more.R], 2), L, self, first)

    def is_made_of(self, other: Units) -> bool:
        """True if the other family is this one or one of its bases."""
        return self is other or (self.base is not None and self.base.is_made_of(other))


def aligned(x: Jet, y: Jet) -> tuple[Jet, Jet]:
    """Two jets in one family, the larger of the two."""
    if x.units is y.units:
        return x, y
    if x.units.is_made_of(y.units):
        return x, y.among(x.units)
    if y.units.is_made_of(x.units):
        return x.among(y.units), y
    raise ValueError("two jets must have errors in common")


@dataclass(frozen=True)
class Jet:
    """`c`, gradient `a` (k,), half the Hessian `Q` (k, k), a sixth of the third derivatives `K` as `triples` has them,
    remainder `E` (k, k), `B` (m,) of the errors of `units`, what y adds to c and a, `c_y` (N,) and `a_y`
    (k, N), and the Lipschitz constant `lip`; or a batch along one more axis, of all but the units."""

    c: Near
    a: Vector
    Q: Square
    K: Cubic
    E: Square
    B: Near
    units: Units
    c_y: Near
    a_y: Vector
    lip: Above

    def at(self, of: list[int]) -> Jet:
        """Some members of a batch, whose B means itself."""
        x, of_y = self, (Near(self.c_y.value[:, of]), Vector(self.a_y.value[:, :, of]))
        return Jet(x.c[of], x.a[of], x.Q[of], x.K[of], x.E[of], Near(x.B.value[:, of]), x.units, *of_y, x.lip[of])

    def among(self, units: Units) -> Jet:
        """The same among further errors, which it does not have."""
        more = np.zeros(units.count - len(self.B.value))
        error = self.B.error if self.B.error is ZERO else self.B.error.beside(Above(more))
        return replace(self, B=Near(np.concatenate([self.B.value, more]), error), units=units)

    @cached_property
    def sway(self) -> Above:
        """Upper bound of y's effect on v(0)."""
        return self.c_y.size.sum()

    @cached_property
    def tilt(self) -> Above:
        """Upper bound of the effect of y, and of kinks, on the gradient: what kinks add is one of some gradient at each
        d."""
        return self.a_y.size.sum() + self.by_kinks(self.B.size)

    def by_kinks(self, size: Above) -> Above:
        """Upper bound of what kinks add to sums of the common errors with magnitudes of this size, over ||d||."""
        if self.units.first is None:
            return ZERO
        return (size * self.units.tilts[(slice(None), *[None] * (np.ndim(self.B.value) - 1))]).sum()

    @cached_property
    def v0(self) -> Near:
        """v(0), whatever y is."""
        return self.c.wider(self.sway)

    @cached_property
    def gradient(self) -> Vector:
        """The gradient, whatever y is."""
        return self.a.wider(self.tilt)

    @property
    def range(self) -> Near:
        """v on the ball, whatever y is."""
        return self.v0.wider(self.radius)

    @property
    def error(self) -> Above:
        """Upper bound of |v(0) - c - sum_j y_j c_j|."""
        return self.c.error + self.c_y.error.sum()

    @property
    def slack(self) -> Above:
        """Upper bound of the gradient's distance from a + sum_j y_j a_j, and of what the stored B has of kinks."""
        return self.a.error + self.a_y.error.sum() + self.by_kinks(self.B.error)

    @cached_property
    def remainder(self) -> Array:
        """A matrix M with |v(d) - v(0) - a.d - d'Q d - K[d] - sum_j B_j e_j(d)| <= d'M d for the stored Q, K and B."""
        E = self.E
        if self.B.error is not ZERO:
            E = E + mixed(Square(self.units.U), Near(self.B.error.top + 0 * self.B.value))
        found: Array = E.wider(self.Q.error + self.K.error).majorant
        return found

    @property
    def lipschitz(self) -> Above:
        """A Lipschitz constant of what v has beyond v(0) + a.d + d'Q d + K[d] for the stored Q and K."""
        return self.lip + self.Q.error * 2 + self.K.error * 3

    @cached_property
    def bend(self) -> Above:
        """Upper bound of ||Q||_F."""
        return self.Q.size

    @cached_property
    def twist(self) -> Above:
        """Upper bound of ||K||_F."""
        return self.K.size

    @cached_property
    def shares(self) -> Square:
        """Bound of sum_j B_j e_j as a matrix."""
        found: Square = mixed(Square(self.units.U), Near(self.B.size.top))
        return found

    @cached_property
    def whole(self) -> Square:
        """Bound of sum_j B_j e_j + r as a matrix."""
        return self.E + self.shares

    @cached_property
    def curve(self) -> Above:
        """Upper bound of |v(d) - v(0) - a.d| / ||d||^2."""
        return self.bend + self.twist + self.whole.size

    @cached_property
    def radius(self) -> Above:
        """Upper bound of |v(d) - v(0)| / ||d|| on the unit ball."""
        return self.gradient.size + self.curve

    @cached_property
    def beyond(self) -> tuple[Above, Above, Above, Above]:
        """Upper bounds of what v has beyond v(0) + a.d, and of a Lipschitz constant of that; and the same of what v has
        beyond v(0) + a.d + d'Q d."""
        bend, twist = self.bend, self.twist
        return bend + twist + self.lip, bend * 2 + twist * 3 + self.lip, twist + self.lip, twist * 3 + self.lip

    def __add__(self, other: Jet) -> Jet:
        x, y = aligned(self, other)
        Q, K, E, B = x.Q + y.Q, x.K + y.K, x.E + y.E, x.B + y.B
        return Jet(x.c + y.c, x.a + y.a, Q, K, E, B, x.units, x.c_y + y.c_y, x.a_y + y.a_y, x.lip + y.lip)

    def __neg__(self) -> Jet:
        x = self
        return Jet(-x.c, -x.a, -x.Q, -x.K, x.E, -x.B, x.units, -x.c_y, -x.a_y, x.lip)

    def __mul__(self, other: Jet) -> Jet:
        x, y = aligned(self, other)
        c = x.c * y.c
        a, a_y = x.a * y.c + y.a * x.c, x.a_y * y.c + y.a_y * x.c
        if x.c_y.value.size:  # second order in y is lost
            c, a = c.wider(x.sway * y.sway), a.wider(x.sway * y.tilt + y.sway * x.tilt)
            a_y = a_y + _each(x.c_y, y.a) + _each(y.c_y, x.a)
        (s, t), (zx, lx, _, tx), (zy, ly, _, ty) = (x.gradient.size, y.gradient.size), x.beyond, y.beyond
        # All products of what v and w have beyond v(0) and w(0), but those that are in Q and K: of gradient, Q, K and
        # the rest (`whole`), `known` has those without a rest. The others are a rest of w times anything of v, and one
        # of v times what w has without a rest.
        known = s * y.twist + t * x.twist + (x.bend + x.twist) * (y.bend + y.twist)
        E = times(y.E, x.v0.size) + times(x.E, y.v0.size)
        E = (E + times(y.whole, x.radius) + times(x.whole, t + y.bend + y.twist)).wider(known)
        lip = x.v0.size * y.lip + y.v0.size * x.lip + zx * ly + zy * lx
        lip = lip + s * (ty + y.beyond[2]) + t * (tx + x.beyond[2])
        return Jet(
            c,
            a,
            y.Q * x.v0 + x.Q * y.v0 + outer(x.gradient, y.gradient),
            y.K * x.v0 + x.K * y.v0 + symmetric(x.gradient, y.Q) + symmetric(y.gradient, x.Q),
            E,
            y.B * x.v0 + x.B * y.v0,
            x.units,
            x.c_y * y.c + y.c_y * x.c,
            a_y,
            lip,
        )

    def function(self, name: str) -> Jet:
        """phi(v) for a function phi of the table."""
        phi = FUNCTIONS[name].expansion(self.v0, self.radius)
        f0, f1, _, _ = phi.f
        H, C, R = self.beyond_tangent(phi)
        c, a, c_y, a_y = f0, self.a * f1, self.c_y * f1, self.a_y * f1
        if self.c_y.value.size:
            c, a, c_y, a_y = self._by_y(name)
        E = times(self.E, f1.size) + R
        lip = f1.size * self.lip + self.lip_beyond_tangent(phi)
        return Jet(c, a, self.Q * f1 + H, self.K * f1 + C, E, self.B * f1, self.units, c_y, a_y, lip)

    def beyond_tangent(self, phi: Expansion) -> tuple[Square, Cubic, Square]:
        """(H, C, R): phi(v) less its tangent at v(0) is d'H d + C[d] within d'R d.

        With half = phi''/2 and sixth = phi'''/6 it is half D^2 + sixth D^3 within fourth D^4, D = v - v(0) = a.d + z,
        |D| <= radius ||d||, |z| <= d'W d <= curve ||d||^2, W = (bend + twist) I + whole.
        """
        _, _, half, sixth = phi.f
        a, s, curve = self.gradient, self.gradient.size, self.curve
        quartic, straight = phi.fourth * (self.radius * self.radius), half.size * s * 2  # 2 half (a.d) (z - d'Q d)
        square = (
            half.size * curve + sixth.size * (s * s * 3 + s * curve * 3 + curve * curve) + quartic * (s * 2 + curve)
        )
        aa = outer(a, a)
        C = symmetric(a, self.Q) * (half * 2) + symmetric(a, aa) * sixth
        plain = straight * self.twist + square * (self.bend + self.twist)
        R = times(self.whole, straight + square) + times(aa, quartic)
        return aa * half, C, R.wider(plain)

    def lip_beyond_tangent(self, phi: Expansion) -> Above:
        """A Lipschitz constant of what phi(v) has beyond its tangent at v(0) and d'H d + C[d] of `beyond_tangent`: of
        half (D^2 - (a.d)^2 - 2 (a.d) d'Q d), sixth (D^3 - (a.d)^3), and what four terms of phi's series leave."""
        (z, L, w, M), s = self.beyond, self.gradient.size
        _, _, half, sixth = phi.f
        squares = half.size * 2 * (s * (w + M) + z * L)
        cubes = sixth.size * 3 * (s * s * (L + z * 2) + s * z * (L * 2 + z) + z * z * L)
        found: Above = squares + cubes + phi.last * (self.radius * self.radius * self.radius) * (s + L)
        return found

    def _by_y(self, name: str) -> tuple[Near, Vector, Near, Vector]:
        """c, a, c_y and a_y of phi(v).

        With delta = v(0) - c, phi(v(0)) is phi(c) + phi'(c) delta within sup|phi''|/2 delta^2, and phi'(v(0)) is
        phi'(c) + phi''(c) delta within sup|phi'''|/2 delta^2, the suprema over all that v(0) may be.
        """
        f0, f1, half, _ = FUNCTIONS[name].expansion(Near(self.c.value), ZERO).f
        _, _, bent, twisted = (f.size for f in FUNCTIONS[name].expansion(self.v0, ZERO).f)
        off, twice = self.v0.error, half * 2
        c = f0.wider(f1.size * self.c.error + bent * (off * off))
        moved = f1.wider(twice.size * self.c.error + twisted * (off * off) * 3)  # phi' at y = 0
        by_y = twice.size * self.sway
        a = (self.a * moved).wider(by_y * (self.a.error + self.tilt))
        return c, a, self.c_y * f1, self.a_y * moved + _each(self.c_y * twice, self.a)


def _each(y: Near, a: Vector) -> Vector:
    """The vectors y_j a, (k, N, ...), of numbers y (N, ...) and vectors a (k, ...)."""
    return Vector(a.value[:, None], a.error[None]) * y


def constant(q: Fraction, units: Units, count: int) -> Jet:
    """A rational among the jets with these errors and `count` numbers y."""
    k, m = len(units.R), units.count
    Q, K = np.zeros((k, k)), np.zeros(len(triples(k)[0]))
    nothing = Vector(np.zeros(k)), Square(Q), Cubic(K), Square(Q), Near(np.zeros(m))
    return Jet(near(q), *nothing, units, Near(np.zeros(count)), Vector(np.zeros((k, count))), ZERO)


def uncertain(lo: Fraction, hi: Fraction, units: Units, number: int, count: int) -> Jet:
    """A number of [lo, hi], lo + hi + (hi - lo) y over 2, y being the one of this number of `count`."""
    reach, here = near((hi - lo) / 2), np.arange(count) == number
    c_y = Near(np.where(here, reach.value, 0.0), reach.error * np.where(here, 1.0, 0.0))
    return replace(constant((lo + hi) / 2, units, count), c_y=c_y)


def between(lo: Fraction, hi: Fraction, units: Units, count: int) -> Jet:
    """A number of [lo, hi] of which nothing else is known, maybe another one wherever it is used."""
    middle = constant((lo + hi) / 2, units, count)
    return replace(middle, c=middle.c.wider(near((hi - lo) / 2).size))
