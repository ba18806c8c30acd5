"""Rows of the table of functions that only some certificates need: those that bend at 0, and activations."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import arb, arb_series

from .elementary import Polynomials, exp, halfway, inverse
from .functions import FUNCTIONS, ONE, THIRD, UNIT, Derivative, Expansion, Four, FourBounds, Function, Lines, Three
from .near import ZERO, Above, Array, Near, lines_around_tanh, lower

_NONE = Near(np.float64(0))


class _Sigmoid(Function):
    """1/(1 + exp(-v)), which is (1 + tanh(v/2))/2: all is known of tanh."""

    name, at_0 = "sigmoid", Fraction(1, 2)

    def lines(self, centre: Array, radius: Above) -> Lines:
        s, m, gap = lines_around_tanh(0.5 * centre, radius * 0.5)
        shift = Near(m) * 0.5 + Near(np.float64(0.5))
        return 0.25 * s, shift.value, gap * 0.5 + shift.error

    def at(self, c: Near) -> Three:
        t, slope, bend = FUNCTIONS["tanh"].at(c * 0.5)
        return t * 0.5 + Near(np.float64(0.5)), slope * 0.25, bend * 0.125

    def sixth(self, c: Near, f: Three) -> Near:
        half = c * 0.5
        return FUNCTIONS["tanh"].sixth(half, FUNCTIONS["tanh"].at(half)) * 0.0625

    def slopes(self, v0: Near) -> FourBounds:
        a, b, c, d = FUNCTIONS["tanh"].slopes(v0)
        return a * 0.25, b * 0.125, c * 0.0625, d * 0.03125

    def third(self, e: Expansion) -> Above:
        return self._of_tanh(e).third * 0.0625

    def fourth(self, e: Expansion) -> Above:
        return self._of_tanh(e).fourth * 0.03125

    def _of_tanh(self, e: Expansion) -> Expansion:
        return Expansion(FUNCTIONS["tanh"], e.v0 * 0.5, e.radius * 0.5)


class _Tabulated(Function):
    """A smooth function from Arb's formula of it, by polynomials. Each is 0 at 0, or has no rational value there."""

    def __init__(self, name: str, formula: Callable[[arb_series], arb_series], at_0: Fraction | None) -> None:
        self.name, self.formula, self.at_0 = name, formula, at_0

    @cached_property
    def polynomials(self) -> Polynomials:
        return Polynomials(self.formula)

    def lines(self, centre: Array, radius: Above) -> Lines:
        return _lines_by_parts(lambda y: (self._at(y, 0), self._at(y, 1)), self._sup(2), centre, radius)

    def at(self, c: Near) -> Three:
        return self._near(c, 0), self._near(c, 1), self._near(c, 2)

    def sixth(self, c: Near, f: Three) -> Near:
        return self._near(c, 3)

    def slopes(self, v0: Near) -> FourBounds:
        return self._sup(1), self._sup(2) * 2, self._sup(3) * 3, self._sup(4) * 4

    def third(self, e: Expansion) -> Above:
        return self._around(e, 3)

    def fourth(self, e: Expansion) -> Above:
        return self._around(e, 4)

    def _at(self, y: Array, j: int) -> Near:
        return self.polynomials.at(y, j)

    def _sup(self, j: int) -> Above:
        return self.polynomials.sup[j]

    def _near(self, c: Near, j: int) -> Near:
        """phi^(j)/j! at numbers near others: it changes by (j + 1) times the next."""
        return self._at(c.value, j).wider(c.error * self._sup(j + 1) * float(j + 1))

    def _around(self, e: Expansion, j: int) -> Above:
        """The largest |phi^(j)/j!| at all that v may be."""
        return self._near(e.v, j).size.least(self._sup(j) + 0 * e.radius.v)


class _Sign(Function):
    """1 or -1, of numbers that are certainly not 0; equations do not have it."""

    name, partial = "sign", True

    def at(self, c: Near) -> Three:
        sign, none = np.where(c.value < 0, -1.0, 1.0), np.zeros_like(c.value)
        return Near(sign), Near(none), Near(none)

    def sixth(self, c: Near, f: Three) -> Near:
        return f[2]

    def slopes(self, v0: Near) -> FourBounds:
        none = _no_more(v0)
        return none, none, none, none

    def third(self, e: Expansion) -> Above:
        return _no_more(e.v)

    def fourth(self, e: Expansion) -> Above:
        return _no_more(e.v)


class _Bent(Function):
    """A function that is smooth but at 0: it has derivatives where the sign of v is certain."""

    half: Above  # bounds |phi''|/2, and |phi'(v) - phi'(w)| / (2 |v - w|) across 0

    def bend(self, v0: Near) -> Above:
        """phi(v) is within this times (v - v0)^2 of the tangent at v0, for all v, as |phi'(v) - phi'(v0)| is at most
        2 half |v - v0|; NaN where there may be no tangent."""
        return self.half + Above(0 * v0.value)

    def leap(self, v0: Near) -> Above:
        """phi'(v) is within this times |v - v0|^3 of phi'(v0), for all v."""
        return Above(np.nan + 0 * v0.value)

    def expansion(self, v0: Near, radius: Above) -> Expansion:
        return _Corner(self, v0, radius)

    def lines(self, centre: Array, radius: Above) -> Lines:
        return _lines_by_parts(lambda y: self.at(Near(y))[:2], self.half, centre, radius)


class _Kink(_Bent):
    """Two half lines that meet at 0, of slopes -1, 0 or 1: |v|, and relu."""

    def __init__(self, name: str, left: int, right: int) -> None:
        self.name, self.left, self.right = name, left, right

    def value(self, y: Array) -> Array:
        """Exactly."""
        return np.where(y < 0, self.left * y, self.right * y)

    def exact(self, q: Fraction) -> Fraction | None:
        return (self.left if q < 0 else self.right) * q

    def at(self, c: Near) -> Three:
        slope, none = np.where(c.value < 0, float(self.left), float(self.right)), np.zeros_like(c.value)
        return Near(self.value(c.value)), Near(slope), Near(none)

    def sixth(self, c: Near, f: Three) -> Near:
        return f[2]

    def slopes(self, v0: Near) -> FourBounds:
        none = _no_more(v0)
        return UNIT, none, none, none

    def third(self, e: Expansion) -> Above:
        return ZERO

    def fourth(self, e: Expansion) -> Above:
        return _no_more(e.v)

    def bend(self, v0: Near) -> Above:
        """Beyond 0 the tangent is off by t = (right - left)(|v - v0| - |v0|), and x - y <= x^2 / (4 y)."""
        return Above(0.25 * (self.right - self.left)).over(lower(v0))

    def leap(self, v0: Near) -> Above:
        """Beyond 0 |v - v0| is at least |v0|."""
        p = UNIT.over(lower(v0))
        return p * p * p * float(self.right - self.left)

    def lines(self, centre: Array, radius: Above) -> Lines:
        """Lines of slopes near the chord's; phi(v) - s v is linear to both sides of 0, so extreme at ends or at 0."""
        lo, hi = Near(centre, radius).ends
        s = np.clip((self.value(hi) - self.value(lo)) / (hi - lo), self.left, self.right)
        s = np.where(lo >= 0, self.right, np.where(hi <= 0, self.left, s))
        at = np.array([lo, hi, np.clip(0.0, lo, hi)])
        lows, highs = (Near(self.value(at)) - Near(at) * Near(s)).ends
        return s, *halfway(np.min(lows, axis=0), np.max(highs, axis=0))


class _Elu(_Bent):
    """v, and exp(v) - 1 for v < 0; slopes are within 1 of each other across 0 as well."""

    name, half = "elu", Above(0.5)

    def exact(self, q: Fraction) -> Fraction | None:
        return q if q >= 0 else None

    def at(self, c: Near) -> Three:
        below, e = c.value < 0, exp(_up_to_0(c))
        return _either(below, e - ONE, c), _either(below, e, ONE), _either(below, e * 0.5, _NONE)

    def sixth(self, c: Near, f: Three) -> Near:
        return f[2] * THIRD

    def slopes(self, v0: Near) -> FourBounds:
        return UNIT, UNIT, Above(0.5) + _no_more(v0), Above(0.25) + _no_more(v0)

    def third(self, e: Expansion) -> Above:
        return exp(_up_to_0(Near(e.v.ends[1]))).size.over(6.0)

    def fourth(self, e: Expansion) -> Above:
        return self.third(e).over(4.0) + _no_more(e.v)


class _Softsign(_Bent):
    """v / (1 + |v|), with the derivatives 1, -2 sign(v), 6, -24 sign(v), by (1 + |v|)^2, ^3, ^4, ^5."""

    name, half = "softsign", UNIT

    def exact(self, q: Fraction) -> Fraction | None:
        return q / (1 + abs(q))

    def at(self, c: Near) -> Three:
        r, sign = self._inverse(c), Near(np.where(c.value < 0, -1.0, 1.0))
        return c * r, r * r, -(r * r * r * sign)

    def sixth(self, c: Near, f: Three) -> Near:
        return f[1] * f[1]

    def slopes(self, v0: Near) -> FourBounds:
        return UNIT, UNIT * 2, Above(3.0) + _no_more(v0), Above(4.0) + _no_more(v0)

    def third(self, e: Expansion) -> Above:
        r = self._inverse(Near(np.maximum(lower(e.v), 0.0))).size
        return r * r * (r * r)

    def fourth(self, e: Expansion) -> Above:
        return self.third(e) * self._inverse(Near(lower(e.v))).size

    def _inverse(self, c: Near) -> Near:
        return inverse(Near(np.abs(c.value), c.error) + ONE)


class _Corner(Expansion):
    """A function that is smooth but at 0, around v0. Where the sign of v is not certain, models on boxes take the lines
    around it, and jets its tangent at v0, phi'' and phi^(3) being 0; there it has no derivative."""

    phi: _Bent

    @cached_property
    def certain(self) -> Array:
        return np.isfinite(lower(self.v))

    @cached_property
    def stored(self) -> Three:
        c = self.v0.value
        s, m, gap = self.phi.lines(c, self.v0.error + self.radius)
        of_lines = Near(c) * Near(s) + Near(m, gap), Near(s), Near(np.zeros_like(c))
        f0, f1, f2 = (_either(self.certain, v, w) for v, w in zip(self.phi.at(Near(c)), of_lines, strict=True))
        return f0, f1, f2

    @cached_property
    def f(self) -> Four:
        c, known = Near(self.v0.value), Above(0 * self.phi.bend(self.v0).top)
        three = self.phi.at(c)
        each = zip((*three, self.phi.sixth(c, three)), self.phi.slopes(self.v0), strict=True)
        f0, f1, f2, f3 = (v.wider(self.v0.error * steep + known) for v, steep in each)
        return f0, f1, _either(self.certain, f2, _NONE), _either(self.certain, f3, _NONE)

    @property
    def derivative(self) -> Derivative:
        found, smooth = Derivative(self), Above(np.where(self.certain, 0.0, np.nan))
        f0, f1, f2 = (v.wider(smooth) for v in found.stored)
        found.stored = f0, f1, f2
        return found

    @cached_property
    def third(self) -> Above:
        """Lines leave nothing."""
        return self._where_certain(self.phi.third(self), ZERO)

    @cached_property
    def fourth(self) -> Above:
        """The tangent leaves at most `bend` D^2, which is at most bend/radius^2 D^4 once D^2 is as large as radius^2:
        jets ask for the product of `fourth` and radius^2."""
        bend = self.phi.bend(self.v0)
        return self._where_certain(self.phi.fourth(self), bend.share(self.radius * self.radius))

    @cached_property
    def last(self) -> Above:
        return self._where_certain(self.phi.last(self), self.phi.leap(self.v0))

    def _where_certain(self, smooth: Above, other: Above) -> Above:
        return Above(np.where(self.certain, smooth.top, other.top))


def _either(condition: Array, a: Near, b: Near) -> Near:
    """a where the condition holds, else b."""
    return Near(np.where(condition, a.value, b.value), Above(np.where(condition, a.error.top, b.error.top)))


def _up_to_0(c: Near) -> Near:
    """min(c, 0)."""
    return Near(np.minimum(c.value, 0.0), c.error)


def _lines_by_parts(at: Callable[[Array], tuple[Near, Near]], bend: Above, centre: Array, radius: Above) -> Lines:
    """Parallel lines around a function whose second derivative is at most 2 `bend`, from its values and slopes `at`
    eight points of the range: (s, m, gap) with |phi(v) - s v - m| <= gap for all |v - centre| <= radius.

    Every v is within `half` of a point p, and there phi(v) - s v is within |phi'(p) - s| half + bend half^2 of its
    value at p. s is any number, here near the chord's slope.
    """
    lo, hi = Near(centre, radius).ends
    p = np.stack([lo + (hi - lo) * ((2 * i + 1) / 16) for i in range(8)])
    apart = (Near(p[1:]) - Near(p[:-1])).size * 0.5
    half = apart.max().most((Near(p[0]) - Near(lo)).size).most((Near(hi) - Near(p[-1])).size)
    f, slopes = at(p)
    s = (f.value[-1] - f.value[0]) / np.where(p[-1] > p[0], p[-1] - p[0], np.nan)
    s = np.where(np.isnan(s), slopes.value[0], s)
    away = (f - Near(p) * Near(s)).wider(((slopes - Near(s)).size + bend * half) * half)
    lows, highs = away.ends
    return s, *halfway(np.min(lows, axis=0), np.max(highs, axis=0))


def _no_more(x: Near) -> Above:
    """0 where numbers are certainly not 0, else NaN."""
    return Above(0 * lower(x))


def _silu(v: arb_series) -> arb_series:
    return v / ((-v).exp() + 1)


def _gelu(v: arb_series) -> arb_series:
    return v * ((v * (arb(1) / 2).sqrt()).erf() + 1) / 2


def _softplus(v: arb_series) -> arb_series:
    return (v.exp() + 1).log()


def _mish(v: arb_series) -> arb_series:
    """v tanh(softplus(v)), and tanh(log w) = 1 - 2/(1 + w^2)."""
    w = v.exp() + 1
    return v * (1 - 2 / (w * w + 1))


ROWS: dict[str, Function] = {
    row.name: row
    for row in (
        *(_Kink("abs", -1, 1), _Sign(), _Kink("relu", 0, 1), _Elu(), _Sigmoid(), _Softsign()),
        _Tabulated("softplus", _softplus, None),
        *(_Tabulated(name, phi, Fraction(0)) for name, phi in (("silu", _silu), ("gelu", _gelu), ("mish", _mish))),
    )
}


def add() -> None:
    """Add these rows to the table."""
    FUNCTIONS.update(ROWS)
