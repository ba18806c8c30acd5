"""The interface of all provers. No prover is trusted: the checker decides."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from certify.certificates import PartitionTree, TrustedSolver
from certify.certificates.claims import Claim, Problem
from certify.certificates.claims.claim import Kind
from certify.certificates.verdict import Stop
from certify.effort import UNLIMITED, Effort
from certify.errors import InputError
from certify.provers.falsify import Witness

FEW = 3
"""States, up to which a tree of boxes may carry a practical claim without a ball."""
MANY = 6
"""States, beyond which boxes add next to nothing to a ball."""


@dataclass(frozen=True, slots=True)
class Budget:
    """Limits of a proof: its effort, of which `check` operations are left for the check of each proved box; boxes,
    boxes at once, and the width of the smallest box relative to the root box."""

    effort: Effort = UNLIMITED
    boxes: int = 4_000_000
    batch: int = 2048
    least_width: float = 2.0**-24
    check: float = 0.0

    @property
    def ended_by(self) -> Stop:
        """The end of its effort, or the clock if that came first."""
        return Stop.TIME if self.effort.is_short_of_time else Stop.EFFORT


@dataclass(frozen=True, slots=True)
class Task:
    """A claim of this kind to prove about the largest set {V <= c2}, c2 up to `target`.

    `exactly` says that less than `target` is of no use; `witness` is the violation that made `target` what it is.
    """

    problem: Problem
    kind: Kind
    target: float
    exactly: bool = False
    witness: Witness | None = None


@dataclass(frozen=True, slots=True)
class Progress:
    """The state of a proof: `level` is proved, `target` aimed at, `boxes` were bounded and `open` wait.

    A pass outwards has a target above its level, one inwards, `down`, a target below. `proved` is the share of the
    ring's volume that is done; `left` estimates the operations of the rest, None at first; `seconds_left` is that in
    seconds, if the pace is known; `name` is the candidate's."""

    level: float
    target: float
    boxes: int
    open: int
    proved: float
    left: float | None
    name: str = ""
    down: bool = False
    seconds_left: float | None = None


@dataclass(frozen=True, slots=True)
class Proof:
    """An engine's finding: a claim with evidence for it, or None and why there is none.

    `stop` and `detail` say what limits the level; `witness` is the lowest violation met on the way; `partial` are
    levels that were reached without making a claim; `solver` is the record of a solver's answers; `seconds` the
    stages `local` and `ring`; `direction`, (n,), is that in which boxes had to be halved most, and `left` estimates
    the operations that the search would still take, both None where unknown.
    """

    claim: Claim | None
    evidence: PartitionTree | TrustedSolver | None
    stop: Stop
    detail: str = ""
    witness: Witness | None = None
    boxes: int = 0
    leaves: int = 0
    partial: Mapping[str, float] = field(default_factory=dict)
    solver: Mapping[str, Any] | None = None
    seconds: Mapping[str, float] = field(default_factory=dict)
    direction: tuple[float, ...] | None = None
    left: float | None = None


@dataclass(frozen=True, slots=True)
class SearchState:
    """A search that can be resumed: the levels, boxes bounded and proved so far, the lowest violation met, and the
    tree in preorder, in which 254 is an open leaf, with the keys (B,) of these, by which they are taken."""

    inner: float
    outer: float
    boxes: int
    proved: int
    witness: Witness | None
    tree: bytes
    keys: NDArray[np.float64]


Report = Callable[[Progress], None]


class Attempt(Protocol):
    """A proof in progress: at any time it gives what it has, and can be continued."""

    @property
    def done(self) -> bool:
        """True if more effort would gain nothing."""

    @property
    def boxes(self) -> int:
        """Boxes bounded so far."""

    @property
    def seconds(self) -> Mapping[str, float]:
        """Seconds that its stages took so far."""

    @property
    def level(self) -> float | None:
        """The c2 that is proved so far; None if there is none."""

    @property
    def reach(self) -> float:
        """The c2 above which nothing can be proved any more, by what the search has met so far."""

    @property
    def gained(self) -> bool:
        """True if the search has added anything to what was there at its beginning."""

    @property
    def expected(self) -> float:
        """Boxes that the search may need before it gains anything, a guess of its order of magnitude."""

    def advance(self, budget: Budget, report: Report | None = None) -> None:
        """Work for as long as the budget allows."""

    def proof(self) -> Proof:
        """The best claim of the task's kind so far."""

    def state(self) -> SearchState | None:
        """The search, to be resumed another time, also one that is done; None if there is none."""

    def restore(self, state: SearchState) -> None:
        """Resume a search for the same task in the same coordinates.

        Raises
        ------
        InputError : it does not fit.
        """


class Engine(ABC):
    """A way to prove claims."""

    @abstractmethod
    def begin(self, task: Task) -> Attempt:
        """An attempt at the task that has not been worked on."""

    def prove(self, task: Task, budget: Budget, report: Report | None = None) -> Proof:
        """The best claim of the task's kind that the budget allows."""
        attempt = self.begin(task)
        attempt.advance(budget, report)
        return attempt.proof()


@dataclass
class Once:
    """An attempt that cannot be interrupted: all its work is done the first time that it is given any."""

    prove: Callable[[Budget, Report | None], Proof]
    found: Proof | None = None

    @property
    def done(self) -> bool:
        """True if it has been worked on."""
        return self.found is not None

    @property
    def boxes(self) -> int:
        """Boxes bounded."""
        return 0 if self.found is None else self.found.boxes

    @property
    def seconds(self) -> Mapping[str, float]:
        """Seconds of its stages."""
        return {} if self.found is None else self.found.seconds

    @property
    def level(self) -> float | None:
        """The c2 that was proved."""
        return None if self.found is None or self.found.claim is None else self.found.claim.roa

    @property
    def reach(self) -> float:
        """Infinite: nothing is known before the end."""
        return math.inf

    @property
    def gained(self) -> bool:
        """True if anything was proved."""
        return self.level is not None

    @property
    def expected(self) -> float:
        """0: it cannot be continued."""
        return 0.0

    def advance(self, budget: Budget, report: Report | None = None) -> None:
        """Work once."""
        self.found = self.found or self.prove(budget, report)

    def proof(self) -> Proof:
        """The proof that was found."""
        return self.found or Proof(None, None, Stop.EFFORT)

    def state(self) -> None:
        """None: it cannot be resumed."""

    def restore(self, state: SearchState) -> None:
        raise InputError("a search for this claim, or of this engine, cannot be resumed; begin it anew.")
