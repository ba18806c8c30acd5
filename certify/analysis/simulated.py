"""The simulated region of attraction: drawn states of the domain from which runs converge without leaving it, and
without violating a constraint or an input's bounds.

It says how much of what is there has been proved, and so if more is worth its effort. Nothing in it is part of a proof.
The same loop and effort draw the same states, whatever machine simulates them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from certify.analysis.facts import SimulatedFacts
from certify.certificates.membership import Region
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants.ode import DOUBLINGS, LATE, lengthened
from certify.lyapunov.function import Quadratic
from certify.provers.ranks import root_box, turning
from certify.report.flow import Flow, time_scales
from certify.report.sampling import run_until_near

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
FEW = 3
"""States of a plant up to which drawn states meet the region often enough to tell its share."""
MOST, NEARLY_ALL = 0.8, 0.9
"""Shares of the simulated region: an ellipsoid with the first is most of it, and a run does not go beyond it by itself;
with the second hardly more is to be proved in this domain."""
_LEAST, _ENOUGH, _MOST = 250, 1000, 4000  # states drawn at once at least, that converge, and in all
_QUICK = 10.0  # multiplications of many runs at once that are worth an operation
_LONGEST = 3000  # steps of one length: of runs over more time each state has a step of its own


@dataclass(frozen=True, slots=True)
class SimulatedRegion:
    """The region of attraction by runs.

    Parameters
    ----------
    converging, others : the drawn states whose runs converge, (N, n), and all others, in deviations from the operating
        point.
    """

    converging: Array
    others: Array

    @property
    def runs(self) -> int:
        """The number of states drawn."""
        return len(self.converging) + len(self.others)

    def facts(self, region: Region, clipped: Simulator | None, effort: Effort) -> SimulatedFacts:
        """The counts, with those of the converging runs that start in a proved set, and with those of the `clipped`
        policy if the effort allows."""
        proved, more = int(region.holds_in_floats(self.converging).sum()), None
        if clipped is not None:
            more = len(self.converging) + int(clipped.converge(self.others, effort).sum())
        return SimulatedFacts(self.runs, len(self.converging), proved, None if effort.over else more)


class Simulator:
    """Runs of a loop until they enter {V <= level}.

    Parameters
    ----------
    loop : of what is uncertain it has the nominal values, of several periods the longest.

    Notes
    -----
    Where boxes may have ranks, full turns of an angle count as the same place. A run that violates a constraint at one
    of its steps does not converge, a held input being taken as a new one there; nor does one with a command outside of
    the input's bounds, outside of {V <= level}: of such states nothing is ever proved.
    """

    def __init__(self, loop: ClosedLoop, V: Quadratic, level: float) -> None:
        flow = Flow.of(loop.system, loop.network)
        if loop.system.in_steps:
            lo, hi = root_box(loop)
            flow = replace(flow, lo=lo, hi=hi, angles=tuple(turning(loop)))
        else:
            flow = replace(flow, angles=())
        step, self.horizon = time_scales(flow)
        whole = math.inf if flow.discrete or flow.period else time_scales(flow, most=math.inf)[1]
        self.farther = whole if self.horizon < whole < math.inf else 0.0
        self.flow, self.step, self.V, self.level = flow, flow.fitting(step), V, level
        self.doublings = DOUBLINGS

    @property
    def operations(self) -> float:
        """Multiplications' worth of one run among many."""
        return (self.flow.operations(2) - self.flow.operations(1)) * self.horizon / self.step

    def converge(self, x: Array, effort: Effort) -> Mask:
        """True (N,) for states (N, n) whose runs converge before the effort, an operation of which is worth several
        multiplications here, is over."""
        found, undecided = self._runs(x, effort, (self.horizon, self.farther))

        def again(at: NDArray[np.int64], k: int) -> tuple[Mask, Mask] | None:
            some = effort.share(0.5)
            late = self._runs(x[at], some, self._longer(k))
            return None if some.over else late

        k = lengthened(found, undecided, again, self.doublings)
        self.doublings = 0 if undecided.sum() >= LATE * len(x) else self.doublings - k  # in vain once is enough
        self.horizon, self.farther = self._longer(k)
        return found

    def _longer(self, k: int) -> tuple[float, float]:
        """2^k times the horizon of the runs, and the time that those with steps of their own may take."""
        time = 2**k * (self.farther or self.horizon)
        if self.farther:
            return self.horizon, time
        follows = not (self.flow.discrete or self.flow.period)
        if follows and k and time > _LONGEST * self.step:
            return _LONGEST * self.step, time
        return time, 0.0

    def _runs(self, x: Array, effort: Effort, times: tuple[float, float]) -> tuple[Mask, Mask]:
        """The runs that converge, and those that do neither that nor leave, (N,) each."""
        worth = Effort(_QUICK * effort.left)
        horizon, farther = times
        found, left, _ = run_until_near(self.flow, x, self.V.P, self.level, self.step, horizon, worth, farther)
        effort.charge(worth.spent / _QUICK)
        return found, ~found & ~left


def simulated_region(runs: Simulator, effort: Effort) -> SimulatedRegion | None:
    """Simulate from states drawn uniformly from the domain, of angles from one turn, until enough of them converge.

    None is returned if the effort ends before the first states are decided.
    """
    generator, flow = np.random.default_rng(0), runs.flow
    dear = _QUICK * effort.left / runs.operations  # states that may stay undecided
    batch = int(min(max(dear, _LEAST), _ENOUGH))
    found, others, drawn = list[Array](), list[Array](), 0
    while drawn < _MOST and sum(map(len, found)) < _ENOUGH:
        x = generator.uniform(flow.lo, flow.hi, (batch, len(flow.lo)))
        converge = runs.converge(x, effort)
        if effort.over:
            break
        found.append(x[converge])
        others.append(x[~converge])
        drawn += batch
    return SimulatedRegion(np.concatenate(found), np.concatenate(others)) if drawn else None
