"""The result of a proof that a set is never left, and its JSON object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from certify.analysis.facts import OuterFacts
from certify.analysis.options import RoaOptions
from certify.certificates.verdict import Verdict
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork


@dataclass(frozen=True, slots=True)
class InvariantResult:
    """The result of a run. `reason` says in words why it ends so, `following` what to try next.

    Parameters
    ----------
    outer : the set, if one is proved; its volume is estimated. `boxes` were bounded.
    learned : how N was learned, in words; empty if it was given.
    state : values of a state that is shown to lie in the set, by the states' names.
    constraints : those that are kept on the set, in words by their names.
    certificate, raw, checker : the file, its bytes, and the checker's answer about them; None where there is none.
    """

    verdict: Verdict
    reason: str
    system: System
    network: PolicyNetwork
    options: RoaOptions
    outer: OuterFacts | None = None
    learned: str = ""
    state: Mapping[str, float] = field(default_factory=dict)
    boxes: int = 0
    constraints: Mapping[str, str] = field(default_factory=dict)
    following: tuple[str, ...] = ()
    notice: str | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    certificate: Path | None = None
    raw: bytes | None = field(default=None, repr=False)
    checker: Mapping[str, Any] | None = None

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify roa --claim invariant --json`."""
        system, checker = self.system, self.checker
        return {
            "schema": "certify-invariant/1",
            "verdict": self.verdict.value,
            "reason": self.reason,
            "claim": {"kind": "invariant"},
            "outer": None if self.outer is None else self.outer.to_dict(),
            "learned": self.learned or None,
            "state": dict(self.state) or None,
            "constraints": dict(self.constraints),
            "next": list(self.following),
            "time": system.time,
            "system": system.name,
            "parameters": {name: str(q) for name, q in system.parameters.items()},
            "uncertain": {name: [str(lo), str(hi)] for name, (lo, hi) in system.ranges.items()},
            "states": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.states],
            "policy": {"sha256": self.network.sha256(), "layers": list(self.network.layers)},
            "boxes": self.boxes,
            "notice": self.notice,
            "seconds": dict(self.seconds),
            "certificate": None if self.certificate is None else str(self.certificate),
            "certificate_sha256": None if checker is None else checker.get("certificate_sha256"),
            "checked": None if checker is None else checker.get("result"),
            "reference": None if checker is None else checker.get("reference", {}).get("result"),
        }
