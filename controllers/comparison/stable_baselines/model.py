"""Models of stable-baselines3 with the networks and the options of a preset."""

from __future__ import annotations

import importlib
import warnings
from types import ModuleType
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from certify.errors import InputError
from certify.loop.activations import activation
from certify.loop.plants import System
from controllers.comparison.trained import Trained
from controllers.options import TrainingOptions
from controllers.training.environment import PlantEnvironment
from controllers.training.interface import Interface

Array = NDArray[np.float64]


Algorithm = Literal["ppo", "sac"]


ROLLOUT = 2048  # steps between two updates of PPO: the default of stable-baselines3


def scaled_environment(plant: PlantEnvironment) -> Any:
    """`plant` as stable-baselines3 wants it: float32 states of order one, actions in [-1, 1]."""
    factors = Interface(plant.system).state_factors
    space = gymnasium.spaces.Box(-np.inf, np.inf, (plant.system.n,), np.float32)
    seen = gymnasium.wrappers.TransformObservation(plant, lambda x: (x * factors).astype(np.float32), space)
    return gymnasium.wrappers.RescaleAction(seen, -1.0, 1.0)


def require_stable_baselines() -> None:
    """Raise InputError, which says what to install, unless stable-baselines3 is there."""
    stable_baselines()


def budget(algorithm: Algorithm, steps: int) -> tuple[int, int]:
    """Steps to make in all, at most `steps`, and steps of one rollout.

    >>> budget("ppo", 40_000), budget("ppo", 80_000), budget("sac", 40_000)
    ((40000, 2000), (79989, 2051), (40000, 1))
    """
    if algorithm == "sac":
        return steps, 1
    rollouts = max(1, round(steps / ROLLOUT))
    return rollouts * (steps // rollouts), steps // rollouts


def new_model(algorithm: Algorithm, options: TrainingOptions, plant: PlantEnvironment, rollout: int) -> Any:
    """An untrained model on this plant."""
    library = stable_baselines()
    common: dict[str, Any] = {
        "learning_rate": options.learning_rate,
        "gamma": options.gamma,
        "seed": options.seed,
        "device": "cpu",
    }
    shape: dict[str, Any] = {"pi": list(options.actor)}
    if algorithm == "ppo":
        shape["vf"] = list(options.critic)
        common["n_steps"], common["batch_size"] = rollout, min(64, rollout)
        make = library.PPO
    else:
        shape["qf"] = list(options.critic)
        common["batch_size"], common["tau"] = options.batch, options.tau
        common["buffer_size"], common["learning_starts"] = min(options.replay, options.steps), options.warm_up
        make = library.SAC
    networks = {"net_arch": shape, "activation_fn": getattr(nn, activation(options.activation).module)}
    # As a vector of one: then the library puts nothing of its own around it that a checkpoint would have to hold.
    vector = stable_baselines("common.vec_env").DummyVecEnv([lambda: scaled_environment(plant)])
    with warnings.catch_warnings():
        # PPO's last batch of a rollout may not be full; it is used all the same.
        warnings.filterwarnings("ignore", message="You have specified a mini-batch size of", category=UserWarning)
        model = make("MlpPolicy", vector, policy_kwargs=networks, **common)
    model.set_logger(stable_baselines("common.logger").Logger(folder=None, output_formats=[]))
    return model


def stable_baselines(part: str = "") -> ModuleType:
    """The library, or a part of it such as `common.logger`.

    Raises
    ------
    InputError : it is not installed.
    """
    try:
        return importlib.import_module("stable_baselines3" + (f".{part}" if part else ""))
    except ImportError as error:
        raise InputError(
            "stable-baselines3 is not installed; `pip install '.[baselines]'` in the project's folder brings it."
        ) from error


def as_trained(algorithm: Algorithm, policy: Any, system: System, steps: int, seed: int) -> Trained:
    """The policy of a model, by its mean and by samples, in physical inputs."""
    interface = Interface(system)

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
