"""`certify float-error`."""

from __future__ import annotations

import json
from decimal import ROUND_CEILING, Context, Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from certify.commands.arguments import plant_of
from certify.commands.shared import Json
from certify.commands.terminal import say

if TYPE_CHECKING:
    from certify.float_error import FloatError
    from certify.policies import Policy
    from certify.systems import System

_SHOWN = 3  # of what a bound is made of


def float_error(
    policy: Annotated[Path, typer.Argument(help="Policy file (certify-policy/1 or /2, .pt).")],
    system: Annotated[str | None, typer.Option(help="Plant, as for roa; default: what the policy file says.")] = None,
    param: Annotated[list[str] | None, typer.Option(help="Parameter of the plant, NAME=VALUE; repeatable.")] = None,
    domain: Annotated[
        list[str] | None, typer.Option(help="Half-width NAME=D or interval NAME=LO..HI of a state; repeatable.")
    ] = None,
    tanh_ulp: Annotated[
        float, typer.Option("--tanh-ulp", help="Accuracy of tanh, in units in the last place of its exact value.")
    ] = 4.0,
    chain: Annotated[
        int | None,
        typer.Option(
            help="The most additions that a product passes through in a sum; default: any order of summation."
        ),
    ] = None,
    boxes: Annotated[
        int | None, typer.Option(help="Parts into which the domain is cut; default: as many as take seconds.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Bound how far the policy computed in binary32 (float32) can be from the exact one, on the plant's domain."""
    from certify.float_error import FloatOptions
    from certify.float_error import float_error as bound
    from certify.policies import load_policy

    options = FloatOptions(tanh_ulp, chain, boxes)
    stored = load_policy(policy)
    plant = plant_of(stored, system, param or [], domain or [])
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
    said.append("for every program of which this holds:")
    return "\n".join([*said, *(f"  - {line}" for line in found.assumptions)])


def _above(value: float) -> str:
    """Six digits in plain letters, rounded up: what is typed into another command is no smaller."""
    return f"{Context(prec=6, rounding=ROUND_CEILING).create_decimal(Decimal(value)):e}"
