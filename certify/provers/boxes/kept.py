"""Constraints g < 0 on boxes, as models of second order like those of D.

With held inputs g is asked for at every time of the period: at the states that enclose the solution, and with uncertain
quantities anywhere in their ranges (FORMAT.md, keep).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from certify.loop.expressions import Expression, Symbol, evaluate
from certify.loop.plants import System
from certify.provers.bounds import Models, Taylor, upper_bound
from certify.provers.bounds.arrays import Array, Mask, chosen
from certify.provers.bounds.compiled import loops
from certify.provers.bounds.loop import played
from certify.provers.bounds.tape import Recording, Tape, Value, recorded
from certify.provers.boxes.form import FormBound
from certify.provers.boxes.lessening import lessened


class Kept(NamedTuple):
    """A constraint on boxes: `inside` (B,), it holds on all of the box; `outside` (B,), it is violated at the centre;
    `score` (n, B): what each axis adds to its bound."""

    inside: Mask
    outside: Mask
    score: Array


class ConstraintModels:
    """Models of the expressions that a claim keeps negative."""

    def __init__(self, system: System, expressions: Sequence[Expression]) -> None:
        self.system, self.expressions = system, tuple(expressions)
        self.tapes: list[Tape] | None = None  # recorded when they are first played

    def __call__(self, x: Array, error: Array, mid: Array, slopes: Array, wide: Array) -> list[Taylor]:
        """The models at the states and inputs of `loop_models`, whose parameters these are."""
        if self.tapes is None:
            self.tapes = [self._recorded(g) for g in self.expressions]
        return [played(loops(0), tape, self.system, x, error, mid, slopes, wide)[0] for tape in self.tapes]

    def during(self, courses: Iterable[Mapping[Symbol, Taylor]]) -> list[Taylor]:
        """The models at each of these states, with their inputs and quantities."""
        found = []
        for values in courses:
            models, known = Models(next(iter(values.values()))), dict[Expression, Taylor]()
            found += [evaluate(g, values, models, known) for g in self.expressions]
        return found

    def _recorded(self, g: Expression) -> Tape:
        system = self.system
        symbols = [*system.states, *system.inputs, *(symbol for symbol, _ in system.uncertain)]

        def model(values: Sequence[Value], algebra: Recording) -> Value:
            return evaluate(g, dict(zip(symbols, values, strict=True)), algebra).scaled(1.0)  # no input of the tape

        return recorded(len(symbols), model)


def held_back(
    models: Sequence[Taylor], known: int, V: FormBound, centre: Array, radius: Array, outer: float
) -> Iterator[Kept]:
    """Each constraint where V <= outer on the boxes, of which `models` are models; the symbols of uncertain quantities
    are the ones from `known` on."""
    n = len(centre)
    for model in models:
        bound, excess = upper_bound(model)
        index = chosen(~(bound < 0))
        if len(index):
            part = model.at(index)
            gap = V.gap(centre.take(index, -1), radius.take(index, -1), part, outer, 1.0)
            bound[index] = lessened(bound[index], part, gap, n)
        # as for D: at the centre, for the worst values of the uncertain quantities, only errors are left
        doubt = np.abs(model.g[n:known]).sum(0) + np.abs(model.Q[n:, n:]).sum((0, 1)) + model.r
        outside = model.c + np.abs(model.g[known:]).sum(0) - doubt >= 0
        yield Kept(bound < 0, outside, np.where(np.isfinite(excess), excess, 0.0))
