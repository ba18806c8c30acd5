"""The parts that commands share: arguments, printing, and the end by bad input."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.cli.options import as_typed, options_of
from certify.errors import CertifyError, OptionError
from controllers.options import TrainingOptions, overridden, preset

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.policies.nonlinearity import Nonlinearity

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]
PlantName = Annotated[str, typer.Argument(help="The plant, for instance pendulum.")]
PolicyFile = Annotated[Path, typer.Argument(help="The policy file.")]
ChosenPlant = Annotated[
    str | None, typer.Option("--system", help="A plant of your own, FILE.toml or FILE.py:NAME; default: the policy's.")
]
Steps = Annotated[int | None, typer.Option("--steps", help="Environment steps of a run; default: the preset's.")]


def preset_options(plant: str, **chosen: Any) -> TrainingOptions:
    """The options that `plant` trains with, those replaced that were chosen; None means not chosen.

    Raises
    ------
    InputError : no such plant, or a chosen value is out of its range.
    """
    return overridden(preset(plant), chosen)


_EXTRA = ("gymnasium", "control")  # packages of the extra `controllers`


@contextmanager
def errors(context: typer.Context, as_json: bool) -> Iterator[None]:
    """Bad input, and an extra that is not installed, end in one sentence and exit status 2.

    The sentence names options as they are typed.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name not in _EXTRA:
            raise
        install = "`pip install '.[controllers]'` in the project's folder"
        said = f"{error.name} is not installed, and training needs it; {install} brings it."
        raise _refused(said, as_json) from error
    except BrokenPipeError:  # nobody reads any more what is said
        raise
    except OptionError as error:
        raise _refused(as_typed(str(error), options_of(context.command)), as_json) from error
    except (CertifyError, OSError) as error:
        raise _refused(str(error), as_json) from error


def _refused(said: str, as_json: bool) -> typer.Exit:
    if as_json:
        typer.echo(json.dumps({"error": said}))
    typer.echo(f"Error: {said}", err=True)
    return typer.Exit(2)


def emit(result: dict[str, Any], as_json: bool) -> None:
    """Print a result, a line for each entry, or as one JSON object."""
    if as_json:
        typer.echo(json.dumps(result))
        return
    width = max(map(len, result))
    for name, value in result.items():
        typer.echo(f"{name:<{width}}  {'-' if value is None else value}")


def beside_a_gain(found: Nonlinearity) -> str:
    """The distance of a policy from the saturated linear feedback of its own gain on a box, in words."""
    rms, largest, bend, saturated = (
        f"{100 * share:.2g} %" for share in (found.rms, found.largest, found.bend, found.saturated)
    )
    return f"{rms} from it on the box of initial states, rms, {largest} at most; bend {bend}, saturated at {saturated}"


def span(duration: float | None, system: System) -> dict[str, Any]:
    """The options for a duration of simulated runs, in the plant's unit of time."""
    if duration is None:
        return {}
    if system.time == "continuous" or not math.isfinite(duration):  # which is refused as a duration
        return {"duration": duration}
    return {"duration_steps": int(duration)}
