"""Models of an expression N of the states on boxes, and of N'F, its derivative along the plant's motion.

N'F is the first coefficient of N along the series x + F t, by the rules of power series: no derivative is written down,
so that what is bounded is what the certificate states (FORMAT.md, rule `outer`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from certify.loop.expressions import PowerSeries, Series, Symbol, evaluate
from certify.lyapunov.symbolic import Symbolic
from certify.provers.bounds.arrays import Array, Index
from certify.provers.bounds.taylor import Models, Taylor


@dataclass(frozen=True, slots=True)
class SymbolicModels:
    """N on a batch of boxes, `value` in the n symbols of the box."""

    function: Symbolic
    states: Mapping[Symbol, Taylor]
    value: Taylor

    @property
    def share(self) -> Array:
        """The share of a remainder that each axis (n, B) is charged with: all of them the same."""
        return np.full_like(self.value.g, 1 / self.function.n)

    def along(self, F: Sequence[Taylor], index: Index) -> tuple[Taylor, Array]:
        """N'F on the boxes `index`, where F is given, and `share` (n, B), the same for each axis."""
        n, symbols = self.function.n, len(F[0].g)
        more = np.zeros((symbols - n, len(index)))
        zeros = np.zeros((symbols, symbols, len(index)))
        models = Models(F[0])
        series = PowerSeries(models)
        x = {}
        for (symbol, state), rate in zip(self.states.items(), F, strict=True):
            own = state.at(index)
            x[symbol] = Series(Taylor(own.c, np.concatenate([own.g, more]), zeros, own.r), rate)
        found = evaluate(self.function.expression, x, series)
        if len(found.coefficients) == 1:  # not a state itself, which has both
            series.advance()
        first = found.coefficients[1]
        return models.constant(Fraction(0)) if first is None else first, self.share.take(index, -1)


class SymbolicEnclosure:
    """Models of N over batches of boxes."""

    units = 1

    def __init__(self, function: Symbolic) -> None:
        self.function = function

    def least(self, x: Array, error: Array, level: float) -> Array:
        """A lower bound of N (B,): none is known before there are models."""
        return np.full_like(x[0, 0], -np.inf)

    def __call__(self, x: Array, error: Array) -> SymbolicModels:
        """N for states `x[:, 0] + x[:, 1:] d`, (n, n + 1, B), within the error (n, B)."""
        n, batch = error.shape
        zeros = np.zeros((n, n, batch))
        states = {s: Taylor(x[i, 0], x[i, 1:], zeros, error[i]) for i, s in enumerate(self.function.states)}
        like = next(iter(states.values()))
        return SymbolicModels(self.function, states, evaluate(self.function.expression, states, Models(like)))
