"""`controllers compare`."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.errors import OptionError
from controllers.commands.shared import Json, PlantName, emit, errors, preset_options, span

if TYPE_CHECKING:
    from controllers.comparison.runs import RunProgress

Without = Annotated[
    list[str] | None, typer.Option("--without", help="A kind of run to leave out, such as sb3-sac; repeatable.")
]
Budget = Annotated[int | None, typer.Option("--budget", help="Steps after which a baseline ends that still improves.")]
Patience = Annotated[
    int | None, typer.Option("--patience", help="Evaluations without an improvement that end a baseline.")
]
Jobs = Annotated[int | None, typer.Option("--jobs", help="Runs trained at a time, in processes of this machine.")]
Cluster = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        help="Dask cluster to train on: a scheduler's address, tcp://HOST:8786, or local:N.",
        metavar="ADDRESS",
    ),
]


def compare(
    context: typer.Context,
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
    without: Without = None,
    steps: Annotated[
        int | None,
        typer.Option("--steps", help="Steps of every run; default: ours by the preset, baselines to their floor."),
    ] = None,
    budget: Budget = None,
    patience: Patience = None,
    jobs: Jobs = None,
    cluster: Cluster = None,
    as_json: Json = False,
) -> None:
    """Compare our policy with SAC without the gain and with SAC and PPO of stable-baselines3: figures and a table.

    A baseline is trained until its evaluation stops improving, and resumed from its checkpoint if it was cut off.
    """
    with errors(context, as_json):
        training = preset_options(plant, seed=0, steps=steps)
        from certify.loop.plants import get_system
        from certify.provers.execution.tasks import place_for
        from controllers.comparison.comparison import compare as run
        from controllers.comparison.comparison import wanted_runs
        from controllers.comparison.methods import ABLATIONS, BASELINES, remaining
        from controllers.comparison.options import CompareOptions
        from controllers.figures.comparison import write_comparison
        from controllers.storage import make_folder

        methods = remaining(ABLATIONS if ablations else BASELINES, without or [])
        if steps is not None and (budget is not None or patience is not None):
            raise OptionError("`steps` is for runs of one length; `budget` and `patience` are for the others.")
        system = get_system(plant)
        options = CompareOptions(
            methods=methods,
            seeds=seeds,
            **span(duration, system),
            states=states,
            to_floor=steps is None and not ablations,
            budget=budget,
            patience=patience,
        )
        place = None if jobs is None and cluster is None else place_for(jobs, cluster)
        wanted_runs(system, training, options)  # refuses bad options before a folder is made
        make_folder(out)
        with _progress() as (say, watch):
            found = run(system, training, runs, options, say, watch, place)
        result = write_comparison(found, out)
        if not as_json:
            typer.echo(_table(result["rows"]))
        emit(result if as_json else result["files"], as_json)


@contextmanager
def _progress() -> Iterator[tuple[Callable[[str], None], Callable[[RunProgress], None]]]:
    """Show progress: on a terminal as a bar with the remaining time, elsewhere as lines on standard error."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda line: typer.echo(line, err=True), lambda progress: None
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

        def watch(at: RunProgress) -> None:
            nonlocal shown
            if at.run != shown:  # another run has a pace of its own
                progress.reset(task)
                shown = at.run
            progress.update(task, description=at.what, completed=at.done, total=at.steps, run=at.run, runs=at.runs)

        yield lambda line: None, watch


def _table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows as aligned text; a value that is not finite is infinite."""
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
