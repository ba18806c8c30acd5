"""SAC and PPO of stable-baselines3 on our plants, as learners that can be followed and resumed to the bit.

They are an outside reference. They learn on `PlantEnvironment` of the plant's preset: its rewards, dt, horizon and
starts, with the preset's actor widths and tanh activation. They see the states times `Interface.state_factors`, as our
learner does, and actions scaled to [-1, 1]; learning rate, gamma, batch, tau, replay buffer and warm-up of its SAC are
the preset's, the critics have the preset's widths and the actor's activation, and everything else (the temperature that
SAC tunes, all of PPO's) is its own default. It is an optional extra, imported only where it is used.

stable-baselines3 draws from torch's and numpy's global generators. A learner has states of its own for them, which are
put in place while it works: two learners in a process know nothing of each other, and one that is restored draws what
it would have drawn.
"""

from __future__ import annotations

import importlib
import io
import json
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy, TanhNetwork, save_policy
from controllers.baselines import Trained
from controllers.environments import PlantEnvironment, Snapshot
from controllers.files import write_atomically
from controllers.options import TrainingOptions, default_record
from controllers.sac import Interface
from controllers.training import parameters_of

Array = NDArray[np.float64]
Algorithm = Literal["ppo", "sac"]

CHECKPOINT_FORMAT = "controllers-sb3-checkpoint/1"
MODEL = "model.zip"
ROLLOUT = 2048  # steps between two updates of PPO: the default of stable-baselines3


class Reference:
    """A run of stable-baselines3; a `controllers.course.Learner`.

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
        self._generators = _globals()
        self.plant = PlantEnvironment(system, options)
        with self._own_generators():
            self.model = _model(algorithm, options, self.plant, rollout)
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
        """Go on until at least so many steps are made in all, PPO to the end of a rollout; `tell` hears of each."""

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
        return _trained(self.algorithm, self.model.policy, self.system, self.steps_done, self.options.seed)

    def network(self) -> TanhNetwork:
        """The mean action as an exact tanh network, not centred: PPO's is clipped, SAC's is squashed by tanh."""
        policy, interface = self.model.policy, Interface(self.system)
        if self.algorithm == "ppo":
            layers = [*policy.mlp_extractor.policy_net, policy.action_net]
        else:
            layers = [*policy.actor.latent_pi, policy.actor.mu]
        affine = [layer for layer in layers if isinstance(layer, nn.Linear)]
        weights = [layer.weight.detach().double().numpy() for layer in affine]
        weights[0] = weights[0] * interface.state_factors  # powers of two: exact
        u_lo, u_hi = np.array(self.system.input_bounds, dtype=np.float64).T
        return TanhNetwork(
            weights=tuple(weights),
            biases=tuple(layer.bias.detach().double().numpy() for layer in affine),
            scale=interface.scale,
            offset=interface.offset,
            squash="identity" if self.algorithm == "ppo" else "tanh",
            centre="none",
            clip=(u_lo, u_hi) if self.algorithm == "ppo" else None,
        )

    def keep(self, folder: Path) -> None:
        """Write `model.zip`, the library's own file, and `policy.pt`, the mean action as a policy file."""
        write_atomically(folder / MODEL, self.saved())
        record = {"algorithm": f"{self.algorithm} of stable-baselines3", "steps": self.steps_done}
        training = {**self.options.record(), **record}
        save_policy(
            folder / "policy.pt", Policy(self.network(), self.system.name, parameters_of(self.system), training)
        )

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
        """Everything that the rest of the run depends on, as plain tensors and values."""
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
        content = io.BytesIO()
        torch.save(state, content)
        return content.getvalue()

    def restore(self, checkpoint: bytes) -> None:
        """Go on from `snapshot()`.

        Raises
        ------
        InputError : the bytes are no checkpoint, or one of another run.
        """
        try:
            state = torch.load(io.BytesIO(checkpoint), map_location="cpu", weights_only=True)
        except Exception as error:  # torch.load has no closed list of what it raises on a damaged file
            raise InputError(f"the checkpoint cannot be read: {error}.") from error
        if not isinstance(state, dict) or state.get("format") != CHECKPOINT_FORMAT:
            raise InputError(f"the checkpoint must have the format {CHECKPOINT_FORMAT!r}.")
        mine = [self.algorithm, [self.system.name, parameters_of(self.system)], self.options.record()]
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
        if self._closing is None:
            return 1.0
        begin, end = self._closing
        return min(1.0, max(0.0, (end - self.steps_done) / (end - begin))) if end > begin else 0.0

    @contextmanager
    def _own_generators(self) -> Iterator[None]:
        outside = _globals()
        _put(self._generators)
        try:
            yield
        finally:
            self._generators = _globals()
            _put(outside)


_REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


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
    short of them by less than the number of rollouts. The file records the steps that were made.
    """
    if algorithm in get_args(Algorithm) and options.steps < 2:
        raise InputError(f"`steps` of a baseline must be at least 2; found {options.steps}.")
    steps, rollout = budget(algorithm, options.steps)
    learner = Reference(algorithm, system, options, rollout)
    learner.advance(steps, (lambda done: None) if report is None else report)
    write_atomically(out, learner.saved())
    return learner.steps_done


def from_reference(content: bytes, system: System, options: TrainingOptions) -> Trained:
    """The policy in the bytes of a file written by `Reference`; only its tensors are read, nothing unpickled.

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
    model = Reference(algorithm, system, replace(options, seed=seed, steps=max(steps, 2), replay=1), 2).model
    try:
        own = model.get_parameters()
        # A file may lack the optimisers, which are two thirds of it: nobody goes on from there.
        optimisers = {name: own[name] for name in own if name.endswith("optimizer") and name not in parameters}
        model.set_parameters({**parameters, **optimisers}, device="cpu")
    except (ValueError, RuntimeError) as error:
        raise InputError(f"the baseline's networks must have the preset's widths: {error}.") from error
    return _trained(algorithm, model.policy, system, steps, seed)


def scaled_environment(plant: PlantEnvironment) -> Any:
    """`plant` as stable-baselines3 wants it: float32 states of order one, actions in [-1, 1]."""
    factors = Interface(plant.system).state_factors
    space = gymnasium.spaces.Box(-np.inf, np.inf, (plant.system.n,), np.float32)
    seen = gymnasium.wrappers.TransformObservation(plant, lambda x: (x * factors).astype(np.float32), space)
    return gymnasium.wrappers.RescaleAction(seen, -1.0, 1.0)


def require_stable_baselines() -> None:
    """Raise InputError, which says what to install, unless stable-baselines3 is there."""
    _stable_baselines()


def budget(algorithm: Algorithm, steps: int) -> tuple[int, int]:
    """Steps to make in all, at most `steps`, and steps of one rollout.

    >>> budget("ppo", 40_000), budget("ppo", 80_000), budget("sac", 40_000)
    ((40000, 2000), (79989, 2051), (40000, 1))
    """
    if algorithm == "sac":
        return steps, 1
    rollouts = max(1, round(steps / ROLLOUT))
    return rollouts * (steps // rollouts), steps // rollouts


def _model(algorithm: Algorithm, options: TrainingOptions, plant: PlantEnvironment, rollout: int) -> Any:
    library = _stable_baselines()
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
    networks = {"net_arch": shape, "activation_fn": nn.Tanh}
    # As a vector of one: then the library puts nothing of its own around it that a checkpoint would have to hold.
    vector = _stable_baselines("common.vec_env").DummyVecEnv([lambda: scaled_environment(plant)])
    with warnings.catch_warnings():
        # PPO's last batch of a rollout may not be full; it is used all the same.
        warnings.filterwarnings("ignore", message="You have specified a mini-batch size of", category=UserWarning)
        model = make("MlpPolicy", vector, policy_kwargs=networks, **common)
    model.set_logger(_stable_baselines("common.logger").Logger(folder=None, output_formats=[]))
    return model


def _trained(algorithm: Algorithm, policy: Any, system: System, steps: int, seed: int) -> Trained:
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


def _globals() -> dict[str, Any]:
    """The states of torch's and numpy's global generators, as a tensor and plain values."""
    _, keys, position, has_gauss, cached = np.random.get_state()  # noqa: NPY002  # what the library draws from
    return {
        "torch": torch.random.get_rng_state(),
        "numpy": [torch.from_numpy(np.asarray(keys, dtype=np.int64)), int(position), int(has_gauss), float(cached)],
    }


def _put(state: dict[str, Any]) -> None:
    keys, *rest = state["numpy"]
    torch.random.set_rng_state(state["torch"])
    np.random.set_state(("MT19937", keys.numpy().astype(np.uint32), *rest))  # noqa: NPY002


def _stable_baselines(part: str = "") -> ModuleType:
    try:
        return importlib.import_module("stable_baselines3" + (f".{part}" if part else ""))
    except ImportError as error:
        raise InputError("stable-baselines3 is not installed; `pip install 'certify[baselines]'` brings it.") from error
