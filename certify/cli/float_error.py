"""`certify float-error`."""

from __future__ import annotations

import json
from decimal import ROUND_CEILING, Context, Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from certify.analysis.changes import PlantChanges
from certify.analysis.inputs import plant_of
from certify.cli.options import changes_of_a_plant, takes
from certify.cli.shared import Json, PlantName
from certify.cli.terminal import say, tell

if TYPE_CHECKING:
    from certify.loop.float32 import FloatError
    from certify.loop.plants import System
    from certify.loop.policies import Policy

_SHOWN = 3  # sources of a bound


@takes(changes=changes_of_a_plant("parameters", "domain"))
def float_error(
    policy: Annotated[Path, typer.Argument(help="Policy file (certify-policy/1 or /2, .pt).")],
    *,
    system: PlantName = None,
    changes: PlantChanges,
    tanh_ulp: Annotated[
        float, typer.Option("--tanh-ulp", help="Error of tanh, in units in the last place of its exact value.")
    ] = 4.0,
    chain: Annotated[
        int | None,
        typer.Option(help="Most additions that a product passes through in a sum; default: any order of summation."),
    ] = None,
    boxes: Annotated[
        int | None, typer.Option(help="Parts to cut the domain into; default: as many as take a few seconds.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Bound the difference between the policy computed in binary32 (float32) and the exact one on the domain."""
    from certify.loop.float32 import FloatOptions
    from certify.loop.float32 import float_error as bound
    from certify.loop.policies import load_policy

    options = FloatOptions(tanh_ulp, chain, boxes)
    stored = load_policy(policy)
    plant = plant_of(stored, system, changes, tell)
    found = bound(stored.network, plant, options)
    say(_data(found, stored, plant, options.tanh_ulp, chain) if as_json else _text(found, stored, plant))


def _data(found: FloatError, stored: Policy, plant: System, tanh_ulp: float, chain: int | None) -> str:
    inputs = [
        {
            "name": u.name,
            "unit": plant.units.get(u.name, ""),
            "bound": bound,
            "parts": {part.source: part.errors[j] for part in found.parts},
        }
        for j, (u, bound) in enumerate(zip(plant.inputs, found.bounds, strict=True))
    ]
    return json.dumps({
        "schema": "certify-float-error/1",
        "system": plant.name,
        "parameters": {name: str(q) for name, q in plant.parameters.items()},
        "domain": {s.name: [str(lo), str(hi)] for s, (lo, hi) in zip(plant.states, plant.domain, strict=True)},
        "policy": {"sha256": stored.network.sha256(), "layers": list(stored.network.layers)},
        "inputs": inputs,
        "tanh_ulp": tanh_ulp,
        "chain": chain,
        "boxes": found.boxes,
        "assumptions": list(found.assumptions),
    })  # fmt: skip


def _text(found: FloatError, stored: Policy, plant: System) -> str:
    width = max(len(u.name) for u in plant.inputs)
    layers = "-".join(map(str, stored.network.layers))
    said = [f"policy {layers} on the domain of {plant.name}, in {found.boxes} parts: |binary32 - exact| is at most"]
    for j, (u, bound) in enumerate(zip(plant.inputs, found.bounds, strict=True)):
        parts = sorted(((part.errors[j], part.source) for part in found.parts), reverse=True)[:_SHOWN]
        total = sum(part.errors[j] for part in found.parts)
        shares = ", ".join(f"{source} {100 * error / total:.0f} %" for error, source in parts)
        unit = plant.units.get(u.name, "")
        said.append(f"  {u.name:<{width}}  {_above(bound)} {unit}".rstrip() + f"  (most of it: {shares})")
    said.append("for every program with these properties:")
    return "\n".join([*said, *(f"  - {line}" for line in found.assumptions)])


def _above(value: float) -> str:
    """Six digits, rounded up: the number typed into another command is no smaller than the bound."""
    return f"{Context(prec=6, rounding=ROUND_CEILING).create_decimal(Decimal(value)):e}"
