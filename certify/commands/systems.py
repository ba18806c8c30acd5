"""`certify systems`."""

from __future__ import annotations

import json

from certify.commands.shared import Json, describe
from certify.commands.terminal import say


def systems(as_json: Json = False) -> None:
    """List the plants that ship, with their parameters, domain and input bounds."""
    from certify.systems import available_systems, get_system

    found = [get_system(name) for name in available_systems()]
    if as_json:
        say(json.dumps({"systems": [describe(s) for s in found]}))
        return
    for s in found:
        lines = [f"{s.name}: {s.description}"]
        equations = zip(s.states, s.dynamics_of_values(), strict=True)
        lines += [f"  {symbol}' = {expression}" for symbol, expression in equations]
        lines += [f"  {name} = {float(value):g} {s.units.get(name, '')}" for name, value in s.parameters.items()]
        for symbols, intervals in ((s.states, s.domain_of_values()), (s.inputs, s.input_bounds)):
            for symbol, (lo, hi) in zip(symbols, intervals, strict=True):
                lines.append(f"  {symbol} in [{float(lo):g}, {float(hi):g}] {s.units.get(symbol.name, '')}")
        say("\n".join(lines))
