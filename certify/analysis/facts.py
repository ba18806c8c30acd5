"""The parts of a result: levels, candidates, a tube, an outer set, boxes with ranks, and what limits it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import RankTree
from certify.lyapunov import extents, semi_axes, volume
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Levels:
    """Levels of V. None means that there is none.

    `local` (c1) and `roa` (c2) state an asymptotic claim, `floor` (c0), `local` and `roa` a practical one.
    `sampled_limit` is where the lowest violation was found, `domain_limit` where the set meets the domain.
    """

    local: float | None = None
    floor: float | None = None
    roa: float | None = None
    sampled_limit: float | None = None
    domain_limit: float | None = None

    @property
    def inner(self) -> float | None:
        """The level of the inner set that the claim speaks of: c0 of a practical claim, else c1."""
        return self.local if self.floor is None else self.floor

    @property
    def ultimate(self) -> float | None:
        """c0 of a practical claim: the level below which every trajectory ends."""
        return self.floor

    def to_dict(self) -> dict[str, float | None]:
        """For JSON."""
        return {**{name: getattr(self, name) for name in self.__slots__}, "ultimate": self.ultimate}


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
    """The next thing to try: options to add to the command (none if no option helps), and why; `flattens` says that the
    policy is to be fine-tuned first, by `controllers flatten`."""

    options: tuple[tuple[str, str], ...]
    why: str
    flattens: bool = False

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {"options": dict(self.options), "why": self.why, "flatten": self.flattens}


@dataclass(frozen=True, slots=True)
class TubeFacts:
    """A tube that enlarges the set: it starts at {(x - c)'P(x - c) <= 1}, P = `start` (n, n), c = `centre`, None for 0,
    of this `shape`, and leads into {V <= c2} in `slabs` pieces, in `duration` units of time."""

    start: Array
    shape: str
    slabs: int
    duration: float
    centre: tuple[float, ...] | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the size of the start along the states."""
        sizes = {"semi_axes": semi_axes(self.start, 1.0).tolist(), "extents": extents(self.start, 1.0).tolist()}
        stated = {"shape": self.shape, "slabs": self.slabs, "duration": self.duration, "start": self.start.tolist()}
        return {**stated, "centre": self.centre and list(self.centre), "volume": volume(self.start, 1.0), **sizes}


@dataclass(frozen=True, slots=True)
class OuterFacts:
    """A set beyond {V <= c2}: {N <= level} within the domain, N a `function` of deviations from the operating point.

    `volume` is that of its union with {V <= c2}, estimated from samples of the domain, and `deviation` the standard
    deviation of that estimate; `leaves` are those of all trees; `limit` says what ends the level: `domain` (its faces),
    `witness`, `requested`, or what ran out;
    `witness` is a state, (n,), at which N is no larger than `witness_level` and does not fall (`violation` is `rise`),
    an input leaves its bounds (`input`) or the `constraint` is violated (`keep`); None if none was met.
    """

    function: Neural | Symbolic
    level: float
    volume: float
    deviation: float
    limit: str
    boxes: int
    leaves: int
    witness: tuple[float, ...] | None = None
    witness_level: float | None = None
    violation: str | None = None
    constraint: str | None = None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        N = self.function
        stated: dict[str, Any] = (
            {"kind": "expression", "expression": str(N.expression)}
            if isinstance(N, Symbolic)
            else {"kind": "network", "layers": list(N.widths), "sha256": N.sha256()}
        )
        numbers = {name: getattr(self, name) for name in self.__slots__ if name not in ("function", "witness")}
        return {**stated, **numbers, "witness": self.witness and list(self.witness)}


@dataclass(frozen=True, slots=True)
class RankFacts:
    """Boxes with ranks, from which {V <= c2} is reached.

    Parameters
    ----------
    tree : the evidence.
    angles : names of states in which 2 pi more is the same place.
    leaves, proved : the number of all leaves, and of those with a rank.
    covered, volume : the share of the tree's box that these take, in angles of one turn, and their volume, both rounded
        down.
    steps : the most steps from one of them.
    rounds : of the search; None if it was not counted.
    done : more effort would gain next to nothing.
    full : and that is because images of boxes meet too many of them.
    """

    tree: RankTree
    angles: tuple[str, ...]
    leaves: int
    proved: int
    covered: float
    volume: float
    steps: int
    rounds: int | None = None
    done: bool = False
    full: bool = False

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the numbers, and the corners of the box that was cut."""
        stated: dict[str, Any] = {name: getattr(self, name) for name in self.__slots__ if name != "tree"}
        return {**stated, "angles": list(self.angles), "lo": self.tree.lo.tolist(), "hi": self.tree.hi.tolist()}


@dataclass(frozen=True, slots=True)
class SimulatedFacts:
    """Counts of simulated runs from states drawn from the domain, which are no part of a proof: of all `runs`, of those
    `converging` without leaving the domain or the inputs' bounds, of these that start in the `proved` set, and of those
    that would converge if the policy were `clipped` at the inputs' bounds, None if it is, or that was not simulated."""

    runs: int
    converging: int
    proved: int
    clipped: int | None = None

    @property
    def share(self) -> float | None:
        """The share of the simulated region of attraction that is proved; None if nothing converges."""
        return self.proved / self.converging if self.converging else None

    @property
    def more(self) -> int:
        """The number that a clip would add."""
        return max(0, (self.clipped or 0) - self.converging)

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the share."""
        return {**asdict(self), "share": self.share}


@dataclass(frozen=True, slots=True)
class StayingFacts:
    """Counts of simulated runs of so many `steps` from states drawn from the domain, which are no part of a proof: of
    all `runs`, of those that are `staying` in the domain and keep constraints, and of these that start in the `proved`
    set."""

    runs: int
    steps: int
    staying: int
    proved: int

    def to_dict(self) -> dict[str, Any]:
        """For JSON, with the share of those that stay."""
        return {**asdict(self), "share": self.proved / self.staying if self.staying else None}


@dataclass(frozen=True, slots=True)
class Share:
    """The set's reach along a state, and that as a share of the nearer side of its domain."""

    state: str
    unit: str
    extent: float
    share: float


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The limit of a result: what binds and where.

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
        """The fastest mode's decay over the slowest's; None unless all decay."""
        if self.fastest is None or self.slowest is None or not self.slowest < 0:
            return None
        return self.fastest / self.slowest

    def to_dict(self) -> dict[str, Any]:
        """For JSON: the fields, and `stiffness`; `hurts` by state."""
        stated = asdict(self)
        return stated | {"stiffness": self.stiffness, "hurts": dict(self.hurts), "next": self.next.to_dict()}
