"""Transitions in models: what each says of parameters in a box and of the errors of what was measured.

The flow over a transition, from a measured state within its noise, is a model of second order in parameters and errors
(`certify.provers.bounds`). Less the measurement at its end it is 0: n functions that are affine but for a slack.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.loop.expressions import Expression, Symbol, evaluate
from certify.loop.plants import Measurements, System
from certify.loop.plants.system import Interval
from certify.provers.bounds import Flow, Models, Taylor
from certify.provers.bounds.arrays import Array
from certify.provers.bounds.taylor import EPS, TINY

_BATCH = 2**21  # numbers in a model
Box = Mapping[str, Interval]


@dataclass(frozen=True)
class Rows:
    """Functions `alpha + slopes.(errors, parameters) - noise.(errors of the measured end)` of symbols in [-1, 1], each
    within `slack` of 0, of T transitions: alpha and slack (n, T), slopes (n, n + K, T). NaN where there is no
    enclosure of the flow."""

    alpha: Array
    slopes: Array
    slack: Array

    def at(self, chosen: NDArray[np.intp]) -> Rows:
        """The rows of some transitions."""
        return Rows(self.alpha[:, chosen], self.slopes[..., chosen], self.slack[:, chosen])

    @property
    def exist(self) -> NDArray[np.bool_]:
        """True for each transition with finite numbers, (T,)."""
        found: NDArray[np.bool_] = np.isfinite(self.alpha + self.slack + self.slopes.sum(1)).all(0)
        return found


class Flows:
    """The plant along its measured transitions: `order` of the series in time, in so many `pieces` of each."""

    def __init__(self, system: System, measurements: Measurements, order: int, pieces: int) -> None:
        self.system, self.order, self.pieces = system, order, pieces
        self.dynamics = system.uncertain_dynamics()
        self.names, self.axes = tuple(measurements.priors), {axis.name: axis for axis in measurements.axes}
        self.symbols = system.n + len(self.names)
        at = system.exact_x_eq()
        states = [_less(run.states, at) for run in measurements.runs]
        self.begins = np.concatenate([x[:-1] for x in states]).T
        self.ends = np.concatenate([x[1:] for x in states]).T
        self.inputs = np.concatenate([run.inputs for run in measurements.runs]).T
        self.noise = np.array([float(w) for w in measurements.noise])
        self.flow = None
        if measurements.period is not None:
            shortest, longest = (end / pieces for end in measurements.period)
            self.flow = Flow(self.dynamics, (shortest, longest), order)
            self.symbols += self.flow.symbols

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def rows(self, box: Box, chosen: NDArray[np.intp]) -> Rows:
        """The rows of some transitions, by their numbers, for parameters in a box."""
        size = max(1, _BATCH // self.symbols**2 // (8 * self.order))
        parts = [self._rows(box, chosen[i : i + size]) for i in range(0, len(chosen), size)]
        return Rows(*(np.concatenate(each, axis=-1) for each in zip(*parts, strict=True)))

    def _rows(self, box: Box, chosen: NDArray[np.intp]) -> tuple[Array, Array, Array]:
        own = self.system.n + len(self.names)
        ends, y = self._ends(box, chosen), self.ends[:, chosen]
        found = list[tuple[Array, Array, Array]]()
        for model, at in zip(ends, y, strict=True):
            squares = np.einsum("iib->ib", model.Q)
            mixed = np.abs(model.Q + model.Q.swapaxes(0, 1)).sum((0, 1)) / 2 - np.abs(squares).sum(0)
            slack = np.abs(squares).sum(0) / 2 + mixed + model.r + np.abs(model.g[own:]).sum(0)
            centre = model.c + squares.sum(0) / 2 - at
            size = np.abs(model.c) + np.abs(at) + np.abs(squares).sum(0) + np.abs(model.g).sum(0)
            found.append((centre, model.g[:own], slack + 64 * EPS * size + TINY))
        alpha, slopes, slack = (np.stack(part) for part in zip(*found, strict=True))
        return alpha, slopes, slack

    def _ends(self, box: Box, chosen: NDArray[np.intp]) -> Sequence[Taylor]:
        """Models of the states at the ends of transitions."""
        system, batch = self.system, len(chosen)
        x = {s: self._number(self.begins[i, chosen], self.noise[i], i) for i, s in enumerate(system.states)}
        held = {s: self._number(self.inputs[j, chosen], 0.0, None) for j, s in enumerate(system.inputs)}
        others = dict[Symbol, Taylor]()
        along = self.on_axes(box)
        for symbol, pair in system.uncertain:
            if symbol.name in along:
                held[symbol] = self._constant(*along[symbol.name], batch)
                continue
            known = symbol.name in self.names
            lo, hi = box[symbol.name] if known else pair
            middle, reach = float((lo + hi) / 2), float((hi - lo) / 2)
            place = system.n + self.names.index(symbol.name) if known else None
            (held if known else others)[symbol] = self._number(np.full(batch, middle), reach, place)
        return self._after(x, held, others)

    def on_axes(self, box: Box) -> dict[str, tuple[float, Array]]:
        """The value of each axis in the middle of a box, and its slopes by the parameters' symbols (K,)."""
        ends = list(box.values())
        return {
            axis.name: (
                float(axis.at + sum(by * (lo + hi) / 2 for by, (lo, hi) in zip(axis.by, ends, strict=True))),
                np.array([float(by * (hi - lo) / 2) for by, (lo, hi) in zip(axis.by, ends, strict=True)]),
            )
            for axis in self.axes.values()
        }

    def _constant(self, centre: float, slopes: Array, batch: int) -> Taylor:
        """A number that has the parameters' symbols."""
        N = self.symbols
        g, r = np.zeros((N, batch)), np.full(batch, 4 * EPS * (abs(centre) + np.abs(slopes).sum()) + TINY)
        g[self.system.n : self.system.n + len(slopes)] = slopes[:, None]
        return Taylor(np.full(batch, centre), g, np.zeros((N, N, batch)), r)

    def _number(self, centre: Array, reach: float, symbol: int | None) -> Taylor:
        """A number within `reach` of a centre (B,), with a symbol of its own or without."""
        batch, N = len(centre), self.symbols
        g, r = np.zeros((N, batch)), 2 * EPS * (np.abs(centre) + reach) + TINY
        if symbol is None:
            r = r + reach
        else:
            g[symbol] = reach
        return Taylor(centre + 0.0, g, np.zeros((N, N, batch)), r)

    def _after(
        self, x: dict[Symbol, Taylor], held: Mapping[Symbol, Taylor], others: Mapping[Symbol, Taylor]
    ) -> list[Taylor]:
        models = Models(next(iter(x.values())))
        if self.flow is None:
            known: dict[Expression, Taylor] = {}
            return [evaluate(e, {**x, **held, **others}, models, known) for e in self.dynamics]
        for _ in range(self.pieces):
            mean = self.flow(x, held, others, self.symbols)
            rises = [self.flow.times_period(G) for G in mean.G]
            lost = np.where(mean.exists, 0.0, np.nan)
            x = {
                s: Taylor(after.c, after.g, after.Q, after.r + lost)
                for s, after in ((s, v + rise) for (s, v), rise in zip(x.items(), rises, strict=True))
            }
        return list(x.values())


def _less(values: Array, at: Sequence[Fraction]) -> Array:
    """Measured values (T, n) in deviations from a point, each rounded once, for which models allow."""
    columns = [
        [float(Fraction(v) - q) for v in column] if q else column
        for column, q in zip(values.T.tolist(), at, strict=True)
    ]
    return np.array(columns).T
