"""The training run: Algorithm 1 of the paper around `SAC` and `GainLearner`, resumed to the bit.

While a round of identification is under way, episodes start in the ball and end on leaving it, so that the transitions
it needs are gathered within a few hundred steps; otherwise, and with `identification_starts` "domain" always, episodes
start anywhere in the domain. Every transition also goes into the replay buffer. With `identification` "before" there is
one round, at the beginning and with random actions, and the warm-up is counted from its end; with "never" there is
none, and no gain.

A checkpoint holds everything that the rest of the run depends on (networks, optimisers, replay buffer, random
states, the episode under way, the identification), so that a resumed run equals an uninterrupted one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from certify.certificates import write_atomically
from certify.errors import InputError, OptionError
from certify.loop.plants import System
from certify.loop.policies import Policy
from controllers.identification.gain_learner import GainLearner, Phase
from controllers.options import Plant, TrainingOptions
from controllers.training.annealing import annealed_share, closing_share
from controllers.training.checkpoint import CHECKPOINT_FORMAT, read_checkpoint, require_same_run, written_checkpoint
from controllers.training.device import CPU
from controllers.training.environment import PlantEnvironment
from controllers.training.episode import RunningEpisode
from controllers.training.interface import Interface
from controllers.training.log import Episode, Monitored
from controllers.training.monitoring import monitored
from controllers.training.record import parameters_of, require_slope, training_record
from controllers.training.replay import Replay
from controllers.training.sac import SAC

Array = NDArray[np.float64]


class Trainer:
    """One run, advanced step by step.

    Parameters
    ----------
    system : the plant; only the environment reads its equations.
    options : everything else.
    device : where the networks and the replay table live; of no account for checkpoints and policies.
    plant : where the evaluations during the run start; default: the plant that ships under the system's name, and no
        evaluations if there is none.
    environment : the plant step by step; default: by the system's equations.

    Raises
    ------
    InputError : weights or the time step do not fit the plant.
    """

    def __init__(
        self,
        system: System,
        options: TrainingOptions,
        device: torch.device = CPU,
        plant: Plant | None = None,
        environment: PlantEnvironment | None = None,
    ) -> None:
        options.check(system)
        self.system, self.options, self.plant = system, options, plant
        self.environment = PlantEnvironment(system, options) if environment is None else environment
        self.interface = Interface(system)
        Q_c, R_c = np.diag(options.state_weights), np.diag(options.input_weights)
        first: Phase = "idle" if options.identification == "never" else "A"
        self.gain = GainLearner(
            options.eta, options.n_A, options.n_B, Q_c, R_c, first, options.transitions, options.terms_A
        )
        self.generator = torch.Generator(CPU).manual_seed(options.seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(options.seed)
            self.sac = SAC(self.interface, options, self.generator, device)
        self.replay = Replay(min(options.replay, options.steps), system.n, system.m, device)
        self.steps_done = 0
        self._prelude = 0  # steps of the identification before the warm-up
        self._closing: tuple[int, int] | None = None
        self.episodes: list[Episode] = []
        self.monitored: list[Monitored] = []
        self._K: torch.Tensor | None = None
        self.episode = RunningEpisode(self.environment, options.seed)
        self._begin_episode()

    def advance(self) -> None:
        """One environment step and, after the warm-up, one gradient step."""
        options, x = self.options, self.episode.x
        if options.identification == "during" and self.steps_done and self.steps_done % options.refresh == 0:
            self.gain.refresh()
        if options.identification == "before" and self.gain.phase != "idle":
            self._prelude = self.steps_done + 1
        u, normalised = self._choose(x)
        x_next, reward, terminated, truncated = self.episode.step(u)
        self.replay.add(x, normalised, reward, x_next, terminated)
        known = self.gain.identified
        self.gain.observe(x, u - self.interface.u_eq, x_next)
        if self.gain.identified is not known:
            self._learn_gain()
        self.steps_done += 1
        if terminated:
            self._finish_episode("terminated")
        elif truncated:
            self._finish_episode("truncated")
        elif self.episode.near and not self.gain.inside(x_next):
            self._finish_episode("left the ball")
        if self.steps_done > self._prelude + options.warm_up:
            batch = self.replay.sample(options.batch, self.generator)
            self.sac.update(batch, self._K, self._actor_step())

    @property
    def closing(self) -> tuple[int, int] | None:
        """The steps between which `close` lets the actor's step fall; None before it."""
        return self._closing

    def close(self, begin: int, end: int) -> None:
        """Let the actor's step fall linearly to zero between these two steps, whatever `anneal` is."""
        self._closing = begin, end

    def distance(self) -> tuple[float, float]:
        """||J_mu(0) + K||, NaN without a gain, and ||mu(0) - u_eq|| of the actor as it is."""
        return self.sac.actor.distance(self._K)

    def monitor(self) -> None:
        """Judge the policy as it is, in a second or so; draws none of the run's random numbers."""
        network, at = self.sac.actor.network(), (self.steps_done, *self.distance())
        self.monitored.append(monitored(network, self.gain.identified, self.system, self.plant, self.options, at))

    @property
    def ships(self) -> bool:
        """True if there is a policy to ship: the gain is learned, or is not to be."""
        return self.gain.identified is not None or self.options.identification == "never"

    def policy(self) -> Policy:
        """The mean action, centred, with the record of how it was made.

        Raises
        ------
        InputError : the run is too short to have learned a gain, or has diverged, or a unit's corner is at the origin.
        """
        _require_finite(self.distance()[1], self.steps_done)
        if not self.ships:
            passing = self.options.identification_starts == "domain"
            instead = ", or `identification_starts` ball, which goes where the gain is learned" if passing else ""
            raise OptionError(
                f"the run ended after {self.steps_done} steps without a gain; it needs more `steps`{instead}."
            )
        network, found, device = self.sac.actor.network(), self.gain.identified, self.sac.device
        require_slope(network, self.system)
        record = training_record(self.options, self.system, network, found, self.distance(), device)
        return Policy(network, self.system.name, parameters_of(self.system), record)

    def snapshot(self) -> bytes:
        """The whole run as the bytes of a checkpoint file.

        Raises
        ------
        InputError : the run has diverged.
        """
        _require_finite(self.distance()[1], self.steps_done)
        state = {
            "format": CHECKPOINT_FORMAT,
            "system": [self.system.name, parameters_of(self.system)],
            "options": self.options.record(),
            "steps_done": self.steps_done,
            "prelude": self._prelude,
            "closing": None if self._closing is None else list(self._closing),
            "sac": self.sac.state(),
            "gain": self.gain.state(),
            "replay": self.replay.state(),
            "generator": self.generator.get_state(),
            **self.episode.state(),
            "episodes": [astuple(episode) for episode in self.episodes],
            "monitored": [astuple(row) for row in self.monitored],
        }
        return written_checkpoint(state)

    def restore(self, checkpoint: bytes) -> None:
        """Continue from `snapshot()`.

        Raises
        ------
        InputError : the bytes are no checkpoint, or one of a run with other options or another plant.
        """
        state = read_checkpoint(checkpoint)
        require_same_run(state, self.system, self.options)
        try:
            self._load(state)
        except (KeyError, TypeError, ValueError, IndexError, RuntimeError) as error:
            raise InputError(f"the checkpoint is damaged: {error}.") from error

    def _load(self, state: dict[str, Any]) -> None:
        self.steps_done, self._prelude = state["steps_done"], state["prelude"]
        closing = state.get("closing")
        self._closing = None if closing is None else (closing[0], closing[1])
        self.sac.load_state(state["sac"])
        self.gain.load_state(state["gain"])
        if self.gain.identified is not None:
            self._learn_gain()
        self.replay.load_state(state["replay"])
        self.generator.set_state(state["generator"])
        self.episode.load_state(state)
        self.episodes = [Episode(*row) for row in state["episodes"]]
        self.monitored = [Monitored(*row) for row in state["monitored"]]

    def _choose(self, x: Array) -> tuple[Array, Array]:
        """The input u and `tanh(w)` of it; zero action is u_eq to the last bit."""
        if self.gain.phase == "A" and self.gain.inside(x):
            return self.interface.u_eq, self.interface.to_normalised(self.interface.u_eq)
        if self.steps_done < self._prelude + self.options.warm_up:
            normalised = np.asarray(self.environment.np_random.uniform(-1.0, 1.0, self.system.m))
        else:
            normalised = self.sac.act(x)
        return self.interface.to_action(normalised), normalised

    def _actor_step(self) -> float:
        if self._closing is not None:
            return closing_share(self._closing, self.steps_done)
        return annealed_share(self.options.anneal, self.options.steps, self.steps_done)

    def _learn_gain(self) -> None:
        if self.gain.identified is not None:
            self._K = torch.from_numpy(self.gain.identified.K).float().to(self.sac.device)

    def _begin_episode(self) -> None:
        near = self.gain.phase != "idle" and self.options.identification_starts == "ball"
        self.episode.begin(self.options.eta if near else None)

    def _finish_episode(self, outcome: str) -> None:
        ended = self.episode
        kind = "identification" if ended.near else "training"
        distance, offset = self.distance()
        _require_finite(offset, self.steps_done)
        self.episodes.append(Episode(self.steps_done, kind, ended.length, ended.total, outcome, distance, offset))
        self._begin_episode()


def _require_finite(offset: float, steps: int) -> None:
    if not math.isfinite(offset):
        raise OptionError(
            f"the run has diverged: the actor's weights are not finite after {steps} steps. Try a smaller "
            "`learning_rate` or `gain_weight`, or another `seed`; an earlier checkpoint is still sound."
        )


def train(
    trainer: Trainer,
    report: Callable[[Trainer], None] | None = None,
    checkpoint: Path | None = None,
    checkpoint_every: int = 10_000,
    evaluate_every: int = 0,
) -> Policy:
    """Run `trainer` to its last step and return the policy.

    Parameters
    ----------
    trainer : a new or a restored run.
    report : called after each step, for progress and logs.
    checkpoint : file that is rewritten every `checkpoint_every` steps.
    evaluate_every : steps between two calls of `Trainer.monitor`, which is also called at the end; 0 means never.
    """
    if checkpoint_every < 1:
        raise OptionError(f"`checkpoint_every` must be positive; found {checkpoint_every}.")
    if evaluate_every < 0:
        raise OptionError(f"`evaluate_every` must be at least 0; found {evaluate_every}.")
    torch.set_num_threads(trainer.options.threads)
    while trainer.steps_done < trainer.options.steps:
        trainer.advance()
        done = trainer.steps_done
        if evaluate_every and (done % evaluate_every == 0 or done == trainer.options.steps):
            trainer.monitor()
        if report is not None:
            report(trainer)
        if checkpoint is not None and done % checkpoint_every == 0:
            write_atomically(checkpoint, trainer.snapshot())
    return trainer.policy()
