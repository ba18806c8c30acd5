"""A claim about every plant with which measurements are consistent, in words: from a certificate, or from a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, Self

from certify.loop.plants import System
from certify.report.sampled import Sampled
from certify.report.words import (
    Varying,
    below,
    inside,
    listed,
    outside,
    pretty_unit,
    stated_for,
    symbol,
    varying,
    varying_in,
)

Interval = tuple[Fraction, Fraction]


@dataclass(frozen=True, slots=True)
class Measured:
    """The part of a claim that measurements are.

    Parameters
    ----------
    priors, ranges : of the parameters, as assumed and as they follow.
    units : of parameters and states, by name.
    noise : by state.
    period : shortest and longest time of a transition; None in discrete time.
    transitions : their number.
    sha256 : of the file.
    """

    priors: Mapping[str, Interval]
    ranges: Mapping[str, Interval]
    units: Mapping[str, str]
    noise: Mapping[str, Fraction]
    period: Interval | None
    transitions: int
    sha256: str

    @classmethod
    def of(cls, system: System) -> Self | None:
        """The measurements of a claim's plant; None where its ranges are assumed."""
        data = system.measurements
        if data is None or not data.runs:
            return None
        return cls(
            priors=data.priors,
            ranges={name: system.ranges[name] for name in data.constants if name in system.ranges},
            units=system.units,
            noise={s.name: w for s, w in zip(system.states, data.noise, strict=True)},
            period=data.period,
            transitions=data.transitions,
            sha256=data.sha256,
        )

    @classmethod
    def of_result(cls, result: Mapping[str, Any]) -> Self | None:
        """The measurements that `certify roa --json` prints; None where ranges are assumed."""
        data = result.get("data")
        if not data:
            return None
        quantities = [*(result.get("states") or ()), *(result.get("uncertain") or ())]
        return cls(
            priors={name: _pair(ends) for name, ends in data["priors"].items()},
            ranges={name: _pair(ends) for name, ends in data["ranges"].items()},
            units={q["name"]: q.get("unit") or "" for q in quantities},
            noise={name: Fraction(w) for name, w in data["noise"].items()},
            period=None if data["period"] is None else _pair(data["period"]),
            transitions=int(data["transitions"]),
            sha256=str(data["sha256"]),
        )

    @property
    def names(self) -> str:
        """The parameters' symbols."""
        return listed([symbol(name) for name in self.priors])

    @property
    def in_priors(self) -> str:
        """The parameters in their priors, never wider than they are."""
        return listed([self._named(name, inside(*pair)) for name, pair in self.priors.items()])

    @property
    def in_ranges(self) -> str:
        """The parameters in the ranges that are left, never narrower than they are."""
        return listed([self._named(name, outside(*pair)) for name, pair in self.ranges.items()])

    @property
    def consistent(self) -> str:
        """The condition that a parameter has to meet."""
        count = f"{self.transitions:,} measured transition{'s' if self.transitions > 1 else ''}"
        are = "are" if self.transitions > 1 else "is"
        return f"with which {count} {are} consistent"

    @property
    def assumed(self) -> str:
        """The noise and the period in which a parameter is consistent."""
        each = [f"{symbol(s)} {below(w)} {pretty_unit(self.units.get(s, ''))}".rstrip() for s, w in self.noise.items()]
        said = f"measured states off by at most {listed(each)}"
        if self.period is None:
            return said
        lo, hi = self.period
        return f"{said}; each transition takes {below(lo) if lo == hi else inside(lo, hi)} s, with the input held"

    def others(self, quantities: Sequence[Varying]) -> list[Varying]:
        """The uncertain quantities that are no parameters of the data."""
        return [q for q in quantities if q.name not in self.ranges]

    def _named(self, name: str, ends: str) -> str:
        return f"{symbol(name)} in {ends} {pretty_unit(self.units.get(name, ''))}".rstrip()


def stated_of(system: System, statement: str, *, by_steps: bool = False) -> str:
    """A claim's statement for all that is uncertain of a plant, with its measurements or samples where it has any."""
    data, sampled, quantities = Measured.of(system), Sampled.of(system), varying_in(system)
    if sampled is not None:
        others = sampled.others(quantities)
        also = f", and every {varying(others)}, whatever moves it within its range," if others else ""
        means = f"Consistent means: {sampled.assumed}."
        return f"For every {sampled.consistent}{also} the following holds. {statement} {means}"
    if data is None:
        return stated_for(quantities, statement, by_steps=by_steps)
    others = data.others(quantities)
    also = f", and every {varying(others)}, whatever moves it within its range," if others else ""
    return (
        f"For every constant {data.in_priors} {data.consistent}{also} the following holds. {statement} "
        f"Consistent means: {data.assumed}."
    )


def _pair(ends: Sequence[str]) -> Interval:
    lo, hi = map(Fraction, ends)
    return lo, hi
