"""What our controllers are compared with, beside stable-baselines3 (`controllers.sb3`): the same SAC without the gain.

All of them learn on `PlantEnvironment` of the plant's preset. Every trained run becomes a `Trained`: physical inputs of
a batch of states, by the mean or by a sample.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy, save_policy
from controllers.files import write_atomically
from controllers.options import TrainingOptions, default_record
from controllers.sac import Actor, Interface
from controllers.training import CHECKPOINT_FORMAT, Trainer, parameters_of, read_checkpoint

Array = NDArray[np.float64]

ACTOR = "actor.pt"


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


def without_gain(options: TrainingOptions) -> TrainingOptions:
    """The same SAC without the gain: no term of it in the actor's loss, no identification."""
    return replace(options, gain_weight=0.0, identification="never")


class OwnRun:
    """A run of our trainer; a `controllers.course.Learner`.

    Parameters
    ----------
    trainer : the run.
    whole : keep the whole actor, as it is sampled and not centred; False keeps the policy as it ships.
    """

    def __init__(self, trainer: Trainer, whole: bool) -> None:
        self.trainer, self.whole = trainer, whole

    @property
    def steps_done(self) -> int:
        """Environment steps so far."""
        return self.trainer.steps_done

    @property
    def closing(self) -> tuple[int, int] | None:
        """The two steps of `close`; None before it."""
        return self.trainer.closing

    def advance(self, steps: int, tell: Callable[[int], None] = lambda done: None) -> None:
        """Go on until so many steps are made in all; `tell` hears of each."""
        torch.set_num_threads(self.trainer.options.threads)
        while self.trainer.steps_done < steps:
            self.trainer.advance()
            tell(self.trainer.steps_done)

    def close(self, begin: int, end: int) -> None:
        """Let the actor's step fall linearly to zero between these two steps."""
        self.trainer.close(begin, end)

    def trained(self) -> Trained:
        """The policy as it is."""
        if self.whole:
            return from_checkpoint(self.actor(), self.trainer.system)
        network, u_eq = self.trainer.sac.actor.network(), self.trainer.system.exact_u_eq()
        folded, options = network.folded(u_eq), self.trainer.options
        return Trained(self.trainer.system.name, self.steps_done, options.seed, lambda x: np.asarray(folded(x, u_eq)))

    def keep(self, folder: Path) -> None:
        """Write `policy.pt`, the mean action as a policy file, and if the actor is kept whole `actor.pt`."""
        trainer = self.trainer
        if not self.whole:
            save_policy(folder / "policy.pt", trainer.policy())
            return
        write_atomically(folder / ACTOR, self.actor())
        mean = replace(trainer.sac.actor.network(), centre="none")
        record = {**trainer.options.record(), "steps": trainer.steps_done, "centre": "none"}
        save_policy(
            folder / "policy.pt", Policy(mean, trainer.system.name, parameters_of(trainer.system), training=record)
        )

    def actor(self) -> bytes:
        """What `from_checkpoint` reads, and no more: a checkpoint without what a run needs to go on."""
        trainer = self.trainer
        state = {
            "format": CHECKPOINT_FORMAT,
            "system": [trainer.system.name, parameters_of(trainer.system)],
            "options": trainer.options.record(),
            "steps_done": trainer.steps_done,
            "sac": {"actor": trainer.sac.actor.state_dict()},
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        return buffer.getvalue()

    def snapshot(self) -> bytes:
        """Everything that the rest of the run depends on."""
        return self.trainer.snapshot()

    def restore(self, checkpoint: bytes) -> None:
        """Go on from `snapshot()`; raises as `Trainer.restore`."""
        self.trainer.restore(checkpoint)


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
        actor = Actor(interface, options["actor"], options["centre"], options["log_std"])
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
    """Raise InputError unless what a record says is this plant with these parameters; `what` is what has the record."""
    if name != system.name:
        raise InputError(f"the {what} must be of {system.name}; it is of {name}.")
    if system.with_parameters(parameters).parameters != system.parameters:
        raise InputError(f"the {what} must be of {name} at the same parameters; it is of {dict(parameters)}.")
