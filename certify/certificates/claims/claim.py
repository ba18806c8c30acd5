"""Claims: a set, a statement about every trajectory from it, and the levels in that statement.

A claim is about a `Problem`, a closed loop with a Lyapunov function, and consists of numbers only. Coordinates, boxes
and other means of the proof belong to the evidence.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Literal

from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression
from certify.loop.plants import kept_constraints
from certify.lyapunov.function import Quadratic
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic

Kind = Literal["asymptotic", "practical"]
UNPROVED = 65_535
"""The rank of a leaf of which nothing is said."""
MOST_RANK, MOST_KEPT = UNPROVED - 1, 64


def require_few(keep: tuple[Expression, ...]) -> None:
    """Refuse more constraints than a claim may have.

    Raises
    ------
    InputError : there are more.
    """
    if len(keep) > MOST_KEPT:
        raise InputError(f"`keep` must have at most {MOST_KEPT} expressions; found {len(keep)}.")


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

    @property
    def keep(self) -> tuple[Expression, ...]:
        """The plant's constraints, g of each inequality g < 0, as a claim states them."""
        return tuple(kept_constraints(self.loop.system).values())


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
class Ranks:
    """Leaves of a tree of boxes, in the evidence, from which every trajectory is in {V <= c2} after at most `steps`
    steps; states that differ by multiples of 2 pi in `angles`, names of states, are the same place.

    Raises
    ------
    InputError : an angle is named twice, or the number of steps is not from 1 to 65,534.
    """

    angles: tuple[str, ...]
    steps: int

    def __post_init__(self) -> None:
        if len(set(self.angles)) != len(self.angles):
            raise InputError(f"`angles` must be different names of states; found {', '.join(self.angles)}.")
        if not 1 <= self.steps <= MOST_RANK:
            raise InputError(f"`steps` of ranks must be an integer from 1 to {MOST_RANK:,}; found {self.steps}.")


@dataclass(frozen=True, slots=True)
class Claim:
    """`roa` is c2: the claim is about every trajectory that starts in {V <= c2}.

    `local` is c1, the level from which the ring reaches outwards to c2: below it what is shown is shown on a ball.
    `rate` is lambda: V falls at least as exp(-2 lambda t) where it is claimed to fall. `outer` is a set from which
    trajectories enter {V <= c2}. `ranks` says the same of boxes, where V is compared at the ends of steps. Along all
    trajectories g < 0 for each g of `keep`, expressions in states, inputs and uncertain quantities.

    A method that gives another claim gives None where this one has no such form.

    Raises
    ------
    InputError : `ranks` stands beside a tube or an outer set, or `keep` has more than 64 expressions.
    """

    kind: ClassVar[str]
    at_rest: ClassVar[bool]  # the origin must be an equilibrium, exactly
    one_equilibrium: ClassVar[bool] = False  # trajectories converge to an equilibrium that is near the origin
    roa: float
    local: float
    rate: float = field(default=0.0, kw_only=True)
    outer: Outer | None = field(default=None, kw_only=True)
    ranks: Ranks | None = field(default=None, kw_only=True)
    keep: tuple[Expression, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        if self.ranks is not None and (self.start is not None or self.outer is not None):
            raise InputError("a claim with a tube or an outer set can have no ranks.")
        require_few(self.keep)

    @property
    def floor(self) -> float | None:
        """The level c0 of the ultimate bound; None where trajectories converge to the origin."""
        return None

    @property
    def start(self) -> Quadratic | None:
        """W of the set {W(x - c) <= 1} from which a tube leads into {V <= c2}; None without a tube."""
        return None

    @property
    def centre(self) -> tuple[float, ...] | None:
        """The state c around which a tube starts; None without a tube, and where that is the origin."""
        return None

    @property
    def inner(self) -> float:
        """The level from which the ring reaches outwards to c2."""
        return self.local

    def _beside(self) -> dict[str, Any]:
        """The parts that a claim may state beside its levels, by their fields."""
        return {"rate": self.rate, "outer": self.outer, "ranks": self.ranks, "keep": self.keep}

    @property
    def levels(self) -> Mapping[str, float]:
        """The section `levels` of the certificate, in its order."""
        floor = {} if self.floor is None else {"floor": self.floor}
        return {**floor, "local": self.local, "roa": self.roa}

    def lowered(self, level: float) -> Claim | None:
        """The same about {V <= level}, a smaller set that the ring still reaches; without ranks, which lead into the
        larger one."""
        return replace(self, roa=level, ranks=None) if self.inner < level < self.roa else None

    def without_outer(self) -> Claim | None:
        """The same without the set beyond the ellipsoid."""
        return None if self.outer is None else replace(self, outer=None)

    def without_ranks(self) -> Claim | None:
        """The same without the boxes from which {V <= c2} is reached."""
        return None if self.ranks is None else replace(self, ranks=None)

    def local_only(self, level: float) -> Claim | None:
        """Asymptotic stability on {V <= level} alone, of which the ring is not asked."""
        return None

    def with_tube(self, start: Quadratic, centre: tuple[float, ...] | None = None) -> Claim | None:
        """The same, and every trajectory from {W(x - c) <= 1}, W = `start`, c = `centre`, reaches {V <= c2}."""
        return None

    def without_tube(self) -> Claim | None:
        """The same without the set from which a tube leads."""
        return None

    def with_floor(self, floor: float) -> Claim | None:
        """The same with a higher ultimate bound, which is still below c1."""
        return None

    def converging(self) -> Claim | None:
        """The same, and trajectories converge to one equilibrium."""
        return None

    def without_equilibrium(self) -> Claim | None:
        """The same without the equilibrium to which trajectories converge."""
        return None


@dataclass(frozen=True, slots=True)
class Asymptotic(Claim):
    """Every trajectory from {V <= c2} stays in it and converges to the origin, which is asymptotically stable."""

    kind = "asymptotic"
    at_rest = True

    def local_only(self, level: float) -> Claim | None:
        """Asymptotic stability on {V <= level} alone, of which the ring is not asked."""
        return Asymptotic(level, level, rate=self.rate, keep=self.keep)

    def with_tube(self, start: Quadratic, centre: tuple[float, ...] | None = None) -> Claim | None:
        """The same, and every trajectory from {W(x - c) <= 1}, W = `start`, c = `centre`, reaches {V <= c2}."""
        if self.ranks is not None:
            return None
        if centre is None:
            return Enlarged(self.roa, self.local, start, **self._beside())
        return Reached(self.roa, self.local, start, centre, **self._beside())


@dataclass(frozen=True, slots=True)
class Enlarged(Asymptotic):
    """The same, and every trajectory from {W <= 1}, W = `start`, reaches {V <= c2} and converges to the origin."""

    kind = "enlarged"
    start: Quadratic = field()

    def without_tube(self) -> Claim | None:
        """The same without the set from which a tube leads."""
        return Asymptotic(self.roa, self.local, **self._beside())


@dataclass(frozen=True, slots=True)
class Reached(Enlarged):
    """The same, and every trajectory from {W(x - c) <= 1}, W = `start`, c = `centre`, reaches {V <= c2} and converges
    to the origin.
    """

    kind = "reached"
    centre: tuple[float, ...] = field()


@dataclass(frozen=True, slots=True)
class Practical(Claim):
    """Every trajectory from {V <= c2} stays in it, enters {V <= c0} in finite time, and stays there.

    `floor` is c0, at most c1, and equal to it if there is no ball. The claim says nothing about motion inside
    {V <= c0}; the origin need not be an equilibrium.
    """

    kind = "practical"
    at_rest = False
    floor: float = field()

    def with_floor(self, floor: float) -> Claim | None:
        """The same with a higher ultimate bound, which is still below c1."""
        return replace(self, floor=floor) if self.floor < floor < self.local else None

    def converging(self) -> Claim | None:
        """The same, and trajectories converge to one equilibrium."""
        return Nearby(self.roa, self.local, self.floor, **self._beside())


@dataclass(frozen=True, slots=True)
class Nearby(Practical):
    """The same, and for constant uncertain quantities one equilibrium in {V <= c0}, to which all converge."""

    kind = "nearby"
    one_equilibrium = True

    def without_equilibrium(self) -> Claim | None:
        """The same without the equilibrium to which trajectories converge."""
        return Practical(self.roa, self.local, self.floor, **self._beside())


CLAIMS: Mapping[str, type[Claim]] = {c.kind: c for c in (Asymptotic, Practical, Nearby, Enlarged, Reached)}
