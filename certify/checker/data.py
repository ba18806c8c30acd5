"""The rule for data: constant parameters with which measurements are consistent lie in the ranges of the claim.

In a box of the parameters the flow over each measured transition is a model in the parameters and in the errors of what
was measured at its beginning. So a transition says that n affine functions of parameters and errors are small; sums of
these with multipliers bound each parameter, whatever the multipliers are (weak duality). The smaller box that follows
makes better models: rounds do this one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .boxes import LEAF, is_whole
from .case import Case, Failures, given
from .document import Intervals
from .expression import evaluate
from .flow import enclosed, later, risen
from .near import Above, Near, all_near, combined, near, size
from .schema import Array
from .sections import Data, Round
from .taylor import Taylor, affine, constants, pairs

if TYPE_CHECKING:
    from .rules import Tally

_BATCH_NUMBERS = 800_000


@dataclass(frozen=True)
class Rows:
    """Functions `alpha + slopes.(errors, parameters) - noise.(errors of the measured end)` of symbols in [-1, 1], each
    within `slack` of 0: `alpha` and `slack` (n, T), slopes (n, n + K, T), all of T transitions."""

    alpha: Near
    slopes: Array
    slack: Above


class Flows:
    """The plant along its measured transitions."""

    def __init__(self, case: Case, data: Data) -> None:
        self.case, self.c, self.data = case, case.c, data
        self.n, self.k = len(case.c.states), len(data.parameters)
        lo, hi = data.period or (0, 0)
        self.symbols = self.n + self.k + int(lo < hi)  # the last is that of the period
        self.noise = all_near(data.noise)
        self.axes = [(near(axis.at), all_near(axis.by)) for axis in data.axes]
        begins = np.concatenate([np.full(len(inputs), run) for run, (_, inputs) in enumerate(data.runs)])
        self.begin = np.arange(len(begins)) + begins  # the number of the measurement at which a transition begins
        self.y = np.concatenate([states for states, _ in data.runs])
        self.u = np.concatenate([inputs for _, inputs in data.runs])

    def rows(self, box: Intervals, chosen: NDArray[np.intp]) -> Rows:
        """The rows of some transitions, by their numbers, for parameters in a box."""
        found = [self._rows(box, chosen[first : first + self._batch]) for first in range(0, len(chosen), self._batch)]
        alpha, wrong, slopes, slack = (np.concatenate(part, axis=-1) for part in zip(*found, strict=True))
        return Rows(Near(alpha, Above(wrong)), slopes, Above(slack))

    @property
    def _batch(self) -> int:
        values = self.c.dynamics.size * (self.data.order + 1)
        return int(max(1, min(256, _BATCH_NUMBERS // (self.symbols**2 * (values + 4)))))

    def _rows(self, box: Intervals, chosen: NDArray[np.intp]) -> tuple[Array, ...]:
        """alpha, its errors, slopes and slack of a batch of transitions."""
        begin, (i, j), own, none = self.begin[chosen], pairs(self.symbols), self.n + self.k, np.zeros(len(chosen))
        found = []
        for s, model in enumerate(self.end(box, chosen)):
            squares, value = Near(model.q[i == j]), self.measured(s, begin + 1)
            centre, wrong = combined((1.0, Near(model.c)), (0.5, squares.sum()), (-1.0, value))
            slack = size(squares.value).sum() * 0.5 + size(model.q[i != j]).sum() + size(model.g[own:]).sum() + model.r
            found.append((centre, wrong.top + none, model.g[:own], slack.top + none))
        return tuple(np.stack(part) for part in zip(*found, strict=True))

    def measured(self, state: int, number: Array) -> Near:
        """Measurements of a state, in deviations."""
        y, origin = self.y[number, state], self.data.origin[state]
        return all_near(Fraction(v) - origin for v in y.tolist()) if origin else Near(y)

    def end(self, box: Intervals, chosen: NDArray[np.intp]) -> list[Taylor]:
        """Models of the states at the ends of transitions. Parameters are constant and keep their symbols throughout;
        other quantities may be another number of their range at each place and time."""
        batch = len(chosen)
        x = [self._symbol(self.measured(s, self.begin[chosen]), self.noise[s], s, batch) for s in range(self.n)]
        inputs = [affine(u, np.zeros((self.symbols, batch))) for u in self.u[chosen].T]
        ranges = [self._number(pair, None, batch) for pair in self.c.ranges]
        constants = [self._number(pair, self.n + k, batch) for k, pair in enumerate(box)]
        if self.axes:
            constants = [self._constant(centre, slopes, batch) for centre, slopes in self.on_axes(box)]
        for name, model in zip(self.data.constants, constants, strict=True):
            ranges[self.c.uncertain.index(name)] = model
        return self._after(x, [*inputs, *ranges], batch)

    def on_axes(self, box: Intervals) -> list[tuple[Near, Near]]:
        """For each axis its value in the middle of a box, and its slopes by the parameters' symbols (K,)."""
        middles, reaches = all_near((lo + hi) / 2 for lo, hi in box), all_near((hi - lo) / 2 for lo, hi in box)
        return [(at + (by * middles).sum(), by * reaches) for at, by in self.axes]

    def _constant(self, centre: Near, slopes: Near, batch: int) -> Taylor:
        """A number that has the parameters' symbols."""
        g = np.zeros((self.symbols, batch))
        g[self.n : self.n + self.k] = slopes.value[:, None]
        return affine(centre.value + np.zeros(batch), g, centre.error + slopes.error.shaped(self.k).sum())

    def _symbol(self, centre: Near, reach: Near, symbol: int | None, batch: int) -> Taylor:
        """A number within `reach` of a centre, with a symbol of its own or without."""
        g = np.zeros((self.symbols, batch))
        if symbol is None:
            return affine(centre.value + np.zeros(batch), g, centre.error + reach.size)
        g[symbol] = reach.value
        return affine(centre.value + np.zeros(batch), g, centre.error + reach.error)

    def _number(self, pair: tuple[Fraction, Fraction], symbol: int | None, batch: int) -> Taylor:
        lo, hi = pair
        return self._symbol(near((lo + hi) / 2), near((hi - lo) / 2), symbol, batch)

    def _after(self, x: list[Taylor], held: list[Taylor], batch: int) -> list[Taylor]:
        number, order, pieces = constants(x[0]), self.data.order, self.data.pieces
        if self.data.period is None:
            return evaluate(self.c.dynamics, number, [*x, *held])
        lo, hi = (end / pieces for end in self.data.period)
        h = self._number((lo, hi), self.symbols - 1 if lo < hi else None, batch)
        longest = float(near(hi).ends[1])
        for _ in range(pieces):
            during, _ = enclosed(lambda v: evaluate(self.c.dynamics, number, [*v, *held]), x, longest)
            G = evaluate(self.c.dynamics, number, [*(during if order == 1 else x), *held])
            if order > 1:
                rows, _ = later(self.c.dynamics, number, x, during, held, order, lambda v: v)
                G = [risen([g, *row], h) for g, row in zip(G, rows, strict=True)]
            x = [v + h * g for v, g in zip(x, G, strict=True)]
        return x

    def bounds(self, rows: Rows, chosen: NDArray[np.intp], weights: Array, a: Near) -> tuple[float, float]:
        """Between what a sum a.d of the parameters' symbols lies, by a sum of rows with weights (T, n): of rows within
        R of 0 `a.d = (a - sum w slopes).z - sum w alpha + sum w R`."""
        w, samples = Near(weights.T), np.arange(len(self.y))
        of_rows = w[:, None] * Near(rows.slopes)  # (n, n + K, T)
        of_each = of_rows.sum()
        own = -a + Near(of_each.value[self.n :].T, _turned(of_each.error[self.n :])).sum()
        begins, ends = np.zeros((2, self.n, len(samples))), np.zeros((2, self.n, len(samples)))
        begins[:, :, self.begin[chosen]] = of_each.value[: self.n], (of_each.error[: self.n]).top
        leads = Near(weights.T) * Near(self.noise.value[:, None], self.noise.error.shaped(self.n, 1))
        ends[:, :, self.begin[chosen] + 1] = leads.value, leads.error.top
        errors = Near(begins[0], Above(begins[1])) - Near(ends[0], Above(ends[1]))
        reach = own.size.sum() + errors.size.sum((0, 1)) + (w.size * rows.slack).sum((0, 1))
        alpha = w * rows.alpha
        total = Near(alpha.value.ravel(), alpha.error.shaped(-1)).sum()
        return (-total).wider(reach).ends

    def after(self, box: Intervals, weights: Array, chosen: NDArray[np.intp]) -> Intervals:
        """The box that weights (2, K, T, n) of some transitions leave of a box; lo > hi where that is nothing."""
        rows, found = self.rows(box, chosen), []
        for k, (lo, hi) in enumerate(box):
            middle, reach = (lo + hi) / 2, (hi - lo) / 2
            a = Near(np.eye(self.k)[k])
            below, above = (self.bounds(rows, chosen, weights[side, k, chosen], a) for side in (0, 1))
            least = middle + reach * Fraction(below[0]) if -1 < below[0] < np.inf else lo  # not where it is NaN
            most = middle + reach * Fraction(above[1]) if -np.inf < above[1] < 1 else hi
            found.append((least, most))
        return tuple(found)

    def turned(self, box: Intervals, weights: Array) -> Intervals | None:
        """Between what each of J axes lies for the consistent parameters in a box, by weights (2, J, T, n); None if
        these show nothing of some."""
        chosen, found = followed(weights), list[tuple[Fraction, Fraction]]()
        if not len(chosen):
            return None
        rows = self.rows(box, chosen)
        for j, (centre, a) in enumerate(self.on_axes(box)):
            ends = [self.bounds(rows, chosen, weights[side, j, chosen], a)[side] for side in (0, 1)]
            least, most = ((centre + Near(np.float64(end))).ends[side] for side, end in enumerate(ends))
            if not np.all(np.isfinite([least, most])):
                return None
            found.append((Fraction(float(least)), Fraction(float(most))))
        return tuple(found)


def followed(weights: Array) -> NDArray[np.intp]:
    """The transitions that have a weight."""
    return np.flatnonzero(np.any(weights != 0, axis=(0, 1, 3)))


def _turned(x: Above) -> Above:
    """The same with its two axes exchanged."""
    return Above(x.v.T, x.k)


def narrowed(flows: Flows, box: Intervals, rounds: Sequence[Round]) -> tuple[Intervals | None, int]:
    """The last of the boxes that rounds state, or None if that has nothing, and the number of rounds that show what
    they state: all, or those before the first that does not."""
    for number, stated in enumerate(rounds):
        chosen = followed(stated.weights)
        if not (len(chosen) and all(map(_holds, stated.box, flows.after(box, stated.weights, chosen)))):
            return box, number
        if any(lo > hi for lo, hi in stated.box):
            return None, len(rounds)
        box = stated.box
    return box, len(rounds)


def _holds(outer: tuple[Fraction, Fraction], inner: tuple[Fraction, Fraction]) -> bool:
    return outer[0] <= inner[0] and inner[1] <= outer[1]


def is_whole_tree(case: Case) -> Failures:
    """`data`: the bytes are a partition of the priors, with rounds for each leaf."""
    data = given(case.c.data)
    leaves = yield from is_whole(data.tree, range(len(data.parameters)), "data, ")
    if leaves != len(data.leaves):
        yield "evidence.data.leaves", f"there must be rounds for each of {leaves} leaves"
    return leaves


def in_ranges(case: Case) -> Failures:
    """`data`: what the measurements leave of the priors lies in the claim's ranges."""
    data, left = given(case.c.data), list[Intervals]()
    flows = Flows(case, data)
    for leaf, (box, rounds) in enumerate(zip(_leaves(data), data.leaves, strict=True)):
        part, shown = narrowed(flows, box, rounds)
        if shown < len(rounds):
            yield f"leaf {leaf}, round {shown}", "the measurements may leave more than the box"
        left += [] if part is None else [part]
    whole: Intervals | None = None
    if left:
        hull = tuple((min(lo for lo, _ in pairs), max(hi for _, hi in pairs)) for pairs in zip(*left, strict=True))
        whole, shown = narrowed(flows, hull, data.rounds)
        if shown < len(data.rounds):
            yield f"round {shown}", "the measurements may leave more than the box"
    if whole is None:
        yield "claim.data", "no parameter is consistent with the measurements: nothing is claimed"
    else:
        ranges = dict(zip(case.c.uncertain, case.c.ranges, strict=True))
        left_of = whole if data.turned is None else flows.turned(whole, data.turned)
        for k, name in enumerate(data.constants):
            if left_of is None or not _holds(ranges[name], left_of[k]):
                yield name, "its range must hold all that the measurements leave of the prior"
    return sum(map(len, data.leaves)) + len(data.rounds)


def _leaves(data: Data) -> Iterator[Intervals]:
    """The parts of the box of priors, in the tree's order; halves meet in the middle."""
    waiting = [data.priors]
    for axis in data.tree:
        box = waiting.pop()
        if axis == LEAF:
            yield box
            continue
        lo, hi = box[axis]
        middle = (lo + hi) / 2
        waiting += [
            tuple(end if k == axis else pair for k, pair in enumerate(box)) for end in ((middle, hi), (lo, middle))
        ]


def examine(tally: Tally, case: Case) -> None:
    tally.hold(OF_DATA, case)


OF_DATA = (("data", is_whole_tree), ("data", in_ranges))
