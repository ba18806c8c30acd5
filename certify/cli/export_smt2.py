"""`certify export-smt2`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from certify.cli.arguments import plant_of
from certify.cli.shared import Json, write
from certify.cli.terminal import say
from certify.errors import InputError


def export_smt2(
    policy: Annotated[Path, typer.Option(help="Policy file (certify-policy/1 or /2, .pt).")],
    out: Annotated[Path, typer.Option(help="Folder for the files, one per condition.")],
    system: Annotated[str | None, typer.Option(help="Plant, as for roa; default: the policy file's plant.")] = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    domain: Annotated[list[str] | None, typer.Option(help="Half-width NAME=D or interval NAME=LO..HI.")] = None,
    candidate: Annotated[str, typer.Option(help="Lyapunov candidate, as for roa.")] = "lyapunov",
    level: Annotated[float | None, typer.Option(help="c2; default: 0.99 of the largest proved level.")] = None,
    time_limit: Annotated[float, typer.Option(help="Seconds for everything up to the verdict.")] = 50.0,
    as_json: Json = False,
) -> None:
    """Prove an asymptotic claim with the bounds engine and write its conditions as SMT-LIB 2 for another solver."""
    from certify.analysis.run import RoaOptions, certify_roa
    from certify.certificates.claims import Asymptotic, conditions
    from certify.certificates.claims.queries import query
    from certify.certificates.verdict import Verdict
    from certify.loop.policies import load_policy
    from certify.provers.dreal.backend import to_smt2

    stored = load_policy(policy)
    plant = plant_of(stored, system, param or [], domain or [])
    if plant.ranges:
        raise InputError(
            "export-smt2 needs a plant with exact equations, since its formulas have no ranges; found ranges of "
            f"{', '.join(plant.ranges)} in {plant.name}. Leave them out (for a disturbance in its file: half-width 0)."
        )
    if plant.in_steps:
        raise InputError(
            f"export-smt2 must have a plant in continuous time; found {plant.name}, whose time is discrete."
        )
    options = RoaOptions(
        claim="asymptotic",  # its conditions are written
        candidate=candidate,  # type: ignore[arg-type]
        level=level,
        time_limit=time_limit,
    )
    result = certify_roa(plant, stored.network, out, options)
    inner, outer = result.levels.local, result.levels.roa
    if result.verdict is not Verdict.PROVED or result.problem is None or inner is None or outer is None:
        raise InputError(f"there are no levels to export; {result.verdict.value}: {result.reason}")
    outer = outer if level is not None else max(inner, 0.99 * outer)
    written = []
    for condition in conditions(Asymptotic(roa=outer, local=inner), result.problem):
        path = out / f"{condition.name}.smt2"
        text = to_smt2(query(condition, result.problem), "unsat (proved by the bounds engine, accepted by the checker)")
        write(path, text)
        written.append(str(path))
    say(json.dumps({"files": written}) if as_json else "\n".join(written))
