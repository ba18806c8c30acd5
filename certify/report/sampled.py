"""A claim about every plant with functions that are consistent with samples, in words: from a plant, or a result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations_with_replacement
from typing import Any, Self

from certify.loop.plants import System
from certify.report.words import Varying, above, below, listed, symbol


def described(system: System) -> dict[str, Any] | None:
    """The samples of a claim's plant as JSON has them; None where there are none, or only their file is known."""
    samples = system.samples
    if samples is None or not samples.taken:
        return None
    functions = []
    for one in samples.unknowns:
        functions.append(
            {
                "state": one.state,
                "variables": list(one.variables),
                "box": [[str(lo), str(hi)] for lo, hi in one.box],
                "curvature": [[str(q) for q in row] for row in one.curvature],
                "noise": str(samples.noise[one.state]),
                "samples": len(samples.taken[one.state].values),
                "vanishes": one.vanishes,
                "quantities": [*one.slopes, *([] if one.error is None else [one.error])],
            }
        )
    return {"sha256": samples.sha256, "functions": functions}


@dataclass(frozen=True, slots=True)
class Sampled:
    """The part of a claim that samples are.

    Parameters
    ----------
    functions : as `described` has them.
    sha256 : of the file.
    by_steps : True if a function gives the next value, and not the derivative.
    """

    functions: tuple[Mapping[str, Any], ...]
    sha256: str
    by_steps: bool

    @classmethod
    def of(cls, system: System) -> Self | None:
        """The samples of a claim's plant; None where its equations are the plant."""
        return cls._of(described(system), system.time)

    @classmethod
    def of_result(cls, result: Mapping[str, Any]) -> Self | None:
        """The samples that `certify roa --json` prints; None where there are none."""
        return cls._of(result.get("samples"), str(result.get("time")))

    @classmethod
    def _of(cls, found: Mapping[str, Any] | None, time: str) -> Self | None:
        return None if not found else cls(tuple(found["functions"]), str(found["sha256"]), time == "discrete")

    @property
    def names(self) -> str:
        """The functions with their variables."""
        mark = "⁺" if self.by_steps else "′"
        return listed(
            [f"{symbol(f['state'])}{mark} = g({', '.join(map(symbol, f['variables']))})" for f in self.functions]
        )

    @property
    def count(self) -> int:
        """The number of samples."""
        return sum(int(f["samples"]) for f in self.functions)

    @property
    def consistent(self) -> str:
        """The functions for every one of which the claim is."""
        word = "function" if len(self.functions) == 1 else "functions"
        return f"{word} {self.names} with which {self.count:,} samples are consistent"

    @property
    def assumed(self) -> str:
        """The properties of a consistent function, as declared."""
        each = []
        for f in self.functions:
            pairs = combinations_with_replacement(enumerate(map(symbol, f["variables"])), 2)
            bends = [
                f"{below(Fraction(f['curvature'][i][j]))} by {a} and {b}" if i != j
                else f"{below(Fraction(f['curvature'][i][i]))} by {a} twice"
                for (i, a), (j, b) in pairs
            ]  # fmt: skip
            zero = "; and 0 at the origin" if f["vanishes"] else ""
            of = f"{symbol(f['state'])}: " if len(self.functions) > 1 else ""
            box = [
                f"{symbol(v)} in [{below(Fraction(lo))}, {above(Fraction(hi))}]"
                for v, (lo, hi) in zip(f["variables"], f["box"], strict=True)
            ]
            each.append(
                f"{of}its second derivatives are continuous and at most {listed(bends)} in size for {listed(box)}; "
                f"at the sampled points it is within {below(Fraction(f['noise']))} of the samples{zero}"
            )
        return "; ".join(each)

    def others(self, quantities: Sequence[Varying]) -> list[Varying]:
        """The uncertain quantities that do not stand for a part of a function."""
        own = {name for f in self.functions for name in f["quantities"]}
        return [q for q in quantities if q.name not in own]
