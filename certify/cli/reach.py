"""`certify reach`."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import typer

from certify.analysis.arguments import options_of
from certify.analysis.changes import PlantChanges
from certify.analysis.inputs import plant_of, policy_in
from certify.cli.certifying import certified
from certify.cli.importing import import_options, kind_called
from certify.cli.options import changes_of_a_plant, options_of_a_run, takes
from certify.cli.shared import Json, PlantName, PolicyArgument, PolicyFile, Quiet, Results, noting, the_policy

if TYPE_CHECKING:
    from certify.loop.policies.importers import ImportOptions

_KIND = "--kind"  # the kind of another program's policy file: --from is the state


@takes(
    importing=import_options(_KIND),
    changes=changes_of_a_plant("parameters", "domain"),
    typed=options_of_a_run("reach_from", "box", "resume", "effort", "time_limit", required=["reach_from"]),
)
def reach(
    context: typer.Context,
    *,
    file: PolicyArgument = None,
    policy: PolicyFile = None,
    system: PlantName = None,
    changes: PlantChanges,
    typed: dict[str, Any],
    out: Results = None,
    as_json: Json = False,
    quiet: Quiet = False,
    importing: ImportOptions,
) -> None:
    """Prove that a state, with what lies around it, converges: a tube around its trajectory into a proved set."""
    start, note, path = time.perf_counter(), noting(quiet), the_policy(context, file, policy)
    with kind_called(_KIND):
        stored = policy_in(path, importing, system, changes, note)
    plant = plant_of(stored, system, changes, note)
    certified(context, path, stored, plant, options_of(typed, plant, note), out, start, quiet, as_json)
