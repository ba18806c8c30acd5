"""What a certificate says: which set, what holds for every trajectory from it, and the levels that state it.

A claim is about a `Problem`, a closed loop with a Lyapunov function, and consists of numbers only. How it is proved,
in which coordinates and with which boxes, is the evidence's affair.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
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
class Claim(ABC):
    """`roa` is c2: the claim is about every trajectory that starts in {V <= c2}."""

    kind: ClassVar[Kind]
    at_rest: ClassVar[bool]  # the origin must be an equilibrium, exactly
    roa: float

    @property
    @abstractmethod
    def inner(self) -> float:
        """The level from which the ring reaches outwards to c2."""

    @property
    @abstractmethod
    def levels(self) -> Mapping[str, float]:
        """The section `levels` of the certificate, in its order."""


@dataclass(frozen=True, slots=True)
class Asymptotic(Claim):
    """Every trajectory from {V <= c2} stays in it and converges to the origin, which is asymptotically stable.

    `local` is c1: below it Vdot < 0 is shown by the linearisation, above it by the ring.
    """

    kind = "asymptotic"
    at_rest = True
    local: float

    @property
    def inner(self) -> float:
        return self.local

    @property
    def levels(self) -> Mapping[str, float]:
        return {"local": self.local, "roa": self.roa}


@dataclass(frozen=True, slots=True)
class Practical(Claim):
    """Every trajectory from {V <= c2} stays in it, enters {V <= c0} in finite time, and stays there.

    `floor` is c0. Nothing is said about what happens inside {V <= c0}; the origin need not be an equilibrium.
    """

    kind = "practical"
    at_rest = False
    floor: float

    @property
    def inner(self) -> float:
        return self.floor

    @property
    def levels(self) -> Mapping[str, float]:
        return {"floor": self.floor, "roa": self.roa}


CLAIMS: Mapping[str, type[Asymptotic] | type[Practical]] = {c.kind: c for c in (Asymptotic, Practical)}
