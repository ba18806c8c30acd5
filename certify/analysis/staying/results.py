"""The result of a proof that a set is never left, and its JSON object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from certify.analysis.facts import OuterFacts, RankFacts, StayingFacts
from certify.analysis.options import RoaOptions
from certify.analysis.without_v import ResultWithoutV


@dataclass(frozen=True, slots=True)
class InvariantResult(ResultWithoutV):
    """The result of a run; `following` says what to try next.

    Parameters
    ----------
    outer : the set {N <= n2}, if one is proved; its volume is estimated.
    ranks, simulated : where time goes in steps the boxes that are, and simulated runs that stay.
    learned : how N was learned, in words; empty if it was given.
    state : values of a state that is shown to lie in the set, by the states' names.
    """

    options: RoaOptions
    outer: OuterFacts | None = None
    ranks: RankFacts | None = None
    simulated: StayingFacts | None = None
    learned: str = ""
    state: Mapping[str, float] = field(default_factory=dict)
    following: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify roa --claim invariant --json`."""
        return {
            "schema": "certify-invariant/1",
            "verdict": self.verdict.value,
            "reason": self.reason,
            "claim": self._claim(),
            "outer": None if self.outer is None else self.outer.to_dict(),
            "ranks": None if self.ranks is None else self.ranks.to_dict(),
            "simulated": None if self.simulated is None else self.simulated.to_dict(),
            "learned": self.learned or None,
            "state": dict(self.state) or None,
            "constraints": dict(self.constraints),
            "next": list(self.following),
            **self.about_the_run(),
        }

    def _claim(self) -> dict[str, Any]:
        sample = {} if self.system.sample is None else {"sample": list(map(str, self.system.sample))}
        return {"kind": "remains" if self.system.in_steps else "invariant", **sample}
