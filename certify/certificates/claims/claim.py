"""Claims: a set, a statement about every trajectory from it, and the levels in that statement.

A claim is about a `Problem`, a closed loop with a Lyapunov function, and consists of numbers only. Coordinates, boxes
and other means of the proof belong to the evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal

from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov.function import Quadratic
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic

Kind = Literal["asymptotic", "practical"]


@dataclass(frozen=True, slots=True)
class Problem:
    """The closed loop and the Lyapunov function V of a claim, and the rate at which V has to fall.

    With `rate` lambda, D + 2 lambda V has to be negative. D is V's increment over a step, per unit of time: Vdot in
    continuous time, `V(F(x)) - V(x)` in discrete time, `(V(x(h)) - V(x))/h` if the input is held over h.

    Raises
    ------
    InputError : V has another number of states, or the rate is negative or no number.
    """

    loop: ClosedLoop
    V: Quadratic
    rate: float = 0.0

    def __post_init__(self) -> None:
        n = self.loop.system.n
        if self.V.n != n:
            raise InputError(f"`P` must be a finite matrix of shape ({n}, {n}); found shape {self.V.P.shape}.")
        if not (math.isfinite(self.rate) and self.rate >= 0):
            raise InputError(f"`rate` must be a number of at least 0; found {self.rate}.")


@dataclass(frozen=True, slots=True)
class Outer:
    """The set {N <= level} within the domain box, N a `function`: every trajectory that starts in it, or in {V <= c2},
    stays in the union of both and enters {V <= c2}.

    Raises
    ------
    InputError : the level is not finite.
    """

    function: Neural | Symbolic
    level: float

    def __post_init__(self) -> None:
        if not math.isfinite(self.level):
            raise InputError(f"`level` of an outer set must be a finite number; found {self.level}.")


@dataclass(frozen=True, slots=True)
class Claim:
    """`roa` is c2: the claim is about every trajectory that starts in {V <= c2}.

    `local` is c1, the inner level of the ring; a ball proves the claim below it. `rate` is lambda: V falls at least as
    exp(-2 lambda t) where it is claimed to fall. `outer` is a set from which trajectories enter {V <= c2}.
    """

    kind: ClassVar[Kind | Literal["nearby", "enlarged", "reached"]]
    at_rest: ClassVar[bool]  # the origin must be an equilibrium, exactly
    roa: float
    local: float
    rate: float = field(default=0.0, kw_only=True)
    outer: Outer | None = field(default=None, kw_only=True)

    @property
    def inner(self) -> float:
        """The level from which the ring reaches outwards to c2."""
        return self.local

    @property
    def levels(self) -> Mapping[str, float]:
        """The section `levels` of the certificate, in its order."""
        return {"local": self.local, "roa": self.roa}


@dataclass(frozen=True, slots=True)
class Asymptotic(Claim):
    """Every trajectory from {V <= c2} stays in it and converges to the origin, which is asymptotically stable."""

    kind: ClassVar[Kind | Literal["nearby", "enlarged", "reached"]] = "asymptotic"
    at_rest = True


@dataclass(frozen=True, slots=True)
class Enlarged(Asymptotic):
    """The same, and every trajectory from {W <= 1}, W = `start`, reaches {V <= c2} and converges to the origin."""

    kind = "enlarged"
    start: Quadratic


@dataclass(frozen=True, slots=True)
class Reached(Asymptotic):
    """The same, and every trajectory from {W(x - c) <= 1}, W = `start`, c = `centre`, reaches {V <= c2} and converges
    to the origin.
    """

    kind = "reached"
    start: Quadratic
    centre: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Practical(Claim):
    """Every trajectory from {V <= c2} stays in it, enters {V <= c0} in finite time, and stays there.

    `floor` is c0, at most c1, and equal to it if there is no ball. The claim says nothing about motion inside
    {V <= c0}; the origin need not be an equilibrium.
    """

    kind: ClassVar[Kind | Literal["nearby", "enlarged", "reached"]] = "practical"
    at_rest = False
    floor: float

    @property
    def levels(self) -> Mapping[str, float]:
        """The section `levels` of the certificate, in its order."""
        return {"floor": self.floor, "local": self.local, "roa": self.roa}


@dataclass(frozen=True, slots=True)
class Nearby(Practical):
    """The same, and for constant uncertain quantities one equilibrium in {V <= c0}, to which all converge."""

    kind = "nearby"


CLAIMS: Mapping[str, type[Asymptotic] | type[Practical]] = {
    c.kind: c for c in (Asymptotic, Practical, Nearby, Enlarged, Reached)
}
