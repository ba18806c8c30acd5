"""The distance of the learned gain from the true one, for each policy of a run.

The true gain is that of the simulator's own linearisation, which training never sees.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from controllers.evaluation.record import recorded, recorded_step
from controllers.history.policies import RunPolicy
from controllers.identification.linearisation import discrete_linearisation
from controllers.identification.riccati import riccati_gain

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Distances:
    """Relative distances in the Frobenius norm after `step` steps.

    `A`, `B` and `K` are what was learned, against the simulator's linearisation and its discrete LQR gain; NaN where
    nothing was. `mean` is the mean action's Jacobian at the origin, which should be -K, against the same true gain.
    """

    step: int
    A: float
    B: float
    K: float
    mean: float


def distances(history: Sequence[RunPolicy], system: System) -> list[Distances]:
    """The distances of each policy, and of what was learned, from the true A, B and gain.

    Raises
    ------
    InputError : a policy is not one of this plant, or its record lacks dt or the weights of its gain.
    """
    found = []
    for kept in history:
        policy, n, m = kept.policy, system.n, system.m
        if (policy.network.n, policy.network.m) != (n, m):
            raise InputError(
                f"the policies must map {n} states to {m} inputs for {system.name}; found {policy.network.n} and "
                f"{policy.network.m}."
            )
        dt = recorded_step(policy, system)
        Q, R = (np.diag(recorded(policy, f"{of}_weights", (k,))) for of, k in (("state", n), ("input", m)))
        A, B = discrete_linearisation(system, dt)
        K = riccati_gain(A, B, Q, R)
        J = policy.network.jacobian_at_origin(system.exact_u_eq())
        learned = {
            name: _relative(recorded(policy, name, true.shape), true) if name in policy.training else math.nan
            for name, true in (("A", A), ("B", B), ("K", K))
        }
        found.append(Distances(step=kept.step, **learned, mean=_relative(-J, K)))
    return found


def _relative(found: Array, true: Array) -> float:
    return float(np.linalg.norm(found - true) / np.linalg.norm(true))
