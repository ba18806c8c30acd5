"""The table of functions: what the checker knows of each function of one variable, and nowhere else.

A row has the exact value where rationals decide it, and the expansion that models on boxes and on balls ask for.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from fractions import Fraction
from functools import cached_property

import numpy as np

from .near import ZERO, Above, Array, Near, lines_around_tanh, near, sin_cos, tanh

Three = tuple[Near, Near, Near]
Four = tuple[Near, Near, Near, Near]
Lines = tuple[Array, Array, Above]
FourBounds = tuple[Above, Above, Above, Above]
ONE, _TWO, THIRD = Near(np.float64(1)), Near(np.float64(2)), near(Fraction(1, 3))
UNIT = Above(1.0)
_TANH_FOURTH, _STEEPEST = Above(4.1).over(24.0), Above(16.0).over(24.0)


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
        slope = ONE - t * t
        return t, slope, -(t * slope)

    def sixth(self, c: Near, f: Three) -> Near:
        t, slope, _ = f
        return (t * t - THIRD) * slope

    def slopes(self, v0: Near) -> FourBounds:
        return UNIT, Above(0.77), UNIT, Above(0.7)

    def third(self, e: Expansion) -> Above:
        """|phi^(3)| is at most 2."""
        return THIRD.size

    def fourth(self, e: Expansion) -> Above:
        """phi^(4)/24 is t (2 - 3 t^2)(1 - t^2)/3, at most 4.1/24 in magnitude, and its derivative at most 16/24."""
        t, slope, _ = e.stored
        here = (t * (_TWO - t * t * 3) * slope).size.over(3.0)
        return (here + (e.v0.error + e.radius) * _STEEPEST).least(_TANH_FOURTH)


class _Sine(Function):
    """sin, and cos, which is the sine of v + pi/2."""

    def __init__(self, name: str) -> None:
        self.name, self.at_0 = name, Fraction(int(name == "cos"))

    def at(self, c: Near) -> Three:
        s, c = sin_cos(c)
        if self.name == "cos":
            s, c = c, -s
        return s, c, s * -0.5

    def sixth(self, c: Near, f: Three) -> Near:
        return -f[1].over(6.0)

    def slopes(self, v0: Near) -> FourBounds:
        return UNIT, UNIT, Above(0.5), Above(0.25)

    def third(self, e: Expansion) -> Above:
        return (e.stored[1].size + e.v0.error + e.radius).least(UNIT).over(6.0)

    def fourth(self, e: Expansion) -> Above:
        return (e.stored[0].size + e.v0.error + e.radius).least(UNIT).over(24.0)


FUNCTIONS: dict[str, Function] = {  # `add` of smooth.py and activations.py adds rows that only some certificates need
    row.name: row for row in (_Tanh(), _Sine("sin"), _Sine("cos"))
}
