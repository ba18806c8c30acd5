"""`controllers history`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from certify.errors import OptionError
from controllers.commands.shared import ChosenPlant, Json, emit, errors

if TYPE_CHECKING:
    from certify.lyapunov import Candidate


def history(
    context: typer.Context,
    kept: Annotated[Path, typer.Argument(help="The folder that `controllers train --keep` wrote.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the figures, the table and the certificates.")],
    evaluations: Annotated[
        Path | None,
        typer.Option("--evaluations", help="CSV file of `train --evaluations`: draws the share that settles."),
    ] = None,
    effort: Annotated[
        float, typer.Option("--effort", help="Effort of the proof of one policy, as of `certify roa`.")
    ] = 1.0,
    candidate: Annotated[str, typer.Option("--candidate", help="Source of P, as of `certify roa`.")] = "ellipsoid",
    every: Annotated[int, typer.Option("--every", help="Prove each policy of so many; the last one always.")] = 1,
    no_proofs: Annotated[bool, typer.Option("--no-proofs", help="Draw the gain only, and prove nothing.")] = False,
    system: ChosenPlant = None,
    as_json: Json = False,
) -> None:
    """Draw a run's history: the learned against the true gain, and the proved set growing over training.

    Each policy is proved by itself, and a certificate that is there is checked again instead of searched for. Only
    what the checker accepts is drawn as proved.
    """
    with errors(context, as_json):
        from controllers.figures import draw_gain, draw_growth
        from controllers.history.gain_distance import distances
        from controllers.history.policies import read_policies
        from controllers.history.proofs import ProvingOptions, prove_all
        from controllers.history.table import read_settled, table
        from controllers.plants.choice import chosen_plant, system_of
        from controllers.storage import make_folder

        if every < 1:
            raise OptionError(f"`every` must be at least 1; found {every}.")
        options = ProvingOptions(effort=effort, candidate=cast("Candidate", candidate))
        policies = read_policies(kept)
        plant = system_of(policies[0].policy) if system is None else chosen_plant(system)[0]
        seed = int(policies[0].policy.training.get("seed", 0))
        settled = [] if evaluations is None else read_settled(evaluations)
        make_folder(out)
        found = distances(policies, plant)
        last = len(policies) - 1
        chosen = [] if no_proofs else [p for k, p in enumerate(policies) if k % every == 0 or k == last]
        proofs = prove_all(chosen, plant, out, options, lambda line: typer.echo(line, err=True))
        contents = {"gain": draw_gain(plant, seed, found, settled)}
        if proofs:
            contents["growth"] = draw_growth(plant, seed, proofs, options)
        files = _write(out, plant.name, contents | {"csv": table(found, proofs)})
        result: dict[str, Any] = {
            "system": plant.name,
            "policies": len(policies),
            "accepted": sum(proof.P is not None for proof in proofs),
            "asked": len(proofs),
            "K": _finite(found[-1].K),
            "mean": _finite(found[-1].mean),
            **{name: str(path) for name, path in files.items()},
        }
        emit(result, as_json)


def _write(out: Path, plant: str, contents: dict[str, bytes]) -> dict[str, Path]:
    """Write the figures and the table; their files by name."""
    from certify.certificates import write_atomically

    files = {name: out / f"{plant}-{'history.csv' if name == 'csv' else f'{name}.png'}" for name in contents}
    for name, content in contents.items():
        write_atomically(files[name], content)
    return files


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
