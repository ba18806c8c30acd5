"""Our policy beside its baselines or its ablations: trained on one budget, simulated from the same states.

Everything is simulated from the plant's box of initial states, with the action held over the training step, which in
discrete time is the plant's own, and clipped to the input's bounds; a run goes on outside the domain. These are figures
for a report, never a proof.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from certify.provers.execution.tasks import Place
from controllers.baselines import Trained
from controllers.course import Course
from controllers.figures import draw_curves, draw_over_time, draw_positions, draw_space, draw_states
from controllers.files import make_folder, write_atomically
from controllers.options import TrainingOptions
from controllers.responses import NAMES, CompareOptions, Response, Row, Run, Spent, table
from controllers.runs import Doing, Wanted, obtain, plan_of, train_at
from controllers.sb3 import require_stable_baselines
from controllers.simulation import initial_states, simulate

Array = NDArray[np.float64]


def compare(
    system: System,
    training: TrainingOptions,
    runs: Path,
    out: Path,
    options: CompareOptions | None = None,
    say: Callable[[str], None] = lambda line: None,
    watch: Callable[[Doing], None] = lambda doing: None,
    place: Place | None = None,
) -> dict[str, Any]:
    """Train what is missing in `runs`, simulate all, write the figures and the table to `out`.

    Parameters
    ----------
    training : the plant's preset with the steps of every run; its seed is replaced.
    say : takes a line of progress, ten times in a run that is trained.
    watch : is told of every step that is trained, and of every run that is there.
    place : where runs are trained, several at a time; None trains one after the other in this process. Then progress
        is told of whole runs.

    Returns
    -------
    The table and the names of the files, as plain values.

    Raises
    ------
    InputError : the plant has no file among `controllers.plants`, stable-baselines3 is missing, a file in `runs`
        is of another plant, seed or budget, or a folder cannot be written.
    BackendError : a run could not be trained at the place; those that were are kept.
    """
    options = options or CompareOptions()
    x0, duration = initial_states(system, options.states, options.start_seed), options.span(system)[0]
    training.check(system)
    if any(method.run in ("sb3-sac", "sb3-ppo") for method in options.methods):
        require_stable_baselines()
    responses, courses = list[Response](), list[tuple[Run, int, Course]]()
    kinds = list(dict.fromkeys(method.run for method in options.methods))
    wanted = [
        Wanted(run, replace(training, seed=seed), plan_of(run, training, options))
        for run in kinds
        for seed in range(options.seeds)
    ]
    make_folder(out)
    if place is not None:
        train_at(place, wanted, system, runs, say, watch)
    for number, one in enumerate(wanted, 1):
        run, seed = one.run, one.training.seed

        def tell(done: int, steps: int, number: int = number, what: str = f"{NAMES[run]}, seed {seed}") -> None:
            watch(Doing(what, number, len(wanted), done, steps))

        found = obtain(run, system, one.training, runs, one.plan, say, tell)
        trained, course = found.trained, found.course
        tell(course.steps, course.steps)
        courses.append((run, seed, course))
        spent = Spent(course.steps, course.rows[-1].wall, course.rows[-1].cpu)
        for method in options.methods:
            if method.run == run:
                act = _action(trained, method.sampled, options.start_seed)
                x, cost = simulate(system, training, act, x0, duration)
                responses.append(Response(method, seed, trained.steps, x, cost, spent))
    rows = table(system, training.dt, responses, options)
    drawings = _drawings(system, training.dt, responses, rows, courses)
    ablations = {method.run for method in options.methods} & {"before", "uncentred"}
    stem = system.name + ("-ablations" if ablations else "")
    result: dict[str, Any] = {
        "system": system.name,
        "time": system.time,
        "dt": training.dt,
        "duration": duration,
        "states": options.states,
        "seeds": options.seeds,
        "runs": [
            {"run": run, "seed": seed, "why": course.why, "kept": course.kept, "steps": course.steps}
            for run, seed, course in courses
        ],
        "plans": {one.run: asdict(one.plan) for one in wanted},
        "tolerance": options.tolerance,
        "rows": [row.as_json() for row in rows],
        "files": {name: str(out / f"{stem}-{name}.png") for name in drawings},
    }
    for name, content in drawings.items():
        write_atomically(out / f"{stem}-{name}.png", content)
    for kind, content in (("csv", _csv(rows)), ("json", (json.dumps(result, indent=1) + "\n").encode())):
        write_atomically(out / f"{stem}-table.{kind}", content)
        result["files"][kind] = str(out / f"{stem}-table.{kind}")
    return result


def _drawings(
    system: System,
    dt: float,
    responses: Sequence[Response],
    rows: Sequence[Row],
    courses: Sequence[tuple[Run, int, Course]],
) -> dict[str, bytes]:
    """The figures by their names."""
    drawings = {
        "cost": draw_over_time("cost", system, dt, responses, rows),
        "norm": draw_over_time("norm", system, dt, responses, rows),
        "positions": draw_positions(system, dt, responses),
        "states": draw_states(system, dt, responses),
        "curves": draw_curves(system, [(run, seed, course.rows) for run, seed, course in courses]),
    }
    space = draw_space(system, dt, responses)
    return drawings if space is None else {**drawings, "space": space}


def _action(trained: Trained, sampled: bool, start_seed: int) -> Callable[[Array], Array]:
    sample = trained.sample
    if not sampled or sample is None:
        return trained.mean
    generator = np.random.default_rng([start_seed, trained.seed])
    return lambda x: sample(x, generator)


def _csv(rows: Sequence[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(Row)])
    for row in rows:
        writer.writerow(astuple(replace(row, seed="all") if row.seed is None else row))  # type: ignore[arg-type]
    return text.getvalue().encode()
