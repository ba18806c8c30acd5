"""SAC and PPO of stable-baselines3 on our plants, as learners that can be followed and resumed to the bit.

They learn on `PlantEnvironment` of the plant's preset: its rewards, dt, horizon and
starts, with the preset's actor widths and activation. They see the states times `Interface.state_factors`, as our
learner does, and actions scaled to [-1, 1]; learning rate, gamma, batch, tau, replay buffer and warm-up of its SAC are
the preset's, the critics have the preset's widths and the actor's activation, and everything else (the temperature that
SAC tunes, all of PPO's) is its own default. It is an optional extra, imported only where it is used.

stable-baselines3 draws from torch's and numpy's global generators. A learner has states of its own for them, which are
put in place while it works: two learners in a process know nothing of each other, and one that is restored draws what
it would have drawn.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from certify.certificates import write_atomically
from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy, PolicyNetwork, save_policy
from controllers.comparison.run_files import MODEL, POLICY
from controllers.comparison.stable_baselines.model import ROLLOUT, Algorithm, as_trained, new_model
from controllers.comparison.trained import Trained
from controllers.options import TrainingOptions, default_record
from controllers.training.annealing import closing_share
from controllers.training.checkpoint import read_checkpoint, written_checkpoint
from controllers.training.environment import PlantEnvironment, Snapshot
from controllers.training.interface import Interface
from controllers.training.record import parameters_of

Array = NDArray[np.float64]


def global_generators() -> dict[str, Any]:
    """The states of torch's and numpy's global generators, as a tensor and plain values."""
    _, keys, position, has_gauss, cached = np.random.get_state()  # noqa: NPY002  # what the library draws from
    return {
        "torch": torch.random.get_rng_state(),
        "numpy": [torch.from_numpy(np.asarray(keys, dtype=np.int64)), int(position), int(has_gauss), float(cached)],
    }


def set_global_generators(state: dict[str, Any]) -> None:
    """Put the generators into these states."""
    keys, *rest = state["numpy"]
    torch.random.set_rng_state(state["torch"])
    np.random.set_state(("MT19937", keys.numpy().astype(np.uint32), *rest))  # noqa: NPY002


CHECKPOINT_FORMAT = "controllers-sb3-checkpoint/1"


class Sb3Learner:
    """A run of stable-baselines3; a `controllers.comparison.finished_run.Learner`.

    Parameters
    ----------
    algorithm : which one.
    system : the plant.
    options : the plant's preset with the seed of this run; `steps` bounds the replay buffer.
    rollout : steps between two updates of PPO, which learns in whole ones; SAC learns in each step.

    Raises
    ------
    InputError : stable-baselines3 is missing, the algorithm is unknown, or the weights do not fit the plant.
    """

    def __init__(self, algorithm: Algorithm, system: System, options: TrainingOptions, rollout: int = ROLLOUT) -> None:
        if algorithm not in get_args(Algorithm):
            raise InputError(f"the baseline must be one of {', '.join(get_args(Algorithm))}; found {algorithm!r}.")
        options.check(system)
        self.algorithm, self.system, self.options = algorithm, system, options
        self._closing: tuple[int, int] | None = None
        self._generators = global_generators()
        self.plant = PlantEnvironment(system, options)
        with self._own_generators():
            self.model = new_model(algorithm, options, self.plant, rollout)
        self.model.lr_schedule = lambda _: options.learning_rate * self._share()

    @property
    def steps_done(self) -> int:
        """Environment steps so far."""
        return int(self.model.num_timesteps)

    @property
    def closing(self) -> tuple[int, int] | None:
        """The two steps of `close`; None before it."""
        return self._closing

    def advance(self, steps: int, tell: Callable[[int], None] = lambda done: None) -> None:
        """Take steps until at least so many are made in all, PPO to the end of a rollout; `tell` gets each number."""

        def step(_: dict[str, Any], __: dict[str, Any]) -> bool:
            tell(self.steps_done)
            return True

        torch.set_num_threads(self.options.threads)
        if steps > self.steps_done:
            with self._own_generators():
                self.model.learn(steps - self.steps_done, callback=step, reset_num_timesteps=False)

    def close(self, begin: int, end: int) -> None:
        """Let the learning rate fall linearly to zero between these two steps."""
        self._closing = begin, end

    def trained(self) -> Trained:
        """The policy as it is."""
        return as_trained(self.algorithm, self.model.policy, self.system, self.steps_done, self.options.seed)

    def network(self) -> PolicyNetwork:
        """The mean action as an exact network, not centred: PPO's is clipped, SAC's is squashed by tanh."""
        policy, interface = self.model.policy, Interface(self.system)
        if self.algorithm == "ppo":
            layers = [*policy.mlp_extractor.policy_net, policy.action_net]
        else:
            layers = [*policy.actor.latent_pi, policy.actor.mu]
        affine = [layer for layer in layers if isinstance(layer, nn.Linear)]
        weights = [layer.weight.detach().double().numpy() for layer in affine]
        weights[0] = weights[0] * interface.state_factors  # powers of two: exact
        u_lo, u_hi = np.array(self.system.input_bounds, dtype=np.float64).T
        return PolicyNetwork.of_layers(
            weights=tuple(weights),
            biases=tuple(layer.bias.detach().double().numpy() for layer in affine),
            scale=interface.scale,
            offset=interface.offset,
            squash="identity" if self.algorithm == "ppo" else "tanh",
            centre="none",
            clip=(u_lo, u_hi) if self.algorithm == "ppo" else None,
            activation=self.options.activation,
        )

    def keep(self, folder: Path) -> None:
        """Write `model.zip`, the library's own file, and `policy.pt`, the mean action as a policy file."""
        write_atomically(folder / MODEL, self.saved())
        record = {"algorithm": f"{self.algorithm} of stable-baselines3", "steps": self.steps_done}
        training = {**self.options.record(), **record}
        save_policy(folder / POLICY, Policy(self.network(), self.system.name, parameters_of(self.system), training))

    def saved(self) -> bytes:
        """The bytes of the library's own zip file, with a plain record of the run in it."""
        # Plain values, which the file keeps as JSON: they are read back without unpickling anything.
        self.model.trained_on = {
            "algorithm": self.algorithm,
            "system": self.system.name,
            "steps": self.steps_done,
            "seed": self.options.seed,
        }
        schedule, self.model.lr_schedule = self.model.lr_schedule, self.options.learning_rate  # it would be pickled
        buffer = io.BytesIO()
        self.model.save(buffer)
        self.model.lr_schedule = schedule
        return buffer.getvalue()

    def snapshot(self) -> bytes:
        """The bytes of a checkpoint, with everything that the rest of the run depends on."""
        model, plant = self.model, self.plant
        state: dict[str, Any] = {
            "format": CHECKPOINT_FORMAT,
            "algorithm": self.algorithm,
            "system": [self.system.name, parameters_of(self.system)],
            "options": self.options.record(),
            "steps": self.steps_done,
            "updates": int(model._n_updates),
            "closing": None if self._closing is None else list(self._closing),
            "parameters": model.get_parameters(),
            "generators": self._generators,
            "plant": [list(plant.snapshot().x), plant.snapshot().elapsed],
            "plant_generator": json.dumps(plant.np_random.bit_generator.state),  # 128-bit integers, as text
            "action_generator": json.dumps(model.action_space.np_random.bit_generator.state),
            "seen": None if model._last_obs is None else torch.from_numpy(model._last_obs.copy()),
        }
        if self.algorithm == "ppo":
            state["starts"] = None if model._last_obs is None else model._last_episode_starts.tolist()
        else:
            buffer = model.replay_buffer
            rows = buffer.buffer_size if buffer.full else buffer.pos
            state["replay"] = {name: torch.from_numpy(getattr(buffer, name)[:rows].copy()) for name in _REPLAY}
            state["replay_end"] = [buffer.pos, buffer.full]
            state["log_ent_coef"] = model.log_ent_coef.detach().clone()
        return written_checkpoint(state)

    def restore(self, checkpoint: bytes) -> None:
        """Continue from `snapshot()`.

        Raises
        ------
        InputError : the bytes are no checkpoint, or one of another run.
        """
        state = read_checkpoint(checkpoint, CHECKPOINT_FORMAT)
        mine = [self.algorithm, [self.system.name, parameters_of(self.system)], self.options.full_record()]
        began = {**default_record(), **state.get("options", {})}  # a run had no options that came later
        if [state.get("algorithm"), state.get("system"), began] != mine:
            raise InputError(
                "the checkpoint must be of the same algorithm on the same plant with the same options; it is not."
            )
        try:
            self._load(state)
        except (KeyError, TypeError, ValueError, IndexError, RuntimeError, AttributeError) as error:
            raise InputError(f"the checkpoint is damaged: {error}.") from error

    def _load(self, state: dict[str, Any]) -> None:
        model, plant = self.model, self.plant
        model.set_parameters(state["parameters"], exact_match=True, device="cpu")
        model.num_timesteps, model._n_updates = int(state["steps"]), int(state["updates"])
        self._closing = None if state["closing"] is None else (int(state["closing"][0]), int(state["closing"][1]))
        self._generators = state["generators"]
        if state["seen"] is not None:  # else it has not begun, and what it was made with stands
            model.env._reset_seeds()
            model._last_obs = state["seen"].numpy()
            plant.reset(seed=0)  # makes its generator
            plant.np_random.bit_generator.state = json.loads(state["plant_generator"])
            x, elapsed = state["plant"]
            plant.restore(Snapshot(tuple(x), int(elapsed)))
        model.action_space.np_random.bit_generator.state = json.loads(state["action_generator"])
        if self.algorithm == "ppo":
            model._last_episode_starts = None if state["starts"] is None else np.array(state["starts"], dtype=bool)
        else:
            buffer = model.replay_buffer
            for name in _REPLAY:
                rows = state["replay"][name].numpy()
                getattr(buffer, name)[: len(rows)] = rows
            buffer.pos, buffer.full = int(state["replay_end"][0]), bool(state["replay_end"][1])
            with torch.no_grad():
                model.log_ent_coef.copy_(state["log_ent_coef"])

    def _share(self) -> float:
        return 1.0 if self._closing is None else closing_share(self._closing, self.steps_done)

    @contextmanager
    def _own_generators(self) -> Iterator[None]:
        outside = global_generators()
        set_global_generators(self._generators)
        try:
            yield
        finally:
            self._generators = global_generators()
            set_global_generators(outside)


_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
