"""`certify fit`: from samples of an unknown right-hand side to two plants with bounds of what they may be off by."""

from __future__ import annotations

import json
import re
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.arguments import bound_or_bounds
from certify.cli.environment import of_environment, recorded
from certify.cli.options import takes
from certify.cli.shared import Json, Quiet, noting
from certify.cli.terminal import say
from certify.errors import InputError

if TYPE_CHECKING:
    from certify.analysis.fitting.run import FitResult, Fitted
    from certify.loop.plants import System


@takes(environment=of_environment())
def fit(
    samples: Annotated[
        Path | None, typer.Argument(help="Samples, on a grid or scattered: .csv, .npz or .parquet.")
    ] = None,
    *,
    structure: Annotated[
        Path, typer.Option(metavar="PLANT.toml", help="The plant, with a table [unknown.STATE] for each unknown.")
    ],
    noise: Annotated[
        str, typer.Option(metavar="E", help="Bound of each sampled value's error: one, or NAME=E,NAME=E.")
    ],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder of far.toml and near.toml.")] = Path("out/fitted"),
    degree: Annotated[int, typer.Option(min=1, max=20, help="Degree of the polynomial in a variable.")] = 9,
    near_origin: Annotated[
        float, typer.Option(min=0, max=4, help="How much more a low error counts near the origin, for a low floor.")
    ] = 0,
    environment: dict[str, Any],
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Fit functions that nobody wrote down, with bounds of what they may be off by.

    The bounds of second derivatives in the structure are what is assumed, on the domain and the input bounds, and
    beyond as far as a grid of samples reaches. The exit status is 1 if the samples refute them.
    """
    from certify.analysis.fitting.linear import Contradicted
    from certify.analysis.fitting.run import fit_plant, structure_in

    said = bound_or_bounds(noise, "noise")

    def of(state: str) -> Fraction:
        bound = said.get(state) if isinstance(said, dict) else said
        if bound is None:
            raise InputError(f"--noise must have a bound for {state}; found {noise}.")
        return Fraction(str(bound))

    def plant() -> System:
        system = structure_in(structure)[1]
        if system.time != "discrete":
            raise InputError('an environment has steps and no rates: write time = "discrete" in the structure.')
        return system

    samples = recorded(samples, environment, plant, out / "samples.csv", noting(quiet))
    try:
        result = fit_plant(samples, structure, of, out, degree, near_origin)
    except Contradicted as error:
        what = "these samples refute the bounds of second derivatives and of the noise, or that 0 is an equilibrium"
        found = {"verdict": "REFUTED", "reason": f"{what}: {error}"}
        say(json.dumps(found) if as_json else f"REFUTED  {found['reason']}")
        raise typer.Exit(1) from None
    say(json.dumps(result.to_dict()) if as_json else "\n".join(_lines(result)))


def _scattered(one: Fitted) -> list[str]:
    """Lines about samples that are no grid over the domain."""
    if not one.missing.points:
        return []
    p, left = one.missing.points[0], one.found - len(one.sampling.values)
    half = (one.grid.bounds[p].hi - one.grid.bounds[p].lo) / 2
    where = ", ".join(f"{v} = {float(q):.4g}" for v, q in zip(one.unknown.variables, p, strict=True))
    lines = [f"scattered    {one.unknown.state} is bounded at {len(one.grid.bounds):,} points of a grid"]
    if left:
        lines.append(f"left out     {left:,} samples beyond the domain or the input bounds")
    lines.append(f"missing      samples near {where}, where it is known within {float(half):.3g}")
    if one.missing.largest is not None:
        more = f"{len(one.missing.points):,} more, at points that --json names"
        lines.append(f"try next     {more}: they would bring the largest error to about {one.missing.largest:.3g}")
    return lines


def _lines(result: FitResult) -> list[str]:
    from certify.report.words import above, below

    lines = []
    for one in result.found:
        state = one.unknown.state
        lines.append(f"FITTED  {state}: {len(one.sampling.values):,} samples, {len(one.polynomial.powers)} terms")
        bound, rise = one.error, zip(one.unknown.variables, one.error.rise, strict=True)
        more = "".join(f" + {above(k)} {v}^2" for v, k in rise if k)
        lines.append(f"error        at most {above(bound.constant)}{more}, on every cell at most {above(one.largest)}")
        for v, (lo, hi) in zip(one.unknown.variables, one.slopes, strict=True):
            lines.append(f"slope        {v}: {below(lo)} to {above(hi)}")
        beyond = re.sub(r"\(([0-9]+/?[0-9]*)\)\*(\w+)\*\*2", lambda k: f"{above(Fraction(k[1]))} {k[2]}^2", one.beyond)
        lines.append(f"beyond       at most {beyond}")
        lines += _scattered(one)
    assumed = "the bounds of second derivatives and of the noise, as far as a grid of samples or the domain reaches"
    lines.append(f"assumed      {assumed}, and that 0 is an equilibrium")
    lines.append("in a claim   with certify roa --data, for which both checkers derive error and slopes again")
    return [*lines, f"far          {result.far}", f"near         {result.near}"]
