"""Models of a step on a ball around the origin, in cells of the ranges: G, by which V's increment is decided.

G is F itself in continuous time, F - x in discrete time, and where the input is held over h the mean of f over the
period: `x_1 + h x_2 + ... + h^(r-1) x_r` by the power series of the solution, whose last coefficient is taken at states
that are near enough to x for the whole period. A quantity may change within it, and leave its cell: only in x_1, the
mean of f at x, is it one number (checker/FORMAT.md, flow).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Symbol, cornered, evaluate, solution_series
from certify.loop.plants.system import Interval
from certify.provers.ball.kinks import Cone
from certify.provers.ball.models import Driven, Models, Paths, Spread, of_all, tilts_of_all
from certify.provers.ball.ranged import RangedJet, RangedJets

Array = NDArray[np.float64]
Cell = tuple[Interval, ...]
_WIDER = 1 + 1e-9  # share of how far a constraint moves on a ball, for the checker's rounding
_LEAST = 1e-300  # such a bound, above rates that are exactly 0 in floats, which a loop at its rest may have
_ATTEMPTS, _FURTHER = 4, 1.25  # at how far the states move in a period, each from the rates of the last


@dataclass(frozen=True, slots=True)
class Steps:
    """The closed loop's map over a step.

    Parameters
    ----------
    known : the loop at the origin.
    at_rest : the loop rests there for certain, so that the models start from 0 exactly.
    order : r, of the series where inputs are held; with 1 G is f at states of the period.
    dynamics : f in states, inputs and uncertain quantities.
    """

    known: Paths
    at_rest: bool
    order: int
    dynamics: tuple[Expression, ...]

    @property
    def longest(self) -> float:
        """h, the length of the step in V's increment: 0 in continuous time."""
        return self.known.loop.step

    @property
    def is_plain(self) -> bool:
        """True if G is F, nothing is uncertain, and nothing has a corner, where gradients are."""
        return not self.longest and not self.known.loop.system.ranges and not any(cornered(*self.dynamics))

    def models(self, J: Array, cells: Sequence[Cell], reach: Array) -> list[Models]:
        """The models of G on the ball x = J d for each cell; no state of interest there exceeds `reach`, (n,)."""
        return self.models_on(J[None], cells, reach[None])[0]

    def models_on(
        self, balls: Array, cells: Sequence[Cell], reach: Array, cone: Cone | None = None
    ) -> list[list[Models]]:
        """The same on each of several balls, (N, n, k), `reach` being (N, n); if one has no finite models, none has.
        With a cone of d relus and clips have kinks."""
        if self.is_plain and cone is None:
            return [[models] for models in self.known.models_on(balls)]
        driven, sample = [self.known.driven(J, cone) for J in balls], self.known.loop.system.sample
        walks = [_Walk(self, balls, driven, cell) for cell in cells]
        # the terms after x_1 hold for the whole ranges, and so are the same for every cell
        later = None if sample is None else _later(walks[0], self.order, sample, reach)
        in_cells = [self._in_cell(walk, driven, later) for walk in walks]
        return [list(of_ball) for of_ball in zip(*in_cells, strict=True)]

    def largest(
        self, balls: Array, constraints: Sequence[Expression], cells: Sequence[Cell], cone: Cone | None = None
    ) -> tuple[Array, Array] | None:
        """For each expression g its value (K,) at the middle, and by how much it is larger anywhere on each of several
        balls (N, n, k), in any cell, (N, K); where inputs are held, at any time of a period, in which quantities may be
        anywhere. None where one has no finite model."""
        driven, sample = [self.known.driven(J, cone) for J in balls], self.known.loop.system.sample
        walks = [_Walk(self, balls, driven, cell) for cell in cells]
        if sample is None:
            found = [walk.of(constraints) for walk in walks]
        else:
            moved = _within_a_period(walks[0], float(sample[1]))
            found = [] if moved is None else [walks[0].of(constraints, moved[0], fixed=False)]
        if not found:
            return None
        middle = np.array([g.c for g in found[0]])
        ends = np.array([[g.c + _WIDER * (g.away + g.radius) for g in of_cell] for of_cell in found]).max(0).T
        return (middle, ends - middle) if np.all(np.isfinite(ends)) else None

    def _in_cell(self, walk: _Walk, driven: Sequence[Driven], later: _Later | None) -> list[Models]:
        """On each ball."""
        system, stays = self.known.loop.system, np.ones(len(driven), bool)
        G = [walk.still(v) for v in walk.rates(None if later is None or self.order > 1 else later.near)]
        if later is not None:
            G, stays = [v + more for v, more in zip(G, later.terms, strict=True)], later.stays
        if system.time == "discrete":
            G = [v + x.scaled(-1.0) for v, x in zip(G, walk.states(), strict=True)]
        moves, turns, error, slack = (
            np.array([getattr(v, part) for v in G]) for part in ("moves", "turns", "error", "slack")
        )
        return [
            one.models(
                G, b, Spread(moves.T, np.swapaxes(turns[:, :, b], 0, 1), error[:, b], slack[:, b]), bool(stays[b])
            )
            for b, one in enumerate(driven)
        ]


def steps_of(known: Paths, at_rest: bool, order: int) -> Steps:
    """The steps of a loop."""
    loop = known.loop
    return Steps(known, at_rest, order, loop.system.uncertain_dynamics() if loop.system.ranges else loop.dynamics)


class _Walk:
    """The equations on balls (N, n, k), in a cell."""

    def __init__(self, steps: Steps, balls: Array, driven: Sequence[Driven], cell: Cell) -> None:
        self.steps, self.balls, self.cell = steps, balls, cell
        sample = self.loop.system.sample
        self.varies = sample is not None and sample[0] < sample[1]
        models, errors = of_all(driven)
        self.algebra = RangedJets(len(balls), balls.shape[2], len(cell) + self.varies, errors, tilts_of_all(driven))
        u = enumerate(steps.known.u)
        self._inputs = [self.algebra.input(j, float(value), *models[j]) for j, value in u]

    @property
    def loop(self) -> ClosedLoop:
        return self.steps.known.loop

    def states(self, near: tuple[Array, Array] | None = None) -> list[RangedJet]:
        """x, or a state as `near` to it: v(0) and gradients within these, (n, N) each."""
        rows = np.swapaxes(self.balls, 0, 1)
        if near is None:
            return [self.algebra.state(0.0, of_state) for of_state in rows]
        return [self.algebra.state(0.0, *of_state) for of_state in zip(rows, *near, strict=True)]

    def rates(self, near: tuple[Array, Array] | None = None, fixed: bool = True) -> list[RangedJet]:
        """f at these states; the quantities are one point of the cell, or anywhere at every place if not `fixed`."""
        shared: dict[Expression, RangedJet] = {}
        values = self._states_by_name(near) | self._held_by_name(fixed)
        return [evaluate(e, values, self.algebra, shared) for e in self.steps.dynamics]

    def of(
        self, expressions: Sequence[Expression], near: tuple[Array, Array] | None = None, fixed: bool = True
    ) -> list[RangedJet]:
        """Expressions at these states, as `rates` has them."""
        shared: dict[Expression, RangedJet] = {}
        values = self._states_by_name(near) | self._held_by_name(fixed)
        return [evaluate(g, values, self.algebra, shared) for g in expressions]

    def series(self, order: int, near: tuple[Array, Array] | None = None) -> list[list[RangedJet]]:
        """x_1 to x_order, from these states, for each component."""
        states, held = self._states_by_name(near), self._held_by_name(False)
        return solution_series(self.steps.dynamics, states, held, self.algebra, order)

    def still(self, v: RangedJet) -> RangedJet:
        """At rest what vanishes at d = 0 does so exactly."""
        if not self.steps.at_rest:
            return v
        return replace(v, c=0.0, moves=np.zeros_like(v.moves), error=np.zeros_like(v.error))

    def _states_by_name(self, near: tuple[Array, Array] | None) -> dict[Symbol, RangedJet]:
        return dict(zip(self.loop.system.states, self.states(near), strict=True))

    def _held_by_name(self, fixed: bool) -> dict[Symbol, RangedJet]:
        system = self.loop.system
        held = dict(zip(system.inputs, self._inputs, strict=True))
        for j, ((symbol, whole), part) in enumerate(zip(system.uncertain, self.cell, strict=True)):
            held[symbol] = self.algebra.quantity(*part, j) if fixed else self.algebra.quantity(*whole, None)
        return held


@dataclass(frozen=True, slots=True)
class _Later:
    """`h x_2 + ... + h^(r-1) x_r` for every h of the sample, on which balls the states stay in the domain, (N,), and
    how far from x they may be."""

    terms: list[RangedJet]
    stays: NDArray[np.bool_]
    near: tuple[Array, Array] | None = None


def _later(walk: _Walk, order: int, sample: Interval, reach: Array) -> _Later:
    """The later terms of a walk in any cell, not finite if the states are not known to stay anywhere."""
    hi = float(sample[1])
    moved = _within_a_period(walk, hi)
    if moved is None:
        return _Later([replace(x, c=math.nan) for x in walk.states()], np.zeros(len(walk.balls), bool))
    near, rate = moved
    low, high = np.array([[float(end) for end in pair] for pair in walk.loop.system.domain]).T
    stays = np.all((low < -reach - hi * rate.T) & (reach + hi * rate.T < high), axis=1)
    if order == 1:
        return _Later([x.scaled(0.0) for x in walk.states()], stays, near)
    last = [row[-1] for row in walk.series(order, near)]
    early = walk.series(order - 1) if order > 2 else [[]] * len(last)
    h = walk.algebra.quantity(*sample, len(walk.cell) if walk.varies else None)
    terms = []
    for own, end in zip(early, last, strict=True):
        value = walk.still(end)
        for v in reversed(own[1:]):
            value = walk.still(v) + h * value
        terms.append(h * value)
    return _Later(terms, stays, near)


def _within_a_period(walk: _Walk, hi: float) -> tuple[tuple[Array, Array], Array] | None:
    """Bounds, (n, N), of how far v(0) and gradients of the states move from x within a period, and their rates.

    None if none is found on some ball. The bounds of one ball do not depend on the others."""
    balls, n, _ = walk.balls.shape
    at_rest, far, along = walk.steps.at_rest, np.zeros((n, balls)), np.zeros((n, balls))
    for _ in range(_ATTEMPTS + 1):
        rates = walk.rates((far, along), fixed=False)
        steep = np.array([v.radius for v in rates])
        first = np.zeros_like(steep) if at_rest else np.array([v.value for v in rates])
        if not (np.all(np.isfinite(first)) and np.all(np.isfinite(steep))):
            return None
        found = np.all((at_rest | (hi * first < far)) & (hi * steep < along), axis=0)
        if np.all(found):
            return (far, along), first + steep
        further = np.maximum(_FURTHER * hi * first, _LEAST)
        far, along = np.where(found, far, further), np.where(found, along, _FURTHER * hi * steep)
    return None
