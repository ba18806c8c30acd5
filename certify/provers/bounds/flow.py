"""The plant's motion in a sampling period, while its input is held, in Taylor models on boxes.

G = (phi(h) - x)/h, the mean of f over the period, is wanted for every period in a range and whatever the uncertain
quantities do in it. The series in time is taken along x, but for its last coefficient, which is the remainder of
Taylor's formula and has to hold all along the solution: it is taken along an enclosure of that, found beforehand by the
argument that a solution cannot be the first to leave what it would need longer than a period to leave (Moore 1966;
Nedialkov, Jackson, Corliss 1999). A quantity that changes in the period is another number at each place where it
stands, so that only the first coefficient, in which it stands for its mean, may know it by a symbol.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import NamedTuple

import numpy as np

from certify.loop.expressions import Expression, Symbol, evaluate, solution_series
from certify.loop.plants.system import Interval
from certify.provers.bounds.arrays import Array, Mask, chosen
from certify.provers.bounds.taylor import EPS, TINY, Models, Taylor

_QUARTERS = 4  # of a period, for constraints
_ATTEMPTS, _WIDER = 8, 1.25  # at the enclosure of the solution
Values = Mapping[Symbol, Taylor]


class Mean(NamedTuple):
    """`G`: models of the mean of f over the period, a component each; `down` and `up` (n, B): by how much the states
    fall and rise at most from its beginning to any time of the longest, at least 0; `exists` (B,): the solution does,
    and these hold for it; `during`: for each quarter of the period all values at any time of it, where it exists, with
    a symbol more for that time, the last of all; none if nobody asks."""

    G: list[Taylor]
    down: Array
    up: Array
    exists: Mask
    during: Sequence[Values]


class Flow:
    """The mean of f over a period with the input held.

    Parameters
    ----------
    dynamics : f, in the order of the states.
    sample : the shortest and the longest period, in units of time.
    order : order of the series in time, at least 1.
    throughout : True if values at any time of the period are wanted.
    """

    def __init__(self, dynamics: Sequence[Expression], sample: Interval, order: int, throughout: bool = False) -> None:
        self.dynamics, self.order, self.throughout = dynamics, order, throughout
        self.shortest, self.longest = sample
        self.symbols = int(self.shortest < self.longest)  # the period's own, the last of all
        self.most = math.nextafter(float(self.longest), math.inf)

    @np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
    def __call__(self, states: Values, inputs: Values, quantities: Values, first: int) -> Mean:
        """G from states, held inputs and uncertain quantities; those have symbols of their own from `first` on."""
        like = next(iter(states.values()))
        models = Models(like)
        alike = slice(first, first + len(quantities))
        held = {**inputs, **{symbol: _without_symbols(model) for symbol, model in quantities.items()}}
        now = self._rate({**states, **inputs, **quantities}, models)
        around, exists = self._enclose(states, held, now)
        along = solution_series(self.dynamics, around, held, models, self.order)
        if self.order == 1:  # the first coefficient is the remainder
            rows = [[model] for model in self._rate({**around, **inputs, **quantities}, models)]
        elif self.order == 2:
            rows = [[model, row[1]] for model, row in zip(now, along, strict=True)]
        else:
            inner = solution_series(self.dynamics, states, held, models, self.order - 1)
            rows = [[model, *row[1:], last[-1]] for model, row, last in zip(now, inner, along, strict=True)]
        down, up = self._moved(now, along)
        rows = [[_mean(row[0], alike), *row[1:]] for row in rows]
        during = self._during(states, held, rows) if self.throughout else ()
        return Mean([_risen(row, self.times_period) for row in rows], down, up, exists, during)

    def _during(self, states: Values, held: Values, rows: Sequence[Sequence[Taylor]]) -> list[Values]:
        """x + s G for any s in each quarter of the longest period, and what is held."""
        wide = {symbol: _with_a_symbol(model) for symbol, model in {**states, **held}.items()}
        wide_rows, found = [list(map(_with_a_symbol, row)) for row in rows], list[Values]()
        like = next(iter(wide.values()))
        half, none = np.full_like(like.c, 0.5 * self.most / _QUARTERS), np.zeros_like(like.Q)
        for k in range(_QUARTERS):
            g = np.zeros_like(like.g)
            g[-1] = half
            s = Taylor((2 * k + 1) * half, g, none, 2 * EPS * self.most + 0 * half)
            moved = [s * _risen(row, s.__mul__) for row in wide_rows]
            found.append(wide | {symbol: wide[symbol] + way for symbol, way in zip(states, moved, strict=True)})
        return found

    def _moved(self, now: Sequence[Taylor], along: Sequence[Sequence[Taylor]]) -> tuple[Array, Array]:
        """By how much the states fall and rise at most: as fast as f along the solution or, where its order is at least
        2, as fast as f at the beginning and then as x_2 along it says."""
        first, second = (_ends([row[k] for row in along]) for k in (0, min(1, self.order - 1)))
        fall, rise = (self.most * np.maximum(v, 0.0) for v in first)
        if self.order == 1:
            return fall, rise
        start = _ends(now)
        bent = (_highest(a, b, self.most) for a, b in zip(start, second, strict=True))
        down, up = (np.minimum(a, b) for a, b in zip((fall, rise), bent, strict=True))
        return down, up

    def _rate(self, values: Values, models: Models) -> list[Taylor]:
        known: dict[Expression, Taylor] = {}
        return [evaluate(expression, values, models, known) for expression in self.dynamics]

    def _enclose(self, states: Values, held: Values, now: Sequence[Taylor]) -> tuple[dict[Symbol, Taylor], Mask]:
        """Models of all states up to the end of the period, NaN where there are none, and where (B,) there are."""
        move = self._most(now)
        way = _WIDER * move
        left = np.arange(move.shape[2])
        for attempt in range(_ATTEMPTS):
            if attempt:
                way[..., left] = _WIDER * move.take(left, -1)
            around = {s: _between(v.at(left), *way[:, i].take(left, -1)) for i, (s, v) in enumerate(states.items())}
            values = {**around, **{symbol: model.at(left) for symbol, model in held.items()}}
            move[..., left] = self._most(self._rate(values, Models(next(iter(around.values())))))
            wrong = ~(move.take(left, -1) < way.take(left, -1))
            left = left[chosen(np.asarray(wrong.any((0, 1))))]
            if not len(left):
                break
        exists = np.ones(move.shape[2], dtype=np.bool_)
        exists[left], move[..., left] = False, np.nan
        return {s: _between(v, *move[:, i]) for i, (s, v) in enumerate(states.items())}, exists

    def _most(self, rate: Sequence[Taylor]) -> Array:
        """Bounds (2, n, B), above 0, of the moves down and up at this rate."""
        moves: Array = self.most * np.maximum(_ends(rate), 0.0) * (1 + EPS) + TINY
        return moves

    def times_period(self, model: Taylor) -> Taylor:
        """h v."""
        if not self.symbols:
            return model.scaled(float(self.longest))
        middle = float((self.shortest + self.longest) / 2)
        reach = float((self.longest - self.shortest) / 2)
        g = np.zeros_like(model.g)
        g[-1] = reach
        rounding = np.full_like(model.c, EPS * (middle + reach) + TINY)
        return model * Taylor(np.full_like(model.c, middle), g, np.zeros_like(model.Q), rounding)


def _risen(row: Sequence[Taylor], times: Callable[[Taylor], Taylor]) -> Taylor:
    """`x_1 + h x_2 + ... + h^(r-1) x_r`, given the product with h."""
    return reduce(lambda rising, model: model + times(rising), reversed(row))


def _with_a_symbol(model: Taylor) -> Taylor:
    """The same among one symbol more, which does not matter to it."""
    return Taylor(model.c, np.pad(model.g, ((0, 1), (0, 0))), np.pad(model.Q, ((0, 1), (0, 1), (0, 0))), model.r)


def _ends(models: Sequence[Taylor]) -> tuple[Array, Array]:
    """Bounds of -v and of v, (n, B) each."""
    c, reach = np.stack([model.c for model in models]), np.stack([model.radius() for model in models])
    wider = EPS * (np.abs(c) + reach)
    return reach - c + wider, reach + c + wider


def _highest(a: Array, b: Array, h: float) -> Array:
    """The largest of `a t + b t^2` over 0 <= t <= h, a little above."""
    with np.errstate(all="ignore"):
        peak = np.where((a > 0) & (b < 0) & (a < -2 * h * b), a * a / (-4 * b), h * (a + h * b))
    return np.where(np.isnan(peak), np.inf, np.maximum(peak, 0.0)) * (1 + 8 * EPS)


def _between(model: Taylor, down: Array, up: Array) -> Taylor:
    """Numbers from `model - down` to `model + up`."""
    middle, reach = 0.5 * (up - down), 0.5 * (up + down)
    rounding = EPS * (np.abs(model.c) + np.abs(middle))
    return Taylor(model.c + middle, model.g, model.Q, (model.r + reach) * (1 + EPS) + rounding)


def _without_symbols(model: Taylor) -> Taylor:
    """The range as a remainder, in which nothing is known of one place by another."""
    return Taylor(model.c, np.zeros_like(model.g), np.zeros_like(model.Q), model.radius())


def _mean(model: Taylor, alike: slice) -> Taylor:
    """The mean over the period, in which the symbols `alike` change and stand for their means from here on.

    What is linear in them has the mean of the same form; a product of two is any number of its range.
    """
    if alike.start == alike.stop:
        return model
    Q = model.Q.copy()
    products = np.abs(Q[alike, alike]).sum((0, 1))
    Q[alike, alike] = 0.0
    return Taylor(model.c, model.g, Q, (model.r + products) * (1 + EPS))
