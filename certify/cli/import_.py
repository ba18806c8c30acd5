"""`certify import`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from certify.analysis.changes import PlantChanges
from certify.analysis.inputs import checked, lines, plant_for
from certify.cli.importing import import_options
from certify.cli.options import changes_of_a_plant, takes
from certify.cli.shared import Json, PlantName
from certify.cli.terminal import say
from certify.errors import InputError

if TYPE_CHECKING:
    from certify.loop.policies.importers import Imported, ImportOptions
    from certify.loop.policies.importers.comparing import Difference
    from certify.lyapunov import ImportedLyapunov


@takes(importing=import_options(), changes=changes_of_a_plant("parameters"))
def import_(
    file: Annotated[Path, typer.Argument(help="Policy file of another program.")],
    *,
    out: Annotated[Path, typer.Option(help="Policy file to write (.pt).")],
    system: PlantName = None,
    changes: PlantChanges,
    lyapunov_out: Annotated[
        Path | None, typer.Option(help="File to write (.pt) for the Lyapunov network beside the policy in FILE.")
    ] = None,
    lyapunov_prefix: Annotated[
        str | None, typer.Option(help="Keys of its layers up to their numbers; two-stage files do not need it.")
    ] = None,
    as_json: Json = False,
    importing: ImportOptions,
) -> None:
    """Convert another program's policy file into one of this program, without executing anything in it."""
    from certify.loop.policies import save_policy
    from certify.loop.policies.importers import import_policy
    from certify.lyapunov import import_lyapunov, save_lyapunov

    if lyapunov_prefix is not None and lyapunov_out is None:
        raise InputError("--lyapunov-prefix must go with --lyapunov-out, the file to write the Lyapunov network to.")
    if lyapunov_out is not None and lyapunov_out.resolve() == out.resolve():
        raise InputError(f"--out and --lyapunov-out must be two files; both are {out}.")
    beside, plant = None, plant_for(f"the policy file {file}", system, changes)
    if lyapunov_out is not None:
        beside = import_lyapunov(file, plant, importing, lyapunov_prefix)
    imported = import_policy(file, plant, importing, lyapunov_prefix)
    save_policy(out, imported.policy)
    said = [*lines(imported), f"written  {out}"]
    if beside is not None and lyapunov_out is not None:
        stored = beside.stored
        save_lyapunov(lyapunov_out, stored.function, stored.system, stored.parameters, stored.training)
        said += [*_lyapunov_lines(beside), f"written  {lyapunov_out}"]
    say(json.dumps(_summary(imported, out, beside, lyapunov_out)) if as_json else "\n".join(said))


def _lyapunov_lines(found: ImportedLyapunov) -> list[str]:
    """The lines printed about an imported Lyapunov network."""
    from certify.lyapunov.file import FORMAT

    return [
        f"lyapunov {found.words}, as {FORMAT}: N(x) = net(x), {found.meaning}",
        *checked(found.difference, None, found.assumed, found.not_read),
        f"N(0)     {found.at_origin:.9g}",
        "level    none: a level that the file's makers state is not imported, and nothing is proved about N here",
    ]


def _summary(imported: Imported, out: Path, beside: ImportedLyapunov | None, beside_out: Path | None) -> dict[str, Any]:
    policy = imported.policy
    return {
        "policy": {"path": str(out), "sha256": policy.network.sha256(), "layers": list(policy.network.layers)},
        "system": policy.system,
        "imported": dict(policy.training["imported"]),
        "formula": imported.formula,
        "compared": None if imported.compared_with is None else _compared(imported.difference),
        "compared_with": imported.compared_with,
        "folding": _compared(imported.difference),
        "assumed": imported.assumed or None,
        "not_read": dict(imported.not_read),
        "pi_0": imported.at_origin.tolist(),
        "u_eq": imported.u_eq.tolist(),
        "centre": policy.network.centre,
        "centring_changes_u_by": dict(imported.centring),
        "valid": None if policy.valid is None else [[_finite(v) for v in row] for row in policy.valid],
        "lyapunov": None if beside is None else _lyapunov_summary(beside, beside_out),
    }


def _lyapunov_summary(found: ImportedLyapunov, out: Path | None) -> dict[str, Any]:
    from certify.lyapunov.file import FORMAT

    return {
        "path": str(out),
        "format": FORMAT,
        "widths": list(found.function.widths),
        "imported": dict(found.stored.training["imported"]),
        "meaning": found.meaning,
        "compared": None,
        "folding": _compared(found.difference),
        "assumed": found.assumed,
        "not_read": dict(found.not_read),
        "N_0": found.at_origin,
        "level": None,
    }


def _compared(difference: Difference) -> dict[str, Any]:
    return {
        "states": difference.states,
        "largest_difference": difference.largest,
        "rounding_explains": difference.explained,
        "in_double_precision": difference.in_double,
    }


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if abs(value) != float("inf") else None
