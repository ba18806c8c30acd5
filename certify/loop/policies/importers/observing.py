"""The inputs that a network of another program expects: which states, in which order, measured from which point.

A policy and a Lyapunov network in one file read the same inputs. This module also samples the states of the domain at
which a network is compared with its framework.
"""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np

from certify.errors import InputError
from certify.loop.policies.importers.comparing import SAMPLES
from certify.loop.policies.importers.options import ImportOptions
from certify.loop.policies.importers.reading import Reading
from certify.loop.policies.importers.steps import Diagonal, Step
from certify.loop.policies.network import Array

if TYPE_CHECKING:
    from certify.loop.plants import System


def index_of(states: tuple[str, ...], plant: System) -> list[int]:
    """The plant's state for each number that the network reads.

    Raises
    ------
    InputError : the plant has no state of that name.
    """
    known = [s.name for s in plant.states]
    for name in states:
        if name not in known:
            raise InputError(
                f"the network must read states of {plant.name}, {', '.join(known)}; --states names {name!r}. "
                "An observation that is a function of states, such as the cosine of an angle, is not proved: only "
                "networks that read the states themselves are. Train the policy again on the states, through a wrapper "
                "of the environment that returns them: for the observations (cos_theta, sin_theta, theta_dot) "
                "gymnasium.wrappers.TransformObservation with (arctan2(sin_theta, cos_theta), theta_dot)."
            )
    return [known.index(name) for name in states]


def shift(x_eq: list[Fraction], options: ImportOptions) -> tuple[Step, ...]:
    """The step from deviations to the states' values, for a network that reads values; else none."""
    return (Diagonal((Fraction(1),), tuple(x_eq)),) if options.observes == "absolute" and any(x_eq) else ()


def require_equilibrium(reading: Reading, x_eq: list[Fraction]) -> None:
    """Refuse a network that is centred at another point than the plant's.

    Raises
    ------
    InputError : it is.
    """
    if reading.equilibrium is None:
        return
    wanted = np.array([float(v) for v in x_eq])
    if np.any(np.float32(wanted) != np.float32(reading.equilibrium)):
        raise InputError(
            f"a two-stage policy must be centred at the plant's operating point, {wanted.tolist()} as it observes it; "
            f"its x_equilibrium is {reading.equilibrium.tolist()}."
        )


def over_states(weight: Array, index: list[int], n: int) -> Array:
    """The first layer's weight over all n states of the plant, (out, n); 0 where the network does not read a state."""
    whole = np.zeros((len(weight), n))
    whole[:, index] = weight
    return whole


def sample(plant: System, valid: Array | None) -> Array:
    """States in the domain where no observation is clipped, as numbers of single precision, (k, n).

    Raises
    ------
    InputError : every observation of a state is clipped in the domain.
    """
    box = np.array([[float(lo), float(hi)] for lo, hi in plant.domain])
    if valid is not None:
        box = np.stack([np.maximum(box[:, 0], valid[:, 0]), np.minimum(box[:, 1], valid[:, 1])], axis=1)
        empty = np.flatnonzero(~(box[:, 0] < box[:, 1]))
        if empty.size:
            state, (lo, hi) = plant.states[empty[0]], valid[empty[0]]
            raise InputError(
                f"the domain of {state} must have a part where its observation is not clipped, [{lo:.6g}, {hi:.6g}]; "
                "it has none."
            )
    lo, hi = box.T
    # Single precision must not round a state out of the box, where a clip begins to act.
    margin = 1e-6 * np.maximum(hi - lo, np.maximum(np.abs(lo), np.abs(hi)))
    inner = np.where(2 * margin < hi - lo, margin, 0)
    x = np.random.default_rng(0).uniform(lo + inner, hi - inner, (SAMPLES, plant.n))
    return x.astype(np.float32).astype(np.float64)
