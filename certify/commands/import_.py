"""`certify import`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.commands.importing import imported_policy
from certify.commands.shared import Json
from certify.commands.terminal import say
from certify.inputs import lines

if TYPE_CHECKING:
    from certify.policies.importers import Imported, ImportOptions


def import_(
    file: Annotated[Path, typer.Argument(help="Policy file of another program.")],
    out: Annotated[Path, typer.Option(help="Policy file to write (.pt).")],
    importing: ImportOptions,
    system: Annotated[str | None, typer.Option(help="Plant that the policy controls: a name or a file.")] = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    as_json: Json = False,
) -> None:
    """Turn a policy file of another program into one of this program; nothing in it is executed."""
    from certify.policies import save_policy

    imported = imported_policy(file, importing, system, param or [])
    save_policy(out, imported.policy)
    say(json.dumps(_summary(imported, out)) if as_json else "\n".join([*lines(imported), f"written  {out}"]))


def _summary(imported: Imported, out: Path) -> dict[str, Any]:
    policy, difference = imported.policy, imported.difference
    return {
        "policy": {"path": str(out), "sha256": policy.network.sha256(), "layers": list(policy.network.layers)},
        "system": policy.system,
        "imported": dict(policy.training["imported"]),
        "formula": imported.formula,
        "compared": {
            "states": difference.states,
            "largest_difference": difference.largest,
            "rounding_explains": difference.explained,
            "in_double_precision": difference.in_double,
        },
        "pi_0": imported.at_origin.tolist(),
        "u_eq": imported.u_eq.tolist(),
        "centre": policy.network.centre,
        "centring_changes_u_by": dict(imported.centring),
        "valid": None if policy.valid is None else [[_finite(v) for v in row] for row in policy.valid],
    }


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if abs(value) != float("inf") else None
