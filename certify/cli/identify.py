"""`certify identify`: from measured transitions to a plant with the ranges that they leave of its parameters."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.arguments import bound_or_bounds, linear_from, value_or_range
from certify.cli.environment import of_environment, recorded
from certify.cli.options import Bundle, parameter, takes
from certify.cli.shared import Json, Quiet, noting, write
from certify.cli.terminal import say, show
from certify.errors import InputError

if TYPE_CHECKING:
    from fractions import Fraction

    from rich.console import RenderableType

    from certify.analysis.identifying.reading import Readings
    from certify.analysis.identifying.run import IdentifyResult
    from certify.loop.plants import System
    from certify.provers.data import Contradiction


def _without_a_model() -> Bundle:
    """The options of the structure `linear`, as a `LinearStructure`, or None where none is given."""
    shown: dict[str, Any] = {"rich_help_panel": "A plant without a model, --structure linear"}
    many: dict[str, Any] = {"metavar": "NAME=D"} | shown
    second = "Bound of what a state's equation has beyond A x + B u, as in theta_dot='10*theta*theta'; repeatable."
    prior = "Prior of an entry, A21=LO..HI, or of all in a state's row; repeatable. By default around least squares."
    ends = "Half-width of {}, or NAME=LO..HI; repeatable. By default as far as the data reach."
    options = (
        parameter("second", "--second", second, list[str], metavar="NAME=BOUND", **shown),
        parameter("prior", "--prior", prior, list[str], **many),
        parameter("domain", "--domain", ends.format("a state's domain"), list[str], **many),
        parameter("input_bounds", "--input-bound", ends.format("an input's bounds"), list[str], **many),
        parameter(
            "without", "--without", "States that no equation contains, such as a position.", metavar="LIST", **shown
        ),
        parameter(
            "inputs", "--inputs", "Columns of inputs; needed without columns NAME_next.", metavar="LIST", **shown
        ),
        parameter("states", "--states", "Names of the states of an .npz file.", metavar="LIST", **shown),
    )
    return Bundle({one.name: one for one in options}, linear_from)


Rotate = Annotated[
    bool,
    typer.Option("--rotate", help="Write the plant in axes, where data bound sums of parameters closer than each."),
]


@takes(environment=of_environment(), linear=_without_a_model())
def identify(
    data: Annotated[
        Path | None, typer.Argument(metavar="DATA", help="Measured transitions: .csv, .npz or .parquet.")
    ] = None,
    *,
    structure: Annotated[
        Path,
        typer.Option(
            metavar="PLANT.toml",
            help="The plant's equations, with ranges of unknown parameters; or linear: no equation is known.",
        ),
    ],
    noise: Annotated[
        str,
        typer.Option(metavar="E", help="Bound of each measured state's error: one, or NAME=E,NAME=E, in its units."),
    ],
    sample_time: Annotated[
        str | None,
        typer.Option(metavar="PERIOD", help="Time of a transition, as in 0.02, or LO..HI. Not in discrete time."),
    ] = None,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Plant with the ranges that are left; a page lies beside it.")
    ] = Path("known.toml"),
    rotate: Rotate = False,
    environment: dict[str, Any],
    linear: Any,  # a LinearStructure or None
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Bound a plant's unknown parameters by measured transitions.

    The exit status is 0 for ranges, 1 if the measurements refute the structure with this noise.
    """
    from certify.analysis.identifying.linear import structure_for
    from certify.analysis.identifying.run import identify_plant, read_and_measure
    from certify.loop.plants import load_system
    from certify.provers.data import Contradiction
    from certify.report.identified import page

    note = noting(quiet)
    if out.suffix != ".toml":
        raise InputError(f"--out must be a .toml file; found {out}.")
    period = None if sample_time is None else value_or_range(sample_time, "sample_time")
    bounds = bound_or_bounds(noise, "noise")
    structure = structure_for(data, structure, linear, out, period, bounds)
    system = load_system(structure)
    source = recorded(data, environment, lambda: system, out.with_name(f"{out.stem}_data.csv"), note)
    measured, readings = read_and_measure(source, system, period, bounds)
    for line in readings.notes:
        note(line)
    try:
        result = identify_plant(measured, readings, source.name, structure, out, rotate)
    except Contradiction as error:
        note("looking for what the equations lack")
        _refuted(error, measured, readings, source, as_json)
        raise typer.Exit(1) from None
    write(out.with_suffix(".html"), page(result.residuals(), result.to_dict()))
    if as_json:
        say(json.dumps(result.to_dict()))
    else:
        show(_summary(result))
        say(f"plant  {out}\npage   {out.with_suffix('.html')}")


def _refuted(error: Contradiction, measured: System, readings: Readings, data: Path, as_json: bool) -> None:
    """Print the finding that the measurements contradict the structure, and what its equations may lack."""
    from certify.analysis.identifying.run import SCHEMA, data_in_json, residuals_of_refuted
    from certify.report.identified import constants_in_words, factors_in_words, table_of_constants

    places, what = [readings.places[t] for t in error.transitions], "these data refute this structure with this noise"
    lacking = residuals_of_refuted(measured)
    if as_json:
        found = {
            "schema": SCHEMA,
            "verdict": "REFUTED",
            "system": measured.name,
            "data": data_in_json(data.name, readings),
            "reason": what,
            "transitions": places,
        }
        say(json.dumps(found | lacking))
        return
    shown = ", ".join(places[:8]) + (f" and {len(places) - 8} more" if len(places) > 8 else "")
    lines = [*map(factors_in_words, lacking["least_residual"]), *map(constants_in_words, lacking["least_constants"])]
    table = table_of_constants(lacking["least_constants"])
    say(
        f"REFUTED  {measured.name}: {what}, whatever the parameters within their ranges are\n\n"
        f"shown by    transitions from {shown} of {data.name}\n"
        + "".join(f"{'' if k else 'residual':<12}{line}\n" for k, line in enumerate(lines))
        + "next        look at these rows first; then a friction, a delay or a unit that the equations lack, ranges "
        "that are too narrow,\n            a wrong period, or noise that is larger than was said"
        + (f"\ntry next    in the structure [residual] {table}, or bounds that depend on the state" if table else "")
    )


def _summary(result: IdentifyResult) -> RenderableType:
    from rich import box
    from rich.console import Group
    from rich.table import Table
    from rich.text import Text

    data, count = result.measurements, len(result.readings.places)
    head = Text.assemble(
        ("IDENTIFIED", "bold green"),
        "  ",
        (
            f"{result.system.name}: {count:,} transitions, {int(result.found.used.sum()):,} of them show the ranges",
            "bold",
        ),
    )
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False, show_edge=False, header_style="dim")
    for title, justify in (
        ("parameter", "left"),
        ("unit", "left"),
        ("prior", "right"),
        ("range", "right"),
        ("smaller", "right"),
        ("shown most by", "left"),
    ):
        table.add_column(title, justify=justify)  # type: ignore[arg-type]
    for name, prior in data.priors.items():
        by = ", ".join(result.readings.places[t] for t in result.shown_by[name]) or "-"
        cells = (
            name,
            result.system.units.get(name, ""),
            _interval(prior),
            _interval(result.known.ranges[name]),
            f"{result.shrink(name):.3g} x",
            by,
        )
        table.add_row(*map(Text, cells))
    grid = Table.grid(padding=(0, 2))
    grid.add_column(style="dim", no_wrap=True)
    grid.add_column(overflow="fold")
    for name, value in _rows(result):
        grid.add_row(Text(name), Text(value))
    return Group(head, Text(), table, Text(), grid, Text())


def _rows(result: IdentifyResult) -> list[tuple[str, str]]:
    from certify.analysis.identifying.run import sizes_in_json
    from certify.report.identified import direction_in_words, factors_in_words, noise_in_words, sums_along

    data, axis = result.measurements, result.least_determined
    each = ", ".join(f"{s} {float(w):g}" for s, w in zip(result.system.states, data.noise, strict=True))
    rows = [("noise at most", each), ("data allow", noise_in_words(result.least_noise))]
    heads = ["residual", *["of one equation"] * len(result.least_residual)]
    rows += zip(heads, map(factors_in_words, sizes_in_json(result.least_residual)), strict=False)
    if data.period is not None:
        rows.append(("period", " to ".join(dict.fromkeys(f"{float(h):g}" for h in data.period))))
    if result.not_narrowed():
        rows.append(("not narrowed", f"{', '.join(result.not_narrowed())}: {result.next_step()}"))
    if data.axes:
        rows.append(
            ("axes", f"{len(data.axes)}, whose box is {result.smaller:.3g} times smaller than that of the ranges")
        )
        rows += [(a.name, f"about {a.text}: {a.ends}, {a.shrink:.3g} x smaller") for a in sums_along(result.to_dict())]
    if axis is not None:
        rows.append(("least determined", direction_in_words(axis.entries, axis.share)))
        rows.append(("to narrow it", f"more like {result.readings.places[axis.telling]}: {result.at(axis.telling)}"))
    return [*rows, ("assumed", "the structure, the priors, constant parameters, noise and period as they were said")]


def _interval(pair: tuple[Fraction, Fraction]) -> str:
    """An interval that holds this one, in digits."""
    from certify.report.words import above, below

    return f"{below(pair[0])} to {above(pair[1])}"
