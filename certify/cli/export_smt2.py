"""`certify export-smt2`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from certify.analysis.arguments import options_of
from certify.analysis.changes import PlantChanges
from certify.analysis.inputs import plant_of
from certify.cli.options import changes_of_a_plant, options_of_a_run, takes
from certify.cli.shared import Json, PlantName, write
from certify.cli.terminal import say, tell
from certify.errors import InputError


@takes(
    changes=changes_of_a_plant("parameters", "domain"),
    typed=options_of_a_run("candidate", "level", "effort", "time_limit", candidate="lyapunov"),
)
def export_smt2(
    policy: Annotated[Path, typer.Option(help="Policy file (certify-policy/1 or /2, .pt).")],
    *,
    out: Annotated[Path, typer.Option(help="Folder for the files, one a condition.")],
    system: PlantName = None,
    changes: PlantChanges,
    typed: dict[str, Any],
    as_json: Json = False,
) -> None:
    """Prove an asymptotic claim with the bounds engine and write its conditions as SMT-LIB 2 for another solver."""
    from certify.analysis.run import certify_roa
    from certify.certificates.claims import Asymptotic, conditions
    from certify.certificates.claims.queries import query, require_no_corners
    from certify.certificates.verdict import Verdict
    from certify.loop.policies import load_policy
    from certify.provers.dreal.backend import to_smt2

    stored = load_policy(policy)
    plant = plant_of(stored, system, changes, tell)
    if plant.ranges:
        raise InputError(
            "export-smt2 needs a plant with exact equations, since its formulas have no ranges; found ranges of "
            f"{', '.join(plant.ranges)} in {plant.name}. Leave them out (for a disturbance in its file: half-width 0)."
        )
    if plant.constraints:
        raise InputError(
            "export-smt2 needs a plant without constraints, since its formulas do not ask about them; found "
            f"{', '.join(plant.constraints)} in {plant.name}. Leave the table [constraints] out of the plant's file."
        )
    if plant.in_steps:
        raise InputError(
            f"export-smt2 must have a plant in continuous time; found {plant.name}, whose time is discrete."
        )
    require_no_corners(plant)
    options = options_of(typed | {"claim": "asymptotic"}, plant, tell)  # its conditions are written
    result = certify_roa(plant, stored.network, out, options)
    inner, outer = result.levels.local, result.levels.roa
    if result.verdict is not Verdict.PROVED or result.problem is None or inner is None or outer is None:
        raise InputError(f"there are no levels to export; {result.verdict.value}: {result.reason}")
    outer = outer if options.level is not None else max(inner, 0.99 * outer)
    written = []
    for condition in conditions(Asymptotic(roa=outer, local=inner), result.problem):
        path = out / f"{condition.name}.smt2"
        text = to_smt2(query(condition, result.problem), "unsat (proved by the bounds engine, accepted by the checker)")
        write(path, text)
        written.append(str(path))
    say(json.dumps({"files": written}) if as_json else "\n".join(written))
