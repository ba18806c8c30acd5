"""Rule `data`: the parameters that are consistent with measurements lie in their ranges.

The priors are divided. What the measurements leave of the parts lies in one box, of which they may leave still less.

A parameter is the middle of its interval and half the width times a symbol d, a measured state what was measured and
the noise times a symbol e. What the equations make of these until the next measurement, less that, is 0 where the
parameters are true ones. So are all sums of such numbers with multipliers w: what such a sum has of d_j, subtracted
from d_j, leaves a number that is d_j again, and that lies between the ends of its form. That is right for every w.

A parameter is one number at all times. Its symbol stands for it wherever it occurs in a series in time, while any other
quantity may be another number at each place.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from flint import arb, arb_mat

from .balls import ONE, ZERO, total
from .document import Axis, Certificate, Data, Interval
from .evidence import Fit, Round
from .fields import exact
from .flow import Moving, mean_on, moved_within
from .leaves import LEAF, structure
from .refusal import Refused, require
from .taylor import Taylor, constant

RULE = "data"
Box = Sequence[Interval]  # for each parameter


def data(c: Certificate, fit: Fit) -> None:
    """The box that the leaves' rounds leave, the one that all further rounds do, and at the end the ranges."""
    if c.data is None:
        raise Refused("format", "claim.data", "multipliers need measurements")
    count = structure(fit.tree, range(len(c.data.parameters)), RULE, "data ")
    require(count == len(fit.leaves), RULE, "data", f"rounds for each of {count} leaves were expected")
    left = list[Box]()
    for k, (box, rounds) in enumerate(zip(leaves(c.data.priors, fit.tree), fit.leaves, strict=True)):
        found = after(c, c.data, fit, box, rounds, f"data leaf {k}")
        left += [] if found is None else [found]
    last = after(c, c.data, fit, hull(left), fit.rounds, "data") if left else None
    if last is None:
        raise Refused(RULE, "data", "no parameters of the priors are consistent with what was measured")
    ranges = dict(zip(c.plant.uncertain, c.plant.ranges, strict=True))
    if fit.turned is not None:
        require(any(fit.turned), RULE, "data turned", "every multiplier is 0")
        there = Measured(c, c.data, fit, last, "data turned")
        bounds = there.bounds(fit.turned, [slopes for _, slopes in there.axes])
        for axis, (middle, _), (below, above) in zip(c.data.axes, there.axes, bounds, strict=True):
            least, most = map(arb, ranges[axis.name])
            good = is_at_most(least, middle + below) and is_at_most(middle + above, most)
            require(good, RULE, axis.name, "it is not certain to lie in its range")
        return
    for name, (lo, hi) in zip(c.data.parameters, last, strict=True):
        least, most = ranges[name]
        require(bool(least <= lo) and bool(hi <= most), RULE, name, "it is not certain to lie in its range")


def leaves(box: Box, tree: bytes) -> Iterator[Box]:
    """Boxes of a tree whose structure is sound, in rationals."""
    waiting = [list(box)]
    for axis in tree:
        here = waiting.pop()
        if axis == LEAF:
            yield here
            continue
        lo, hi = here[axis]
        below, above, middle = list(here), list(here), (lo + hi) / 2
        below[axis], above[axis] = (lo, middle), (middle, hi)
        waiting += [above, below]  # the lower half is next


def hull(boxes: Sequence[Box]) -> Box:
    """The least box that has all these."""
    return [(min(lo for lo, _ in each), max(hi for _, hi in each)) for each in zip(*boxes, strict=True)]


def after(c: Certificate, data: Data, fit: Fit, box: Box, rounds: Sequence[Round], at: str) -> Box | None:
    """The box that some rounds leave of another, None where nothing is left."""
    for number, each in enumerate(rounds):
        Measured(c, data, fit, box, f"{at} round {number}").narrows(each)
        box = [(exact(lo), exact(hi)) for lo, hi in zip(*halves(each.box), strict=True)]
        if not all(lo <= hi for lo, hi in box):
            return None
    return box


def halves(values: array[float]) -> tuple[array[float], array[float]]:
    return values[: len(values) // 2], values[len(values) // 2 :]


@dataclass(frozen=True)
class Transition:
    """From a measured state by an input to another; `start` and `end` are the numbers of the rows of all runs."""

    number: int
    start: int
    x: Sequence[float]
    u: Sequence[float]
    y: Sequence[float]

    @property
    def end(self) -> int:
        return self.start + 1


def transitions(data: Data) -> Iterator[Transition]:
    number = row = 0
    for run in data.runs:
        for k, u in enumerate(run.inputs):
            yield Transition(number, row + k, run.states[k], u, run.states[k + 1])
            number += 1
        row += len(run.states)


@dataclass(frozen=True)
class Residual:
    """A number that is 0: `alpha` and `slopes` times symbols, within `slack`."""

    alpha: arb
    slopes: Mapping[int, arb]
    slack: arb


NO_NUMBER = Residual(arb("nan"), {}, ZERO)


class Measured:
    """Residuals of all transitions where the parameters are in a box, and bounds of those that are consistent.

    Models of a transition have the n symbols of its start, those of the parameters, and one of the period where that
    may be one of many. Of all symbols those of the parameters come first, then n for each row of each run.
    """

    def __init__(self, c: Certificate, data: Data, fit: Fit, box: Box, at: str) -> None:
        self.c, self.data, self.fit, self.box, self.at = c, data, fit, box, at
        self.n, self.K = c.n, len(data.parameters)
        self.varies = data.period is not None and bool(data.period[0] < data.period[1])
        self.symbols = self.n + self.K + self.varies
        self.noise, self.origin = [arb(q) for q in data.noise], [arb(q) for q in data.origin]
        self.quantities = {q: number_in(ends) for q, ends in zip(c.plant.uncertain, c.plant.ranges, strict=True)}
        self.axes = [on_axis(axis, box) for axis in data.axes]
        for axis, (middle, by) in zip(data.axes, self.axes, strict=True):
            slopes = [by.get(k - self.n, ZERO) for k in range(self.symbols)]
            self.quantities[axis.name] = Taylor(middle, arb_mat(1, self.symbols, slopes))
        for j, (name, (lo, hi)) in enumerate(zip(data.parameters, box, strict=True)):
            if not data.axes:
                self.quantities[name] = self.moving(arb((lo + hi) / 2), self.n + j, arb((hi - lo) / 2))

    def moving(self, middle: arb, symbol: int, size: arb) -> Taylor:
        return Taylor(middle, arb_mat(1, self.symbols, [size if k == symbol else ZERO for k in range(self.symbols)]))

    def narrows(self, stated: Round) -> None:
        """By the multipliers no consistent parameters are beyond the stated box, or a refusal."""
        require(any(stated.weights), RULE, self.at, "every multiplier is 0")
        bounds = self.bounds(stated.weights, [{j: ONE} for j in range(self.K)])
        each = zip(self.data.parameters, self.box, *halves(stated.box), bounds, strict=True)
        for name, (lo, hi), least, most, (below, above) in each:
            middle, half = arb((lo + hi) / 2), arb((hi - lo) / 2)
            bounded = exact(least) <= lo or is_at_most(arb(least), middle + half * below)
            require(bounded, RULE, f"{self.at} {name}", "a consistent one may be below the lower end of the box")
            bounded = hi <= exact(most) or is_at_most(middle + half * above, arb(most))
            require(bounded, RULE, f"{self.at} {name}", "a consistent one may be above the upper end of the box")

    def bounds(self, weights: array[float], sums: Sequence[Mapping[int, arb]]) -> Iterator[tuple[arb, arb]]:
        """Numbers below and above sums of the parameters' symbols, for all that are consistent, by multipliers."""
        size, found = self.data.steps * self.n, dict[int, Residual]()
        rows = [weights[k : k + size] for k in range(0, len(weights), size)]
        for t in transitions(self.data):
            first = t.number * self.n
            if any(any(row[first : first + self.n]) for row in rows):
                try:
                    found.update(enumerate(self.residuals(t), first))
                except Refused:  # a bound with it is no number, and says nothing
                    found.update((first + i, NO_NUMBER) for i in range(self.n))
        for a, below, above in zip(sums, rows[: len(sums)], rows[len(sums) :], strict=True):
            reach, shift = combined(a, below, found)
            further, other = combined(a, above, found)
            yield -reach - shift, further - other

    def residuals(self, t: Transition) -> Iterator[Residual]:
        """The residual of each state: its value at the end, less the measured one and the noise."""
        for i, v in enumerate(self.reached(t)):
            mean = v.averaged(range(self.symbols))  # squares of symbols lie in 1/2 +- 1/2, products in 0 +- 1
            own, of_period = mean.slopes(self.symbols)[: self.n + self.K], mean.slopes(self.symbols)[self.n + self.K :]
            slopes = dict(zip([*self.of_row(t.start), *range(self.K)], own, strict=True))
            slopes[self.of_row(t.end)[i]] = -self.noise[i]
            yield Residual(mean.c - self.middle(t.y, i), slopes, mean.r + total(map(abs, of_period)))

    def of_row(self, row: int) -> range:
        """The symbols of a measured state."""
        return range(self.K + row * self.n, self.K + (row + 1) * self.n)

    def middle(self, measured: Sequence[float], i: int) -> arb:
        return arb(measured[i]) - self.origin[i]

    def reached(self, t: Transition) -> list[Taylor]:
        """Models of the states at the end of a transition; a refusal where they have none."""
        at, plant = f"{self.at} transition {t.number}", self.c.plant
        states = {name: self.moving(self.middle(t.x, i), i, self.noise[i]) for i, name in enumerate(plant.states)}
        inputs = {name: Taylor(arb(v)) for name, v in zip(plant.inputs, t.u, strict=True)}
        if self.data.period is None:
            values: list[Taylor] = plant.dynamics.evaluate({**states, **inputs, **self.quantities}, constant)
            return values
        for _ in range(self.fit.pieces):
            states = self.followed(states, inputs, self.data.period, at)
        return list(states.values())

    def followed(
        self, states: Mapping[str, Taylor], inputs: Mapping[str, Taylor], period: Interval, at: str
    ) -> dict[str, Taylor]:
        """The states after one of the equal parts of a period."""
        lo, hi = (end / self.fit.pieces for end in period)
        h = Taylor(arb(hi))
        if self.varies:
            h = self.moving(arb((lo + hi) / 2), self.symbols - 1, arb((hi - lo) / 2))
        here = Moving(states, inputs, self.quantities, self.quantities, None, (), (), None)
        within, _ = moved_within(self.c, here, arb(hi), at)
        G = mean_on(self.c, here, within, self.fit.order, h, at)
        return {name: x + h * g for (name, x), g in zip(states.items(), G, strict=True)}


def number_in(ends: Interval) -> Taylor:
    """A number between two others, which may be another one at each place."""
    lo, hi = ends
    return Taylor(arb((lo + hi) / 2), r=arb((hi - lo) / 2))


def on_axis(axis: Axis, box: Box) -> tuple[arb, dict[int, arb]]:
    """The value of an axis in the middle of a box, and its slopes by the symbols of the parameters there."""
    each = [(arb(by), (lo + hi) / 2, (hi - lo) / 2) for by, (lo, hi) in zip(axis.by, box, strict=True)]
    middle = arb(axis.at) + total(by * arb(centre) for by, centre, _ in each)
    return middle, {j: by * arb(half) for j, (by, _, half) in enumerate(each)}


def combined(a: Mapping[int, arb], w: Sequence[float], found: Mapping[int, Residual]) -> tuple[arb, arb]:
    """A reach and a shift: by the residuals with these multipliers a.d + shift lies within reach of 0."""
    left, slack, shift = dict(a), ZERO, ZERO
    for k, each in enumerate(w):
        if each == 0:
            continue
        factor, residual = arb(each), found[k]
        shift += factor * residual.alpha
        slack += abs(factor) * residual.slack
        for symbol, slope in residual.slopes.items():
            left[symbol] = left.get(symbol, ZERO) - factor * slope
    return total(map(abs, left.values())) + slack, shift


def is_at_most(a: arb, b: arb) -> bool:
    """True if both certainly are numbers, and the first no greater one."""
    return bool(a.is_finite()) and bool(b.is_finite()) and bool(a <= b)
