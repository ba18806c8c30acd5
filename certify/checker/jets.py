"""Third-order models on the unit ball, in which the local rule evaluates the plant and the policy.

A jet of v over d in R^k says, for *all* ||d|| <= 1: `v(d) = v(0) + a.d + d'Q d + K[d] + sum_j B_j e_j(d) + r(d)` with
|r(d)| <= d'E d, K[d] being the sum of all K_hij d_h d_i d_j. It holds on every smaller ball too. The errors e_j are the
same in all jets of one family, so that they cancel as they do in truth: |e_j(d)| <= d'U_j d. With numbers y_j in
[-1, 1] that are uncertain v(0) lies within `error` of c + sum_j y_j c_j, and the true gradient within `slack` of a +
sum_j y_j a_j in the 2-norm; Q, K and B are the numbers that are stored, and whatever they leave out lies in E. All of
this is meant for each d by itself: nothing asks how v(0) and the gradient at two d belong together. But `lip`, a
Lipschitz constant of what v has beyond v(0) + a.d + d'Q d + K[d], is meant where v(0) and the gradient are the same for
all d. E and U_j dominate sums of positive semidefinite matrices with weights >= 0, so each is one, and knows the
directions in which v is far from what is known of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, cached_property
from itertools import combinations_with_replacement, permutations
from typing import Any

import numpy as np

from .elementary import Expansion, elementary
from .float64 import EPS, Array, float_with_error, frobenius, gamma, norm, total, up

_UNDERFLOW = 2.0**-1000  # more than a few products of two numbers lose where they underflow


def widen(E: Any, extra: Any, relative: float = EPS) -> Any:
    """E (..., k, k) enlarged by its own rounding errors, at most `relative` a term, and by `extra` ||d||^2.

    E sums semidefinite matrices with weights >= 0. The Frobenius norm of each is at most its trace, so the 2-norm of
    all rounding errors is at most `relative` times the trace of the sum.
    """
    trace = total(np.diagonal(E, axis1=-2, axis2=-1), -1)
    return E + each(up(2 * relative * trace + extra)) * np.eye(E.shape[-1])


def each(x: Any) -> Any:
    """Numbers (...,) as factors of matrices (..., k, k)."""
    return np.asarray(x)[..., None, None]


def outer(a: Any, b: Any) -> Any:
    return a[..., :, None] * b[..., None, :]


@cache
def triples(k: int) -> tuple[Array, Array, Array, Array]:
    """h <= i <= j, in the order in which the entries of a symmetric tensor K are stored, and how often each stands in
    the whole tensor."""
    kept = list(combinations_with_replacement(range(k), 3))
    often = [float(len(set(permutations(triple)))) for triple in kept]
    h, i, j = np.array(kept).T
    return h, i, j, np.array(often)


def symmetric(a: Any, Q: Any) -> Any:
    """The symmetric part of a_h Q_ij, Q symmetric; its Frobenius norm is at most ||a|| ||Q||_F."""
    h, i, j, _ = triples(a.shape[-1])
    return (a[..., h] * Q[..., i, j] + a[..., i] * Q[..., h, j] + a[..., j] * Q[..., h, i]) / 3


def tensor_norm(K: Any, k: int) -> Any:
    """An upper bound of ||K||_F of what is stored."""
    return up(np.sqrt(total(triples(k)[-1] * (K * K), -1)))


def unpacked(K: Array, k: int) -> Array:
    """The whole tensors (..., k, k, k) of what is stored (..., k (k + 1) (k + 2) / 6)."""
    place, (h, i, j, _) = np.zeros((k, k, k), dtype=np.intp), triples(k)
    for p, q, r in permutations((h, i, j)):
        place[p, q, r] = np.arange(len(h))
    return K[..., place]


@dataclass(frozen=True)
class Jet:
    """`c` +- `error`, gradient `a` (k,) +- `slack`, half the Hessian `Q` (k, k), a sixth of the third derivatives `K`
    as `triples` has them, remainder `E` (k, k), `B` (m,) of the errors within `U` (m, k, k), what y adds to c and a,
    `c_y` (N,) and `a_y` (N, k), and the Lipschitz constant `lip`; or a batch, of all but U."""

    c: Any
    error: Any
    a: Any
    slack: Any
    Q: Any
    K: Any
    E: Any
    B: Any
    U: Any
    c_y: Any
    a_y: Any
    lip: Any

    @property
    def members(self) -> list[Jet]:
        """The jets of a batch."""
        names = ("c", "error", "a", "slack", "Q", "K", "E", "B", "c_y", "a_y", "lip")
        return [replace(self, **{name: getattr(self, name)[i] for name in names}) for i in range(len(self.c))]

    @cached_property
    def sway(self) -> Any:
        """Upper bound of y's effect on v(0)."""
        return total(np.abs(self.c_y), -1)

    @cached_property
    def tilt(self) -> Any:
        """Upper bound of y's effect on the gradient."""
        return total(norm(self.a_y, -1), -1)

    @cached_property
    def doubt(self) -> Any:
        """Upper bound of |v(0) - c|."""
        return up(self.error + self.sway)

    @cached_property
    def turn(self) -> Any:
        """Upper bound of the gradient's distance from a."""
        return up(self.slack + self.tilt)

    @cached_property
    def size(self) -> Any:
        """Upper bound of |v(0)|."""
        return up(abs(self.c) + self.doubt)

    @cached_property
    def slope(self) -> Any:
        """Upper bound of the gradient's 2-norm."""
        return up(norm(self.a, -1) + self.turn)

    @cached_property
    def bend(self) -> Any:
        """Upper bound of ||Q||_F."""
        return frobenius(self.Q)

    @cached_property
    def twist(self) -> Any:
        """Upper bound of ||K||_F."""
        return tensor_norm(self.K, self.a.shape[-1])

    @cached_property
    def shares(self) -> Any:
        """Bound of sum_j B_j e_j as a matrix."""
        return widen(np.tensordot(np.abs(self.B), self.U, 1), 0.0, gamma(len(self.U)) + EPS)

    @cached_property
    def whole(self) -> Any:
        """Bound of sum_j B_j e_j + r as a matrix."""
        return widen(self.E + self.shares, 0.0)

    @cached_property
    def spread(self) -> Any:
        """Upper bound of what Q, K and B come to together."""
        return up(self.bend + self.twist + frobenius(self.shares))

    @cached_property
    def faint(self) -> Any:
        """Upper bound of the underflow in products of B."""
        return up(_UNDERFLOW * total(frobenius(self.U), -1))

    @cached_property
    def curve(self) -> Any:
        """Upper bound of |v(d) - v(0) - a.d| / ||d||^2, a being the true gradient."""
        return up(self.bend + self.twist + frobenius(self.whole))

    @cached_property
    def radius(self) -> Any:
        """Upper bound of |v(d) - v(0)| / ||d|| on the unit ball."""
        return up(self.slope + self.curve)

    def __add__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c + y.c
        error = up(x.error + y.error + EPS * (abs(c) + x.sway + y.sway))
        slack = up(x.slack + y.slack + EPS * (x.slope + y.slope))
        E = widen(x.E + y.E, EPS * (x.spread + y.spread))
        of_y, lip = (x.c_y + y.c_y, x.a_y + y.a_y), up(x.lip + y.lip + 3 * EPS * (x.spread + y.spread))
        return Jet(c, error, x.a + y.a, slack, x.Q + y.Q, x.K + y.K, E, x.B + y.B, x.U, *of_y, lip)

    def __neg__(self) -> Jet:
        x = self
        return Jet(-x.c, x.error, -x.a, x.slack, -x.Q, -x.K, x.E, -x.B, x.U, -x.c_y, -x.a_y, x.lip)

    def __mul__(self, other: Jet) -> Jet:
        x, y = self, other
        c = x.c * y.c
        error = x.size * y.error + y.size * x.error + x.sway * y.sway  # the last is of second order in y
        error = up(error + EPS * (abs(c) + x.size * y.sway + y.size * x.sway))
        slack = x.size * y.slack + x.error * y.slope + y.size * x.slack + y.error * x.slope
        slack = up(slack + x.sway * y.tilt + y.sway * x.tilt + EPS * (x.size * y.slope + y.size * x.slope))
        c_y = x.c * y.c_y + y.c * x.c_y
        a_y = x.c * y.a_y + y.c * x.a_y + outer(x.c_y, y.a) + outer(y.c_y, x.a)
        ab = outer(x.a, y.a)
        Q = x.c * y.Q + y.c * x.Q + (ab + ab.T) / 2
        K = x.c * y.K + y.c * x.K + symmetric(x.a, y.Q) + symmetric(y.a, x.Q)
        # all products of what v and w have beyond v(0) and w(0), but those that are in Q and K
        known = x.slope * y.twist + y.slope * x.twist + up(x.bend + x.twist) * up(y.bend + y.twist)
        E = each(x.size) * y.E + each(y.size) * x.E
        E = E + each(x.radius) * y.whole + each(up(y.slope + y.bend + y.twist)) * x.whole
        sx, sy = up(x.slope + x.bend), up(y.slope + y.bend)
        wrong = x.doubt * y.spread + y.doubt * x.spread + x.turn * sy + y.turn * sx
        wrong = wrong + EPS * (x.size * y.spread + y.size * x.spread + x.slope * sy + y.slope * sx) + x.faint
        B, E = x.c * y.B + y.c * x.B, widen(E, known + wrong)
        (zx, lx), (zy, ly) = x.second, y.second
        lip = x.size * y.lip + y.size * x.lip + x.slope * sum(y.third) + y.slope * sum(x.third) + zx * ly + zy * lx
        return Jet(c, error, x.c * y.a + y.c * x.a, slack, Q, K, E, B, x.U, c_y, a_y, up(lip + 3 * wrong))

    @cached_property
    def second(self) -> tuple[Any, Any]:
        """Upper bounds of what v has beyond v(0) + a.d, and of a Lipschitz constant of that."""
        return up(self.bend + self.twist + self.lip), up(2 * self.bend + 3 * self.twist + self.lip)

    @cached_property
    def third(self) -> tuple[Any, Any]:
        """The same for v less v(0) + a.d + d'Q d."""
        return up(self.twist + self.lip), up(3 * self.twist + self.lip)

    def lip_beyond_tangent(self, phi: Expansion) -> Any:
        """A Lipschitz constant of what phi(v) has beyond its tangent at v(0) and d'H d + C[d] of `beyond_tangent`: of
        half (D^2 - (a.d)^2 - 2 (a.d) d'Q d), sixth (D^3 - (a.d)^3), and what four terms of phi's series leave."""
        (_, _, half, sixth), (_, _, half_error, sixth_error) = phi.f, phi.e
        (z, L), s = self.second, self.slope
        h, g = up(np.abs(half) + half_error), up(np.abs(sixth) + sixth_error)
        squares = 2 * h * up(s * up(self.third[0] + self.third[1]) + z * L)
        cubes = 3 * g * up(s * s * up(L + 2 * z) + s * z * up(2 * L + z) + z * z * L)
        rest = phi.last * up(self.radius * up(self.radius * self.radius)) * up(s + L)
        return up(squares + cubes + rest + 3 * self.mistaken(phi))

    def mistaken(self, phi: Expansion) -> Any:
        """Upper bound of what H and C of `beyond_tangent` come to that is not in the truth, each at its most."""
        (_, _, half, sixth), (_, _, half_error, sixth_error) = phi.f, phi.e
        s, ss = self.slope, up(self.slope * self.slope)
        h, g = up(np.abs(half) + half_error), up(np.abs(sixth) + sixth_error)
        quartic = up(phi.fourth * up(self.radius * self.radius))
        wrong = up(half_error + EPS * h) * up(ss + 2 * up(s * self.bend)) + up(sixth_error + EPS * g) * up(s * ss)
        return wrong + up(2 * up(up(h + quartic) * s) + 2 * up(h * self.bend) + 3 * up(g * ss)) * self.turn

    def beyond_tangent(self, phi: Expansion) -> tuple[Any, Any, Any]:
        """(H, C, R): phi(v) less its tangent at v(0) is d'H d + C[d] within d'R d.

        With half = phi''/2 and sixth = phi'''/6 it is half D^2 + sixth D^3 within fourth D^4, D = v - v(0) = a.d + z,
        |D| <= radius ||d||, |z| <= d'W d <= curve ||d||^2, W = (bend + twist) I + whole, a being the true gradient.
        R covers the roundings of a sum of H or C and something else, too, as far as they are H's or C's.
        """
        (_, _, half, sixth), (_, _, half_error, sixth_error) = phi.f, phi.e
        a, s = self.a, self.slope
        h, g = up(np.abs(half) + half_error), up(np.abs(sixth) + sixth_error)
        quartic, ss = up(phi.fourth * up(self.radius * self.radius)), up(s * s)
        straight = up(2 * h * s)  # 2 half (a.d) (z - d'Q d)
        cubes = up(3 * ss + 3 * up(s * self.curve) + up(self.curve * self.curve))
        square = up(h * self.curve + g * cubes + quartic * up(2 * s + self.curve))
        aa, aQ = outer(a, a), symmetric(a, self.Q)
        H, C = each(half) * aa, np.asarray(2 * half)[..., None] * aQ + np.asarray(sixth)[..., None] * symmetric(a, aa)
        plain = straight * self.twist + square * up(self.bend + self.twist)
        return H, C, widen(each(up(straight + square)) * self.whole + each(quartic) * aa, plain + self.mistaken(phi))

    def function(self, name: str) -> Jet:
        """phi(v) for a function phi that elementary.py knows."""
        phi = elementary(name, self.c, self.doubt, self.radius)
        (f0, f1, _, _), (e0, e1, _, _) = phi.f, phi.e
        H, C, R = self.beyond_tangent(phi)
        steepest, column = up(np.abs(f1) + e1), np.asarray(f1)[..., None]
        slack = up(e1 * self.slope + steepest * self.slack + EPS * (steepest * self.slope))
        c_y, a_y = column * self.c_y, each(f1) * self.a_y
        if self.c_y.size:
            e0, slack, a_y = self._by_y(name, phi, a_y)
        wrong = up(e1 + EPS * steepest) * self.spread + self.faint
        Q, K, E = each(f1) * self.Q + H, column * self.K + C, widen(each(steepest) * self.E + R, wrong)
        lip = steepest * self.lip + self.lip_beyond_tangent(phi) + 3 * wrong
        return Jet(f0, e0, column * self.a, slack, Q, K, E, column * self.B, self.U, c_y, a_y, up(lip))

    def _by_y(self, name: str, phi: Expansion, plain: Any) -> tuple[Any, Any, Any]:
        """`error`, `slack` and `a_y` of phi(v); `plain` is phi'(c) a_y.

        With delta = v(0) - c, phi(v(0)) is phi(c) + phi'(c) delta within sup|phi''|/2 delta^2, and phi'(v(0)) is
        phi'(c) + phi''(c) delta within sup|phi'''|/2 delta^2, the suprema over all that v(0) may be.
        """
        here = elementary(name, self.c, 0.0, 0.0)
        (_, f1, half, _), (e0, e1, e2, _) = here.f, here.e
        bent, twisted = (up(np.abs(f) + e) for f, e in zip(phi.f[2:], phi.e[2:], strict=True))
        off, slope = self.doubt, up(np.abs(f1) + e1)
        error = up(e0 + e1 * off + slope * self.error + bent * up(off * off) + EPS * (slope * self.sway))
        moved = up(e1 + 2 * bent * self.error + 2 * e2 * off + 3 * twisted * up(off * off))  # phi' less its part in y
        by_y = 2 * up(np.abs(half) * self.sway)
        slack = moved * self.slope + up(slope + by_y) * self.slack + by_y * self.tilt
        slack = up(slack + EPS * (up(slope + by_y) * self.slope))
        return error, slack, plain + outer(2 * np.asarray(half)[..., None] * self.c_y, self.a)


def uncertain(lo: Fraction, hi: Fraction, U: Array, number: int, count: int) -> Jet:
    """A number of [lo, hi], lo + hi + (hi - lo) y over 2, y being the one of this number of `count`."""
    middle, (reach, error) = constant((lo + hi) / 2, U, count), float_with_error((hi - lo) / 2)
    c_y = np.where(np.arange(count) == number, reach, 0.0)
    return replace(middle, error=up(middle.error + error), c_y=c_y)


def between(lo: Fraction, hi: Fraction, U: Array, count: int) -> Jet:
    """A number of [lo, hi] of which nothing else is known, maybe another one wherever it is used."""
    middle, (reach, error) = constant((lo + hi) / 2, U, count), float_with_error((hi - lo) / 2)
    return replace(middle, error=up(middle.error + reach + error))


def constant(q: Fraction, U: Array, count: int) -> Jet:
    """A rational among the jets with these errors and `count` numbers y."""
    value, error = float_with_error(q)
    m, k, _ = U.shape
    nothing, thirds = np.zeros((k, k)), np.zeros(len(triples(k)[0]))
    of_y = np.zeros(count), np.zeros((count, k))
    return Jet(np.float64(value), error, np.zeros(k), 0.0, nothing, thirds, nothing, np.zeros(m), U, *of_y, 0.0)
