"""Closed loops step by step, run from many initial states at once; `evaluate` and `compare` measure on them.

A trajectory whose state is no longer finite, or beyond `DIVERGED`, has *diverged*: from there on its state is NaN
and its cost infinite. These are figures for a report, never a proof.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.plants.ode import rk4_step
from controllers.simulation.stepping import Stepper

Array = NDArray[np.float64]
Action = Callable[[Array], Array]


DIVERGED = 1e9
"""Bound on |x_i|, in the states' units: beyond it a trajectory counts as diverged."""


@dataclass(frozen=True, slots=True)
class Loop:
    """A closed loop in steps of h, in the plant's unit of time: seconds, or steps, of which h is 1.

    Parameters
    ----------
    step : states (N, n) and inputs (N, m) to the next states.
    act : states (N, n) to inputs (N, m); never asked about a state that has diverged.
    cost : states and inputs to the running cost (N,), per unit of time.

    Notes
    -----
    The arithmetic of a trajectory is its own, to the last bit, whatever else is in the batch, as far as that holds for
    `act`. It does not hold for a matrix product, and so not for a network: BLAS chooses its kernel, with or without
    fused multiply-adds, by the number of rows.
    """

    step: Callable[[Array, Array], Array]
    act: Action
    cost: Callable[[Array, Array], Array]
    h: float

    def count(self, duration: float) -> int:
        """Steps that cover `duration`."""
        return math.ceil(duration / self.h - 1e-9)

    def run(self, x: Array, duration: float) -> Iterator[tuple[Array, Array]]:
        """States (N, n) and accumulated cost (N,) at 0, h, 2 h, ... until `duration` is covered."""
        total = np.zeros(len(x))
        yield x, total
        for _ in range(self.count(duration)):
            u = self.act(np.where(np.isnan(x), 0.0, x))
            with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is a result, not an accident
                total = total + self.h * self.cost(x, u)
                x = self.step(x, u)
                x = np.where((np.abs(x) <= DIVERGED).all(axis=1, keepdims=True), x, math.nan)
            total = np.where(np.isnan(x).any(axis=1), math.inf, total)
            yield x, total


def held_loop(system: System, dt: float, act: Action, Q: Array, R: Array) -> Loop:
    """The loop in which an input is held for dt seconds, or in discrete time for one step, dt = 1.

    Q (n,) and R (m,) are the diagonals of the cost's weights.
    """
    return Loop(Stepper(system, dt, "numpy"), act, _cost(system, Q, R), dt)


def continuous_loop(system: System, h: float, act: Action, Q: Array, R: Array) -> Loop:
    """The loop in which the policy is evaluated at every Runge-Kutta stage of a step of h seconds.

    Raises
    ------
    InputError : the plant is in discrete time, where nothing happens between two steps.
    """
    if system.time == "discrete":
        raise InputError(f"{system.name} must be in continuous time to be followed between two steps; it is not.")
    f = system.function("numpy")

    def step(x: Array, u: Array) -> Array:
        # The first stage is at x itself, where the action is already known.
        return np.asarray(rk4_step(lambda y: f(y, u if y is x else act(y)), x, h))

    return Loop(step, act, _cost(system, Q, R), h)


def _cost(system: System, Q: Array, R: Array) -> Callable[[Array, Array], Array]:
    """`x'Qx + (u - u_eq)'R(u - u_eq)` for diagonal weights."""
    equilibrium = np.array([float(u) for u in system.exact_u_eq()])
    return lambda x, u: np.asarray((Q * x * x).sum(-1) + (R * (u - equilibrium) ** 2).sum(-1))
