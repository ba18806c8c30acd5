"""Our policy beside its baselines or its ablations: trained on one budget, simulated from the same states.

A folder of runs holds `<run>/seed-<k>/` with the file that each run ends in: `policy.pt`, as `controllers train`
writes it, in `ours`, `before` and `uncentred`; `checkpoint.pt`, as `--checkpoint-dir` keeps it, in `sac`, the same SAC
without the gain; `model.zip`, as `controllers train-baseline` writes it, in `sb3-sac` and `sb3-ppo`. What is missing
is trained, what is there is used; our own runs also go on from a checkpoint that lies there. Where a run is trained,
in this process, in others of this machine or on a cluster, changes nothing in it: what comes back is its file, which is
read as any other before it gets its name.

Everything is simulated from the plant's box of initial states, with the action held over the training step and
clipped to the input's bounds; a run goes on outside the domain. These are figures for a report, never a proof.
"""

from __future__ import annotations

import csv
import io
import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import BackendError, InputError
from certify.policies import load_policy, save_policy
from certify.running.tasks import Piece, Place, Processes
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
    place: Place | None = None,
) -> dict[str, Any]:
    """Train what is missing in `runs`, simulate all, write three figures and the table to `out`.

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
    x0 = initial_states(system, options.states, options.start_seed)
    training.check_sizes(system)
    if any(method.run in ("sb3-sac", "sb3-ppo") for method in options.methods):
        require_stable_baselines()
    make_folder(out)
    responses = []
    kinds = list(dict.fromkeys(method.run for method in options.methods))
    if place is not None:
        _train_at(place, kinds, options.seeds, system, training, runs, say, watch)
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
    path, steps = _path(runs, run, training), _steps(run, training)
    trained = _there(run, path, system, training)
    if trained is None:
        make_folder(path.parent)
        _train(run, system, training, path, _progress(f"{run} seed {training.seed}", steps, say, tell))
        trained = _load(run, path, system, training)
    return _required(trained, run, path, training)


def _path(runs: Path, run: Run, training: TrainingOptions) -> Path:
    """The file that a run ends in."""
    return runs / run / f"seed-{training.seed}" / _FILES[run]


def _steps(run: Run, training: TrainingOptions) -> int:
    """The steps that a run of this budget makes."""
    return budget("ppo" if run == "sb3-ppo" else "sac", training.steps)[0]


def _there(run: Run, path: Path, system: System, training: TrainingOptions) -> Trained | None:
    """The run in the file; None if there is none, or a checkpoint from which it goes on."""
    trained = _load(run, path, system, training) if path.is_file() else None
    unfinished = trained is not None and run == "sac" and trained.steps < _steps(run, training)
    return None if trained is None or (unfinished and trained.seed == training.seed) else trained


def _required(trained: Trained, run: Run, path: Path, training: TrainingOptions) -> Trained:
    """The run, if it has the budget and the seed that are asked for.

    Raises
    ------
    InputError : it has others.
    """
    steps = _steps(run, training)
    if (trained.steps, trained.seed) != (steps, training.seed):
        raise InputError(
            f"{path} must be a run of {steps} steps with seed {training.seed}; it has {trained.steps} steps with "
            f"seed {trained.seed}. Compare with its number of steps, or in another folder of runs."
        )
    return trained


def _train_at(
    place: Place,
    kinds: Sequence[Run],
    seeds: int,
    system: System,
    training: TrainingOptions,
    runs: Path,
    say: Callable[[str], None],
    watch: Callable[[Doing], None],
) -> None:
    """Train the runs that are missing at a place.

    Processes of this machine work in the folder of runs, and leave checkpoints there; a cluster gets the checkpoint
    that is there, and its file is written here.

    Raises
    ------
    BackendError : one could not be trained; the others are kept.
    InputError : what came back is no such run.
    """
    wanted = [(run, replace(training, seed=seed)) for run in kinds for seed in range(seeds)]
    missing = {
        f"{run} seed {options.seed}": (run, options)
        for run, options in wanted
        if _there(run, _path(runs, run, options), system, options) is None
    }
    done, lost = len(wanted) - len(missing), dict[str, str]()
    with closing(place.run(_pieces(place, missing, system, runs))) as outcomes:
        for outcome in outcomes:
            if outcome is None:
                continue
            if outcome.result is None:
                lost[outcome.key] = outcome.reason
                continue
            run, options = missing[outcome.key]
            if outcome.result:
                _keep(outcome.result, run, _path(runs, run, options), system, options)
            done, steps = done + 1, _steps(run, options)
            say(f"{outcome.key}: {steps} of {steps} steps")
            watch(Doing(f"{NAMES[run]}, seed {options.seed}", done, len(wanted), steps, steps))
    if lost:
        what, why = next(iter(lost.items()))
        raise BackendError(
            f"{len(lost)} of {len(missing)} runs could not be trained, {what} among them: {why}. "
            "What was trained is kept; the same command goes on."
        )


def _pieces(
    place: Place, missing: dict[str, tuple[Run, TrainingOptions]], system: System, runs: Path
) -> Iterator[Piece]:
    for key, (run, options) in missing.items():
        path = _path(runs, run, options)
        if isinstance(place, Processes):
            make_folder(path.parent)
            yield Piece(key, train_here, (run, system, options, path))
        else:
            checkpoint = path.with_name("checkpoint.pt")
            content = checkpoint.read_bytes() if checkpoint.is_file() else None
            yield Piece(key, train_elsewhere, (run, system, options, content))


def train_here(run: Run, system: System, training: TrainingOptions, path: Path) -> bytes:
    """Train a run into its file; nothing is sent back."""
    _train(run, system, training, path, lambda done: None)
    return b""


def train_elsewhere(run: Run, system: System, training: TrainingOptions, checkpoint: bytes | None) -> bytes:
    """Train a run, from a checkpoint if there is one; the bytes of its file."""
    with tempfile.TemporaryDirectory(prefix="controllers-run-") as folder:
        if checkpoint is not None:
            write_atomically(Path(folder) / "checkpoint.pt", checkpoint)
        path = Path(folder) / _FILES[run]
        _train(run, system, training, path, lambda done: None)
        return path.read_bytes()


def _keep(content: bytes, run: Run, path: Path, system: System, training: TrainingOptions) -> None:
    """Give what came back its name, once it was read as the run that was asked for.

    Raises
    ------
    InputError : it is none.
    """
    with tempfile.TemporaryDirectory(prefix="controllers-run-") as folder:
        received = Path(folder) / _FILES[run]
        received.write_bytes(content)
        _required(_load(run, received, system, training), run, path, training)
    make_folder(path.parent)
    write_atomically(path, content)
    if run != "sac":
        path.with_name("checkpoint.pt").unlink(missing_ok=True)


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
