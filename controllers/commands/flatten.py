"""`controllers flatten`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from certify.errors import OptionError
from controllers.commands.shared import ChosenPlant, Json, emit, errors
from controllers.storage import require_writable, set_aside

if TYPE_CHECKING:
    from certify.loop.plants import System
    from controllers.flattening.options import Curvature, FlattenOptions, Gain
    from controllers.flattening.result import Figures, Flattened
    from controllers.options import Plant

DiagonalQ = Annotated[
    str | None,
    typer.Option("--Q", help="Diagonal of the LQR's Q, as in 1,1,0.1; default: that of the runs that judge."),
]
DiagonalR = Annotated[str | None, typer.Option("--R", help="Diagonal of the LQR's R, as --Q.")]

Box = Annotated[
    str | None,
    typer.Option(
        "--box", help="Half-widths of states where the policy is used, as in x=0.4,phi=0.2; others as where runs start."
    ),
]
GainAtOrigin = Annotated[
    str, typer.Option("--gain", help="Gain at the origin: kept (as it is), or lqr (by the weights that judge runs).")
]
Kept = Annotated[
    str,
    typer.Option(
        "--curvature", help="Curvature: removed, or kept as far as it lowers the cost of runs and a set stays provable."
    ),
]
KeptVolume = Annotated[
    float | None, typer.Option("--volume", help="Volume of that set; default: of the ellipsoid of twice the box.")
]

Distance = Annotated[
    float,
    typer.Option(
        "--distance", help="Least distance from the linear feedback of the policy's gain to keep, rms on the box."
    ),
]


def flatten(
    context: typer.Context,
    policy: Annotated[Path, typer.Argument(help="The policy file to begin with; it is left as it is.")],
    out: Annotated[Path, typer.Option("--out", help="The policy file to write.")],
    weight: Annotated[
        float, typer.Option("--weight", help="Weight of easier proofs beside doing the same as before.")
    ] = 1.0,
    box: Box = None,
    time_limit: Annotated[float, typer.Option("--time-limit", help="Seconds after which training ends.")] = 600.0,
    steps: Annotated[int, typer.Option("--steps", help="Gradient steps at most.")] = 2000,
    max_cost_change: Annotated[
        float, typer.Option("--max-cost-change", help="Share by which the median cost of a run may rise.")
    ] = 0.05,
    gain: GainAtOrigin = "kept",
    curvature: Kept = "removed",
    volume: KeptVolume = None,
    distance: Distance = 0.0,
    Q: DiagonalQ = None,
    R: DiagonalR = None,
    states: Annotated[int, typer.Option("--states", help="Initial states of the runs that judge a policy.")] = 200,
    seed: Annotated[int, typer.Option("--seed", help="Seed of everything random.")] = 0,
    system: ChosenPlant = None,
    as_json: Json = False,
) -> None:
    """Fine-tune a policy so that it does the same and is easier to prove.

    Layers, squash, centring, scale, offset and clip stay. Nothing is written unless as many runs settle as before, the
    median cost stays within its bound, and what a proof must absorb of the hidden units is less than it was; with
    --curvature kept, unless the cost and the boxes that a proof is forecast to take are less together.
    """
    with errors(context, as_json):
        from certify.loop.policies import load_policy, save_policy
        from controllers.flattening.flattening import flatten as run
        from controllers.flattening.options import FlattenOptions
        from controllers.plants.choice import chosen_plant, plant_of

        require_writable(out)
        given = load_policy(policy)
        plant = plant_of(given, None if system is None else chosen_plant(system))
        options = FlattenOptions(
            weight=weight,
            box=None if box is None else _half_widths(box, *plant),
            steps=steps,
            time_limit=time_limit,
            max_cost_change=max_cost_change,
            states=states,
            gain=cast("Gain", gain),
            curvature=cast("Curvature", curvature),
            volume=volume,
            distance=distance,
            Q=_weights(Q, "Q"),
            R=_weights(R, "R"),
            seed=seed,
        )
        with _progress(options) as report:
            set_aside(out)
            result = run(given, options, plant, report)
        save_policy(out, result.policy)
        emit({"policy": str(out), **(result.as_json() if as_json else _table(result))}, as_json)


def _half_widths(text: str, system: System, plant: Plant) -> tuple[float, ...]:
    """The box of initial states with the half-widths that `x=0.4,phi=0.2` names."""
    names = [symbol.name for symbol in system.states]
    widths = dict(zip(names, plant.initial_states, strict=True))
    for part in text.split(","):
        name, equals, number = (piece.strip() for piece in part.partition("="))
        if name not in widths:
            raise OptionError(f"`box` must name states of {system.name}, {', '.join(names)}; found {name!r}.")
        try:
            widths[name] = float(number if equals else "")
        except ValueError as error:
            raise OptionError(f"`box` must be NAME=HALF-WIDTH,...; found {part!r}.") from error
    return tuple(widths.values())


def _weights(text: str | None, option: str) -> tuple[float, ...] | None:
    """The diagonal that is typed as `1,1,0.1`."""
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise OptionError(f"`{option}` must be numbers as in 1,1,0.1; found {text!r}.") from error


@contextmanager
def _progress(options: FlattenOptions) -> Iterator[Callable[[int, float, float], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    kept = options.curvature == "kept"
    columns = (
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn(("cost" if kept else "change") + " {task.fields[fit]}  "),
        TextColumn(("boxes" if kept else "departure") + " {task.fields[departure]}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=options.steps, fit="-", departure="-")

        def report(step: int, fit: float, departure: float) -> None:
            if step % 20 == 0:
                progress.update(
                    task, completed=step, fit=f"{fit if kept else math.sqrt(fit):.1%}", departure=f"{departure:.2g}"
                )

        yield report


def _table(result: Flattened) -> dict[str, Any]:
    def runs(found: Figures) -> str:
        return f"{found.settled} of {found.states} settled, median cost {found.cost:.4g}"

    before, after = result.before, result.after
    rms, largest = (", ".join(f"{v:.3g}" for v in values) for values in (result.rms, result.largest))
    forecast = {} if result.boxes is None else {"forecast": f"volume {result.volume:.3g} by {result.boxes:.2g} boxes"}
    return {
        "system": result.policy.system,
        "sha256": result.policy.network.sha256(),
        "departure": f"{before.departure:.3g} before, {after.departure:.3g} after",
        "bend on the box": f"{100 * before.bend:.3g} % before, {100 * after.bend:.3g} % after",
        "runs before": runs(before),
        "runs after": runs(after),
        **forecast,
        "change of inputs": f"rms {rms}; at most {largest}",
        "change of J(0)": f"{100 * result.gain_change:.2g} %",
        "trained": f"from factor {result.factor:g}, {result.steps} steps in {result.seconds:.0f} s ({result.ended})",
    }
