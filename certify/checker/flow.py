"""The mean of f over a period in which the input is held: G, with x(h) = x + h G, in models of a ball or of leaves; and
rule `flow`: during a period the state stays in the interior of the domain.

Taylor's formula in time: G = x_1 + h x_2 + ... + h^(r-1) x_r, the last coefficient, which is the remainder, taken where
the state may be during the period. Power series give the coefficients in any arithmetic (Moore). Uncertain quantities
may change within the period. So all coefficients but the first take them as ranges, which enclose another value at each
place; the first is linear in them except for terms that its caller has moved, so that there a symbol stands for the
mean.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, partial, reduce
from operator import add
from typing import Any

import numpy as np

from .case import Failures
from .document import Certificate, Intervals
from .exact import fraction, quotient, rational, root_above
from .expression import Tape, evaluate
from .jets import Jet
from .near import Above, Array, Near, near, norm, size
from .ranges import Swayed, between, uncertain
from .ring import Motion, Moving, RingLeaves
from .stepping import Stepping
from .taylor import Taylor, affine, combination, constants, pairs, upper_bound

Constant = Callable[[Fraction], Any]
Way = tuple[Array, Array]  # the largest move of each state in a period: a number, and one times ||d||
Enclosed = tuple[Way, list[Jet]]  # and f on the way
_QUARTERS = 4  # of a period, for constraints
_ATTEMPTS = 8  # at the a-priori enclosure


@dataclass(frozen=True)
class Series:
    """`parts[0] + parts[1] t + ...`, of which the first `count` are of interest; those that are missing are 0."""

    parts: list[Any]
    count: int
    constant: Constant

    def _of(self, parts: list[Any]) -> Series:
        return Series(parts[: self.count], self.count, self.constant)

    def __add__(self, other: Series) -> Series:
        a, b = self.parts, other.parts
        common = min(len(a), len(b))
        return self._of([x + y for x, y in zip(a, b, strict=False)] + a[common:] + b[common:])

    def __neg__(self) -> Series:
        return self._of([-x for x in self.parts])

    def __mul__(self, other: Series) -> Series:
        a, b = self.parts, other.parts
        found = []
        for k in range(min(self.count, len(a) + len(b) - 1)):
            first, last = max(0, k - len(b) + 1), min(k, len(a) - 1)
            found.append(reduce(add, [a[i] * b[k - i] for i in range(first, last + 1)]))
        return self._of(found)

    def function(self, name: str) -> Series:
        """phi(v) for a function phi that equations may have."""
        count = self.count if len(self.parts) > 1 else 1
        return self._of(SERIES[name](self.parts, count, self.constant))


def coefficients(
    dynamics: Tape,
    constant: Constant,
    states: Sequence[Any],
    held: Sequence[Any],
    order: int,
    rest: Callable[[Any], Any],
) -> list[list[Any]]:
    """x_1 to x_order for each state, from there on, inputs and quantities `held`; `rest` is applied to each."""
    parts = [[x] for x in states]
    for k in range(1, order + 1):
        series = [Series(list(own), k, constant) for own in parts]
        others = [Series([v], k, constant) for v in held]
        F = evaluate(dynamics, lambda q, k=k: Series([constant(q)], k, constant), [*series, *others])  # type: ignore[misc]
        for own, f in zip(parts, F, strict=True):
            last = f.parts[k - 1] if len(f.parts) >= k else constant(Fraction(0))
            own.append(rest(last if k == 1 else constant(Fraction(1, k)) * last))
    return [own[1:] for own in parts]


def later(
    dynamics: Tape,
    constant: Constant,
    states: Sequence[Any],
    during: Sequence[Any],
    held: Sequence[Any],
    order: int,
    rest: Callable[[Any], Any],
) -> tuple[list[list[Any]], list[Any]]:
    """x_2 to x_order for each state, `order` being at least 2, and x_2 at any time: `states` are those at the period's
    beginning, `during` where they may be during it, `held` inputs and ranges of what is uncertain."""
    early = coefficients(dynamics, constant, states, held, order - 1, rest) if order > 2 else [[] for _ in states]
    late = coefficients(dynamics, constant, during, held, order, rest)
    rows = [[*known[1:], last[order - 1]] for known, last in zip(early, late, strict=True)]
    return rows, [last[1] for last in late]


def risen(row: Sequence[Any], h: Any) -> Any:
    """row[0] + h row[1] + h^2 row[2] + ..."""
    return reduce(lambda rising, x: x + h * rising, reversed(row))


def enclosed(
    f: Callable[[list[Taylor]], list[Taylor]], states: list[Taylor], longest: float
) -> tuple[list[Taylor], list[Taylor]]:
    """Models of the states during a period of at most that length, and f of them; NaN where none of a few attempts is
    an enclosure: in it states fall and rise by less than to its ends, so that they cannot come there (Moore 1966), and
    by no more than that. Boxes with both ends equally far come second: their models may be narrower."""
    down, up = np.zeros((2, len(states), len(states[0].c)))
    for attempt in range(2 * (1 + _ATTEMPTS)):
        F = f([reached(x, *ends) for x, *ends in zip(states, down, up, strict=True)])
        most = (Above(np.maximum(outwards(F), 0.0)) * longest).top  # and above 0
        good = np.all(most < (down, up), axis=(0, 1))
        if np.all(good):
            break
        further = np.zeros_like(most) if attempt == _ATTEMPTS else 1.25 * most
        if attempt > _ATTEMPTS:
            further[:] = further.max(axis=0)
        down, up = np.where(good, (down, up), further)
    during = [reached(x, *ends) for x, *ends in zip(states, *np.where(good, most, np.nan), strict=True)]
    return during, f(during)


def reached(x: Taylor, down: Array, up: Array) -> Taylor:
    """A number from x - down to x + up."""
    middle = (up - down) / 2
    return x + affine(middle, np.zeros_like(x.g), (Above(down) + up) * 0.5 + size(middle).ulps(1))


class Held(Stepping):
    """The ball of the section `local`, where inputs are held."""

    @property
    def order(self) -> int:
        return self.case.local.order

    @property
    def ranges(self) -> list[Jet]:
        """The uncertain quantities, of which only their whole ranges are known."""
        return self.of_y([between(lo, hi, self.units) for lo, hi in self.case.c.ranges])

    @cached_property
    def enclosed(self) -> Enclosed | None:
        """The a-priori enclosure of the states during a period, and of f there, from the first that holds of a few
        attempts: what f may come to, over the longest period, is less, and is as far as they go. None if none does."""
        n, h = len(self.J), longest(self.case.c)
        far, along = np.zeros(n), np.zeros(n)
        for _ in range(1 + _ATTEMPTS):
            F = self.f(self.during((far, along)), self.ranges)
            most = np.array([0.0 if self.at_rest else (f.v0.size * h).top for f in F])
            steepest = np.array([(self.steepness(f) * h).top for f in F])
            if np.all((most < far) | self.at_rest) and np.all(steepest < along):
                return (most, steepest), F
            far, along = (0 * most if self.at_rest else 1.25 * most), 1.25 * steepest
        return None

    def steepness(self, f: Jet) -> Above:
        """A bound of how much f changes with d, over ||d||."""
        return f.radius

    @property
    def way(self) -> Way | None:
        """The one of the enclosure, if there is one."""
        return None if self.enclosed is None else self.enclosed[0]

    def during(self, way: Way) -> list[Jet]:
        """The states within a way of the ball's."""
        moved = zip(self.states, *way, strict=True)
        return [replace(x, c=x.c.wider(far), a=x.a.wider(along)) for x, far, along in moved]

    def courses(self) -> Iterator[tuple[list[Jet], list[Jet]]]:
        if self.way is None:
            yield from super().courses()
        else:
            yield self.during(self.way), self.ranges

    def settled(self, v: Jet) -> Jet:
        """Set the value at d = 0 to exactly 0 at rest, where it is 0 in truth."""
        if not self.at_rest:
            return v
        v = replace(v, c=Near(np.float64(0)))
        return replace(v, c_y=Near(0 * v.c_y.value)) if isinstance(v, Swayed) else v

    @property
    def period(self) -> Jet:
        """h, by the last of the numbers y if it has a range."""
        lo, hi = self.case.c.sample or (Fraction(0), Fraction(0))
        return uncertain(lo, hi, self.units, self.count - 1, self.count) if lo < hi else self.constant(hi)

    @cached_property
    def later(self) -> list[Jet]:
        """The terms of G beyond x_1, divided by h; uncertain quantities enter them with their whole range alone."""
        if self.way is None or self.order == 1:
            return []
        start, during = self.shared(self.states), self.shared(self.during(self.way))
        held, dynamics = [*self.inputs, *self.ranges], self.case.c.dynamics
        rows, _ = later(dynamics, self.constant, start, during, held, self.order, self.settled)
        return [risen(row, self.period) for row in rows]

    def G(self, cell: Intervals) -> list[Jet] | None:
        """Within a period uncertain quantities may leave the cell: the cell counts only for their mean, in which D is
        convex."""
        if self.way is None:  # on a cone it may not be found, though it is on all
            return None
        first = self.f(self.during(self.way) if self.order == 1 else self.states, self.symbols(cell))
        rising = self.later or [self.constant(Fraction(0))] * len(first)
        return [self.settled(x) + self.period * more for x, more in zip(first, rising, strict=True)]


def stays_on_ball(local: Held) -> Failures:
    """`flow`: during a period the state stays in the interior of the domain."""
    c = local.case.c
    if local.enclosed is None:
        yield local.at, "the state is not shown to stay near during a period"
        return 0
    _, F = local.enclosed
    for i, (f, name, (lo, hi)) in enumerate(zip(F, c.states, c.domain, strict=True)):
        p = local.case.P_inverse[i]
        reach = root_above(rational(c.c1) * quotient(p))
        of_ball = float(norm(local.J[i]).top)
        reach = min(reach, rational(of_ball)) if np.isfinite(of_ball) else reach
        moved = float(((f.radius if local.at_rest else f.radius + f.v0.size) * longest(c)).top)
        if not (np.isfinite(moved) and fraction(reach + rational(moved)) < min(-lo, hi)):
            yield local.at, f"{name} may leave the domain during a period"
    return len(c.states)


def stays_on_leaves(leaves: RingLeaves) -> Failures:
    """`flow`: during a period the state stays in the interior of the domain."""
    c, ends = leaves.boxes.c, leaves.motion.ends
    for i, (name, (lo, hi)) in enumerate(zip(c.states, c.domain, strict=True)):
        (_, least), (most, _) = near(lo).ends, near(hi).ends
        hold = (ends[0, i] > least) & (ends[1, i] < most)
        if not np.all(hold):
            yield f"leaf {leaves.numbers[np.argmin(hold)]}", f"{name} may leave the domain during a period"
    return int(ends[0].size)


def longest(c: Certificate) -> float:
    """At or above the longest period."""
    return float(near(c.step).ends[1])


def motion(
    boxes: Moving, period: tuple[Fraction, Fraction], states: list[Taylor], inputs: list[Taylor], ranges: list[Taylor]
) -> Motion:
    """G over a period, and where the state may be until it is over: at x + s G, with s for h, for some s up to h, which
    is in one of its quarters."""
    c, most = boxes.c, longest(boxes.c)
    loose = [*inputs, *(affine(v.c, np.zeros_like(v.g), v.moved) for v in ranges)]  # by their ranges, without symbols
    during, F = enclosed(lambda x: boxes.f(x, loose), states, most)
    h = boxes.number(period, boxes.symbols - 1, len(inputs[0].c))
    first = boxes.f(during if boxes.order == 1 else states, [*inputs, *ranges])
    rows, way = [[of_mean(boxes, f)] for f in first], Above(np.maximum(outwards(F), 0.0)) * most
    if boxes.order > 1:
        more, bent = later(c.dynamics, constants(inputs[0]), states, during, loose, boxes.order, lambda v: v)
        rows = [[*row, *others] for row, others in zip(rows, more, strict=True)]
        way = way.least(highest(outwards(first), outwards(bent), most))
    G, ends = [risen(row, h) for row in rows], hull(states, way, boxes.widest)
    if c.keep is None:
        return Motion(G, [], loose, ends)
    states, loose, *rows = ([v.widened(boxes.symbols + 1) for v in some] for some in (states, loose, *rows))
    quarters = [(c.step * k / _QUARTERS, c.step * (k + 1) / _QUARTERS) for k in range(_QUARTERS)]
    times = [boxes.number(quarter, boxes.symbols, len(h.c)) for quarter in quarters]
    courses = [[x + s * risen(row, s) for x, row in zip(states, rows, strict=True)] for s in times]
    return Motion(G, courses, loose, ends)


def outwards(models: list[Taylor]) -> Array:
    """The upper ends of -v and of v, (2, n, B)."""
    lo, hi = (np.array(end) for end in zip(*(v.range.ends for v in models), strict=True))
    return np.array([-lo, hi])


def highest(a: Array, b: Array, h: float) -> Above:
    """The largest a t + b t^2 over 0 <= t <= h, for exact numbers. Half of h may underflow."""
    half = np.full(a.size, h / 2)
    t = affine(half, half[None], size(2 * half).ulps(1))
    top = upper_bound(combination((a.ravel(), t), (b.ravel(), t * t)))
    return Above(np.maximum(top, 0.0).reshape(a.shape))


def hull(states: list[Taylor], way: Above, widest: list[float]) -> Array:
    """Between what the states lie that start at |x_i| <= `widest` and move so far down and up, (2, n, B)."""
    found = []
    for i, (x, most) in enumerate(zip(states, widest, strict=True)):
        lo, hi = x.range.ends
        low, high = Near(np.maximum(lo, -most), way[0, i]), Near(np.minimum(hi, most), way[1, i])
        found.append((low.ends[0], high.ends[1]))
    return np.moveaxis(np.array(found), 1, 0)


def of_mean(boxes: Moving, f: Taylor) -> Taylor:
    """A model with the symbols of uncertain quantities, and of the errors of calls, which change within a period too,
    as their means: what is of second order in them, whose mean is another, becomes part of the remainder."""
    first, last = boxes.errors + boxes.m, boxes.calls + boxes.c.dynamics.entries
    i, j = ((first <= index) & (index < last) for index in pairs(boxes.symbols))
    own = boxes.symbols + np.flatnonzero(i & j)
    p = f.p.copy()
    p[own] = 0.0
    return Taylor(f.c, p, f.r + size(f.p[own]).sum())


# ---------------------------------------------------------------------------------------- power series of functions


def _tanh(v: list[Any], count: int, constant: Constant) -> list[Any]:
    y, slope = [v[0].function("tanh")], list[Any]()
    for k in range(1, count):
        square = reduce(add, [y[i] * y[k - 1 - i] for i in range(k)])
        slope.append(constant(Fraction(1)) + -square if k == 1 else -square)
        y.append(_step(v, slope, k, constant))
    return y


def _sine(name: str, v: list[Any], count: int, constant: Constant) -> list[Any]:
    """sin, and cos, which is the sine of v + pi/2."""
    y, other = [v[0].function(name)], [v[0].function("cos" if name == "sin" else "sin")]
    for k in range(1, count):
        rise, fall = _step(v, other, k, constant), _step(v, y, k, constant)
        y.append(rise if name == "sin" else -rise)
        other.append(-fall if name == "sin" else fall)
    return y


def _inv(v: list[Any], count: int, constant: Constant) -> list[Any]:
    y = [v[0].function("inv")]
    for k in range(1, count):
        y.append(-(reduce(add, [v[j] * y[k - j] for j in range(1, min(k, len(v) - 1) + 1)]) * y[0]))
    return y


def _exp(v: list[Any], count: int, constant: Constant) -> list[Any]:
    y = [v[0].function("exp")]
    for k in range(1, count):
        y.append(_step(v, y, k, constant))
    return y


def _atan(v: list[Any], count: int, constant: Constant) -> list[Any]:
    square = [
        reduce(add, [v[i] * v[k - i] for i in range(max(0, k - len(v) + 1), min(k, len(v) - 1) + 1)])
        for k in range(min(count, 2 * len(v) - 1))
    ]
    slopes = _inv([constant(Fraction(1)) + square[0], *square[1:]], count, constant)
    y = [v[0].function("atan")]
    for k in range(1, count):
        y.append(_step(v, slopes, k, constant))
    return y


def _sqrt(v: list[Any], count: int, constant: Constant) -> list[Any]:
    y = [v[0].function("sqrt")]
    half = constant(Fraction(1, 2)) * y[0].function("inv")
    for k in range(1, count):
        known = [v[k]] if k < len(v) else []
        known += [-(y[i] * y[k - i]) for i in range(1, k)]
        y.append(half * reduce(add, known) if known else constant(Fraction(0)))
    return y


def _abs(v: list[Any], count: int, constant: Constant) -> list[Any]:
    sign = v[0].function("sign") if count > 1 else None
    return [v[0].function("abs"), *(sign * v[k] if k < len(v) else constant(Fraction(0)) for k in range(1, count))]


def _sign(v: list[Any], count: int, constant: Constant) -> list[Any]:
    return [v[0].function("sign"), *[constant(Fraction(0))] * (count - 1)]


def _step(v: list[Any], w: list[Any], k: int, constant: Constant) -> Any:
    """sum_(j=1..k) j v_j w_(k-j) / k."""
    terms = [constant(Fraction(j, k)) * (v[j] * w[k - j]) for j in range(1, min(k, len(v) - 1) + 1)]
    return reduce(add, terms) if terms else constant(Fraction(0))


SERIES: dict[str, Callable[[list[Any], int, Constant], list[Any]]] = {  # the first coefficients of phi(v_0 + v_1 t ...)
    **{"tanh": _tanh, "sin": partial(_sine, "sin"), "cos": partial(_sine, "cos"), "inv": _inv, "exp": _exp},
    **{"atan": _atan, "sqrt": _sqrt, "abs": _abs, "sign": _sign},
}
