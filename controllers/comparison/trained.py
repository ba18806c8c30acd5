"""Trained runs, ready to be simulated: inputs at a batch of states, by the mean or by a sample."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy
from controllers.options import default_record
from controllers.training.actor import Actor
from controllers.training.checkpoint import read_checkpoint
from controllers.training.interface import Interface

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trained:
    """A trained run, ready to be simulated.

    Parameters
    ----------
    system : name of the plant.
    steps, seed : of its training.
    mean : states (N, n) to physical inputs (N, m), the mean action.
    sample : states (N, n) and a source of noise to physical inputs (N, m); None where only the mean was kept.
    """

    system: str
    steps: int
    seed: int
    mean: Callable[[Array], Array]
    sample: Callable[[Array, np.random.Generator], Array] | None = None


def from_policy(policy: Policy, system: System) -> Trained:
    """The policy of an exported file, centred as it ships; such a file has no standard deviation to sample with.

    Raises
    ------
    InputError : the policy is of another plant or other parameters, or its record lacks `steps` or `seed`.
    """
    require_plant("policy", policy.system, policy.parameters, system)
    u_eq = system.exact_u_eq()
    network = policy.network.folded(u_eq)
    try:
        steps, seed = int(policy.training["steps"]), int(policy.training["seed"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError("the policy's `training` record must have `steps` and `seed`.") from error
    return Trained(system.name, steps, seed, lambda x: np.asarray(network(x, u_eq)))


def from_checkpoint(checkpoint: bytes, system: System) -> Trained:
    """The whole actor of `Trainer.snapshot()`: its mean in float64 as it was trained, not centred, and its samples.

    Raises
    ------
    InputError : the bytes are no checkpoint of a run on this plant.
    """
    state = read_checkpoint(checkpoint)
    interface = Interface(system)
    try:
        (name, parameters), options = state["system"], {**default_record(), **state["options"]}
        require_plant("checkpoint", name, parameters, system)
        shape = (options["actor"], options["centre"], options["log_std"], options["activation"])
        actor = Actor(interface, *shape)
        actor.load_state_dict(state["sac"]["actor"])
        steps, seed = int(state["steps_done"]), int(options["seed"])
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
        raise InputError(f"the checkpoint is damaged: {error}.") from error
    network, u_eq = replace(actor.network(), centre="none"), system.exact_u_eq()

    def sample(x: Array, generator: np.random.Generator) -> Array:
        noise = torch.from_numpy(generator.standard_normal((len(x), system.m))).float()
        with torch.no_grad():
            normalised, _ = actor.sample(torch.from_numpy(x).float(), noise)
        return interface.to_action(normalised.double().numpy())

    return Trained(system.name, steps, seed, lambda x: np.asarray(network(x, u_eq)), sample)


def require_plant(what: str, name: str, parameters: Mapping[str, float | int | str], system: System) -> None:
    """Raise InputError unless a record names this plant with these parameters; messages call its owner `what`."""
    if name != system.name:
        raise InputError(f"the {what} must be of {system.name}; it is of {name}.")
    if system.with_parameters(parameters).parameters != system.parameters:
        raise InputError(f"the {what} must be of {name} at the same parameters; it is of {dict(parameters)}.")
