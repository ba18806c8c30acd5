"""The stages that simulate: how much of what converges is proved, and more of it where an ellipsoid is too little.

A function N is learned where inputs follow at once; with steps boxes get ranks. Whatever these do not prove, the claim
about the ellipsoid stays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from certify.analysis.simulated import FEW, MOST, Simulator, simulated_region
from certify.analysis.stages.further import Beyond, ByRanks, Equilibrium
from certify.analysis.stages.ring import Ring
from certify.analysis.stages.state import State, Tools
from certify.certificates.ellipsoids import sublevel_set
from certify.certificates.membership import Region, region_of
from certify.effort import Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.policies import clipped_at
from certify.provers.ranks import Enough

_FOR_RUNS = 0.06  # share of the whole effort for simulated runs
_FOR_MORE = 0.35  # share of the whole effort that the ring leaves, for what lies beyond
_FOR_RING = 0.5  # share of the effort that is left which the ring has in any case
_LEAST = 0.04  # share of the whole effort, with less of which nothing more is begun
_WANTED = 0.98  # share of it in the proved set, with which the search for ranks ends


def goes_on(state: State) -> bool:
    """True if the run may go on beyond the ellipsoid: few states, and nothing else that was asked for."""
    return state.options.goes_on and state.loop.system.n <= FEW


@dataclass(frozen=True)
class Onwards:
    """The stage that proves the ring and then, with what this leaves of the effort, more of the simulated region."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Add an outer set or ranks where the ellipsoid is too little; the ring takes what is left without them."""
        left = effort.left
        found = self._with_ring(state, effort.part(max(left - _FOR_MORE * self.tools.whole, _FOR_RING * left)))
        cut = found.result.stop.ran_out
        if found.done:
            return self._with_ring(state, effort) if cut else found
        if effort.left >= _LEAST * self.tools.whole:
            found = self._with_more(found, effort)
        gained = found.beyond is not None or found.ranked is not None
        if gained or not cut:
            return found
        again = self._with_ring(state, effort)
        return again if again.done else replace(again, notes=found.notes, simulated=found.simulated)

    def _with_ring(self, state: State, effort: Effort) -> State:
        state = Ring(self.tools).extend(state, effort)
        return Equilibrium(self.tools).extend(state, effort) if state.converging and not state.done else state

    def _with_more(self, state: State, effort: Effort) -> State:
        state = _simulated(state, self.tools, effort)
        problem, (claim, _) = state.contest.best.trial.task.problem, state.proved
        runs = np.zeros((0, state.loop.system.n)) if state.simulated is None else state.simulated.converging
        outside = runs[~Region((sublevel_set(problem.V.P, claim.roa),)).holds_in_floats(runs)]
        if state.simulated is not None and len(outside) <= (1 - MOST) * len(runs):
            return state
        if state.loop.system.in_steps:
            wanted = math.ceil(len(outside) - (1 - _WANTED) * len(runs))
            return ByRanks(self.tools, Enough(outside.T, max(1, wanted))).extend(state, effort)
        try:
            more = Beyond(self.tools).extend(replace(state, options=replace(state.options, candidate="neural")), effort)
        except InputError as error:  # too little converges from outside of the ellipsoid to learn from
            return state.noting(f"no function is learned for a set beyond the ellipsoid: {error}")
        return replace(more, options=state.options)


@dataclass(frozen=True)
class Simulation:
    """The last stage: the share of the simulated region that the accepted claim covers, in few states."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Add the counts of runs to the result."""
        accepted = state.accepted
        if accepted is None or state.loop.system.n > FEW:
            return state
        state = state if state.simulated is not None else _simulated(state, self.tools, effort)
        if state.simulated is None:
            return state
        region, share = region_of(accepted.certificate), effort.part(_FOR_RUNS * self.tools.whole)
        with self.tools.timing("simulate"):
            return state.with_result(simulated=state.simulated.facts(region, _clipped(state), share))


def _clipped(state: State) -> Simulator | None:
    """Runs of the policy that saturates at the inputs' bounds; None where its form keeps it within them."""
    problem, claim = state.contest.best.trial.task.problem, state.claim
    system = problem.loop.system
    network = clipped_at(problem.loop.network, system.input_bounds)
    if network is None or claim is None:
        return None
    return Simulator(ClosedLoop(system, network), problem.V, claim.roa)


def _simulated(state: State, tools: Tools, effort: Effort) -> State:
    """The state with runs, as far as they can be had."""
    problem, claim = state.contest.best.trial.task.problem, state.claim
    if claim is None:
        return state
    with tools.timing("simulate"):
        tools.tell("simulate")
        share = effort.part(_FOR_RUNS * tools.whole)
        return replace(state, simulated=simulated_region(Simulator(problem.loop, problem.V, claim.roa), share))
