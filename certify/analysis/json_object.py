"""The JSON object of `certify roa --json`."""

from __future__ import annotations

from dataclasses import asdict
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from certify.loop.equilibrium import Rest
from certify.loop.plants import Measurements, System, kind_of
from certify.lyapunov import extents, semi_axes
from certify.provers.falsify import Witness
from certify.report.rows import STAGES
from certify.report.sampled import described

if TYPE_CHECKING:
    from certify.analysis.results import RoaResult


def to_dict(result: RoaResult) -> dict[str, Any]:
    """The JSON object of `certify roa --json`; lengths along the states are in their units."""
    system, network, P = result.system, result.network, result.P
    return {
        "schema": "certify-roa/1",
        "verdict": result.verdict.value,
        "reason": result.reason,
        "stop": result.stop.name.lower(),
        "claim": _claim(result),
        "time": system.time,
        "system": system.name,
        "parameters": {name: str(q) for name, q in system.parameters.items()},
        "uncertain": _uncertain(system),
        "data": None if system.measurements is None else _data(system, system.measurements),
        "samples": described(system),
        "states": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.states],
        "operating_point": {name: str(q) for name, q in system.operating_point().items()},
        "inputs": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.inputs],
        "policy": {"sha256": network.sha256(), "layers": list(network.layers), "words": network.words},
        "lyapunov": {
            "P": None if P is None else P.tolist(),
            "candidate": result.candidate,
            "notice": result.notice,
        },
        "levels": result.levels.to_dict(),
        "reach_time": result.reach_time,
        "reach_from": None
        if result.reach_from is None
        else {
            s.name: str(lo) if lo == hi else [str(lo), str(hi)]
            for s, (lo, hi) in zip(system.states, result.reach_from, strict=True)
        },
        "tube": None if result.tube is None else result.tube.to_dict(),
        "outer": None if result.outer is None else result.outer.to_dict(),
        "ranks": None if result.ranks is None else result.ranks.to_dict(),
        "constraints": dict(result.constraints),
        "simulated": None if result.simulated is None else result.simulated.to_dict(),
        "nonlinearity": None if result.nonlinearity is None else result.nonlinearity.to_dict(),
        "witness": None if result.witness is None else _witness(result.witness),
        "eigenvalues": list(result.eigenvalues),
        "rest": None if result.rest is None else _rest(result, result.rest),
        **_sizes(result),
        "candidates": [asdict(one) for one in result.tried],
        "engine": result.engine,
        "solver": None if result.solver is None else dict(result.solver),
        "diagnosis": None if result.diagnosis is None else result.diagnosis.to_dict(),
        "boxes": result.boxes,
        "leaves": result.leaves,
        "seconds": {name: result.seconds.get(name) for name in (*STAGES, "total")},
        "certificate": None if result.certificate is None else str(result.certificate),
        "search": None if result.search is None else str(result.search),
        "certificate_sha256": None if result.checker is None else result.checker.get("certificate_sha256"),
        "checked": None if result.checker is None else result.checker.get("result"),
        "reference": None if result.checker is None else result.checker.get("reference", {}).get("result"),
        "contains": None,  # the answer to `certify roa --contains`
    }


def _uncertain(system: System) -> list[dict[str, str]]:
    return [
        {"name": name, "kind": kind_of(system, name), "lo": str(lo), "hi": str(hi), "unit": system.units.get(name, "")}
        for name, (lo, hi) in system.ranges.items()
    ]


def _data(system: System, data: Measurements) -> dict[str, Any] | None:
    """The measurements of the claim; None where only ranges are known to rest on some."""
    if not data.runs:
        return None
    ranges = {name: [str(q) for q in system.ranges[name]] for name in data.constants}
    return {
        "sha256": data.sha256,
        "transitions": data.transitions,
        "runs": len(data.runs),
        "period": None if data.period is None else [str(h) for h in data.period],
        "noise": {s.name: str(w) for s, w in zip(system.states, data.noise, strict=True)},
        "priors": {name: [str(q) for q in pair] for name, pair in data.priors.items()},
        "ranges": ranges,
    }


def _witness(witness: Witness) -> dict[str, Any]:
    held = {} if witness.kind == "input" else witness.values  # an input does not depend on them
    values = {name: str(q) for name, q in held.items()}
    named = {"constraint": witness.constraint} if witness.constraint else {}
    return {"x": witness.x.tolist(), "V": witness.level, "kind": witness.kind, "values": values, **named}


def _sizes(result: RoaResult) -> dict[str, Any]:
    if result.ellipsoid is None:
        return dict.fromkeys(("volume", "semi_axes", "extents"))
    axes, reach = semi_axes(*result.ellipsoid).tolist(), extents(*result.ellipsoid).tolist()
    return {"volume": result.volume, "semi_axes": axes, "extents": reach}


def _claim(result: RoaResult) -> dict[str, Any]:
    """The claim's kind, with the rate and the periods where there are any."""
    rate = {"rate": result.timing.rate} if result.timing.rate else {}
    sample = result.system.sample
    return {"kind": result.claim, **rate, **({} if sample is None else {"sample": [str(h) for h in sample]})}


def _rest(result: RoaResult, rest: Rest) -> dict[str, Any]:
    """The point at which the loop rests, also by the states' values; `origin` says that V is 0 there."""
    moved = map(Fraction, result.network.origin.tolist())  # x is in deviations from where the plant was to rest
    each = zip(result.system.exact_x_eq(), moved, rest.x, strict=True)
    values = [float(at - by + Fraction(x)) for at, by, x in each]
    return asdict(rest) | {"values": values, "origin": result.network.is_moved}
