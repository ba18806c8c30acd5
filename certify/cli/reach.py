"""`certify reach`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated

import typer

from certify.cli.arguments import plant_of, state, widths
from certify.cli.certifying import certified
from certify.cli.importing import kind_called, policy_of
from certify.cli.shared import (
    Domain,
    Json,
    PlantName,
    PolicyArgument,
    PolicyFile,
    Quiet,
    Results,
    Resume,
    TimeLimit,
    the_policy,
)
from certify.report.drawing import Drawing

if TYPE_CHECKING:
    from certify.loop.policies.importers import ImportOptions


def reach(
    context: typer.Context,
    importing: ImportOptions,
    from_: Annotated[
        str,
        typer.Option("--from", help="The state, as in x=0.5,y=-0.2; what is not named is at the operating point."),
    ],
    file: PolicyArgument = None,
    policy: PolicyFile = None,
    system: PlantName = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    domain: Domain = None,
    box: Annotated[
        str | None,
        typer.Option(help="Half-axes of the ellipsoid around the state that is to be widest, as in x=0.4,phi=0.2."),
    ] = None,
    resume: Resume = False,
    time_limit: TimeLimit = None,
    out: Results = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Prove that a state, with what lies around it, converges: a tube around its trajectory into a certified set."""
    start, drawing = time.perf_counter(), context.with_resource(Drawing())
    from certify.analysis.options import RoaOptions

    path = the_policy(context, file, policy)
    with kind_called("--kind"):
        stored = policy_of(path, importing, system, param or [])
    plant = plant_of(stored, system, param or [], domain or [])
    options = RoaOptions(
        reach_from=state(from_, "--from"), box=widths(box, "--box"), resume=resume, time_limit=time_limit
    )
    certified(context, path, stored, plant, options, out, start, drawing, quiet, as_json)
