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

    def holds(self, x: Array, e: Array, angles: Sequence[int]) -> Mask:
        """True (B,) where states `x[:, 0] + x[:, 1:] d` within e, (n, n + 1, B) and (n, B), certainly lie in the set;
        `angles` are numbers of states of which 2 pi more is the same place."""


@dataclass(frozen=True, slots=True)
class Sublevel:
    """The set {V <= level}, as places."""

    V: Quadratic
    level: float

    def holds(self, x: Array, e: Array, angles: Sequence[int]) -> Mask:
        """True where V is at most the level."""
        turned = x.copy()
        for i in angles:
            turned[i, 0] -= TURN * np.rint(x[i, 0] / TURN)
        error = 8 * EPS * (np.abs(x).sum(1) + TURN) + TINY
        states = _models(turned, e, error)
        rows = Models(states[0]).combined(self.V.P, states)
        V = states[0] * rows[0]
        for state, row in zip(states[1:], rows[1:], strict=True):
            V = V + state * row
        there: Mask = upper_bound(V.shifted(-self.level))[0] < -_ENDS * self.level
        return there


@dataclass(frozen=True, slots=True)
class Region:
    """The set where each of these `expressions` in `states` is at most 0."""

    expressions: tuple[Expression, ...]
    states: tuple[Symbol, ...]

    def holds(self, x: Array, e: Array, angles: Sequence[int]) -> Mask:
        """True where all are; with angles they are periodic."""
        there = np.ones(e.shape[1], dtype=bool)
        if not len(there):
            return there
        models = _models(x, e, 8 * EPS * np.abs(x).sum(1) + TINY)
        values, known = dict(zip(self.states, models, strict=True)), dict[Expression, Taylor]()
        for expression in self.expressions:
            v = evaluate(expression, values, Models(models[0]), known)
            there &= upper_bound(v)[0] < -_ENDS * (np.abs(v.c) + v.radius())
        return there


def _models(x: Array, e: Array, error: Array) -> list[Taylor]:
    """The states as models in the coordinates of the box and their errors."""
    n = len(e)
    g = np.concatenate([x[:, 1:], np.eye(n)[:, :, None] * e], 1)
    zeros = np.zeros((2 * n, 2 * n, x.shape[2]))
    return [Taylor(x[i, 0], g[i], zeros, error[i]) for i in range(n)]
