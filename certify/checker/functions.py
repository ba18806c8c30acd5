"""The table of functions: what the checker knows of each function of one variable, and nowhere else.

A row has the exact value where rationals decide it, the expansion that models on boxes and on balls ask for, and the
coefficients of its power series in time.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from fractions import Fraction
from functools import cached_property, reduce
from math import isqrt
from operator import add
from typing import Any

import numpy as np

from .near import (
    ZERO,
    Above,
    Array,
    Near,
    atan,
    exp,
    inverse,
    lines_around_tanh,
    lower,
    near,
    sin_cos,
    sqrt,
    tanh,
)

Three = tuple[Near, Near, Near]
Four = tuple[Near, Near, Near, Near]
Constant = Callable[[Fraction], Any]
Lines = tuple[Array, Array, Above]
FourBounds = tuple[Above, Above, Above, Above]
_NONE, _ONE, _TWO, _THIRD = Near(np.float64(0)), Near(np.float64(1)), Near(np.float64(2)), near(Fraction(1, 3))
_UNIT = Above(1.0)
_TANH_FOURTH, _ATAN_FOURTH, _STEEPEST = Above(4.1).over(24.0), Above(4.7).over(24.0), Above(16.0).over(24.0)


class Undecided(Exception):
    """There is no value, or it is too long."""


class Expansion:
    """phi around numbers v0 which are only known to be near others; NaN where phi may be undefined.

    For all |v - v0| <= radius and D = v - v0, phi(v) lies within `third` |D|^3 of the first three terms of its series,
    and within `fourth` D^4 of the first four; the derivative by D of what these leave is at most `last` |D|^3.
    """

    def __init__(self, phi: Function, v0: Near, radius: Above) -> None:
        self.phi, self.v0, self.radius = phi, v0, radius

    @cached_property
    def stored(self) -> Three:
        """phi, phi' and phi''/2 at the stored numbers; NaN where phi may be undefined around v0."""
        f0, f1, f2 = self.phi.at(Near(self.v0.value))
        if not self.phi.partial:
            return f0, f1, f2
        defined = Above(0 * self.third.v)
        return f0.wider(defined), f1.wider(defined), f2.wider(defined)

    @cached_property
    def f(self) -> Four:
        """phi, phi', phi''/2 and phi^(3)/6 at v0."""
        f0, f1, f2, f3 = (*self.stored, self.phi.sixth(Near(self.v0.value), self.stored))
        if self.v0.error is ZERO:
            return f0, f1, f2, f3
        e0, e1, e2, e3 = (self.v0.error * steep for steep in self.phi.slopes(self.v0))
        return f0.wider(e0), f1.wider(e1), f2.wider(e2), f3.wider(e3)

    @property
    def derivative(self) -> Derivative:
        """The expansion of phi' that models on boxes ask for."""
        return Derivative(self)

    @property
    def v(self) -> Near:
        """All that v may be."""
        return self.v0.wider(self.radius)

    @cached_property
    def third(self) -> Above:
        return self.phi.third(self)

    @cached_property
    def fourth(self) -> Above:
        return self.phi.fourth(self)

    @cached_property
    def last(self) -> Above:
        return self.phi.last(self)


class Derivative:
    """phi' around v0: its first three terms, `stored` as those of an expansion, leave at most `third` |D|^3."""

    def __init__(self, e: Expansion) -> None:
        _, f1, f2, f3 = e.f
        self.stored, self.third = (f1, f2 * 2, f3 * 3), e.last


class Function(ABC):
    """A row of the table: phi, and its first derivatives, f = (phi, phi', phi''/2, phi^(3)/6)."""

    name: str
    partial = False  # true if phi is not defined for all numbers
    at_0: Fraction | None = Fraction(0)  # phi(0), None if rationals do not know it

    def exact(self, q: Fraction) -> Fraction | None:
        """phi(q), None where rationals do not know it: they know it at 0. Raises `Undecided` where there is none."""
        return self.at_0 if q == 0 else None

    @abstractmethod
    def at(self, c: Near) -> Three:
        """phi, phi' and phi''/2 at exact numbers c; NaN where phi may be undefined."""

    @abstractmethod
    def sixth(self, c: Near, f: Three) -> Near:
        """phi^(3)/6 at c, f being what `at` gives there."""

    @abstractmethod
    def slopes(self, v0: Near) -> FourBounds:
        """Upper bounds of |phi'|, |phi''|, |phi^(3)|/2 and |phi^(4)|/6 at all numbers v0."""

    @abstractmethod
    def third(self, e: Expansion) -> Above:
        """`third` of an expansion."""

    @abstractmethod
    def fourth(self, e: Expansion) -> Above:
        """`fourth` of an expansion."""

    def last(self, e: Expansion) -> Above:
        """`last` of an expansion: sup |phi^(4)|/6, four times that of `fourth`, unless a row says otherwise."""
        return e.fourth * 4

    def series(self, v: list[Any], count: int, constant: Constant) -> list[Any]:
        """The first `count` coefficients of phi(v_0 + v_1 t + ...), of a function that equations may have."""
        raise Undecided(f"equations have no {self.name}")

    def expansion(self, v0: Near, radius: Above) -> Expansion:
        return Expansion(self, v0, radius)

    def lines(self, centre: Array, radius: Above) -> Lines:
        """Parallel lines around phi: (s, m, gap) with |phi(v) - s v - m| <= gap for all |v - centre| <= radius, here
        the tangent's; NaN where phi may be undefined."""
        e = self.expansion(Near(centre), radius)
        f0, f1, f2 = e.stored
        m = f0 - Near(centre) * Near(f1.value)
        return f1.value, m.value, m.error + (f1.error + (f2.size + e.third * radius) * radius) * radius


class _Tanh(Function):
    name = "tanh"

    def lines(self, centre: Array, radius: Above) -> Lines:
        return lines_around_tanh(centre, radius)

    def at(self, c: Near) -> Three:
        t = tanh(c)
        slope = _ONE - t * t
        return t, slope, -(t * slope)

    def sixth(self, c: Near, f: Three) -> Near:
        t, slope, _ = f
        return (t * t - _THIRD) * slope

    def slopes(self, v0: Near) -> FourBounds:
        return _UNIT, Above(0.77), _UNIT, Above(0.7)

    def third(self, e: Expansion) -> Above:
        """|phi^(3)| is at most 2."""
        return _THIRD.size

    def fourth(self, e: Expansion) -> Above:
        """phi^(4)/24 is t (2 - 3 t^2)(1 - t^2)/3, at most 4.1/24 in magnitude, and its derivative at most 16/24."""
        t, slope, _ = e.stored
        here = (t * (_TWO - t * t * 3) * slope).size.over(3.0)
        return (here + (e.v0.error + e.radius) * _STEEPEST).least(_TANH_FOURTH)

    def series(self, v: list[Any], count: int, constant: Constant) -> list[Any]:
        y, slope = [v[0].function("tanh")], list[Any]()
        for k in range(1, count):
            square = reduce(add, [y[i] * y[k - 1 - i] for i in range(k)])
            slope.append(constant(Fraction(1)) + -square if k == 1 else -square)
            y.append(_step(v, slope, k, constant))
        return y


class _Inverse(Function):
    name, partial = "inv", True

    def exact(self, q: Fraction) -> Fraction | None:
        if q == 0:
            raise Undecided("a division by 0")
        return 1 / q

    def at(self, c: Near) -> Three:
        f0 = inverse(c)
        square = f0 * f0
        return f0, -square, square * f0

    def sixth(self, c: Near, f: Three) -> Near:
        return -(f[1] * f[1])

    def slopes(self, v0: Near) -> FourBounds:
        p = _UNIT.over(lower(v0))
        pp = p * p
        return pp, p * pp * 2, pp * pp * 3, pp * p * pp * 4

    def third(self, e: Expansion) -> Above:
        """Three terms leave exactly -D^3 / (v0^3 v)."""
        p = _UNIT.over(lower(e.v0))
        return (p * p * p).over(lower(e.v))

    def fourth(self, e: Expansion) -> Above:
        """Four leave exactly D^4 / (v0^4 v)."""
        return e.third.over(lower(e.v0))

    def last(self, e: Expansion) -> Above:
        """The derivative of that is D^3 (3 v + v0) / (v0^4 v^2), which falls in magnitude as v rises."""
        return e.fourth * (e.v0.size.over(lower(e.v)) + 3.0)

    def series(self, v: list[Any], count: int, constant: Constant) -> list[Any]:
        y = [v[0].function("inv")]
        for k in range(1, count):
            y.append(-(reduce(add, [v[j] * y[k - j] for j in range(1, min(k, len(v) - 1) + 1)]) * y[0]))
        return y


class _Exp(Function):
    name, at_0 = "exp", Fraction(1)

    def at(self, c: Near) -> Three:
        f0 = exp(c)
        return f0, f0, f0 * 0.5

    def sixth(self, c: Near, f: Three) -> Near:
        return f[0].over(6.0)

    def slopes(self, v0: Near) -> FourBounds:
        most = exp(Near(v0.ends[1])).size
        return most, most, most, most

    def third(self, e: Expansion) -> Above:
        return exp(Near(e.v.ends[1])).size.over(6.0)

    def fourth(self, e: Expansion) -> Above:
        return e.third.over(4.0)

    def series(self, v: list[Any], count: int, constant: Constant) -> list[Any]:
        y = [v[0].function("exp")]
        for k in range(1, count):
            y.append(_step(v, y, k, constant))
        return y


class _Atan(Function):
    name = "atan"

    def at(self, c: Near) -> Three:
        slope = inverse(_ONE + c * c)
        return atan(c), slope, -(c * slope * slope)

    def sixth(self, c: Near, f: Three) -> Near:
        slope = f[1]
        bent = c * slope
        return (bent * bent - slope * slope * _THIRD) * slope

    def slopes(self, v0: Near) -> FourBounds:
        return _UNIT, Above(0.65), _UNIT, Above(0.79)

    def third(self, e: Expansion) -> Above:
        """|phi^(3)| is at most 2."""
        return _THIRD.size

    def fourth(self, e: Expansion) -> Above:
        """|phi^(4)| is at most 4.7."""
        return _ATAN_FOURTH

    def series(self, v: list[Any], count: int, constant: Constant) -> list[Any]:
        square = [
            reduce(add, [v[i] * v[k - i] for i in range(max(0, k - len(v) + 1), min(k, len(v) - 1) + 1)])
            for k in range(min(count, 2 * len(v) - 1))
        ]
        slopes = FUNCTIONS["inv"].series([constant(Fraction(1)) + square[0], *square[1:]], count, constant)
        y = [v[0].function("atan")]
        for k in range(1, count):
            y.append(_step(v, slopes, k, constant))
        return y


class _Sqrt(Function):
    """With s^2 = v0 and w^2 = v."""

    name, partial = "sqrt", True

    def exact(self, q: Fraction) -> Fraction | None:
        if q <= 0:
            raise Undecided("the root of a number that is not positive")
        root = Fraction(isqrt(q.numerator), isqrt(q.denominator))
        return root if root * root == q else None

    def at(self, c: Near) -> Three:
        s = sqrt(c)
        p = inverse(s)
        return s, p * 0.5, p * p * p * -0.125

    def sixth(self, c: Near, f: Three) -> Near:
        p = f[1] * 2
        return f[2] * p * p * -0.5

    def slopes(self, v0: Near) -> FourBounds:
        p = _UNIT.over(lower(sqrt(Near(_positive(v0)))))
        cube = p * p * p
        fifth = cube * p * p
        return p * 0.5, cube * 0.25, fifth * 0.1875, fifth * p * p * 0.15625

    def third(self, e: Expansion) -> Above:
        """Three terms leave exactly D^3 (3 s + w) / (8 s^3 (s + w)^3), which falls as v rises; and 3 s + w is
        2 s + (s + w)."""
        p, q, _ = self._inverses(e)
        pq = p * q
        return (pq * pq * (q * 2 + p)).over(8.0)

    def fourth(self, e: Expansion) -> Above:
        """Four leave exactly -D^4 (5 s^2 + 4 s w + w^2) / (16 s^5 (s + w)^4), which falls in magnitude as v
        rises; and 5 s^2 + 4 s w + w^2 is 2 s^2 + 2 s (s + w) + (s + w)^2."""
        p, q, _ = self._inverses(e)
        pq = p * q
        return (pq * pq * p * (q * q * 2 + pq * 2 + p * p)).over(16.0)

    def last(self, e: Expansion) -> Above:
        """The derivative of that is -D^3 (8 s^2 + 9 s w + 3 w^2) / (16 s^5 w (s + w)^3), which falls so, too."""
        p, q, r = self._inverses(e)
        far, w = sqrt(Near(e.v0.ends[1])).size, sqrt(Near(_positive(e.v))).size
        bent = far * far * 8 + far * w * 9 + w * w * 3
        return (bent * (p * p * p * (p * p)) * r * (q * q * q)).over(16.0)

    def _inverses(self, e: Expansion) -> tuple[Above, Above, Above]:
        """1/s, 1/(s + w) and 1/w at the least that v0 and v may be."""
        s, w = sqrt(Near(_positive(e.v0))), sqrt(Near(_positive(e.v)))
        p, q, r = (_UNIT.over(lower(x)) for x in (s, s + w, w))
        return p, q, r

    def series(self, v: list[Any], count: int, constant: Constant) -> list[Any]:
        y = [v[0].function("sqrt")]
        half = constant(Fraction(1, 2)) * y[0].function("inv")
        for k in range(1, count):
            known = [v[k]] if k < len(v) else []
            known += [-(y[i] * y[k - i]) for i in range(1, k)]
            y.append(half * reduce(add, known) if known else constant(Fraction(0)))
        return y


class _Sine(Function):
    """sin, and cos, which is the sine of v + pi/2."""

    def __init__(self, name: str, other: str) -> None:
        self.name, self.other, self.at_0 = name, other, Fraction(int(name == "cos"))

    def at(self, c: Near) -> Three:
        s, c = sin_cos(c)
        if self.name == "cos":
            s, c = c, -s
        return s, c, s * -0.5

    def sixth(self, c: Near, f: Three) -> Near:
        return -f[1].over(6.0)

    def slopes(self, v0: Near) -> FourBounds:
        return _UNIT, _UNIT, Above(0.5), Above(0.25)

    def third(self, e: Expansion) -> Above:
        return (e.stored[1].size + e.v0.error + e.radius).least(_UNIT).over(6.0)

    def fourth(self, e: Expansion) -> Above:
        return (e.stored[0].size + e.v0.error + e.radius).least(_UNIT).over(24.0)

    def series(self, v: list[Any], count: int, constant: Constant) -> list[Any]:
        y, other = [v[0].function(self.name)], [v[0].function(self.other)]
        for k in range(1, count):
            rise, fall = _step(v, other, k, constant), _step(v, y, k, constant)
            y.append(rise if self.name == "sin" else -rise)
            other.append(-fall if self.name == "sin" else fall)
        return y


def _positive(x: Near) -> Any:
    """Lower bounds, NaN unless they are positive and finite."""
    return np.where(x.value > 0, lower(x), np.nan)


def _step(v: list[Any], w: list[Any], k: int, constant: Constant) -> Any:
    """sum_(j=1..k) j v_j w_(k-j) / k."""
    terms = [constant(Fraction(j, k)) * (v[j] * w[k - j]) for j in range(1, min(k, len(v) - 1) + 1)]
    return reduce(add, terms) if terms else constant(Fraction(0))


FUNCTIONS: dict[str, Function] = {  # `activations.add` adds rows that only some certificates need
    row.name: row for row in (_Inverse(), _Tanh(), _Exp(), _Atan(), _Sqrt(), _Sine("sin", "cos"), _Sine("cos", "sin"))
}
