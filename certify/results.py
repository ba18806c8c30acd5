"""What a run found, as a typed value and as the JSON object of `certify roa --json`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.claims import Problem
from certify.claims.claim import Kind
from certify.engines.falsify import Witness
from certify.lyapunov import extents, semi_axes, volume
from certify.policies import TanhNetwork
from certify.rest import Rest
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
class Tried:
    """A candidate that was tried.

    `level` and `volume` are the most within its reach, sampled, ended by `limited_by`; `proved` says that the result is
    about this one, `proved_volume` what the search had proved with it, None if nothing.
    """

    candidate: str
    level: float
    limited_by: str
    volume: float
    proved: bool
    proved_volume: float | None


@dataclass(frozen=True, slots=True)
class Step:
    """What to try next: options to add to the command (none if no option helps), and why."""

    options: tuple[tuple[str, str], ...]
    why: str


@dataclass(frozen=True, slots=True)
class Share:
    """How far the set reaches along a state, and that as a share of the nearer side of its domain."""

    state: str
    unit: str
    extent: float
    share: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What binds and where.

    Parameters
    ----------
    binds : in words, with the names of states and inputs.
    kind : `domain`, `vdot`, `input`, or the name of the stop.
    name, side : the state or input that binds and which side, None where neither does.
    point : a state at which it binds, (n,), None if there is none.
    shares : one a state; empty without a set.
    fastest, slowest : real parts of the closed loop's eigenvalues at the origin, 1/s.
    hurts : weights of the states, (n,), the largest 1: the direction in which the proof had most to do.
    next : what to try.
    """

    binds: str
    kind: str
    name: str | None
    side: str | None
    point: tuple[float, ...] | None
    shares: tuple[Share, ...]
    fastest: float | None
    slowest: float | None
    hurts: tuple[tuple[str, float], ...]
    next: Step

    @property
    def stiffness(self) -> float | None:
        """How many times faster the fastest mode decays than the slowest; None unless all decay."""
        if self.fastest is None or self.slowest is None or not self.slowest < 0:
            return None
        return self.fastest / self.slowest

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the fields, and `stiffness`; `hurts` by state."""
        stated = asdict(self)
        stated |= {"stiffness": self.stiffness, "hurts": dict(self.hurts)}
        stated["next"] = {"options": dict(self.next.options), "why": self.next.why}
        return stated


@dataclass(frozen=True, slots=True)
class RoaResult:
    """What was proved. `stop` and `detail` say what limits the level, or why nothing was proved.

    `rest` is where the loop rests, if not at the origin. `candidate` is where P came from, `tried` all that were tried,
    `notice` what is not as it was asked for. `checker` is what the checker said, None if it was not reached, about
    `raw`, the certificate's bytes; `solver` has dReal's version and every query with its answer, None if it was not
    asked.
    """

    verdict: Verdict
    stop: Stop
    system: System
    network: TanhNetwork
    claim: Kind = "asymptotic"
    detail: str = ""
    problem: Problem | None = None
    candidate: str | None = None
    tried: tuple[Tried, ...] = ()
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
    diagnosis: Diagnosis | None = None
    rest: Rest | None = None

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
            "rest": None if self.rest is None else asdict(self.rest),
        }
        if witness is not None:
            stated["witness"] = {"x": witness.x.tolist(), "V": witness.level, "kind": witness.kind}
        return {
            **stated,
            **geometry,
            "candidates": [asdict(one) for one in self.tried],
            "engine": self.engine,
            "solver": None if self.solver is None else dict(self.solver),
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_dict(),
            "boxes": self.boxes,
            "leaves": self.leaves,
            "seconds": {name: self.seconds.get(name) for name in _STAGES},
            "certificate": None if self.certificate is None else str(self.certificate),
            "certificate_sha256": None if self.checker is None else self.checker.get("certificate_sha256"),
            "checked": None if self.checker is None else self.checker.get("result"),
        }
