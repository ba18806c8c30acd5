"""`controllers history`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from certify.errors import InputError
from controllers.commands.shared import Json, emit, errors

if TYPE_CHECKING:
    from certify.lyapunov import Candidate


def history(
    kept: Annotated[Path, typer.Argument(help="The folder that `controllers train --keep` wrote.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the figures, the table and the certificates.")],
    evaluations: Annotated[
        Path | None,
        typer.Option("--evaluations", help="The run's CSV file of `train --evaluations`: draws which share settled."),
    ] = None,
    time_limit: Annotated[float, typer.Option("--time-limit", help="Seconds for the proof of one policy.")] = 50.0,
    candidate: Annotated[str, typer.Option("--candidate", help="Where P comes from, as of `certify roa`.")] = "auto",
    every: Annotated[int, typer.Option("--every", help="Prove each policy of so many; the last one always.")] = 1,
    no_proofs: Annotated[bool, typer.Option("--no-proofs", help="Draw the gain only, and prove nothing.")] = False,
    system: Annotated[
        str | None,
        typer.Option(help="A plant of your own, FILE.toml or FILE.py:NAME; default: what the policies say."),
    ] = None,
    as_json: Json = False,
) -> None:
    """Draw a run's history: the learned against the true gain, and the certified set growing over training.

    Each policy is proved by itself, and a certificate that is there is checked again and not searched for again. Only
    what the checker accepts is drawn as proved.
    """
    with errors(as_json):
        from certify.loop.plants import shipped_system
        from controllers.figures import draw_gain, draw_growth
        from controllers.files import make_folder, write_atomically
        from controllers.history import ProvingOptions, distances, prove_all, read_settled, table
        from controllers.kept import read_kept
        from controllers.own import chosen_plant

        if every < 1:
            raise InputError(f"`every` must be at least 1; found {every}.")
        options = ProvingOptions(time_limit=time_limit, candidate=cast("Candidate", candidate))
        policies = read_kept(kept)
        first = policies[0].policy
        plant = (
            shipped_system(first.system).with_parameters(first.parameters)
            if system is None
            else chosen_plant(system)[0]
        )
        seed = int(first.training.get("seed", 0))
        settled = [] if evaluations is None else read_settled(evaluations)
        make_folder(out)
        found = distances(policies, plant)
        last = len(policies) - 1
        chosen = [] if no_proofs else [p for k, p in enumerate(policies) if k % every == 0 or k == last]
        proofs = prove_all(chosen, plant, out, options, lambda line: typer.echo(line, err=True))
        pictures = {"gain": draw_gain(plant, seed, found, settled)}
        if proofs:
            pictures["growth"] = draw_growth(plant, seed, proofs, options)
        files = {name: out / f"{plant.name}-{name}.png" for name in pictures}
        for name, content in pictures.items():
            write_atomically(files[name], content)
        files["csv"] = out / f"{plant.name}-history.csv"
        write_atomically(files["csv"], table(found, proofs))
        end = found[-1]
        result: dict[str, Any] = {
            "system": plant.name,
            "policies": len(policies),
            "accepted": sum(proof.P is not None for proof in proofs),
            "asked": len(proofs),
            "K": _finite(end.K),
            "mean": _finite(end.mean),
            **{name: str(path) for name, path in files.items()},
        }
        emit(result, as_json)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
