"""Rows of functions by power series: the coefficients of Arb's series are the derivatives, on balls as on numbers."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence

from flint import arb, arb_series, fmpq

from .balls import ONE, SPREAD, ZERO, lesser
from .lines import Line, Turn, around, chord, limited
from .rows import Four, Function

NARROW = ONE / 2**20  # of a ball whose derivatives are not worth a second look
HALVINGS, STEPS, CLOSE = 4, 3, ONE / 2**12  # of a range, of Newton's method, and how close is close enough
UNKNOWN = arb("nan")
Formula = Callable[[arb_series], arb_series]
Turns = Callable[[arb], Sequence[Turn]]  # of phi(y) - slope y for a slope strictly between the least and the most


def coefficients(formula: Formula, y: arb, count: int) -> list[arb]:
    """phi^(k)(y)/k! of a formula for k below a count, numbers of all that there are on the ball; NaN if not known."""
    try:
        series = formula(arb_series([y, ONE], prec=count))
    except ValueError:  # a denominator that may be 0
        return [UNKNOWN] * count
    return [series[k] for k in range(count)]


class BySeries(Function):
    """A function whose derivatives are the coefficients of power series, phi^(k) at most `largest` on a ball.

    Slopes of lines around it are between the ends of `slopes`, and near that of a chord whose ends are `inset` by this
    share of a range: the best one where the function is convex has none.
    """

    inset = ZERO

    def __init__(self, name: str, slopes: tuple[arb, arb], turns: Turns) -> None:
        self.name, self.slopes, self.known_turns = name, slopes, turns

    @abstractmethod
    def series(self, y: arb, count: int) -> list[arb]:
        """phi^(k)/k! on a ball, for k below a count."""

    @abstractmethod
    def largest(self, k: int, y: arb, reach: arb = ZERO) -> arb:
        """A bound of |phi^(k)| within a reach of all numbers of a ball, k from 1 to 4; NaN without one."""

    def derivatives(self, y: arb) -> Four:
        """On a wide ball those of the series, or those in its middle and by how much they change, if that is less."""
        found = self.series(y, 4)
        if not y.rad() < NARROW:
            moved = (
                c + (k + 1) * self.scaled(k + 1, y) * y.rad() * SPREAD for k, c in enumerate(self.series(y.mid(), 4))
            )
            found = list(map(narrower, found, moved))
        return found[0], found[1], 2 * found[2], 6 * found[3]

    def scaled(self, k: int, y: arb) -> arb:
        return self.largest(k, y) / math.factorial(k)

    def line(self, middle: arb, reach: arb) -> Line:
        lo, hi = arb((middle - reach).lower()), arb((middle + reach).upper())
        at_lo, at_hi = self.value(lo), self.value(hi)
        a, b = lo + self.inset * (hi - lo), hi - self.inset * (hi - lo)
        slope = chord(a, b, self.value(a), self.value(b)) if self.inset > 0 else chord(lo, hi, at_lo, at_hi)
        if not slope.is_finite():  # on a point
            slope = self.series(lo, 2)[1].mid()
        slope = limited(slope if slope.is_finite() else ONE, *self.slopes)
        return around(slope, lo, hi, at_lo, at_hi, self.turns(slope, lo, hi))

    def turns(self, slope: arb, lo: arb, hi: arb) -> Sequence[Turn]:
        """Values of phi(y) - slope y on [lo, hi], or beyond all of them, between which it stays with those at ends."""
        return self.known_turns(slope) if slope > self.slopes[0] and slope < self.slopes[1] else ()


class Smooth(BySeries):
    """A smooth function. `bounds` are those of |phi'| to |phi^(5)| everywhere, in millionths."""

    def __init__(
        self,
        name: str,
        formula: Formula,
        at_0: fmpq | None,
        bounds: Sequence[int],
        most: arb,
        turns: Turns,
    ) -> None:
        super().__init__(name, (ZERO, most), turns)
        self.formula, self.at_0 = formula, at_0
        self.bounds = [UNKNOWN, *(arb(fmpq(bound, 10**6)) for bound in bounds)]

    def exact(self, q: fmpq) -> fmpq | None:
        return self.at_0 if q == 0 else None

    def series(self, y: arb, count: int) -> list[arb]:
        return coefficients(self.formula, y, count)

    def value(self, y: arb) -> arb:
        return self.series(y, 1)[0]

    def largest(self, k: int, y: arb, reach: arb = ZERO) -> arb:
        return lesser(math.factorial(k) * top(self.series(y + reach * SPREAD, k + 1)[k]), self.bounds[k])

    def third(self, y: arb, at: Four, reach: arb) -> arb:
        return lesser(top(at[3]) + self.bounds[4] * reach, self.largest(3, y, reach))

    def fourth(self, y: arb, at: Four, reach: arb) -> arb:
        here = 24 * top(self.series(y.mid(), 5)[4]) + self.bounds[5] * (y.rad() + reach)
        return lesser(here, self.largest(4, y, reach))


class Bumpy(Smooth):
    """A smooth function of which no formula tells where phi' has a given value: turns are found in parts of a range."""

    inset = ONE / 16

    def __init__(self, name: str, formula: Formula, bounds: Sequence[int]) -> None:
        super().__init__(name, formula, fmpq(0), bounds, ONE, lambda slope: ())
        self.slopes = arb(-2), arb(2)

    def turns(self, slope: arb, lo: arb, hi: arb) -> list[Turn]:
        return self.turns_of_part(slope, lo, hi, HALVINGS)

    def turns_of_part(self, slope: arb, lo: arb, hi: arb, halvings: int) -> list[Turn]:
        """None where it rises or falls, one where it is convex or concave, else those of both halves."""
        mid = ((lo + hi) / 2).mid()
        radius = (hi - mid).max(mid - lo)
        value, steep, bend = self.series(mid, 3)
        steep -= slope
        bent = self.bent(mid, radius, bend)
        if abs(steep) > 2 * top(bent) * radius:
            return []
        if bent > 0 or bent < 0:
            return [self.turn(slope, lo, hi, mid - (steep / (2 * bend)).mid(), bool(bent > 0))]
        here = value - slope * mid
        if halvings == 0:
            far = lesser(abs(steep) + top(bent) * radius, abs(slope) + self.bounds[1]) * radius
            return [(mid, here - far), (mid, here + far)]
        halves = ((lo, mid), (mid, hi))
        return [(mid, here), *(turn for ends in halves for turn in self.turns_of_part(slope, *ends, halvings - 1))]

    def bent(self, mid: arb, radius: arb, bend: arb) -> arb:
        """phi''/2 within a radius of where it is `bend`."""
        bent = bend + self.bounds[3] / 2 * radius * SPREAD
        if bent > 0 or bent < 0:
            return bent
        return narrower(self.series(mid + radius * SPREAD, 3)[2], narrower(bent, self.bounds[2] / 2 * SPREAD))

    def turn(self, slope: arb, lo: arb, hi: arb, guess: arb, convex: bool) -> Turn:
        """A number below a convex phi(y) - slope y on [lo, hi], or above a concave one: tangents are."""
        for _ in range(STEPS):
            y = limited(guess, lo, hi) if guess.is_finite() else lo
            value, steep, bend = self.series(y, 3)
            steep -= slope
            ends = steep * (lo - y), steep * (hi - y)
            far = ends[0].min(ends[1]) if convex else ends[0].max(ends[1])
            if abs(far) < CLOSE * abs(bend) * (hi - lo) * (hi - lo):
                break
            guess = (y - steep / (2 * bend)).mid()
        return y, value - slope * y + far


class Cornered(BySeries):
    """A function that is smooth but at 0, by two formulas. |phi^(k)| never rises with |y|, for k >= 1.

    With `bend` phi' has no leap, rises by at most 2 bend by unit, and is 1 at 0.
    """

    cornered = True

    def __init__(
        self,
        name: str,
        left: Formula,
        right: Formula,
        value: Callable[[arb], arb],
        exact: Callable[[fmpq], fmpq | None],
        least: arb,
        turns: Turns,
        inset: arb = ZERO,
        bend: arb | None = None,
    ) -> None:
        super().__init__(name, (least, ONE), turns)
        self.inset, self.bend = inset, bend
        self.left, self.right, self.at, self.of_rational = left, right, value, exact
        self.undefined = f"{name} of what may vanish"

    def exact(self, q: fmpq) -> fmpq | None:
        return self.of_rational(q)

    def value(self, y: arb) -> arb:
        return self.at(y)

    def series(self, y: arb, count: int) -> list[arb]:
        if y > 0 or y < 0:
            return coefficients(self.right if y > 0 else self.left, y, count)
        return [UNKNOWN] * count

    def derivatives(self, y: arb) -> Four:
        """By series, but where y may be 0 and phi' has no leap. There the ball for phi'' has all chord slopes of phi',
        half of it all that phi is from its tangents by D^2, and the third derivative is 0 beside it."""
        if self.bend is None or y > 0 or y < 0:
            return super().derivatives(y)
        return self.value(y), ONE.union(coefficients(self.left, -top(y), 2)[1]), 2 * self.bend * SPREAD, ZERO

    def largest(self, k: int, y: arb, reach: arb = ZERO) -> arb:
        size = arb((arb(y.abs_lower()) - reach).lower())
        if not size > 0:
            return UNKNOWN
        return math.factorial(k) * abs(self.series(size if y > 0 else -size, k + 1)[k])

    def corner(self, y: arb) -> tuple[arb, arb] | None:
        """`bend` where phi' has no leap. Where it leaps from the least slope to 1, a number beyond the corner is at
        least |y| away, and x - y <= x^2 / (4 y)."""
        if self.bend is not None:
            return self.bend, arb("inf")
        least, leap = arb(y.abs_lower()), ONE - self.slopes[0]
        return (leap / (4 * least), leap / least**3) if least > 0 else None

    def third(self, y: arb, at: Four, reach: arb) -> arb | None:
        return self.near(3, y, reach)

    def fourth(self, y: arb, at: Four, reach: arb) -> arb | None:
        return self.near(4, y, reach)

    def near(self, k: int, y: arb, reach: arb) -> arb | None:
        bound = self.largest(k, y, reach)
        return bound if bound.is_finite() else None


def top(v: arb) -> arb:
    """The largest magnitude in a ball."""
    return arb(v.abs_upper())


def narrower(a: arb, b: arb) -> arb:
    """One of two balls around the same."""
    return a if a.is_finite() and not a.rad() > b.rad() else b
