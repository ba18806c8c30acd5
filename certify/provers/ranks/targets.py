"""Targets of ranks: the sets that trajectories are to reach, as the search sees them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from certify.loop.expressions import Expression, Symbol, evaluate
from certify.lyapunov.function import Quadratic
from certify.provers.bounds import Models, Taylor, upper_bound
from certify.provers.bounds.arrays import Array, Mask
from certify.provers.bounds.taylor import EPS, TINY

TURN = 2 * np.pi
_ENDS = 1e-9  # relative distance kept from a target's boundary, beyond all that two programs' rounding may differ by


class Target(Protocol):
    """A set of states."""

    def holds(self, x: Array, angles: Sequence[int]) -> Mask:
        """True (B,) where states `x[:, 0] + x[:, 1:] d`, (n, N + 1, B), certainly lie in the set; `angles` are numbers
        of states that are angles: x and x + 2 pi are the same place."""

    def misses(self, x: Array, angles: Sequence[int]) -> Mask:
        """True (B,) where none of these states lies in the set."""


@dataclass(frozen=True, slots=True)
class Sublevel:
    """The set {V <= level}, as places."""

    V: Quadratic
    level: float

    def holds(self, x: Array, angles: Sequence[int]) -> Mask:
        """True where V is at most the level."""
        there: Mask = upper_bound(self._beyond(x, angles))[0] < -_ENDS * self.level
        return there

    def misses(self, x: Array, angles: Sequence[int]) -> Mask:
        """True where V is above the level."""
        away: Mask = upper_bound(self._beyond(x, angles).scaled(-1.0))[0] < 0
        return away

    def _beyond(self, x: Array, angles: Sequence[int]) -> Taylor:
        """V - level of the places that are nearest to 0."""
        turned = x.copy()
        for i in angles:
            turned[i, 0] -= TURN * np.rint(x[i, 0] / TURN)
        error = 8 * EPS * (np.abs(x).sum(1) + TURN) + TINY
        states = _models(turned, error)
        rows = Models(states[0]).combined(self.V.P, states)
        V = states[0] * rows[0]
        for state, row in zip(states[1:], rows[1:], strict=True):
            V = V + state * row
        return V.shifted(-self.level)


@dataclass(frozen=True, slots=True)
class Region:
    """The set where each of these `expressions` in `states` is at most 0."""

    expressions: tuple[Expression, ...]
    states: tuple[Symbol, ...]

    def holds(self, x: Array, angles: Sequence[int]) -> Mask:
        """True where all are; with angles they are periodic."""
        there = np.ones(x.shape[2], dtype=bool)
        for v in self._values(x):
            there &= upper_bound(v)[0] < -_ENDS * (np.abs(v.c) + v.radius())
        return there

    def misses(self, x: Array, angles: Sequence[int]) -> Mask:
        """True where one is positive."""
        away = np.zeros(x.shape[2], dtype=bool)
        for v in self._values(x):
            away |= upper_bound(v.scaled(-1.0))[0] < 0
        return away

    def _values(self, x: Array) -> list[Taylor]:
        """The expressions; none of no states."""
        if not x.shape[2]:
            return []
        models = _models(x, 8 * EPS * np.abs(x).sum(1) + TINY)
        values, known = dict(zip(self.states, models, strict=True)), dict[Expression, Taylor]()
        return [evaluate(expression, values, Models(models[0]), known) for expression in self.expressions]


@dataclass(frozen=True, slots=True)
class Nothing:
    """The empty set, the target of boxes that are never left."""

    def holds(self, x: Array, angles: Sequence[int]) -> Mask:
        """False."""
        return np.zeros(x.shape[2], dtype=bool)

    def misses(self, x: Array, angles: Sequence[int]) -> Mask:
        """True."""
        return np.ones(x.shape[2], dtype=bool)


def _models(x: Array, error: Array) -> list[Taylor]:
    """The states as models in these symbols, within an error of each."""
    N = x.shape[1] - 1
    zeros = np.zeros((N, N, x.shape[2]))
    return [Taylor(row[0], row[1:], zeros, error[i]) for i, row in enumerate(x)]
