"""Our policy beside its baselines or its ablations: trained on one budget, simulated from the same states.

A folder of runs holds `<run>/seed-<k>/` with the file that each run ends in: `policy.pt`, as `controllers train`
writes it, in `ours`, `before` and `uncentred`; `checkpoint.pt`, as `--checkpoint-dir` keeps it, in `sac`, the same SAC
without the gain; `model.zip`, as `controllers train-baseline` writes it, in `sb3-sac` and `sb3-ppo`. What is missing
is trained, what is there is used; our own runs also go on from a checkpoint that lies there.

Everything is simulated from the plant's box of initial states, with the action held over the training step and
clipped to the input's bounds; a run goes on outside the domain. These are figures for a report, never a proof.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.policies import load_policy, save_policy
from certify.systems import System
from controllers.baselines import (
    Trained,
    budget,
    from_checkpoint,
    from_policy,
    from_reference,
    require_stable_baselines,
    train_reference,
    without_gain,
)
from controllers.figures import draw_over_time, draw_states
from controllers.files import make_folder, read, write_atomically
from controllers.options import TrainingOptions
from controllers.responses import NAMES, CompareOptions, Response, Row, Run, table
from controllers.simulation import Action, held_loop, initial_states
from controllers.training import Trainer, train

Array = NDArray[np.float64]

_FILES: dict[Run, str] = {
    "ours": "policy.pt",
    "sac": "checkpoint.pt",
    "before": "policy.pt",
    "uncentred": "policy.pt",
    "sb3-sac": "model.zip",
    "sb3-ppo": "model.zip",
}


@dataclass(frozen=True, slots=True)
class Doing:
    """What a comparison is doing.

    Parameters
    ----------
    what : the run in words.
    run, runs : its number, from 1 on, and how many there are.
    done, steps : of its training; equal once it is trained.
    """

    what: str
    run: int
    runs: int
    done: int
    steps: int


def compare(
    system: System,
    training: TrainingOptions,
    runs: Path,
    out: Path,
    options: CompareOptions | None = None,
    say: Callable[[str], None] = lambda line: None,
    watch: Callable[[Doing], None] = lambda doing: None,
) -> dict[str, Any]:
    """Train what is missing in `runs`, simulate all, write three figures and the table to `out`.

    Parameters
    ----------
    training : the plant's preset with the steps of every run; its seed is replaced.
    say : takes a line of progress, ten times in a run that is trained.
    watch : is told of every step that is trained, and of every run that is there.

    Returns
    -------
    The table and the names of the files, as plain values.

    Raises
    ------
    InputError : the plant has no file among `controllers.plants`, stable-baselines3 is missing, a file in `runs`
        is of another plant, seed or budget, or a folder cannot be written.
    """
    options = options or CompareOptions()
    x0 = initial_states(system, options.states, options.start_seed)
    training.check_sizes(system)
    if any(method.run in ("sb3-sac", "sb3-ppo") for method in options.methods):
        require_stable_baselines()
    make_folder(out)
    responses = []
    kinds = list(dict.fromkeys(method.run for method in options.methods))
    for k, run in enumerate(kinds):
        for seed in range(options.seeds):
            number, what = k * options.seeds + seed + 1, f"{NAMES[run]}, seed {seed}"

            def tell(done: int, steps: int, number: int = number, what: str = what) -> None:
                watch(Doing(what, number, len(kinds) * options.seeds, done, steps))

            trained = obtain(run, system, replace(training, seed=seed), runs, say, tell)
            tell(trained.steps, trained.steps)
            for method in options.methods:
                if method.run == run:
                    act = _action(trained, method.sampled, options.start_seed)
                    x, cost = simulate(system, training, act, x0, options.duration)
                    responses.append(Response(method, seed, trained.steps, x, cost))
    rows = table(system, training.dt, responses, options)
    drawings = {
        "cost": draw_over_time("cost", system, training.dt, responses, rows),
        "norm": draw_over_time("norm", system, training.dt, responses, rows),
        "states": draw_states(system, training.dt, responses),
    }
    ablations = {method.run for method in options.methods} & {"before", "uncentred"}
    stem = system.name + ("-ablations" if ablations else "")
    result: dict[str, Any] = {
        "system": system.name,
        "dt": training.dt,
        "duration": options.duration,
        "states": options.states,
        "seeds": options.seeds,
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


def obtain(
    run: Run,
    system: System,
    training: TrainingOptions,
    runs: Path,
    say: Callable[[str], None] = lambda line: None,
    tell: Callable[[int, int], None] = lambda done, steps: None,
) -> Trained:
    """The run of `training.seed` from its file in `runs`, trained first if there is none.

    Raises
    ------
    InputError : the file is of another plant, seed or budget, or damaged, or the folder cannot be written.
    """
    folder = runs / run / f"seed-{training.seed}"
    path, what = folder / _FILES[run], f"{run} seed {training.seed}"
    steps = budget("ppo" if run == "sb3-ppo" else "sac", training.steps)[0]
    trained = _load(run, path, system, training) if path.is_file() else None
    if trained is None or (run == "sac" and trained.steps < steps and trained.seed == training.seed):
        make_folder(folder)
        _train(run, system, training, path, _progress(what, steps, say, tell))
        trained = _load(run, path, system, training)
    if (trained.steps, trained.seed) != (steps, training.seed):
        raise InputError(
            f"{path} must be a run of {steps} steps with seed {training.seed}; it has {trained.steps} steps with "
            f"seed {trained.seed}. Compare with its number of steps, or in another folder of runs."
        )
    return trained


def variant(run: Run, training: TrainingOptions) -> TrainingOptions:
    """The options of one of our own runs."""
    if run == "sac":
        return without_gain(training)
    if run == "before":
        return replace(training, identification="before")
    return replace(training, centre="none") if run == "uncentred" else training


def simulate(system: System, training: TrainingOptions, act: Action, x0: Array, duration: float) -> tuple[Array, Array]:
    """States (T + 1, N, n) and accumulated cost (T + 1, N) of the held closed loop from x0 (N, n).

    Parameters
    ----------
    training : dt, and the weights of `x'Qx + (u - u_eq)'R(u - u_eq)`, which is summed times dt.
    act : states (N, n) to inputs (N, m), which are clipped to their bounds.
    duration : seconds; T is the number of steps that cover it.
    """
    Q, R = np.array(training.state_weights), np.array(training.input_weights)
    u_lo, u_hi = np.array(system.input_bounds, dtype=np.float64).T
    loop = held_loop(system, training.dt, lambda x: np.clip(act(x), u_lo, u_hi), Q, R)
    states, costs = zip(*loop.run(x0, duration), strict=True)
    return np.stack(states), np.stack(costs)


def _action(trained: Trained, sampled: bool, start_seed: int) -> Callable[[Array], Array]:
    sample = trained.sample
    if not sampled or sample is None:
        return trained.mean
    generator = np.random.default_rng([start_seed, trained.seed])
    return lambda x: sample(x, generator)


def _load(run: Run, path: Path, system: System, training: TrainingOptions) -> Trained:
    if run in ("ours", "before", "uncentred"):
        policy = load_policy(path)
        for name in ("identification", "centre"):  # what tells these runs apart
            asked, found = getattr(variant(run, training), name), policy.training.get(name)
            if found != asked:
                raise InputError(f"{path}: `{name}` must be {asked!r} for the run {run}; it is {found!r}.")
        return from_policy(policy, system)
    content = read(path)
    return from_checkpoint(content, system) if run == "sac" else from_reference(content, system, training)


def _train(run: Run, system: System, training: TrainingOptions, path: Path, report: Callable[[int], None]) -> None:
    if run == "sb3-sac" or run == "sb3-ppo":
        train_reference("sac" if run == "sb3-sac" else "ppo", system, training, path, report)
        return
    trainer = Trainer(system, variant(run, training))
    checkpoint = path.with_name("checkpoint.pt")
    if checkpoint.is_file():
        trainer.restore(checkpoint.read_bytes())
    policy = train(trainer, lambda trainer: report(trainer.steps_done), checkpoint)
    if run == "sac":
        write_atomically(checkpoint, trainer.snapshot())
        return
    save_policy(path, policy)
    checkpoint.unlink(missing_ok=True)


def _progress(
    what: str, steps: int, say: Callable[[str], None], tell: Callable[[int, int], None]
) -> Callable[[int], None]:
    """Tells of every step, and says ten times in a run how far it is."""
    every = max(1, steps // 10)

    def report(done: int) -> None:
        tell(done, steps)
        if done % every == 0:
            say(f"{what}: {done} of {steps} steps")

    return report


def _csv(rows: Sequence[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(Row)])
    for row in rows:
        writer.writerow(astuple(replace(row, seed="all") if row.seed is None else row))  # type: ignore[arg-type]
    return text.getvalue().encode()
