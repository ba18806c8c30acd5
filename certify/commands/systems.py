"""`certify systems`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from certify.commands.shared import Json
from certify.commands.terminal import say

if TYPE_CHECKING:
    from certify.systems import System


def systems(as_json: Json = False) -> None:
    """List the plants that ship, with their parameters, domain and input bounds."""
    from certify.systems import available_systems, get_system

    found = [get_system(name) for name in available_systems()]
    if as_json:
        say(json.dumps({"systems": [_describe(s) for s in found]}))
        return
    for s in found:
        lines = [f"{s.name}: {s.description}"]
        lines += [f"  {symbol}' = {expression}" for symbol, expression in zip(s.states, s.dynamics, strict=True)]
        lines += [f"  {name} = {float(value):g} {s.units.get(name, '')}" for name, value in s.parameters.items()]
        for symbols, intervals in ((s.states, s.domain), (s.inputs, s.input_bounds)):
            for symbol, (lo, hi) in zip(symbols, intervals, strict=True):
                lines.append(f"  {symbol} in [{float(lo):g}, {float(hi):g}] {s.units.get(symbol.name, '')}")
        say("\n".join(lines))


def _describe(s: System) -> dict[str, Any]:
    return {
        "name": s.name,
        "description": s.description,
        "states": [x.name for x in s.states],
        "inputs": [u.name for u in s.inputs],
        "parameters": {name: str(q) for name, q in s.parameters.items()},
        "domain": {x.name: [str(lo), str(hi)] for x, (lo, hi) in zip(s.states, s.domain, strict=True)},
        "input_bounds": {u.name: [str(lo), str(hi)] for u, (lo, hi) in zip(s.inputs, s.input_bounds, strict=True)},
        "dynamics": {x.name: str(e) for x, e in zip(s.states, s.dynamics, strict=True)},
        "units": dict(s.units),
    }
