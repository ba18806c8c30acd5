"""Our policy beside its baselines: trained on one budget, simulated from the same states, drawn and tabulated.

A folder of runs holds `<run>/seed-<k>/` with the file that each run ends in: `ours/seed-0/policy.pt`, as `controllers
train` writes it; `sac/seed-0/checkpoint.pt`, the same SAC without the gain, as `--checkpoint-dir` keeps it;
`sb3-sac/seed-0/model.zip` and `sb3-ppo/seed-0/model.zip`, as `controllers train-baseline` writes them. What is missing
is trained, what is there is used; our own runs also go on from a checkpoint that lies there.

Everything is simulated with the action held over the training step and clipped to the input's bounds, in the plant's
box of `INITIAL_STATES`; a run goes on outside the domain. A trajectory whose state is no longer finite, or beyond
`DIVERGED`, has *diverged*: its cost and norm are infinite from there on, and infinity takes part in every quartile.
Quartiles are over seeds and states together. These are figures for a report, never a proof.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

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
from controllers.environments import Stepper
from controllers.evaluate import INITIAL_STATES
from controllers.options import TrainingOptions
from controllers.training import Trainer, train, write_atomically

Array = NDArray[np.float64]
Run = Literal["ours", "sac", "sb3-sac", "sb3-ppo"]

DIVERGED = 1e9
"""Bound on |x_i|, in the states' units: beyond it a trajectory counts as diverged."""

POSITIONS: dict[str, tuple[str, ...]] = {
    "pendulum": ("theta",),
    "cartpole": ("p", "theta"),
    "quadrotor2d": ("x", "y", "theta"),
    "quadrotor3d": ("x", "y", "z"),
}
"""The states of each plant whose trajectories are drawn."""

_FILES: dict[Run, str] = {
    "ours": "policy.pt", "sac": "checkpoint.pt", "sb3-sac": "model.zip", "sb3-ppo": "model.zip",
}  # fmt: skip
_COLOURS: dict[Run, str] = {  # Okabe and Ito's, told apart with any colour vision
    "ours": "#0072b2", "sac": "#d55e00", "sb3-sac": "#009e73", "sb3-ppo": "#cc79a7",
}  # fmt: skip
_NAMES: dict[Run, str] = {
    "ours": "ours", "sac": "SAC without gain", "sb3-sac": "SB3 SAC", "sb3-ppo": "SB3 PPO",
}  # fmt: skip
_RC: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": "#6b7785",
    "axes.labelcolor": "#1f2933",
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "text.color": "#1f2933",
    "xtick.color": "#6b7785",
    "ytick.color": "#6b7785",
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
}
_SMALLEST = 1e-16  # norms are drawn from here on: a logarithmic axis has no 0


@dataclass(frozen=True, slots=True)
class Method:
    """A way to act: a kind of run, and whether its action is the mean or sampled."""

    run: Run
    sampled: bool

    @property
    def name(self) -> str:
        """For the table: `ours`, `sac mean`, `sac stochastic`, ..."""
        return self.run if self.run == "ours" else f"{self.run} {'stochastic' if self.sampled else 'mean'}"

    @property
    def label(self) -> str:
        """For people."""
        return _NAMES[self.run] + ("" if self.run == "ours" else ", stochastic" if self.sampled else ", mean")


METHODS: tuple[Method, ...] = (
    Method("ours", False),
    *(Method(run, sampled) for run in ("sac", "sb3-sac", "sb3-ppo") for sampled in (False, True)),
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareOptions:
    """What is compared.

    Parameters
    ----------
    seeds : trained runs of each kind, with the seeds 0, 1, ...
    states, start_seed : number and seed of the initial states, which all methods share.
    duration, window : seconds simulated, and the last seconds in which the floor of ||x|| is measured.
    tolerance : bound on ||x|| in the window for a trajectory that has settled.
    """

    seeds: int = 5
    states: int = 50
    start_seed: int = 0
    duration: float = 20.0
    window: float = 1.0
    tolerance: float = 1e-6

    def __post_init__(self) -> None:
        for name in ("seeds", "states", "duration", "window", "tolerance"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"`{name}` must be positive and finite; found {getattr(self, name)}.")
        if self.start_seed < 0 or self.window > self.duration:
            raise InputError("`start_seed` must be at least 0 and `window` at most `duration`.")


@dataclass(frozen=True, slots=True)
class Response:
    """One trained run, simulated.

    Parameters
    ----------
    x : states (T + 1, N, n); NaN after a divergence.
    cost : accumulated cost (T + 1, N), 0 at first; infinite after a divergence.
    """

    method: Method
    seed: int
    steps: int
    x: Array
    cost: Array

    @property
    def norm(self) -> Array:
        """||x||, shape (T + 1, N); infinite after a divergence."""
        norm = np.linalg.norm(self.x, axis=2)
        return np.where(np.isnan(norm), math.inf, norm)


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table; `seed` is None for all seeds together.

    `floor` is the median over the trajectories of the largest ||x|| in the window; `settled`, `diverged` and
    `left_domain` count trajectories out of `trajectories`; the costs are quartiles at the end.
    """

    method: str
    seed: int | None
    steps: int
    trajectories: int
    settled: int
    diverged: int
    left_domain: int
    floor: float
    cost_lower: float
    cost_median: float
    cost_upper: float

    def as_json(self) -> dict[str, Any]:
        """Plain values; infinity becomes None."""
        values = {column.name: getattr(self, column.name) for column in fields(self)}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def compare(
    system: System,
    training: TrainingOptions,
    runs: Path,
    out: Path,
    options: CompareOptions | None = None,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Train what is missing in `runs`, simulate all, write three figures and the table to `out`.

    Parameters
    ----------
    training : the plant's preset with the steps of every run; its seed is replaced.
    say : takes a line of progress.

    Returns
    -------
    The table and the names of the files, as plain values.

    Raises
    ------
    InputError : the plant has no box of initial states or no positions, stable-baselines3 is missing, a file in `runs`
        is of another plant, seed or budget, or a folder cannot be written.
    """
    options = options or CompareOptions()
    if system.name not in INITIAL_STATES or system.name not in POSITIONS:
        raise InputError(f"no initial states and positions are known for the plant {system.name}.")
    training.check_sizes(system)
    require_stable_baselines()
    _make(out)
    half_widths = np.array(INITIAL_STATES[system.name])
    x0 = np.random.default_rng(options.start_seed).uniform(-half_widths, half_widths, (options.states, system.n))
    responses = []
    for run in get_args(Run):
        for seed in range(options.seeds):
            trained = obtain(run, system, replace(training, seed=seed), runs, say)
            for method in METHODS:
                if method.run == run:
                    act = _action(trained, method.sampled, options.start_seed)
                    x, cost = simulate(system, training, act, x0, options.duration)
                    responses.append(Response(method, seed, trained.steps, x, cost))
    rows = table(system, training.dt, responses, options)
    drawings = {
        "cost": _draw_over_time("cost", system, training.dt, responses, rows),
        "norm": _draw_over_time("norm", system, training.dt, responses, rows),
        "positions": _draw_positions(system, training.dt, responses),
    }
    result: dict[str, Any] = {
        "system": system.name,
        "dt": training.dt,
        "duration": options.duration,
        "states": options.states,
        "seeds": options.seeds,
        "tolerance": options.tolerance,
        "rows": [row.as_json() for row in rows],
        "files": {name: str(out / f"{system.name}-{name}.png") for name in drawings},
    }
    for name, content in drawings.items():
        write_atomically(out / f"{system.name}-{name}.png", content)
    for kind, content in (("csv", _csv(rows)), ("json", (json.dumps(result, indent=1) + "\n").encode())):
        write_atomically(out / f"{system.name}-table.{kind}", content)
        result["files"][kind] = str(out / f"{system.name}-table.{kind}")
    return result


def obtain(
    run: Run, system: System, training: TrainingOptions, runs: Path, say: Callable[[str], None] = lambda line: None
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
        _make(folder)
        _train(run, system, training, path, _progress(what, steps, say))
        trained = _load(run, path, system, training)
    if (trained.steps, trained.seed) != (steps, training.seed):
        raise InputError(
            f"{path} must be a run of {steps} steps with seed {training.seed}; it has {trained.steps} steps with "
            f"seed {trained.seed}. Compare with its number of steps, or in another folder of runs."
        )
    return trained


def simulate(
    system: System, training: TrainingOptions, act: Callable[[Array], Array], x0: Array, duration: float
) -> tuple[Array, Array]:
    """States (T + 1, N, n) and accumulated cost (T + 1, N) of the held closed loop from x0 (N, n).

    Parameters
    ----------
    training : dt, and the weights of `x'Qx + (u - u_eq)'R(u - u_eq)`, which is summed times dt.
    act : states (N, n) to inputs (N, m); only asked about states that have not diverged.
    duration : seconds; T is the number of steps that cover it.
    """
    step, dt = Stepper(system, training.dt, "numpy"), training.dt
    Q, R = np.array(training.state_weights), np.array(training.input_weights)
    u_eq = np.array([float(u) for u in system.exact_u_eq()])
    u_lo, u_hi = np.array(system.input_bounds, dtype=np.float64).T
    count = math.ceil(duration / dt - 1e-9)
    states, costs = np.empty((count + 1, *x0.shape)), np.zeros((count + 1, len(x0)))
    states[0] = x = x0
    for k in range(count):
        alive = np.asarray(~np.isnan(x).any(axis=1))
        u = np.clip(act(np.where(alive[:, None], x, 0.0)), u_lo, u_hi)
        added = dt * ((Q * x * x).sum(1) + (R * (u - u_eq) ** 2).sum(1))
        costs[k + 1] = np.where(np.isnan(added), math.inf, costs[k] + added)
        with np.errstate(over="ignore", invalid="ignore"):  # a run that diverges is a result, not an accident
            x = step(x, u)
            x = np.where((np.abs(x) <= DIVERGED).all(axis=1)[:, None], x, math.nan)
        states[k + 1] = x
    costs[-1] = np.where(np.isnan(x).any(axis=1), math.inf, costs[-1])
    return states, costs


def quartiles(values: Array) -> Array:
    """Lower quartile, median and upper quartile along the last axis, shape (3, ...); infinity is a value like any.

    >>> quartiles(np.array([4.0, 1.0, 2.0, 3.0]))
    array([1.75, 2.5 , 3.25])
    >>> quartiles(np.array([1.0, np.inf, 2.0, np.inf, np.inf]))
    array([ 2., inf, inf])
    """
    ordered = np.moveaxis(np.sort(values, axis=-1), -1, 0)
    place = np.array([0.25, 0.5, 0.75]) * (len(ordered) - 1)
    low, high = np.floor(place).astype(int), np.ceil(place).astype(int)
    weight = (place - low).reshape(3, *[1] * (ordered.ndim - 1))
    below, above = ordered[low], ordered[high]
    finite = np.where(np.isinf(above), 0.0, above)
    between = np.where(np.isinf(below), 0.0, below) * (1 - weight) + finite * weight
    return np.asarray(np.where(weight == 0, below, np.where(np.isinf(above), above, between)))


def table(system: System, dt: float, responses: Sequence[Response], options: CompareOptions) -> list[Row]:
    """A row for each response, and after those of a method one for all its seeds."""
    rows = []
    for method in METHODS:
        own = [response for response in responses if response.method == method]
        rows += [_row(system, dt, [response], response.seed, options) for response in own]
        if own:
            rows.append(_row(system, dt, own, None, options))
    return rows


def _row(system: System, dt: float, responses: Sequence[Response], seed: int | None, options: CompareOptions) -> Row:
    lo, hi = np.array(system.domain, dtype=np.float64).T
    x = np.concatenate([response.x for response in responses], axis=1)
    norm = np.concatenate([response.norm for response in responses], axis=1)
    cost = np.concatenate([response.cost[-1] for response in responses])
    largest = norm[-1 - math.ceil(options.window / dt - 1e-9) :].max(axis=0)
    lower, median, upper = quartiles(cost)
    return Row(
        method=responses[0].method.name,
        seed=seed,
        steps=max(response.steps for response in responses),
        trajectories=len(largest),
        settled=int((largest < options.tolerance).sum()),
        diverged=int(np.isnan(x[-1]).any(axis=1).sum()),
        left_domain=int((~((x >= lo) & (x <= hi)).all(axis=(0, 2))).sum()),
        floor=float(quartiles(largest)[1]),
        cost_lower=float(lower),
        cost_median=float(median),
        cost_upper=float(upper),
    )


def _action(trained: Trained, sampled: bool, start_seed: int) -> Callable[[Array], Array]:
    sample = trained.sample
    if not sampled or sample is None:
        return trained.mean
    generator = np.random.default_rng([start_seed, trained.seed])
    return lambda x: sample(x, generator)


def _load(run: Run, path: Path, system: System, training: TrainingOptions) -> Trained:
    try:
        if run == "ours":
            return from_policy(load_policy(path), system)
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    return from_checkpoint(content, system) if run == "sac" else from_reference(content, system, training)


def _train(run: Run, system: System, training: TrainingOptions, path: Path, report: Callable[[int], None]) -> None:
    if run == "sb3-sac" or run == "sb3-ppo":
        train_reference("sac" if run == "sb3-sac" else "ppo", system, training, path, report)
        return
    trainer = Trainer(system, training if run == "ours" else without_gain(training))
    checkpoint = path.with_name("checkpoint.pt")
    if checkpoint.is_file():
        trainer.restore(checkpoint.read_bytes())
    policy = train(trainer, lambda trainer: report(trainer.steps_done), checkpoint)
    if run == "sac":
        write_atomically(checkpoint, trainer.snapshot())
        return
    temporary = path.with_name(path.name + ".partial")
    save_policy(temporary, policy)
    os.replace(temporary, path)
    checkpoint.unlink(missing_ok=True)


def _progress(what: str, steps: int, say: Callable[[str], None]) -> Callable[[int], None]:
    """Says ten times in a run how far it is."""
    every = max(1, steps // 10)

    def report(done: int) -> None:
        if done % every == 0:
            say(f"{what}: {done} of {steps} steps")

    return report


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be made: {error.strerror}.") from error


def _csv(rows: Sequence[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(Row)])
    for row in rows:
        writer.writerow(astuple(replace(row, seed="all") if row.seed is None else row))  # type: ignore[arg-type]
    return text.getvalue().encode()


def _draw_over_time(
    what: Literal["cost", "norm"], system: System, dt: float, responses: Sequence[Response], rows: Sequence[Row]
) -> bytes:
    """Median and quartiles over seeds and states against time: mean actions left, sampled ones right."""
    import matplotlib
    from matplotlib.figure import Figure

    seeds, states = len({response.seed for response in responses}), responses[0].x.shape[1]
    pooled = {row.method: row for row in rows if row.seed is None}
    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(10.0, 4.8), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        for panel, sampled in zip(panels, (False, True), strict=True):
            for method in METHODS:
                if method.run != "ours" and method.sampled != sampled:
                    continue
                own = [response for response in responses if response.method == method]
                row, colour = pooled[method.name], _COLOURS[method.run]
                values = np.concatenate([getattr(response, what) for response in own], axis=1)
                lower, median, upper = np.maximum(quartiles(values), _SMALLEST)
                first = 1 if what == "cost" else 0  # no cost at time 0, and no 0 on a logarithmic axis
                time = dt * np.arange(len(median))[first:]
                label = _NAMES[method.run]
                if what == "norm":
                    label += f", floor {row.floor:.1e}"
                    if math.isfinite(row.floor):
                        panel.axhline(max(row.floor, _SMALLEST), color=colour, lw=0.8, ls=":")
                if row.diverged:
                    label += f" ({row.diverged} of {row.trajectories} diverged)"
                panel.plot(time, _drawable(median)[first:], color=colour, label=label)
                panel.fill_between(
                    time, _drawable(lower)[first:], _drawable(upper, median)[first:], color=colour, alpha=0.18, lw=0
                )
            panel.set_yscale("log")
            panel.set_xlim(0, dt * (len(responses[0].x) - 1))
            panel.set_xlabel("time (s)")
            panel.set_title("stochastic actions (ours: mean)" if sampled else "mean actions")
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
        if what == "cost":
            panels[0].set_ylabel("∫ x'Qx + (u − u_eq)'R(u − u_eq) dt")
            title = "accumulated cost"
        else:
            panels[0].set_ylabel("‖x‖ (units of the states)")
            title = "distance from the equilibrium (dotted: floor, the largest in the last second)"
        figure.suptitle(
            f"{system.name}: {title}\nmedian and quartiles of {_count(seeds, 'seed')} × {states} states", fontsize=10.0
        )
        return _png(figure)


def _draw_positions(system: System, dt: float, responses: Sequence[Response]) -> bytes:
    """Fifty trajectories at most of each position, one column a method, all of the first seed."""
    import matplotlib
    from matplotlib.figure import Figure

    names, seed = [symbol.name for symbol in system.states], responses[0].seed
    chosen = {response.method: response.x[:, :50] for response in responses if response.seed == seed}
    positions, time = POSITIONS[system.name], dt * np.arange(len(responses[0].x))
    with matplotlib.rc_context(_RC):
        figure = Figure(figsize=(15.0, 0.9 + 1.9 * len(positions)), layout="constrained")
        panels = figure.subplots(len(positions), len(chosen), sharex=True, sharey="row", squeeze=False)
        for position, line in zip(positions, panels, strict=True):
            k = names.index(position)
            bound = float(max(map(abs, system.domain[k])))
            shown = np.concatenate([x[..., k].ravel() for x in chosen.values()])
            reach = 1.05 * min(bound, float(np.nanmax(np.abs(shown))))
            for panel, (method, x) in zip(line, chosen.items(), strict=True):
                path = x[..., k]
                panel.plot(time, np.clip(path, -10 * reach, 10 * reach), color=_COLOURS[method.run], lw=0.6, alpha=0.6)
                outside = int((~(np.abs(path) <= reach)).any(axis=0).sum())
                if outside:
                    panel.text(
                        0.98,
                        0.03,
                        f"{outside} leave the frame",
                        transform=panel.transAxes,
                        ha="right",
                        fontsize=7.5,
                        bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
                    )
            line[0].set_ylim(-reach, reach)
            line[0].set_ylabel(f"{'θ' if position == 'theta' else position} ({system.units.get(position, '')})")
        for panel, method in zip(panels[0], chosen, strict=True):
            panel.set_title(method.label)
        for panel in panels[-1]:
            panel.set_xlabel("time (s)")
            panel.set_xlim(0, time[-1])
        number = next(iter(chosen.values())).shape[1]
        figure.suptitle(
            f"{system.name}: {_count(number, 'trajectory', 'trajectories')}, held actions, seed {seed}", fontsize=10.0
        )
        return _png(figure)


def _drawable(values: Array, otherwise: Array | None = None) -> Array:
    """Infinity is not drawn; an infinite edge of a band is drawn far above its finite median."""
    far = math.nan if otherwise is None else np.where(np.isfinite(otherwise), 1e3 * otherwise, math.nan)
    return np.where(np.isfinite(values), values, far)


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return buffer.getvalue()
