"""The zip file of a model of stable-baselines3: trained into, and read without unpickling."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import get_args

from certify.certificates import write_atomically
from certify.errors import InputError
from certify.loop.plants import System
from controllers.comparison.stable_baselines.learner import Sb3Learner
from controllers.comparison.stable_baselines.model import Algorithm, as_trained, budget, stable_baselines
from controllers.comparison.trained import Trained
from controllers.options import TrainingOptions


def train_sb3(
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
    short of them by less than the number of rollouts. The file records the steps that were made.
    """
    if algorithm in get_args(Algorithm) and options.steps < 2:
        raise InputError(f"`steps` of a baseline must be at least 2; found {options.steps}.")
    steps, rollout = budget(algorithm, options.steps)
    learner = Sb3Learner(algorithm, system, options, rollout)
    learner.advance(steps, (lambda done: None) if report is None else report)
    write_atomically(out, learner.saved())
    return learner.steps_done


def read_sb3(content: bytes, system: System, options: TrainingOptions) -> Trained:
    """The policy in the bytes of a file written by `Sb3Learner`; only its tensors are read, nothing unpickled.

    Parameters
    ----------
    options : the options it was trained with, as far as they decide the networks' shapes.

    Raises
    ------
    InputError : stable-baselines3 is missing, or the bytes are no such file of this plant and these widths.
    """
    from_zip = stable_baselines("common.save_util").load_from_zip_file
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
    model = Sb3Learner(algorithm, system, replace(options, seed=seed, steps=max(steps, 2), replay=1), 2).model
    try:
        own = model.get_parameters()
        # A file may lack the optimisers, which are two thirds of it: nobody resumes it.
        optimisers = {name: own[name] for name in own if name.endswith("optimizer") and name not in parameters}
        model.set_parameters({**parameters, **optimisers}, device="cpu")
    except (ValueError, RuntimeError) as error:
        raise InputError(f"the baseline's networks must have the preset's widths: {error}.") from error
    return as_trained(algorithm, model.policy, system, steps, seed)
