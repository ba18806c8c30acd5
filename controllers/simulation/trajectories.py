"""Trajectories of a policy from states that are drawn in the plant's box."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from controllers.options import Plant, TrainingOptions, get_plant
from controllers.simulation.closed_loop import Action, held_loop

Array = NDArray[np.float64]


def mean_action(network: PolicyNetwork, system: System) -> Action:
    """`network` as an `Action`, in float64; torch's tanh takes a fraction of numpy's time."""
    u_eq = system.exact_u_eq()
    folded = network.folded(u_eq)  # once, not in every step
    return lambda x: np.asarray(folded(torch.from_numpy(x), u_eq))


def initial_states(system: System, count: int, seed: int, plant: Plant | None = None) -> Array:
    """States (count, n), uniform in the box of `plant`, by default the plant that ships under the system's name.

    Raises
    ------
    InputError : no such plant ships, or it does not fit the system's states.
    """
    plant = get_plant(system.name) if plant is None else plant
    plant.check(system)
    half_widths = np.array(plant.initial_states)
    return np.random.default_rng(seed).uniform(-half_widths, half_widths, (count, system.n))


def simulate(system: System, training: TrainingOptions, act: Action, x0: Array, duration: float) -> tuple[Array, Array]:
    """States (T + 1, N, n) and accumulated cost (T + 1, N) of the held closed loop from x0 (N, n).

    Parameters
    ----------
    training : dt, and the weights of `x'Qx + (u - u_eq)'R(u - u_eq)`, which is summed times dt.
    act : states (N, n) to inputs (N, m), which are clipped to their bounds.
    duration : seconds, or steps of a plant in discrete time; T is the number of steps that cover it.
    """
    Q, R = np.array(training.state_weights), np.array(training.input_weights)
    u_lo, u_hi = np.array(system.input_bounds, dtype=np.float64).T
    loop = held_loop(system, training.dt, lambda x: np.clip(act(x), u_lo, u_hi), Q, R)
    states, costs = zip(*loop.run(x0, duration), strict=True)
    return np.stack(states), np.stack(costs)
