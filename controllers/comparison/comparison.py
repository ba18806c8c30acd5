"""Our policy beside its baselines or its ablations: trained on one budget, simulated from the same states.

Everything is simulated from the plant's box of initial states, with the input held over the training step, which in
discrete time is the plant's own, and clipped to the input's bounds; a run continues outside the domain. These are
figures for a report, never a proof.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from certify.provers.execution.tasks import Place
from controllers.comparison.finished_run import FinishedRun
from controllers.comparison.methods import NAMES
from controllers.comparison.options import CompareOptions
from controllers.comparison.places import train_at
from controllers.comparison.runs import ObtainedRun, RunProgress, WantedRun, obtain, plan_of
from controllers.comparison.stable_baselines.model import require_stable_baselines
from controllers.comparison.table import Response, Row, Spent, table
from controllers.comparison.trained import Trained
from controllers.options import TrainingOptions
from controllers.simulation.trajectories import initial_states, simulate

Array = NDArray[np.float64]
Say = Callable[[str], None]
Watch = Callable[[RunProgress], None]


@dataclass(frozen=True, slots=True)
class Comparison:
    """The runs of a comparison, their responses, and the table of these."""

    system: System
    dt: float
    options: CompareOptions
    runs: tuple[tuple[WantedRun, FinishedRun], ...]
    responses: tuple[Response, ...]
    rows: tuple[Row, ...]

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "system": self.system.name,
            "time": self.system.time,
            "dt": self.dt,
            "duration": self.options.span(self.system)[0],
            "states": self.options.states,
            "seeds": self.options.seeds,
            "runs": [
                {
                    "run": wanted.run,
                    "seed": wanted.training.seed,
                    "why": finished.why,
                    "kept": finished.kept,
                    "steps": finished.steps,
                }
                for wanted, finished in self.runs
            ],
            "plans": {wanted.run: asdict(wanted.plan) for wanted, _ in self.runs},
            "tolerance": self.options.tolerance,
            "rows": [row.as_json() for row in self.rows],
        }


def wanted_runs(system: System, training: TrainingOptions, options: CompareOptions) -> list[WantedRun]:
    """The runs that a comparison needs.

    Raises
    ------
    InputError : the options do not fit the plant or each other, or stable-baselines3 is needed and missing.
    """
    training.check(system)
    if any(method.run in ("sb3-sac", "sb3-ppo") for method in options.methods):
        require_stable_baselines()
    return [
        WantedRun(run, replace(training, seed=seed), plan_of(run, training, options))
        for run in dict.fromkeys(method.run for method in options.methods)
        for seed in range(options.seeds)
    ]


def compare(
    system: System,
    training: TrainingOptions,
    runs: Path,
    options: CompareOptions | None = None,
    say: Say = lambda line: None,
    watch: Watch = lambda progress: None,
    place: Place | None = None,
) -> Comparison:
    """Train what is missing in the folder `runs`, and simulate all.

    Parameters
    ----------
    training : the plant's preset with the steps of every run; its seed is replaced.
    say : takes a line of progress, ten times in a run that is trained.
    watch : is told of every step that is trained, and of every run that is there.
    place : where runs are trained, several at a time; None trains one after the other in this process. Then progress
        is told of whole runs.

    Raises
    ------
    InputError : the plant has no file among `controllers.plants.shipped`, stable-baselines3 is missing, a file in
        `runs` is of another plant, seed or budget, or a folder cannot be written.
    BackendError : a run could not be trained at the place; those that were are kept.
    """
    options = options or CompareOptions()
    x0 = initial_states(system, options.states, options.start_seed)
    wanted = wanted_runs(system, training, options)
    if place is not None:
        train_at(place, wanted, system, runs, say, watch)
    finished, responses = list[FinishedRun](), list[Response]()
    for number, one in enumerate(wanted, 1):
        found = _obtained(one, number, len(wanted), system, runs, say, watch)
        finished.append(found.finished)
        responses += _responses(one, found, system, x0, options)
    return Comparison(
        system=system,
        dt=training.dt,
        options=options,
        runs=tuple(zip(wanted, finished, strict=True)),
        responses=tuple(responses),
        rows=tuple(table(system, training.dt, responses, options)),
    )


def _obtained(
    wanted: WantedRun, number: int, of: int, system: System, runs: Path, say: Say, watch: Watch
) -> ObtainedRun:
    name = f"{NAMES[wanted.run]}, seed {wanted.training.seed}"

    def tell(done: int, steps: int) -> None:
        watch(RunProgress(name, number, of, done, steps))

    found = obtain(wanted.run, system, wanted.training, runs, wanted.plan, say, tell)
    tell(found.finished.steps, found.finished.steps)
    return found


def _responses(
    wanted: WantedRun, found: ObtainedRun, system: System, x0: Array, options: CompareOptions
) -> list[Response]:
    """The responses of one run: by its mean action, by samples, or both."""
    trained, last = found.trained, found.finished.rows[-1]
    spent = Spent(found.finished.steps, last.wall, last.cpu)
    responses = []
    for method in options.methods:
        if method.run == wanted.run:
            act = _action(trained, method.sampled, options.start_seed)
            x, cost = simulate(system, wanted.training, act, x0, options.span(system)[0])
            responses.append(Response(method, wanted.training.seed, trained.steps, x, cost, spent))
    return responses


def _action(trained: Trained, sampled: bool, start_seed: int) -> Callable[[Array], Array]:
    sample = trained.sample
    if not sampled or sample is None:
        return trained.mean
    generator = np.random.default_rng([start_seed, trained.seed])
    return lambda x: sample(x, generator)
