"""`controllers distil`."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from certify.errors import OptionError
from controllers.commands.shared import ChosenPlant, Json, PolicyFile, emit, errors
from controllers.storage import require_writable, set_aside

if TYPE_CHECKING:
    from controllers.distillation.options import DistilOptions
    from controllers.distillation.result import Distilled
    from controllers.options import Activation, Centre


def distil(
    context: typer.Context,
    policy: PolicyFile,
    out: Annotated[Path, typer.Option("--out", help="The policy file to write.")],
    activation: Annotated[
        str,
        typer.Option(
            "--activation", help="Function between the new layers: tanh, relu, elu, silu, ... as of controllers train."
        ),
    ] = "tanh",
    hidden: Annotated[str, typer.Option("--hidden", help="Hidden widths of the new policy.")] = "32,32",
    centre: Annotated[
        str | None,
        typer.Option(
            "--centre",
            help="Centring: preactivation, output, or none; default: preactivation behind tanh, else output.",
        ),
    ] = None,
    steps: Annotated[int, typer.Option("--steps", help="Gradient steps.")] = 3000,
    samples: Annotated[int, typer.Option("--samples", help="States that are imitated.")] = 20_000,
    states: Annotated[int, typer.Option("--states", help="Initial states of the runs that compare the two.")] = 200,
    seed: Annotated[int, typer.Option("--seed", help="Seed of everything random.")] = 0,
    system: ChosenPlant = None,
    as_json: Json = False,
) -> None:
    """Train a small network of layers that imitates a policy, whatever its steps are.

    Squash, scale, offset and clip stay, and so does the gain at the origin. The output says how far the two are from
    each other over the domain, and how their closed loops compare.
    """
    with errors(context, as_json):
        from certify.loop.policies import load_policy, save_policy
        from controllers.distillation.distillation import distil as run
        from controllers.distillation.options import DistilOptions
        from controllers.plants.choice import chosen_plant, plant_of

        require_writable(out)
        given = load_policy(policy)
        plant = plant_of(given, None if system is None else chosen_plant(system))
        options = DistilOptions(
            activation=cast("Activation", activation),
            hidden=_widths(hidden),
            centre=cast("Centre | None", centre),
            steps=steps,
            samples=samples,
            states=states,
            seed=seed,
        )
        with _progress(options) as report:
            set_aside(out)
            result = run(given, options, plant, report)
        save_policy(out, result.policy)
        emit({"policy": str(out), **(result.as_json() if as_json else _table(result))}, as_json)


def _widths(text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OptionError(f"`hidden` must be widths as in 32,32; found {text!r}.") from error


@contextmanager
def _progress(options: DistilOptions) -> Iterator[Callable[[int, float], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("difference {task.fields[fit]}"))
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=options.steps, fit="-")

        def report(step: int, fit: float) -> None:
            if step % 20 == 0:
                progress.update(task, completed=step, fit=f"{fit:.2%}")

        yield report


def _table(result: Distilled) -> dict[str, Any]:
    network = result.policy.network
    mean, largest = (", ".join(f"{v:.3g}" for v in values) for values in (result.mean, result.largest))
    runs = {
        name: f"{found.settled} of {found.states} settled, median cost {found.cost:.4g}"
        for name, found in (("runs of the source", result.source), ("runs of the new one", result.own))
    }
    corner = {} if math.isinf(result.corner) else {"nearest corner": f"at {result.corner:.3g} of the domain"}
    return {
        "system": result.policy.system,
        "sha256": network.sha256(),
        "network": f"{network.words}, centre {network.centre}",
        "difference": f"mean {mean}; at most {largest}, at {result.states} states of the domain",
        "error of J(0)": f"{100 * result.gain_error:.2g} %",
        **corner,
        **runs,
        "seconds": f"{result.seconds:.0f}",
    }
