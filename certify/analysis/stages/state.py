"""The state of a run, which each stage extends, and the tools that all stages share."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol

from certify.analysis.acceptance import Accepted
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.saved_search import Keeper
from certify.analysis.selection import Race
from certify.analysis.simulated import SimulatedRegion
from certify.certificates import PartitionTree, TrustedSolver
from certify.certificates.claims import Claim
from certify.certificates.claims.claim import Kind
from certify.certificates.data import DataBounds
from certify.certificates.ellipsoids import Box
from certify.certificates.samples import SampleBounds
from certify.effort import WHOLE, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.provers.base import Progress, Proof
from certify.provers.execution import Runner

if TYPE_CHECKING:
    from certify.provers.outer import OuterProof
    from certify.provers.ranks import RankProof

StageName = Literal["candidate", "ring", "tube", "simulate", "learn", "outer", "ranks", "function", "set", "check"]
Report = Callable[[StageName, Progress | None], None]


@dataclass(frozen=True)
class State:
    """All that a run has found so far.

    Parameters
    ----------
    loop : the closed loop, as seen from where V is 0.
    options : of the run, with the claim that is aimed at.
    result : as far as it is known.
    converging : convergence to one nearby equilibrium is to be shown as well.
    insists : the same, and a smaller set of which it is shown is better than a larger one.
    begin : the state or box that a tube has to start around, in deviations; None if none was named.
    notes : remarks for a person, in order; none is ever taken away.
    race, proof : the candidates, and what the prover says of the best.
    claim, evidence : what is to be certified.
    data : evidence that measurements bound the plant's parameters, or that equations stand for sampled functions; None
        where ranges and equations are assumed.
    beyond : the set of another function around the ellipsoid.
    ranked : boxes with ranks, as the search found them.
    simulated : the region of attraction by runs.
    missed : why no tube holds `begin`.
    accepted : the certificate that the checker accepts.
    done : the result is final.
    """

    loop: ClosedLoop
    options: RoaOptions
    result: RoaResult
    converging: bool = False
    insists: bool = False
    begin: Box | None = None
    notes: tuple[str, ...] = ()
    race: Race | None = None
    proof: Proof | None = None
    claim: Claim | None = None
    evidence: PartitionTree | TrustedSolver | None = None
    data: DataBounds | SampleBounds | None = None
    beyond: OuterProof | None = None
    ranked: RankProof | None = None
    simulated: SimulatedRegion | None = None
    missed: str = ""
    accepted: Accepted | None = None
    done: bool = False

    @property
    def kind(self) -> Kind:
        """The claim that the provers aim at."""
        return "practical" if self.options.claim == "practical" else "asymptotic"

    @property
    def interruptible(self) -> bool:
        """True if attempts can be worked on a little at a time."""
        return self.kind == "asymptotic" and self.options.engine != "dreal"

    @property
    def contest(self) -> Race:
        """The race, once the candidates have entered it."""
        if self.race is None:
            raise ValueError("no candidate has entered the race")
        return self.race

    @property
    def proved(self) -> tuple[Claim, PartitionTree]:
        """The claim and the tree that shows it, where the prover gave one."""
        if self.claim is None or not isinstance(self.evidence, PartitionTree):
            raise ValueError("no claim with a tree is proved")
        return self.claim, self.evidence

    def noting(self, *notes: str | None) -> State:
        """The state with further remarks."""
        return replace(self, notes=(*self.notes, *(note for note in notes if note is not None)))

    def with_result(self, **changes: Any) -> State:
        """The state with changes of the result."""
        return replace(self, result=replace(self.result, **changes))

    def finished(self, result: RoaResult) -> State:
        """The final state, with this result."""
        return replace(self, result=result, done=True)


def effort_of(effort: float, time_limit: float | None, load_seconds: float) -> Effort:
    """The counted work that the options allow, and the part of their time limit that reading has left."""
    return Effort(effort * WHOLE, None if time_limit is None else max(0.0, time_limit - load_seconds))


@contextmanager
def timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    """Add the seconds of the block to those of a stage."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        seconds[stage] = seconds.get(stage, 0.0) + time.perf_counter() - begin


@dataclass
class Tools:
    """The hands of a run: where it writes and computes, what it reports, and its stopwatch.

    Parameters
    ----------
    whole : operations of the run, of which stages take shares.
    show : called with the bytes of a certificate that the run ends with if they are accepted, before they are checked.
    load : seconds of reading before the run.
    """

    out: Path
    runner: Runner
    effort: Effort
    keeper: Keeper
    provenance: Mapping[str, Any]
    progress: Report | None = None
    show: Callable[[bytes], None] = lambda _: None
    load: float = 0.0
    seconds: dict[str, float] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)  # on where and how it was checked
    whole: float = field(init=False)
    start: float = field(init=False)

    def __post_init__(self) -> None:
        self.whole, self.start = self.effort.left, time.perf_counter()

    def timing(self, stage: str) -> AbstractContextManager[None]:
        """Add the seconds of the block to those of a stage."""
        return timed(self.seconds, stage)

    def timings(self) -> dict[str, float]:
        """Seconds of all stages, and in all."""
        return {"load": self.load, **self.seconds, "total": self.load + time.perf_counter() - self.start}

    def tell(self, stage: StageName) -> None:
        """Report that a stage begins."""
        if self.progress is not None:
            self.progress(stage, None)

    def report(self, state: Progress, stage: StageName = "ring") -> None:
        """Report a stage's progress, and the seconds until the run ends at the latest, at the pace so far."""
        if self.progress is not None:
            left = self.effort.left if state.left is None else min(state.left, self.effort.left)
            self.progress(stage, replace(state, left=left, seconds_left=self.effort.seconds_for(left)))


class Stage(Protocol):
    """A step of the pipeline."""

    def extend(self, state: State, effort: Effort) -> State:
        """The state with what this stage finds, within the effort."""
