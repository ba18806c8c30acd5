"""What our controllers are compared with: the same SAC without the gain, and SAC and PPO of stable-baselines3.

All of them learn on `PlantEnvironment` of the plant's preset: its rewards, dt, horizon, starts and number of
environment steps, with the preset's actor widths and tanh activation. stable-baselines3 is an outside reference: it
sees the states times `Interface.state_factors`, as our learner does, and actions scaled to [-1, 1]; learning rate,
gamma, batch, tau, replay buffer and warm-up of its SAC are the preset's, the critics have the preset's widths and the
actor's activation, and everything else (the temperature that SAC tunes, all of PPO's) is its own default. It is an
optional extra, imported only where it is used.

Every trained run becomes a `Trained`: physical inputs of a batch of states, by the mean or by a sample.
"""

from __future__ import annotations

import io
import json
import warnings
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray

from certify.errors import InputError
from certify.policies import Policy
from certify.systems import System
from controllers.environments import PlantEnvironment
from controllers.files import write_atomically
from controllers.options import TrainingOptions
from controllers.sac import Actor, Interface
from controllers.training import read_checkpoint

Array = NDArray[np.float64]
Algorithm = Literal["ppo", "sac"]

_ROLLOUT = 2048  # steps between two updates of PPO, about: the default of stable-baselines3


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


def from_policy(policy: Policy, system: System) -> Trained:
    """The policy of an exported file, centred as it ships; such a file has no standard deviation to sample with.

    Raises
    ------
    InputError : the policy is of another plant or other parameters, or its record lacks `steps` or `seed`.
    """
    _require_plant("policy", policy.system, policy.parameters, system)
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
        (name, parameters), options = state["system"], state["options"]
        _require_plant("checkpoint", name, parameters, system)
        actor = Actor(interface, options["actor"], options["centre"])
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


def train_reference(
    algorithm: Algorithm,
    system: System,
    options: TrainingOptions,
    out: Path,
    report: Callable[[int], None] | None = None,
) -> int:
    """Train PPO or SAC of stable-baselines3, write its zip file to `out`, and return the steps that were made.

    Parameters
    ----------
    algorithm : which one.
    options : the plant's preset, with the steps and the seed of this run.
    report : called with the number of steps done, after each step.

    Raises
    ------
    InputError : stable-baselines3 is missing, the algorithm is unknown, there is less than two steps, the weights do
        not fit the plant, or `out` cannot be written.

    Notes
    -----
    PPO learns in whole rollouts of about 2048 steps, of which as many are made as fit `options.steps`; it may stop
    short of them by less than the number of rollouts. The file records the steps that were made. Seeding is
    stable-baselines3's own and also seeds the global generators of `random` and numpy.
    """

    def step(_: dict[str, Any], __: dict[str, Any]) -> bool:
        if report is not None:
            report(int(model.num_timesteps))
        return True

    if algorithm not in get_args(Algorithm):
        raise InputError(f"the baseline must be one of {', '.join(get_args(Algorithm))}; found {algorithm!r}.")
    if options.steps < 2:
        raise InputError(f"`steps` of a baseline must be at least 2; found {options.steps}.")
    torch.set_num_threads(options.threads)
    with torch.random.fork_rng(devices=[]):
        model = _model(algorithm, system, options)
        steps, _ = budget(algorithm, options.steps)
        model.learn(total_timesteps=steps, callback=step)
    # Plain values, which the file keeps as JSON: they are read back without unpickling anything.
    model.trained_on = {
        "algorithm": algorithm,
        "system": system.name,
        "steps": int(model.num_timesteps),
        "seed": options.seed,
    }
    buffer = io.BytesIO()
    model.save(buffer)
    write_atomically(out, buffer.getvalue())
    return int(model.num_timesteps)


def from_reference(content: bytes, system: System, options: TrainingOptions) -> Trained:
    """The policy in the bytes of a file written by `train_reference`; only its tensors are read, nothing unpickled.

    Parameters
    ----------
    options : the options it was trained with, as far as they decide the networks' shapes.

    Raises
    ------
    InputError : stable-baselines3 is missing, or the bytes are no such file of this plant and these widths.
    """
    from_zip = _stable_baselines("common.save_util").load_from_zip_file
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            record = json.loads(archive.read("data"))["trained_on"]
        algorithm, name = record["algorithm"], record["system"]
        steps, seed = int(record["steps"]), int(record["seed"])
        if algorithm not in get_args(Algorithm) or name != system.name:
            raise InputError(f"the baseline must be ppo or sac of {system.name}; it is {algorithm} of {name}.")
        _, parameters, _ = from_zip(io.BytesIO(content), device="cpu", load_data=False)
    except InputError:
        raise
    except Exception as error:  # zip, JSON and torch.load have no common list of what they raise on a damaged file
        raise InputError(f"the baseline's file cannot be read: {error}.") from error
    with torch.random.fork_rng(devices=[]):
        model = _model(algorithm, system, replace(options, seed=seed, steps=max(steps, 2), replay=1))
        try:
            model.set_parameters(parameters, device="cpu")
        except (ValueError, RuntimeError) as error:
            raise InputError(f"the baseline's networks must have the preset's widths: {error}.") from error
    interface, policy = Interface(system), model.policy

    def normalised(x: Array, noise: Array | float) -> Array:
        scaled = torch.from_numpy(x * interface.state_factors).float()
        with torch.no_grad():
            if algorithm == "sac":
                mean, log_std, _ = policy.actor.get_action_dist_params(scaled)
                deviation = log_std.exp()
            else:
                gaussian = policy.get_distribution(scaled).distribution
                mean, deviation = gaussian.mean, gaussian.stddev
        w = mean.double().numpy() + deviation.double().numpy() * noise
        return np.asarray(np.tanh(w) if algorithm == "sac" else np.clip(w, -1.0, 1.0))

    return Trained(
        system.name,
        steps,
        seed,
        mean=lambda x: interface.to_action(normalised(x, 0.0)),
        sample=lambda x, generator: interface.to_action(normalised(x, generator.standard_normal((len(x), system.m)))),
    )


def scaled_environment(system: System, options: TrainingOptions) -> Any:
    """`PlantEnvironment` as stable-baselines3 wants it: float32 states of order one, actions in [-1, 1]."""
    plant = PlantEnvironment(system, options)
    factors = Interface(system).state_factors
    space = gymnasium.spaces.Box(-np.inf, np.inf, (system.n,), np.float32)
    seen = gymnasium.wrappers.TransformObservation(plant, lambda x: (x * factors).astype(np.float32), space)
    return gymnasium.wrappers.RescaleAction(seen, -1.0, 1.0)


def require_stable_baselines() -> None:
    """Raise InputError, which says what to install, unless stable-baselines3 is there."""
    _stable_baselines()


def _require_plant(what: str, name: str, parameters: Mapping[str, float | int | str], system: System) -> None:
    if name != system.name:
        raise InputError(f"the {what} must be of {system.name}; it is of {name}.")
    if system.with_parameters(parameters).parameters != system.parameters:
        raise InputError(f"the {what} must be of {name} at the same parameters; it is of {dict(parameters)}.")


def _model(algorithm: Algorithm, system: System, options: TrainingOptions) -> Any:
    library = _stable_baselines()
    environment = scaled_environment(system, options)
    common: dict[str, Any] = {
        "learning_rate": options.learning_rate,
        "gamma": options.gamma,
        "seed": options.seed,
        "device": "cpu",
    }
    shape: dict[str, Any] = {"pi": list(options.actor)}
    if algorithm == "ppo":
        shape["vf"] = list(options.critic)
        _, common["n_steps"] = budget(algorithm, options.steps)
        common["batch_size"] = min(64, common["n_steps"])
        make = library.PPO
    else:
        shape["qf"] = list(options.critic)
        common["batch_size"], common["tau"] = options.batch, options.tau
        common["buffer_size"], common["learning_starts"] = min(options.replay, options.steps), options.warm_up
        make = library.SAC
    networks = {"net_arch": shape, "activation_fn": torch.nn.Tanh}
    with warnings.catch_warnings():
        # PPO's last batch of a rollout may not be full; it is used all the same.
        warnings.filterwarnings("ignore", message="You have specified a mini-batch size of", category=UserWarning)
        return make("MlpPolicy", environment, policy_kwargs=networks, **common)


def budget(algorithm: Algorithm, steps: int) -> tuple[int, int]:
    """Steps to make in all, at most `steps`, and steps of one rollout.

    >>> budget("ppo", 40_000), budget("ppo", 80_000), budget("sac", 40_000)
    ((40000, 2000), (79989, 2051), (40000, 1))
    """
    if algorithm == "sac":
        return steps, 1
    rollouts = max(1, round(steps / _ROLLOUT))
    return rollouts * (steps // rollouts), steps // rollouts


def _stable_baselines(part: str = "") -> ModuleType:
    import importlib

    try:
        return importlib.import_module("stable_baselines3" + (f".{part}" if part else ""))
    except ImportError as error:
        raise InputError("stable-baselines3 is not installed; `pip install 'certify[baselines]'` brings it.") from error
