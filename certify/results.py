"""What a run found, as a typed value and as the JSON object of `certify roa --json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.claims import Problem
from certify.claims.claim import Kind
from certify.engines.falsify import Witness
from certify.lyapunov import extents, semi_axes, volume
from certify.policies import TanhNetwork
from certify.systems import System
from certify.verdict import Stop, Verdict

Array = NDArray[np.float64]
_STAGES = ("load", "candidate", "local", "ring", "write", "check", "total")


@dataclass(frozen=True, slots=True)
class Levels:
    """Levels of V. None means that there is none.

    `local` (c1) and `roa` (c2) state an asymptotic claim, `floor` (c0) and `roa` a practical one. `sampled_limit` is
    where the lowest violation was found, `domain_limit` where the set meets the domain.
    """

    local: float | None = None
    floor: float | None = None
    roa: float | None = None
    sampled_limit: float | None = None
    domain_limit: float | None = None

    @property
    def inner(self) -> float | None:
        """The level from which the ring reaches outwards."""
        return self.floor if self.local is None else self.local


@dataclass(frozen=True, slots=True)
class RoaResult:
    """What was proved. `stop` and `detail` say what limits the level, or why nothing was proved.

    `candidate` is where P came from, `notice` why that is not what was asked for. `checker` is what the checker said,
    None if it was not reached, about `raw`, the certificate's bytes; `solver` has dReal's version and every query with
    its answer, None if it was not asked.
    """

    verdict: Verdict
    stop: Stop
    system: System
    network: TanhNetwork
    claim: Kind = "asymptotic"
    detail: str = ""
    problem: Problem | None = None
    candidate: str | None = None
    notice: str | None = None
    levels: Levels = field(default_factory=Levels)
    witness: Witness | None = None
    eigenvalues: tuple[str, ...] = ()
    boxes: int = 0
    leaves: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    certificate: Path | None = None
    raw: bytes | None = field(default=None, repr=False)
    checker: Mapping[str, Any] | None = None
    engine: str = "bounds"
    solver: Mapping[str, Any] | None = None

    @property
    def P(self) -> Array | None:
        """The matrix of V, (n, n); None if nothing was tried."""
        return None if self.problem is None else self.problem.V.P

    @property
    def reason(self) -> str:
        """What limits the level, or why nothing was proved, in words."""
        return self.stop.explain(self.detail)

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify roa --json`; lengths along the states are in their units."""
        system, network, witness = self.system, self.network, self.witness
        P, level = self.P, self.levels.roa
        geometry: dict[str, Any] = dict.fromkeys(("volume", "semi_axes", "extents"))
        if P is not None and level is not None:
            axes, reach = semi_axes(P, level).tolist(), extents(P, level).tolist()
            geometry = {"volume": volume(P, level), "semi_axes": axes, "extents": reach}
        stated = {
            "schema": "certify-roa/1",
            "verdict": self.verdict.value,
            "reason": self.reason,
            "stop": self.stop.name.lower(),
            "claim": {"kind": self.claim},
            "system": system.name,
            "parameters": {name: str(q) for name, q in system.parameters.items()},
            "states": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.states],
            "operating_point": {name: str(q) for name, q in system.operating_point().items()},
            "inputs": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.inputs],
            "policy": {"sha256": network.sha256(), "layers": list(network.layers)},
            "lyapunov": {
                "P": None if P is None else P.tolist(),
                "candidate": self.candidate,
                "notice": self.notice,
            },
            "levels": {name: getattr(self.levels, name) for name in Levels.__slots__},
            "witness": None,
            "eigenvalues": list(self.eigenvalues),
        }
        if witness is not None:
            stated["witness"] = {"x": witness.x.tolist(), "V": witness.level, "kind": witness.kind}
        return {
            **stated,
            **geometry,
            "engine": self.engine,
            "solver": None if self.solver is None else dict(self.solver),
            "boxes": self.boxes,
            "leaves": self.leaves,
            "seconds": {name: self.seconds.get(name) for name in _STAGES},
            "certificate": None if self.certificate is None else str(self.certificate),
            "certificate_sha256": None if self.checker is None else self.checker.get("certificate_sha256"),
            "checked": None if self.checker is None else self.checker.get("result"),
        }
