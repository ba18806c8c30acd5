"""Rows of the table of functions that only some certificates need: 1/v, exp, atan and the root."""

from __future__ import annotations

from fractions import Fraction
from math import isqrt
from typing import Any

import numpy as np

from .elementary import atan, exp, inverse, sqrt
from .functions import FUNCTIONS, ONE, THIRD, UNIT, Expansion, FourBounds, Function, Three, Undecided
from .near import Above, Near, lower

_ATAN_FOURTH = Above(4.7).over(24.0)


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
        p = UNIT.over(lower(v0))
        pp = p * p
        return pp, p * pp * 2, pp * pp * 3, pp * p * pp * 4

    def third(self, e: Expansion) -> Above:
        """Three terms leave exactly -D^3 / (v0^3 v)."""
        p = UNIT.over(lower(e.v0))
        return (p * p * p).over(lower(e.v))

    def fourth(self, e: Expansion) -> Above:
        """Four leave exactly D^4 / (v0^4 v)."""
        return e.third.over(lower(e.v0))

    def last(self, e: Expansion) -> Above:
        """The derivative of that is D^3 (3 v + v0) / (v0^4 v^2), which falls in magnitude as v rises."""
        return e.fourth * (e.v0.size.over(lower(e.v)) + 3.0)


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


class _Atan(Function):
    name = "atan"

    def at(self, c: Near) -> Three:
        slope = inverse(ONE + c * c)
        return atan(c), slope, -(c * slope * slope)

    def sixth(self, c: Near, f: Three) -> Near:
        slope = f[1]
        bent = c * slope
        return (bent * bent - slope * slope * THIRD) * slope

    def slopes(self, v0: Near) -> FourBounds:
        return UNIT, Above(0.65), UNIT, Above(0.79)

    def third(self, e: Expansion) -> Above:
        """|phi^(3)| is at most 2."""
        return THIRD.size

    def fourth(self, e: Expansion) -> Above:
        """|phi^(4)| is at most 4.7."""
        return _ATAN_FOURTH


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
        p = UNIT.over(lower(sqrt(Near(_positive(v0)))))
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
        p, q, r = (UNIT.over(lower(x)) for x in (s, s + w, w))
        return p, q, r


def _positive(x: Near) -> Any:
    """Lower bounds, NaN unless they are positive and finite."""
    return np.where(x.value > 0, lower(x), np.nan)


ROWS: dict[str, Function] = {row.name: row for row in (_Inverse(), _Exp(), _Atan(), _Sqrt())}


def add() -> None:
    """Add these rows to the table."""
    FUNCTIONS.update(ROWS)
