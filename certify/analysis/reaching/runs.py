"""Simulated runs from a box, and the proof in Arb that one of them breaks the claim.

Floats look for a state from which a run does not get there in time, or violates a constraint on the way; in Arb balls
the same run then shows it, or does not. Values of uncertain quantities are the nominal ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice, product
from typing import Literal

import flint
import numpy as np
from numpy.typing import NDArray

from certify.certificates.ellipsoids import Box
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Symbol
from certify.loop.plants import System, kept_constraints
from certify.loop.plants.floating_point import function_of
from certify.loop.rigorous import ball, evaluate_arb, precision, states_after
from certify.report.flow import Flow, time_scales

Array = NDArray[np.float64]
End = Literal["late", "left", "violates"]
LONG = 3000  # steps after which a run is given up
_RANDOM, _GRID, _CORNERS = 100, 51, 8  # states of a box; a grid's points in one state; states that have all corners
_CLOSE = 1e-9  # a target that is missed by less is not missed, in floats
_FINER = 0.1  # of the step with which pictures are drawn
_BITS = 400


@dataclass(frozen=True, slots=True)
class Run:
    """The course of a run that does not get there, from the state `x`, deviations as rationals: after so many `steps`
    it has not been in the target ("late"), it leaves the domain ("left"), or it violates a `constraint`."""

    x: tuple[Fraction, ...]
    end: End
    steps: int
    constraint: str = ""


@dataclass(frozen=True, slots=True)
class Runs:
    """Simulated runs from a box: how many, the numbers of steps after which some get there, and one that does not."""

    count: int
    arrivals: tuple[int, ...]
    failing: Run | None

    @property
    def longest(self) -> int | None:
        """The most steps of a run that gets there."""
        return self.arrivals[-1] if self.arrivals else None


class Simulation:
    """Runs of a closed loop towards a target, in floats; `begin` is the box from which they start, and the target is
    that of states less full turns of the angles whose numbers are `turned`."""

    def __init__(self, loop: ClosedLoop, target: Sequence[Expression], begin: Box, turned: Sequence[int] = ()) -> None:
        system, self.turned = loop.system, list(turned)
        self.flow, self.begin, self.names = Flow.of(system, loop.network), begin, tuple(kept_constraints(system))
        quantities = [s for s, _ in system.uncertain]
        self.nominal = [float(_nominal(system, s)) for s in quantities]
        self.beyond = function_of(system, tuple(target), (), "numpy")
        kept = tuple(kept_constraints(system).values())
        self.kept = function_of(system, kept, quantities, "numpy") if kept else None
        self.step = self.flow.fitting(_FINER * time_scales(self.flow)[0])

    @np.errstate(all="ignore")
    def runs(self, within: int | None, effort: Effort, states: Array | None = None) -> Runs:
        """Runs from states of the box, those of `begins` or others (N, n); `within` is the number of steps after which
        the target is to be reached."""
        x, most = begins(self.begin) if states is None else states, LONG if within is None else within
        start, alive, arrivals, failing = x, np.arange(len(x)), list[int](), list[Run]()
        for k in range(most + 1):
            there = self.beyond(self._place(x), self.flow.policy(x), ()).max(-1) <= _CLOSE
            arrivals += [k] if np.any(there) else []
            x, alive = x[~there], alive[~there]
            ended = self.ended(x, k)
            failing += [Run(self._exact(start[alive[i]]), *end) for i, end in ended.items()]
            going = ~np.isin(np.arange(len(x)), list(ended))
            x, alive = x[going], alive[going]
            if not len(x) or k == most or effort.over:
                break
            effort.charge(self.operations(len(x)))
            x = self.later(x)
        if not effort.over:
            failing += [Run(self._exact(start[i]), "late", most) for i in alive]
        worst = ("violates", "late", "left")
        arrivals = [] if effort.over else arrivals
        return Runs(len(start), tuple(arrivals), min(failing, key=lambda run: worst.index(run.end), default=None))

    def ended(self, x: Array, k: int) -> dict[int, tuple[End, int, str]]:
        """The runs that end at states x (N, n) after k steps, by their numbers, and how."""
        turning = np.isin(np.arange(x.shape[-1]), self.flow.angles)
        inside = np.all(((x > self.flow.lo) & (x < self.flow.hi)) | turning, axis=-1)
        found: dict[int, tuple[End, int, str]] = {int(i): ("left", k, "") for i in np.flatnonzero(~inside)}
        if self.kept is not None and len(x):
            g = self.kept(x, self.flow.policy(x), self.nominal)
            for i in np.flatnonzero((g > 0).any(-1)):
                found[int(i)] = ("violates", k, self.names[int(g[i].argmax())])
        return found

    def _place(self, x: Array) -> Array:
        """States x (N, n) less full turns of those angles, as near to 0 as they get."""
        found = x.copy()
        found[:, self.turned] -= 2 * math.pi * np.rint(x[:, self.turned] / (2 * math.pi))
        return found

    @property
    def _each(self) -> int:
        """Steps of the integration in a step of the loop."""
        return 1 if self.flow.discrete else self.flow.steps_between(self.step)

    def operations(self, runs: int) -> float:
        """The operations of a step of the loop of so many runs."""
        return self._each * self.flow.operations(runs)

    def later(self, x: Array) -> Array:
        """The states after a step of the loop."""
        held = None if self.flow.discrete else self.flow.policy(x)
        for _ in range(self._each):
            x = self.flow.advance(x, held, self.step)
        return x

    def _exact(self, x: Array) -> tuple[Fraction, ...]:
        """A state in the box, which a float may lie beside."""
        each = zip(x.tolist(), self.begin, strict=True)
        return tuple(min(max(Fraction(v), lo), hi) for v, (lo, hi) in each)


def ends_of_runs(loop: ClosedLoop, x: Array, steps: int, effort: Effort) -> tuple[Array, int]:
    """The states (N, n) after so many steps of runs from states x, (N, n), NaN of those that leave the domain or
    violate a constraint; and the number of steps, which the effort may cut."""
    simulation, end = Simulation(loop, (), ()), x.copy()
    for k in range(steps):
        alive = np.flatnonzero(np.isfinite(end).all(-1))
        end[alive[list(simulation.ended(end[alive], k))]] = np.nan
        alive = np.flatnonzero(np.isfinite(end).all(-1))
        effort.charge(simulation.operations(len(alive)))
        if effort.over:
            return end, k
        end[alive] = simulation.later(end[alive])
    return end, steps


def begins(box: Box) -> Array:
    """States of a box: its corners, its middle, and some between, (N, n)."""
    lo, hi = (np.array([float(pair[k]) for pair in box]) for k in (0, 1))
    wide = np.flatnonzero(hi > lo)
    found = [0.5 * (lo + hi)]
    if 0 < len(wide) <= _CORNERS:
        found += [np.where(np.isin(np.arange(len(lo)), wide[list(map(bool, each))]), hi, lo)
                  for each in product((0, 1), repeat=len(wide))]  # fmt: skip
    if len(wide):
        shares = np.random.default_rng(0).uniform(size=(_RANDOM, len(lo)))
        found += list(lo + shares * (hi - lo))
        line = np.linspace(0, 1, _GRID)[:, None] if len(wide) == 1 else np.zeros((0, 1))
        found += list(lo + line * (hi - lo))
    inside = np.clip(np.array(found), lo, hi)
    first: NDArray[np.intp] = np.unique(inside, axis=0, return_index=True)[1]
    states: Array = inside[np.sort(first)]
    return states


def is_refuted(loop: ClosedLoop, target: Sequence[Expression], run: Run, within: int | None) -> bool:
    """True if Arb shows that the run breaks the claim: in none of `within` steps is it in the target, or in none until
    it violates the constraint."""
    system = loop.system
    if not is_nominal(system):
        return False
    if run.end == "left" or (run.end == "late" and run.steps != within):
        return False
    with precision(_BITS):
        values: dict[Symbol, flint.arb] = {}
        for x, u in islice(states_after(loop, run.x), run.steps + 1):
            values = dict(zip((*system.states, *system.inputs), (*x, *u), strict=True))
            if not any(bool(evaluate_arb(t, values) > 0) for t in target):
                return False
        if run.end == "late":
            return True
        violated = kept_constraints(system)[run.constraint]
        nominal = {s: ball(_nominal(system, s)) for s, _ in system.uncertain}
        return bool(evaluate_arb(violated, {**values, **nominal}) > 0)


def is_nominal(system: System) -> bool:
    """True if the nominal values, which runs have, are among those that uncertain quantities may take."""
    return all(lo <= _nominal(system, s) <= hi for s, (lo, hi) in system.uncertain)


def _nominal(system: System, quantity: Symbol) -> Fraction:
    return system.parameters.get(quantity.name, Fraction(0))
