"""Simulated runs of a policy that settle, and their cost.

A run has *settled* when ||x|| < 1e-6 throughout the last second of 60 s, in discrete time the last 50 of 3,000 steps.
While a policy is trained, `MONITORING` asks for less: ||x|| < 1e-3 throughout the last second of 20 s, or the last 50
of 1,000 steps, inputs held, 100 initial states.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.errors import OptionError
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from controllers.options import Plant
from controllers.simulation.closed_loop import Loop, held_loop
from controllers.simulation.lengths import Lengths
from controllers.simulation.trajectories import initial_states, mean_action

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class EvaluationOptions(Lengths):
    """The simulations that judge a policy; a run has settled if it stays small in the window.

    Parameters
    ----------
    states : number of initial states, uniform in the plant's box.
    seed : of the initial states.
    tolerance : bound on ||x|| in the window.
    resolution : step of the continuous simulation, as a multiple of 1 / (fastest eigenvalue's modulus).
    """

    states: int = 1000
    seed: int = 0
    tolerance: float = 1e-6
    resolution: float = 0.2

    def __post_init__(self) -> None:
        Lengths.__post_init__(self)
        self.require_positive("states", "tolerance", "resolution")
        if self.seed < 0:
            raise OptionError(f"`seed` must be at least 0; found {self.seed}.")


MONITORING = EvaluationOptions(states=100, duration=20.0, duration_steps=1000, tolerance=1e-3)
"""The simulations that judge a policy now and then while it is trained."""


@dataclass(frozen=True, slots=True)
class Settling:
    """One simulation of all initial states.

    `largest` is the largest ||x||, from where runs are to settle, of any run in the window; `left_domain` counts runs
    that were outside the domain at some step. `cost` is the integral of `x'Q x + (u - u_eq)'R (u - u_eq)`, in discrete
    time its sum, median over the runs. `step` is in seconds, and 1 in discrete time.
    """

    settled: int
    states: int
    largest: float
    left_domain: int
    cost: float
    step: float


def settle(
    network: PolicyNetwork,
    system: System,
    dt: float,
    Q: Array,
    R: Array,
    options: EvaluationOptions = MONITORING,
    plant: Plant | None = None,
    rest: Array | None = None,
) -> Settling:
    """Simulate `network` with its input held over dt, or in discrete time a step, from the plant's initial states.

    Parameters
    ----------
    Q, R : diagonals of the cost's weights, shapes (n,) and (m,).
    plant : whose box the initial states come from; default: the plant that ships under the system's name.
    rest : the state (n,) towards which runs settle; default: the origin.

    Raises
    ------
    InputError : the plant has no box of initial states.
    """
    loop = held_loop(system, dt, mean_action(network, system), Q, R)
    return settling_of(loop, system, initial_states(system, options.states, options.seed, plant), options, rest)


def settling_of(
    loop: Loop, system: System, x0: Array, options: EvaluationOptions, rest: Array | None = None
) -> Settling:
    domain = np.array(system.domain, dtype=np.float64)
    duration, window = options.span(system)
    window_begins = loop.count(duration) - loop.count(window)
    largest, outside, cost = np.zeros(len(x0)), np.zeros(len(x0), dtype=bool), np.zeros(len(x0))
    for k, (x, total) in enumerate(loop.run(x0, duration)):
        if k >= window_begins:
            norm = np.linalg.norm(x if rest is None else x - rest, axis=1)
            largest = np.maximum(largest, np.where(np.isnan(norm), math.inf, norm))
        outside |= ~((x >= domain[:, 0]) & (x <= domain[:, 1])).all(axis=1)
        cost = total
    return Settling(
        settled=int((largest < options.tolerance).sum()),
        states=len(x0),
        largest=float(largest.max()),
        left_domain=int(outside.sum()),
        cost=float(np.median(cost)),
        step=loop.h,
    )
