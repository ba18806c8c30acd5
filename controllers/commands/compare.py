"""`controllers compare`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.errors import InputError
from controllers.commands.shared import Json, PlantName, emit, errors, options_of

if TYPE_CHECKING:
    from controllers.runs import Doing


def compare(
    plant: PlantName,
    runs: Annotated[Path, typer.Option("--runs", help="Folder of trained runs; missing ones are trained into it.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the figures and the table.")],
    seeds: Annotated[int, typer.Option("--seeds", help="Runs of each method, with the seeds 0, 1, ...")] = 5,
    duration: Annotated[
        float | None,
        typer.Option("--duration", help="Seconds simulated, or steps in discrete time; default: 20 s or 1000 steps."),
    ] = None,
    states: Annotated[int, typer.Option("--states", help="Number of initial states.")] = 50,
    ablations: Annotated[
        bool, typer.Option("--ablations", help="Compare with ablations of our own training, not with baselines.")
    ] = False,
    without: Annotated[
        list[str] | None, typer.Option("--without", help="A kind of run to leave out, such as sb3-sac; repeatable.")
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option("--steps", help="Steps of every run; default: ours by the preset, baselines to their floor."),
    ] = None,
    budget: Annotated[
        int | None, typer.Option("--budget", help="Steps after which a baseline ends that still improves.")
    ] = None,
    patience: Annotated[
        int | None, typer.Option("--patience", help="Evaluations without an improvement that end a baseline.")
    ] = None,
    jobs: Annotated[
        int | None, typer.Option("--jobs", help="Runs trained at a time, in processes of this machine.")
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            "--cluster",
            help="Dask cluster to train on: a scheduler's address, tcp://HOST:8786, or local:N.",
            metavar="ADDRESS",
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Compare our policy with SAC without the gain and with SAC and PPO of stable-baselines3: figures and a table.

    A baseline is trained until its evaluation stops improving, and goes on from its checkpoint when it was cut off.
    """
    with errors(as_json):
        training = options_of(plant, seed=0, steps=steps)
        from certify.loop.plants import get_system
        from certify.provers.execution.tasks import place_for
        from controllers.compare import compare as run
        from controllers.responses import ABLATIONS, BASELINES, CompareOptions, remaining

        methods = remaining(ABLATIONS if ablations else BASELINES, without or [])
        if steps is not None and (budget is not None or patience is not None):
            raise InputError("`--steps` is for runs of one length; `--budget` and `--patience` are for the others.")
        system = get_system(plant)
        span: dict[str, Any] = {}
        if duration is not None:
            span = {"duration": duration} if system.time == "continuous" else {"duration_steps": int(duration)}
        options = CompareOptions(
            methods=methods,
            seeds=seeds,
            **span,
            states=states,
            to_floor=steps is None and not ablations,
            budget=budget,
            patience=patience,
        )
        place = None if jobs is None and cluster is None else place_for(jobs, cluster)
        with _progress() as (say, watch):
            result = run(system, training, runs, out, options, say, watch, place)
        if as_json:
            emit(result, as_json)
            return
        typer.echo(_table(result["rows"]))
        emit(result["files"], as_json)


@contextmanager
def _progress() -> Iterator[tuple[Callable[[str], None], Callable[[Doing], None]]]:
    """Where progress goes: on a terminal a bar, with the time that is left, elsewhere lines on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda line: typer.echo(line, err=True), lambda doing: None
        return
    columns = (
        TextColumn("run {task.fields[run]} of {task.fields[runs]}: {task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("starting", total=None, run=1, runs="?")
        shown = 0

        def watch(doing: Doing) -> None:
            nonlocal shown
            if doing.run != shown:  # another run has a pace of its own
                progress.reset(task)
                shown = doing.run
            progress.update(
                task, description=doing.what, completed=doing.done, total=doing.steps, run=doing.run, runs=doing.runs
            )

        yield lambda line: None, watch


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as aligned text; what is not finite is infinite."""
    lines = [
        (
            "method",
            "seed",
            "steps",
            "made",
            "cpu (s)",
            "settled",
            "diverged",
            "left domain",
            "floor",
            "cost: lower quartile, median, upper",
        )
    ]
    for row in rows:
        floor, lower, median, upper = (
            "inf" if row[name] is None else f"{row[name]:.3g}"
            for name in ("floor", "cost_lower", "cost_median", "cost_upper")
        )
        seed = "all" if row["seed"] is None else str(row["seed"])
        made = (str(row["steps"]), str(row["made"]), "-" if row["cpu"] is None else f"{row['cpu']:.0f}")
        counts = [f"{row[name]} of {row['trajectories']}" for name in ("settled", "diverged", "left_domain")]
        lines.append((row["method"], seed, *made, *counts, floor, f"{lower} {median} {upper}"))
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join("  ".join(f"{cell:<{w}}" for cell, w in zip(line, widths, strict=True)).rstrip() for line in lines)
