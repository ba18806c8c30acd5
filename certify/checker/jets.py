"""Third-order models on the unit ball, in which the local rule evaluates the plant and the policy.

A jet of v over d in R^k says, for *all* ||d|| <= 1: `v(d) = v(0) + a.d + d'Q d + K[d] + sum_j B_j e_j(d) + r(d)` with
|r(d)| <= d'E d, K[d] being the sum of all K_hij d_h d_i d_j. It holds on every smaller ball too. The errors e_j are the
same in all jets of one family, so that they cancel as they do in truth: |e_j(d)| <= d'U_j d. v(0), a, Q, K, B and E are
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
from .near import ZERO, Above, Array, Cubic, Near, Square, Vector, lower, mixed, near, norm, outer, symmetric, triples


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
class Units:
    """The errors e_j that a family of jets has in common, |e_j(d)| <= d'U_j d, U (k, k, m).

    They are sums of those of units: e_j = sum_q L_jq e_q, L (m, N), |e_q(d)| <= d'R_q d, R (k, k, N). A family that was
    made of another one by further errors has it as `base`.
    """

    R: Array
    L: Array | None = None  # None if each unit's error is one of the common ones
    base: Units | None = None

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

    @property
    def norms(self) -> list[Above]:
        """Upper bounds, infinite or NaN where anything here is."""
        return [norm(self.reach, (0, 1)), norm(self.R, (0, 1, 2))]

    def beside(self, more: Units, L: Array) -> Units:
        """Errors that are sums, by L, over these units and others."""
        return Units(np.concatenate([self.R, more.R], 2), L, self)

    def tilt(self, size: Above) -> Above:
        """Upper bound, over ||d||, of what the errors add to the gradient in sums with magnitudes of this size: nothing
        unless some are of first order (kinks.py)."""
        return ZERO


def aligned(x: Jet, y: Jet) -> tuple[Jet, Jet]:
    """Two jets in one family, the larger of the two."""
    if x.units is y.units:
        return x, y
    from .calls import in_one_family

    return in_one_family(x, y)


@dataclass(frozen=True)
class Jet:
    """`c`, gradient `a` (k,), half the Hessian `Q` (k, k), a sixth of the third derivatives `K` as `triples` has them,
    remainder `E` (k, k), `B` (m,) of the errors of `units`, and the Lipschitz constant `lip`; or a batch along one more
    axis, of all but the units."""

    c: Near
    a: Vector
    Q: Square
    K: Cubic
    E: Square
    B: Near
    units: Units
    lip: Above

    @property
    def v0(self) -> Near:
        """v(0)."""
        return self.c

    @cached_property
    def gradient(self) -> Vector:
        """The gradient."""
        return self.a.wider(self.units.tilt(self.B.size))

    @property
    def range(self) -> Near:
        """v on the ball."""
        return self.v0.wider(self.radius)

    @property
    def error(self) -> Above:
        """Upper bound of the distance of v(0) from what is stored of it."""
        return self.c.error

    @property
    def slack(self) -> Above:
        """Upper bound of the gradient's distance from what is stored of it and of B."""
        return self.a.error + self.units.tilt(self.B.error)

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
        return Jet(x.c + y.c, x.a + y.a, Q, K, E, B, x.units, x.lip + y.lip)

    def __neg__(self) -> Jet:
        x = self
        return Jet(-x.c, -x.a, -x.Q, -x.K, x.E, -x.B, x.units, x.lip)

    def __mul__(self, other: Jet) -> Jet:
        x, y = aligned(self, other)
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
            x.c * y.c,
            x.a * y.c + y.a * x.c,
            y.Q * x.v0 + x.Q * y.v0 + outer(x.gradient, y.gradient),
            y.K * x.v0 + x.K * y.v0 + symmetric(x.gradient, y.Q) + symmetric(y.gradient, x.Q),
            E,
            y.B * x.v0 + x.B * y.v0,
            x.units,
            lip,
        )

    def function(self, name: str) -> Jet:
        """phi(v) for a function phi of the table."""
        if name == "abs" and self.may_vanish:
            return self.magnitude()
        phi = FUNCTIONS[name].expansion(self.v0, self.radius)
        f0, f1, _, _ = phi.f
        H, C, R = self.beyond_tangent(phi)
        E = times(self.E, f1.size) + R
        lip = f1.size * self.lip + self.lip_beyond_tangent(phi)
        return Jet(f0, self.a * f1, self.Q * f1 + H, self.K * f1 + C, E, self.B * f1, self.units, lip)

    @property
    def may_vanish(self) -> bool:
        """True if v(0) may be 0."""
        return not np.all(lower(self.v0) > 0)

    def magnitude(self) -> Jet:
        """|v| where v(0) may be 0, to first order: it is within radius ||d|| of |v(0)|, as if it had some gradient of
        that length at each d, and as steep as v."""
        c, nothing = self.c, constant(Fraction(0), self.units)
        a = nothing.a.wider(self.radius)
        return replace(nothing, c=Near(np.abs(c.value), c.error), a=a, lip=self.gradient.size + self.beyond[1])

    def beyond_tangent(self, phi: Expansion) -> tuple[Square, Cubic, Square]:
        """(H, C, R): phi(v) less its tangent at v(0) is d'H d + C[d] within d'R d.

        With half = phi''/2 and sixth = phi'''/6 it is half D^2 + sixth D^3 within fourth D^4, D = v - v(0) = a.d + z,
        |D| <= radius ||d||, |z| <= d'W d <= curve ||d||^2, W = (bend + twist) I + whole.
        """
        _, _, half, sixth = phi.f
        a, s, curve = self.gradient, self.gradient.size, self.curve
        quartic, straight = phi.fourth * (self.radius * self.radius), half.size * s * 2  # 2 half (a.d) (z - d'Q d)
        along = quartic + sixth.size * curve * 3  # of (a.d)^2
        square = half.size * curve + sixth.size * (s * curve * 3 + curve * curve) + quartic * (s * 2 + curve)
        aa = outer(a, a)
        C = symmetric(a, self.Q) * (half * 2) + symmetric(a, aa) * sixth
        plain = straight * self.twist + square * (self.bend + self.twist)
        R = times(self.whole, straight + square) + times(aa, along)
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


def constant(q: Fraction, units: Units) -> Jet:
    """A rational among the jets with these errors."""
    k = len(units.R)
    Q, K = np.zeros((k, k)), np.zeros(len(triples(k)[0]))
    return Jet(near(q), Vector(np.zeros(k)), Square(Q), Cubic(K), Square(Q), Near(np.zeros(units.count)), units, ZERO)
