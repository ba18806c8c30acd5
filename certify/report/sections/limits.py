"""The set's limits and the next thing to try: its share of the domain, and the states that cost the proof most.

The limits' names stand in `certify/report/limits.py`, which the terminal shares.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from certify.certificates import Certificate
from certify.lyapunov import extents
from certify.report.figures.sets import centre_of, is_ellipsoid
from certify.report.limits import AT_A_POINT, limit_in_words, outer_limited_by
from certify.report.sections.shared import ellipsoids_of, shares_of, timing_of
from certify.report.sections.status import is_missed
from certify.report.words import above, held_at, modes, pretty_unit, symbol


def limits_of(certificate: Certificate, result: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """The set's shares of its domain, and the limits that the run reports; None if there is no set.

    The shares come from the certificate; only words and the next step come from the run.
    """
    if not is_ellipsoid(certificate):
        return None
    system = certificate.system
    sets = ellipsoids_of(certificate)
    if centre_of(certificate) is not None:  # the reach of a set elsewhere is no share of a side
        sets = sets[-1:]
    reach = [extents(each.P, each.level) for each in sets]
    shares = [shares_of(certificate, e) for e in reach]
    found: Mapping[str, Any] = (result or {}).get("diagnosis") or {}
    names = {s.name: symbol(s.name) for s in system.states}
    step: Mapping[str, Any] = found.get("next") or {}
    options = " ".join(f"{name} {value}" for name, value in (step.get("options") or {}).items())
    return {
        "binds": "" if is_missed(result) else limit_in_words(str(found.get("binds", "")), timing_of(certificate)),
        "modes": ""
        if timing_of(certificate).discrete
        else _modes(found, "with " * bool(system.ranges) + held_at(system)),
        "outer": _outer_limit(result),
        "sets": len(sets),
        "shares": [
            {
                "name": symbol(s.name) if each is sets[0] else "",
                "of": each.name,
                "kind": each.kind,
                "reach": f"{above(float(e[k]), 4)} {pretty_unit(system.units.get(s.name, ''))}".rstrip(),
                "share": f"{above(100 * share[k], 3)} %",
                "width": f"{min(100.0, 100 * share[k]):.1f}",
                "binds": share[k] == max(share),
            }
            for k, s in enumerate(system.states)
            for each, e, share in zip(sets, reach, shares, strict=True)
        ],
        "hurts": [
            (names.get(name, name), f"{100 * weight:.1f}", f"{100 * weight:.0f} %")
            for name, weight in ({} if found.get("kind") in AT_A_POINT else found.get("hurts") or {}).items()
        ],
        "why": str(step.get("why", "")).rstrip("."),
        "command": step.get("command") or options,
    }


def _outer_limit(result: Mapping[str, Any] | None) -> str:
    """The limit of the outer set that the run reports; empty without an outer set."""
    found: Mapping[str, Any] = (result or {}).get("outer") or {}
    return outer_limited_by(found) if found else ""


def _modes(found: Mapping[str, Any], held: str) -> str:
    """The closed loop's modes at the equilibrium in a sentence, with the uncertain values `held`."""
    if not found.get("stiffness"):
        return ""
    return f"Modes at the equilibrium{f', {held}' if held else ''}: {modes(found['fastest'], found['slowest'])}."
