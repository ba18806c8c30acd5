"""The training run: Algorithm 1 of the paper around `sac.SAC` and `lqr.GainLearner`, with exact resumption.

While a round of identification is under way, episodes start in the ball and end on leaving it, so that the transitions
it needs are gathered within a few hundred steps; otherwise, and with `identification_starts` "domain" always, episodes
start anywhere in the domain. Every transition also goes into the replay buffer. With `identification` "before" there is
one round, at the beginning and with random actions, and the warm-up is counted from its end; with "never" there is
none, and no gain.

A checkpoint holds everything that the rest of the run depends on (networks, optimisers, replay buffer, random
states, the episode under way, the identification), so that a resumed run equals an uninterrupted one.
"""

from __future__ import annotations

import io
import json
import math
import platform
from collections.abc import Callable
from dataclasses import astuple
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from certify.loop.policies import Policy
from controllers.environments import PlantEnvironment, Snapshot
from controllers.evaluate import curvature, errors_of, settle
from controllers.files import write_atomically
from controllers.logs import Episode, Monitored
from controllers.lqr import GainLearner, Identified, Phase
from controllers.options import Plant, TrainingOptions, available_plants, default_record
from controllers.sac import CPU, SAC, Interface, Replay

Array = NDArray[np.float64]

CHECKPOINT_FORMAT = "controllers-checkpoint/2"


class Trainer:
    """One run, advanced step by step.

    Parameters
    ----------
    system : the plant; only the environment reads its equations.
    options : everything else.
    device : where the networks and the replay table live; of no account for checkpoints and policies.
    plant : where the evaluations during the run start; default: the plant that ships under the system's name, and no
        evaluations if there is none.

    Raises
    ------
    InputError : weights or the time step do not fit the plant.
    """

    def __init__(
        self, system: System, options: TrainingOptions, device: torch.device = CPU, plant: Plant | None = None
    ) -> None:
        options.check(system)
        self.system, self.options, self.plant = system, options, plant
        self.environment = PlantEnvironment(system, options)
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
        self._x, _ = self.environment.reset(seed=options.seed)
        self._begin_episode()

    def advance(self) -> None:
        """One environment step and, after the warm-up, one gradient step."""
        options, x = self.options, self._x
        if options.identification == "during" and self.steps_done and self.steps_done % options.refresh == 0:
            self.gain.refresh()
        if options.identification == "before" and self.gain.phase != "idle":
            self._prelude = self.steps_done + 1
        u, normalised = self._choose(x)
        x_next, reward, terminated, truncated, _ = self.environment.step(u)
        self.replay.add(x, normalised, reward, x_next, terminated)
        known = self.gain.identified
        self.gain.observe(x, u - self.interface.u_eq, x_next)
        if self.gain.identified is not known:
            self._learn_gain()
        self.steps_done += 1
        self._x = x_next
        self._total += reward
        self._length += 1
        if terminated:
            self._finish_episode("terminated")
        elif truncated:
            self._finish_episode("truncated")
        elif self._near and not self.gain.inside(x_next):
            self._finish_episode("left the ball")
        if self.steps_done > self._prelude + options.warm_up:
            batch = self.replay.sample(options.batch, self.generator)
            self.sac.update(batch, self._K, self._actor_step())

    @property
    def closing(self) -> tuple[int, int] | None:
        """The steps between which `close` lets the actor's step fall; None before it."""
        return self._closing

    def close(self, begin: int, end: int) -> None:
        """Let the actor's step fall linearly to zero between these two steps, whatever `anneal` says."""
        self._closing = begin, end

    def distance(self) -> tuple[float, float]:
        """||J_mu(0) + K||, NaN without a gain, and ||mu(0) - u_eq|| of the actor as it is."""
        with torch.no_grad():
            mean, jacobian = self.sac.actor.at_origin()
            offset = float(torch.linalg.vector_norm(mean - self.sac.actor.u_eq))
            if self._K is None:
                return float("nan"), offset
            return float(torch.linalg.vector_norm(jacobian + self._K)), offset

    def monitor(self) -> None:
        """Judge the policy as it is, in a second or so; draws none of the run's random numbers."""
        network, options = self.sac.actor.network(), self.options
        Q, R = np.array(options.state_weights), np.array(options.input_weights)
        settled = cost = float("nan")
        if self.plant is not None or self.system.name in available_plants():
            found = settle(network, self.system, options.dt, Q, R, plant=self.plant)
            settled, cost = found.settled / found.states, found.cost
        bend = curvature(network, self.system, options.eta)
        known, errors = self.gain.identified, (float("nan"),) * 3
        if known is not None:
            errors = errors_of(known, self.system, options.dt, Q, R)
        self.monitored.append(Monitored(self.steps_done, *self.distance(), bend, settled, cost, *errors))

    @property
    def ships(self) -> bool:
        """Whether there is a policy to ship: the gain is learned, or is not to be."""
        return self.gain.identified is not None or self.options.identification == "never"

    def policy(self) -> Policy:
        """The mean action, centred, with the record of how it was made.

        Raises
        ------
        InputError : the run is too short to have learned a gain, and was to learn one; or it has diverged.
        """
        self._require_finite(self.distance()[1])
        found = self.gain.identified
        if not self.ships:
            passing = self.options.identification_starts == "domain"
            instead = ", or `identification_starts` ball, which goes where the gain is learned" if passing else ""
            raise InputError(
                f"the run ended after {self.steps_done} steps without a gain; it needs more `steps`{instead}."
            )
        return Policy(
            network=self.sac.actor.network(),
            system=self.system.name,
            parameters=parameters_of(self.system),
            training=self._record(found),
        )

    def snapshot(self) -> bytes:
        """The whole run as the bytes of a checkpoint file.

        Raises
        ------
        InputError : the run has diverged.
        """
        self._require_finite(self.distance()[1])
        state = {
            "format": CHECKPOINT_FORMAT,
            "system": [self.system.name, parameters_of(self.system)],
            "options": self.options.record(),
            "steps_done": self.steps_done,
            "prelude": self._prelude,
            "closing": None if self._closing is None else list(self._closing),
            "sac": self.sac.state(),
            "gain": self.gain.state(),
            "replay": {"rows": self.replay.table[: len(self.replay)].cpu().clone(), "count": self.replay.count},
            "generator": self.generator.get_state(),
            # 128-bit integers: as text, which every reader of plain tensors accepts.
            "environment_generator": json.dumps(self.environment.np_random.bit_generator.state),
            "environment": [list(self.environment.snapshot().x), self.environment.snapshot().elapsed],
            "episode": [self._near, self._total, self._length],
            "episodes": [astuple(episode) for episode in self.episodes],
            "monitored": [astuple(row) for row in self.monitored],
        }
        buffer = io.BytesIO()
        torch.save(state, buffer)
        return buffer.getvalue()

    def restore(self, checkpoint: bytes) -> None:
        """Continue from `snapshot()`.

        Raises
        ------
        InputError : the bytes are no checkpoint, or one of a run with other options or another plant.
        """
        state = read_checkpoint(checkpoint)
        if state.get("system") != [self.system.name, parameters_of(self.system)]:
            raise InputError(f"the checkpoint must be of {self.system.name}; it is of {state['system']}.")
        mine = self.options.record()
        theirs = {**default_record(), **state.get("options", {})}  # a run had no options that came later
        changed = sorted(name for name in mine.keys() | theirs.keys() if mine.get(name) != theirs.get(name))
        if changed:
            name = changed[0]
            raise InputError(
                f"a run is resumed with the options it began with; `{name}` was {theirs.get(name)}, "
                f"now it is {mine.get(name)}."
            )
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
        rows = state["replay"]["rows"]
        self.replay.table[: len(rows)] = rows
        self.replay.count = state["replay"]["count"]
        self.generator.set_state(state["generator"])
        self.environment.np_random.bit_generator.state = json.loads(state["environment_generator"])
        x, elapsed = state["environment"]
        self.environment.restore(Snapshot(tuple(x), elapsed))
        self._x = np.array(x)
        self._near, self._total, self._length = state["episode"]
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
            begin, end = self._closing
            return min(1.0, max(0.0, (end - self.steps_done) / max(1, end - begin)))
        anneal = self.options.anneal * self.options.steps
        return min(1.0, (self.options.steps - self.steps_done) / anneal) if anneal > 0 else 1.0

    def _learn_gain(self) -> None:
        if self.gain.identified is not None:
            self._K = torch.from_numpy(self.gain.identified.K).float().to(self.sac.device)

    def _begin_episode(self) -> None:
        self._near = self.gain.phase != "idle" and self.options.identification_starts == "ball"
        self._x, _ = self.environment.reset(options={"radius": self.options.eta} if self._near else None)
        self._total, self._length = 0.0, 0

    def _finish_episode(self, outcome: str) -> None:
        kind = "identification" if self._near else "training"
        distance, offset = self.distance()
        self._require_finite(offset)
        self.episodes.append(Episode(self.steps_done, kind, self._length, self._total, outcome, distance, offset))
        self._begin_episode()

    def _require_finite(self, offset: float) -> None:
        if not math.isfinite(offset):
            raise InputError(
                f"the run has diverged: the actor's weights are not finite after {self.steps_done} steps. Try a "
                "smaller `learning_rate` or `gain_weight`, or another `seed`; an earlier checkpoint is still sound."
            )

    def _record(self, found: Identified | None) -> dict[str, Any]:
        distance, offset = self.distance()
        learned: dict[str, Any] = {}
        if found is not None:
            learned = {"A": found.A.tolist(), "B": found.B.tolist(), "K": found.K.tolist(), "distance": distance}
        return {
            **self.options.record(),
            **learned,
            "offset_before_centring": offset,
            "curvature": curvature(self.sac.actor.network(), self.system, self.options.eta),
            "versions": {
                "python": platform.python_version(),
                "torch": torch.__version__.split("+")[0],
                "numpy": np.__version__,
            },
            "device": self.sac.device.type,
        }


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
        raise InputError(f"`checkpoint_every` must be positive; found {checkpoint_every}.")
    if evaluate_every < 0:
        raise InputError(f"`evaluate_every` must be at least 0; found {evaluate_every}.")
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


def read_checkpoint(content: bytes) -> dict[str, Any]:
    """The state that `Trainer.snapshot` wrote, on the CPU; what it holds is not looked at.

    Raises
    ------
    InputError : the bytes are no checkpoint.
    """
    try:
        state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # torch.load has no closed list of what it raises on a damaged file
        raise InputError(f"the checkpoint cannot be read: {error}.") from error
    if not isinstance(state, dict) or state.get("format") != CHECKPOINT_FORMAT:
        raise InputError(f"the checkpoint must have the format {CHECKPOINT_FORMAT!r}.")
    return state


def parameters_of(system: System) -> dict[str, str]:
    """A plant's parameters as text, which stands for the exact value: decimal where that is exact, else a fraction."""
    texts = {}
    for name, value in system.parameters.items():
        decimal = str(Decimal(value.numerator) / Decimal(value.denominator))
        texts[name] = decimal if Fraction(decimal) == value else str(value)
    return texts
