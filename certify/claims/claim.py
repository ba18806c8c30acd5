"""What a certificate says: which set, what holds for every trajectory from it, and the levels that state it.

A claim is about a `Problem`, a closed loop with a Lyapunov function, and consists of numbers only. How it is proved,
in which coordinates and with which boxes, is the evidence's affair.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

from certify.closed_loop import ClosedLoop
from certify.errors import InputError
from certify.lyapunov.function import Quadratic

Kind = Literal["asymptotic", "practical"]


@dataclass(frozen=True, slots=True)
class Problem:
    """The closed loop `xdot = F(x)` and the Lyapunov function V that claims are about.

    Raises
    ------
    InputError : V has another number of states.
    """

    loop: ClosedLoop
    V: Quadratic

    def __post_init__(self) -> None:
        n = self.loop.system.n
        if self.V.n != n:
            raise InputError(f"`P` must be a finite matrix of shape ({n}, {n}); found shape {self.V.P.shape}.")


@dataclass(frozen=True, slots=True)
class Claim:
    """`roa` is c2: the claim is about every trajectory that starts in {V <= c2}."""

    kind: ClassVar[Kind | Literal["enlarged", "reached"]]
    at_rest: ClassVar[bool]  # the origin must be an equilibrium, exactly
    inner_name: ClassVar[str]  # of the level from which the ring reaches outwards to c2
    roa: float

    @property
    def inner(self) -> float:
        """The level from which the ring reaches outwards to c2."""
        return float(getattr(self, self.inner_name))

    @property
    def levels(self) -> Mapping[str, float]:
        """The section `levels` of the certificate, in its order."""
        return {self.inner_name: self.inner, "roa": self.roa}


@dataclass(frozen=True, slots=True)
class Asymptotic(Claim):
    """Every trajectory from {V <= c2} stays in it and converges to the origin, which is asymptotically stable.

    `local` is c1: below it Vdot < 0 is shown by the linearisation, above it by the ring.
    """

    kind: ClassVar[Kind | Literal["enlarged", "reached"]] = "asymptotic"
    at_rest = True
    inner_name = "local"
    local: float


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

    `floor` is c0. Nothing is said about what happens inside {V <= c0}; the origin need not be an equilibrium.
    """

    kind = "practical"
    at_rest = False
    inner_name = "floor"
    floor: float


CLAIMS: Mapping[str, type[Asymptotic] | type[Practical]] = {
    c.kind: c for c in (Asymptotic, Practical, Enlarged, Reached)
}
