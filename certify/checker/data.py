"""The rule for data: constant parameters with which measurements are consistent lie in the ranges of the claim.

In a box of the parameters the flow over each measured transition is a model in the parameters and in the errors of what
was measured at its beginning. So a transition says that n affine functions of parameters and errors are small; sums of
these with multipliers bound each parameter, whatever the multipliers are (weak duality). The smaller box that follows
makes better models: rounds do this one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from .case import Case, Failures
from .document import Array, Data, Intervals
from .expression import evaluate
from .flow import enclosed, later
from .near import Above, Near, all_near, combined, near, size
from .taylor import Taylor, affine, constants, pairs

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
        self.symbols = self.n + self.k
        self.noise = all_near(data.noise)
        begins = np.concatenate([np.full(len(inputs), run) for run, (_, inputs) in enumerate(data.runs)])
        self.begin = np.arange(len(begins)) + begins  # the number of the measurement at which a transition begins
        self.y = np.concatenate([states for states, _ in data.runs])
        self.u = np.concatenate([inputs for _, inputs in data.runs])

    def rows(self, box: Intervals, chosen: Array) -> Rows:
        """What some transitions say, by their numbers, of parameters in a box."""
        found = [self._rows(box, chosen[first : first + self._batch]) for first in range(0, len(chosen), self._batch)]
        alphas, slopes, slacks = zip(*found, strict=True)
        return Rows(
            Near(*(np.concatenate(part, axis=1) for part in zip(*alphas, strict=True))),
            np.concatenate(slopes, axis=-1),
            Above(np.concatenate(slacks, axis=1)),
        )

    @property
    def _batch(self) -> int:
        values = self.c.dynamics.size * (self.data.order + 1)
        return int(max(1, min(256, _BATCH_NUMBERS // (self.symbols**2 * (values + 4)))))

    def _rows(self, box: Intervals, chosen: Array) -> tuple[tuple[Array, Array], Array, Array]:
        begin, (i, j) = self.begin[chosen], pairs(self.symbols)
        alphas, slopes, slacks = [], [], []
        for s, model in enumerate(self.end(box, chosen)):
            squares, value = Near(model.q[i == j]), self.measured(s, begin + 1)
            centre, wrong = combined((1.0, Near(model.c)), (0.5, squares.sum()), (-1.0, value))
            alphas.append((centre, (wrong + np.zeros_like(centre)).top))
            slopes.append(model.g)
            slacks.append((size(squares.value).sum() * 0.5 + size(model.q[i != j]).sum() + model.r).top)
        values, errors = (np.stack(part) for part in zip(*alphas, strict=True))
        return (values, Above(errors)), np.stack(slopes), np.stack(slacks)

    def measured(self, state: int, number: Array) -> Near:
        """Measurements of a state, in deviations."""
        y, origin = self.y[number, state], self.data.origin[state]
        return all_near(Fraction(v) - origin for v in y.tolist()) if origin else Near(y)

    def end(self, box: Intervals, chosen: Array) -> list[Taylor]:
        """Models of the states at the ends of transitions. Parameters are constant and keep their symbols throughout;
        other quantities may be another number of their range at each place and time."""
        batch = len(chosen)
        x = [self._symbol(self.measured(s, self.begin[chosen]), self.noise[s], s, batch) for s in range(self.n)]
        inputs = [affine(u, np.zeros((self.symbols, batch))) for u in self.u[chosen].T]
        own = {name: (pair, self.n + k) for k, (name, pair) in enumerate(zip(self.data.parameters, box, strict=True))}
        ranges = [
            self._number(*own.get(name, (pair, None)), batch)
            for name, pair in zip(self.c.uncertain, self.c.ranges, strict=True)
        ]
        return self._after(x, [*inputs, *ranges], batch)

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
        h = self._number((lo, hi), None, batch)
        longest = float(near(hi).ends[1])
        for _ in range(pieces):
            during, _ = enclosed(lambda v: evaluate(self.c.dynamics, number, [*v, *held]), x, longest)
            G = evaluate(self.c.dynamics, number, [*(during if order == 1 else x), *held])
            if order > 1:
                rising = later(self.c.dynamics, number, x, during, held, h, order, lambda v: v)
                G = [g + h * more for g, more in zip(G, rising, strict=True)]
            x = [v + h * g for v, g in zip(x, G, strict=True)]
        return x

    def bounds(self, rows: Rows, chosen: Array, weights: Array, k: int) -> tuple[float, float]:
        """Between what the symbol of parameter k lies, by a sum of rows with weights (T, n): of rows within R of 0
        `e_k.z = (e_k - sum w slopes).z - sum w alpha + sum w R`."""
        w, samples = Near(weights.T), np.arange(len(self.y))
        of_rows = w[:, None] * Near(rows.slopes)  # (n, n + K, T)
        of_each = of_rows.sum()
        own = Near(-np.eye(self.k)[k]) + Near(of_each.value[self.n :].T, _turned(of_each.error[self.n :])).sum()
        begins, ends = np.zeros((2, self.n, len(samples))), np.zeros((2, self.n, len(samples)))
        begins[:, :, self.begin[chosen]] = of_each.value[: self.n], (of_each.error[: self.n]).top
        leads = Near(weights.T) * Near(self.noise.value[:, None], self.noise.error.shaped(self.n, 1))
        ends[:, :, self.begin[chosen] + 1] = leads.value, leads.error.top
        errors = Near(begins[0], Above(begins[1])) - Near(ends[0], Above(ends[1]))
        reach = own.size.sum() + errors.size.sum((0, 1)) + (w.size * rows.slack).sum((0, 1))
        alpha = w * rows.alpha
        total = Near(alpha.value.ravel(), alpha.error.shaped(-1)).sum()
        return (-total).wider(reach).ends


def _turned(x: Above) -> Above:
    """The same with its two axes exchanged."""
    return Above(x.v.T, x.k)


def in_box(case: Case) -> Failures:
    """`data`: the box that the measurements leave of the priors lies in the claim's ranges."""
    data = case.data
    flows, box, count = Flows(case, data), list(data.priors), 0
    for number, multipliers in enumerate(data.rounds):
        chosen = np.flatnonzero(np.any(multipliers != 0, axis=(0, 1, 3)))
        rows = flows.rows(tuple(box), chosen)
        for k, ends in enumerate(multipliers[:, :, chosen].swapaxes(0, 1)):
            lo, hi = box[k]
            middle, reach = (lo + hi) / 2, (hi - lo) / 2
            least, most = flows.bounds(rows, chosen, ends[0], k)[0], flows.bounds(rows, chosen, ends[1], k)[1]
            lo = middle + reach * Fraction(least) if least > -1 else lo  # not where it is NaN
            hi = middle + reach * Fraction(most) if most < 1 else hi
            if lo > hi:
                yield f"round {number}", f"no {data.parameters[k]} is consistent with the measurements"
            box[k], count = (lo, hi), count + 2
    ranges = dict(zip(case.c.uncertain, case.c.ranges, strict=True))
    for name, (lo, hi) in zip(data.parameters, box, strict=True):
        if not (ranges[name][0] <= lo and hi <= ranges[name][1]):
            yield name, "its range must hold all that the measurements are shown to leave of the prior"
    return count


OF_DATA = (("data", in_box),)
