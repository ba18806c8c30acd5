"""Which candidate is proved: each gets a little time, the better half of them more, and the best what is left.

A candidate is judged by the volume that is proved with it in the time, not by the volume within its reach: the largest
sampled set is of no use if its proof takes a week.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from certify.analysis.candidates.trials import Trial, by_reach
from certify.lyapunov import volume
from certify.provers.base import Attempt, Budget, Once, Progress

_FIRST_LOOK = 0.25  # of a heat, after which it may end
_HOPELESS = 1e9  # boxes that a first gain may need, at a hundred thousand a second some hours
_RING = 0.5  # share of a set's level, up to which the local rule proves little of it
_WORTH = 1.02  # of the best proved volume: what a candidate's reach must exceed to be given time


@dataclass
class Contender:
    """A trial, its attempt, and the volume that is proved so far."""

    trial: Trial
    attempt: Attempt
    proved: float = 0.0

    @property
    def hopeless(self) -> bool:
        """Whether no time that anybody has would gain anything."""
        return not self.attempt.gained and self.attempt.expected > _HOPELESS

    def advance(self, budget: Budget, report: Callable[[Progress], None] | None) -> None:
        """Work on the proof for as long as the budget allows, whose boxes are those of the whole attempt."""
        name, budget = self.trial.name, replace(budget, boxes=budget.boxes - self.attempt.boxes)
        self.attempt.advance(budget, None if report is None else lambda state: report(replace(state, name=name)))
        level = self.attempt.level
        self.proved = 0.0 if level is None else volume(self.trial.P, level)


@dataclass
class Race:
    """Contenders for the largest proved volume.

    Parameters
    ----------
    begin : makes the attempt of a trial.
    left : seconds that the search may still take.
    boxes : that an attempt may bound.
    """

    begin: Callable[[Trial], Attempt]
    left: Callable[[], float]
    boxes: int
    report: Callable[[Progress], None] | None = None
    contenders: list[Contender] = field(default_factory=list)
    early: Contender | None = None  # one that has begun, but is not entered

    @property
    def best(self) -> Contender:
        """The one with the largest proved volume; of those with none, the one that came first."""
        return max(self.contenders, key=lambda c: c.proved)

    @property
    def proved(self) -> bool:
        """True if anything is proved, by a contender or by one that has begun."""
        return any(c.proved for c in (*self.contenders, *([] if self.early is None else [self.early])))

    @property
    def open(self) -> list[Contender]:
        """Those that more time could make the best, the largest proved volume first."""
        most = self.best.proved
        can = [c for c in self.contenders if c is self.best or c.trial.volume > _WORTH * most]
        return sorted((c for c in can if not c.attempt.done), key=lambda c: -c.proved)

    def is_settled_by(self, trial: Trial, seconds: float, most: float) -> bool:
        """Whether after a heat of so many seconds this trial leaves no other one worth its time, because no set has a
        larger volume than `most`; it is entered only where its reach lets that be hoped for.

        Where the local rule proves most of the set, the candidate that is made for this rule could still be ahead by a
        little. If the race goes on, it does so as if this trial had not been entered, which keeps what it has proved.
        """
        if most > _WORTH * trial.volume:
            return False
        before = len(self.contenders)
        self.enter([trial], seconds)
        if len(self.contenders) == before:  # a search of an earlier run has proved more
            return False
        claim = self.best.attempt.proof().claim
        if most <= _WORTH * self.best.proved and claim is not None and claim.local <= _RING * claim.roa:
            return True
        self.early = self.contenders.pop()
        return False

    def enter(self, trials: Iterable[Trial], seconds: float) -> None:
        """A heat of so many seconds for each trial within whose reach lies more than is proved already, as long as
        there is time; without time too, until one proves something."""
        for trial in by_reach(list(trials)):
            known = self.early if self.early is not None and self.early.trial is trial else None
            if self.contenders and trial.volume <= _WORTH * self.best.proved:
                continue
            if known is None and self.proved and self.left() <= 0:
                continue
            self.contenders.append(known or Contender(trial, self.begin(trial)))
            self._heat(self.contenders[-1], seconds)

    @property
    def gained(self) -> bool:
        """Whether any contender's search has added to what it began with."""
        return any(c.attempt.gained for c in self.contenders)

    def knock_out(self, seconds: float) -> None:
        """Heats among the better half, each round twice as long as the one before, until one is left.

        Those whose search has added nothing yet cannot be told apart by more of the same: they are out.
        """
        contenders = [c for c in self.open if c.attempt.gained]
        while len(contenders) > 1 and self.left() > 0:
            contenders, seconds = contenders[: (len(contenders) + 1) // 2], 2 * seconds
            if len(contenders) == 1:
                break
            for contender in contenders:
                self._heat(contender, seconds)
            contenders = [c for c in self.open if c in contenders]

    def _heat(self, contender: Contender, seconds: float) -> None:
        for share in (1.0,) if isinstance(contender.attempt, Once) else (_FIRST_LOOK, 1 - _FIRST_LOOK):
            contender.advance(Budget(max(1e-3, min(share * seconds, self.left())), self.boxes), self.report)
            if contender.hopeless:
                return
