"""The result of a proof that a region is reached, and its JSON object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from certify.analysis.facts import RankFacts, Step
from certify.analysis.reaching.never import Stay
from certify.analysis.reaching.options import ReachOptions, in_words
from certify.analysis.reaching.runs import Run, Runs
from certify.analysis.without_v import ResultWithoutV
from certify.certificates import Certificate

_UP = 1.06  # a number of two digits is then not below what it stands for


@dataclass(frozen=True, slots=True)
class ReachResult(ResultWithoutV):
    """The result of a run.

    Parameters
    ----------
    ranks : the boxes that are proved, if any are.
    steps : after so many every trajectory from the box `options.begin` has been in the region; None if that is not
        proved, or no box was named.
    runs : simulated, from that box.
    stay : a start in it that never arrives, if one is shown.
    given : the certificate whose set is the target; None for a region.
    following : what to try next, where the search ended before it was done.
    """

    options: ReachOptions
    ranks: RankFacts | None = None
    steps: int | None = None
    runs: Runs | None = None
    stay: Stay | None = None
    given: Certificate | None = None
    following: Step | None = None

    @property
    def begin(self) -> dict[str, tuple[Fraction, Fraction]] | None:
        """The box that was asked about, by the states' values; None if there is none."""
        box = self.options.begin
        if box is None:
            return None
        each = zip(self.system.states, box, self.system.exact_x_eq(), strict=True)
        return {s.name: (lo + q, hi + q) for s, (lo, hi), q in each}

    def values(self, x: Sequence[Fraction]) -> dict[str, Fraction]:
        """A state by the states' values, from its deviations."""
        each = zip(self.system.states, x, self.system.exact_x_eq(), strict=True)
        return {s.name: v + q for s, v, q in each}

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify reach --target --json`."""
        system, begin = self.system, self.begin
        return {
            "schema": "certify-reach/1",
            "verdict": self.verdict.value,
            "reason": self.reason,
            "claim": {"kind": "reaches" if self.given is None else self.given.kind}
            | ({} if system.sample is None else {"sample": list(map(str, system.sample))}),
            "target": list(self.options.target),
            "operating_point": {name: str(q) for name, q in system.operating_point().items()},
            "levels": {} if self.given is None else dict(self.given.claim.levels),
            "from": None if begin is None else {name: [str(lo), str(hi)] for name, (lo, hi) in begin.items()},
            "within": self.options.within,
            "steps": self.steps,
            "ranks": None if self.ranks is None else self.ranks.to_dict(),
            "constraints": dict(self.constraints),
            "simulated": None if self.runs is None else self._simulated(self.runs),
            "never": None if self.stay is None else self._stay(self.stay),
            "next": None if self.following is None else self.following.to_dict(),
            **self.about_the_run(),
        }

    def _stay(self, stay: Stay) -> dict[str, Any]:
        x, at = ({name: str(q) for name, q in self.values(v).items()} for v in (stay.x, stay.at))
        return {"x": x, "error": stay.error, "steps": stay.steps, "at": at, "radius": stay.radius}

    def _simulated(self, runs: Runs) -> dict[str, Any]:
        failing = None if runs.failing is None else self._run(runs.failing)
        return {"runs": runs.count, "longest": runs.longest, "witness": failing}

    def _run(self, run: Run) -> dict[str, Any]:
        x = {name: str(q) for name, q in self.values(run.x).items()}
        named = {"constraint": run.constraint} if run.constraint else {}
        return {"x": x, "end": run.end, "steps": run.steps, **named}

    def told(self, run: Run) -> str:
        """The end of a run in words."""
        state = self._in_words(run.x)
        if run.end == "violates":
            return f"from {state} the constraint {run.constraint} is violated after {run.steps:,} steps"
        where = in_words(self.options.target) if self.given is None else f"V <= {self.given.roa:.6g}"
        if run.end == "left":
            return f"from {state} the domain is left after {run.steps:,} steps, before {where}"
        return f"from {state} {where} does not hold in any of the first {run.steps:,} steps"

    def told_of(self, stay: Stay) -> str:
        """A start that never arrives, in words."""
        at, never = self._near(stay.at, stay.radius), "and so never gets there, shown in Arb"
        if not stay.steps:
            return f"a state {at} rests {never}"
        start = self._near(stay.x, stay.error)
        return f"a run from a state {start} stays {at} from step {stay.steps:,} on {never}"

    def _near(self, x: Sequence[Fraction], error: float) -> str:
        """A state that is known up to an error, to which what is left out of its numbers is added."""
        values = self.values(x)
        shown = {name: Fraction(f"{float(q):.6g}") if abs(q) > error else Fraction(0) for name, q in values.items()}
        whole = error + max(float(abs(q - shown[name])) for name, q in values.items())
        return f"within {_UP * whole:.1e} of {_words(shown)}"

    def _in_words(self, x: Sequence[Fraction]) -> str:
        return _words(self.values(x))


def _words(values: Mapping[str, Fraction]) -> str:
    return ", ".join(f"{name} = {float(q):.6g}" for name, q in values.items())
