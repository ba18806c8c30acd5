"""`certify systems`."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from certify.cli.shared import Json, describe
from certify.cli.terminal import say

if TYPE_CHECKING:
    from certify.loop.plants import System


def systems(as_json: Json = False) -> None:
    """List the plants that ship, with their parameters, disturbances, domain and input bounds."""
    from certify.loop.plants import available_systems, get_system

    found = [get_system(name) for name in available_systems()]
    if as_json:
        say(json.dumps({"systems": [describe(s) for s in found]}))
        return
    for s in found:
        lines = [f"{s.name}: {s.description}"]
        equations = zip(s.states, s.dynamics_of_values(), strict=True)
        mark = "'" if s.time == "continuous" else "+"  # mark of the state one step later
        lines += [f"  {symbol}{mark} = {expression}" for symbol, expression in equations]
        lines += [
            f"  {name} = {float(value):g} {s.units.get(name, '')}{_range(s, name)}"
            for name, value in s.parameters.items()
        ]
        lines += [
            f"  disturbance {w} {s.units.get(w.name, '')}".rstrip() + (_range(s, w.name) or ", 0 unless asked for")
            for w in s.disturbances
        ]
        for symbols, intervals in ((s.states, s.domain_of_values()), (s.inputs, s.input_bounds)):
            for symbol, (lo, hi) in zip(symbols, intervals, strict=True):
                lines.append(f"  {symbol} in [{float(lo):g}, {float(hi):g}] {s.units.get(symbol.name, '')}")
        say("\n".join(lines))


def _range(s: System, name: str) -> str:
    """The range that the plant's own file gives a quantity, in words; empty if it gives none."""
    if name not in s.ranges:
        return ""
    from certify.report.words import inside

    return f", uncertain in {inside(*s.ranges[name])}"
