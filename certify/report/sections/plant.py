"""The claim's plant, within the section on the proof: its equations, its domain, the bounds of its inputs, its
operating point, and its uncertain quantities."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import Any

from certify.certificates import AnyCertificate, Certificate
from certify.loop.expressions import Expression, Number, Symbol, jumping, nodes
from certify.loop.plants import System, input_errors
from certify.report.mathml import identifier, is_long, multiplied_out, typeset
from certify.report.measured import Measured
from certify.report.sampled import Sampled
from certify.report.sections.shared import centre_in_words, read_in_words
from certify.report.words import (
    above,
    at_rest,
    below,
    held_at,
    is_free,
    listed,
    number,
    pretty_unit,
    symbol,
    varying,
    varying_in,
)


def plant_of(certificate: AnyCertificate) -> dict[str, Any]:
    """Its equations, its ranges and its operating point, by their names in the template."""
    system, units = certificate.system, certificate.system.units
    expressions, steps = system.uncertain_dynamics(), system.time == "discrete"

    def interval(name: str, bounds: tuple[Fraction, Fraction]) -> str:
        lo, hi = bounds
        if is_free(lo, hi):
            return f"{symbol(name)} of any size"
        return f"{symbol(name)} ∈ [{below(lo)}, {above(hi)}] {pretty_unit(units.get(name, ''))}".rstrip()

    equilibrium = zip(system.inputs, system.exact_u_eq(), strict=True)
    return {
        "name": system.name,
        "equations": [_equation(s, e, steps=steps) for s, e in zip(system.states, expressions, strict=True)],
        "jumps": bool(jumping(*expressions)),
        "rounded": any(map(is_long, _numbers(expressions, system.exact_u_eq()))),
        "domain": [interval(s.name, b) for s, b in zip(system.states, system.domain, strict=True)],
        "inputs": [interval(s.name, b) for s, b in zip(system.inputs, system.input_bounds, strict=True)],
        "at": at_rest(
            [s.name for s in system.states], system.exact_x_eq(), [units.get(s.name, "") for s in system.states]
        ),
        "read": read_in_words(certificate) if certificate.network.is_moved else "",
        "centre": centre_in_words(certificate, of_values=True) if isinstance(certificate, Certificate) else "",
        "u_eq": ", ".join(f"{symbol(s.name)} = {_short(u)}" for s, u in equilibrium),
        "uncertain": [q.words for q in varying_in(system)],
        "held": held_at(system),
        "data": data_of(system),
        "stands": _stands_for(system),
        "listed": ", ".join(symbol(name) for name in system.ranges),
        "errors": [f"{symbol(u)} + {symbol(e)}" for u, e in input_errors(system).items()],
    }


def _stands_for(system: System) -> str:
    """The words of equations that stand for sampled functions; empty where there are none."""
    sampled = Sampled.of(system)
    if sampled is None:
        return ""
    own = listed([symbol(name) for f in sampled.functions for name in f["quantities"]])
    which = "equation stands" if len(sampled.functions) == 1 else "equations stand"
    return f"The {which} for {sampled.names}: whatever the function is, the two are the same for some values of {own}."


def data_of(system: System) -> dict[str, str]:
    """The words of measurements about the plant's parameters, in words; empty where its ranges are assumed."""
    data = Measured.of(system)
    if data is None:
        return {}
    return {"names": data.names, "ranges": data.in_ranges, "others": varying(data.others(varying_in(system)))}


def _numbers(expressions: Sequence[Expression], more: Sequence[Fraction]) -> list[Fraction]:
    shown = nodes(*map(multiplied_out, expressions))
    return [*(e.value for e in shown if isinstance(e, Number)), *more]


def _equation(state: Symbol, expression: Expression, *, steps: bool) -> Any:
    """`state' = expression`, or by steps `state+ = expression`."""
    left = f"<mfrac><mrow><mi>d</mi>{identifier(state.name)}</mrow><mrow><mi>d</mi><mi>t</mi></mrow></mfrac>"
    if steps:
        left = f"<msup>{identifier(state.name)}<mo>+</mo></msup>"
    return typeset(left, expression)


def _short(value: Fraction) -> str:
    return number(float(value)) if is_long(value) else str(value)
