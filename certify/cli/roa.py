"""`certify roa`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.arguments import changes_of, options_of, region
from certify.analysis.declaration import declared
from certify.analysis.inputs import plant_of, policy_in
from certify.analysis.options import RoaOptions
from certify.cli.certifying import CONTAINS, certified
from certify.cli.importing import import_options
from certify.cli.options import FIRST, Bundle, changes_of_a_plant, options_of_a_run, takes
from certify.cli.shared import Json, PlantName, PolicyArgument, PolicyFile, Quiet, Results, noting, the_policy
from certify.cli.terminal import tell
from certify.cli.without_v import concluded
from certify.errors import BackendError, InputError, OptionError

if TYPE_CHECKING:
    from certify.analysis.maximise import Quantity
    from certify.loop.policies.importers import ImportOptions

_MOST = "max"
_OPTIONS = [name for name, option in declared(RoaOptions).items() if option.typed and name != "reach_from"]


@takes(
    importing=import_options(),
    changed=Bundle(changes_of_a_plant().parameters, dict),
    typed=options_of_a_run(*_OPTIONS),
)
def roa(
    context: typer.Context,
    *,
    file: PolicyArgument = None,
    policy: PolicyFile = None,
    system: PlantName = None,
    changed: dict[str, Any],
    typed: dict[str, Any],
    contains: Annotated[
        str | None,
        typer.Option(
            metavar="STATE",
            help="Say whether the proved set contains a state or a box, as in x=1.57,x_dot=-1..1.",
            rich_help_panel=FIRST,
        ),
    ] = None,
    out: Results = None,
    as_json: Json = False,
    quiet: Quiet = False,
    importing: ImportOptions,
) -> None:
    """Certify a region of attraction: prove, write a certificate, have it checked, report."""
    start, note, path = time.perf_counter(), noting(quiet), the_policy(context, file, policy)
    largest = _largest(changed.get("sample_time"), typed.get("rate"), "resume" in typed)
    if largest is not None:
        (changed if largest == "period" else typed).pop("sample_time" if largest == "period" else "rate")
    changes = changes_of(changed)
    stored = policy_in(path, importing, system, changes, note)
    plant = plant_of(stored, system, changes, note)
    trained = stored if system is None and not changed else None
    engine = _engine(context, typed.get("engine", "bounds"))
    options = options_of(typed | {"engine": engine}, plant, note, trained)
    if contains is not None:
        region(contains, plant, CONTAINS)  # an error in it is reported before the run
    if options.claim == "invariant":
        if largest is not None:
            raise OptionError("`claim` invariant has neither a rate nor a period; leave out max.")
        from certify.analysis.staying import certify_invariant
        from certify.report.stayed import summary

        concluded(
            context, certify_invariant, summary, path, stored, plant, options, out, start, quiet, as_json, contains
        )
    certified(context, path, stored, plant, options, out, start, quiet, as_json, contains, largest)


def _largest(period: str | None, rate: str | None, resume: bool) -> Quantity | None:
    """The quantity that is to be as large as can be proved, if any."""
    if resume and _MOST in (period, rate):
        raise InputError("--resume continues one search; ask for a period or a rate instead of max.")
    if period == _MOST and rate not in (None, "0"):
        raise InputError("--sample-time max must stand without --rate; found both. Ask for one of them at a time.")
    return "period" if period == _MOST else "rate" if rate == _MOST else None


def _engine(context: typer.Context, name: str) -> str:
    """The engine; without dReal, one that only the environment names falls back to bounds with a notice."""
    source = context.get_parameter_source("engine")
    if name in ("dreal", "both") and source is not None and source.name == "ENVIRONMENT":
        from certify.provers.dreal.backend import find_backend

        try:
            find_backend()
        except BackendError as error:
            tell(f"engine bounds instead of {name}: {error}")
            return "bounds"
    return name
