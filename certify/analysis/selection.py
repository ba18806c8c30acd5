"""The race of candidates: each gets a little effort, the better half more, and the best the rest.

A candidate is judged by the volume that is proved with it, not by the volume within its reach: the largest sampled set
is of no use if its proof takes a week.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

from certify.analysis.candidates.trials import Trial, by_reach
from certify.effort import Effort
from certify.lyapunov import volume
from certify.provers.base import Attempt, Budget, Once, Progress

_FIRST_LOOK = 0.25  # share of a heat after which it may end
_HOPELESS = 1e9  # boxes that a first gain may need, at a hundred thousand a second some hours
_RING = 0.5  # share of a set's level, up to which the local rule proves little of it
_WORTH = 1.02  # factor of the best proved volume that a candidate's reach must exceed to be given effort
_LEAST = 1.0  # operation of an advance, so that an attempt that has begun is always asked once


@dataclass
class Contender:
    """A trial, its attempt, and the volume that is proved so far."""

    trial: Trial
    attempt: Attempt
    proved: float = 0.0

    @property
    def reach(self) -> float:
        """The volume above which nothing can be proved any more."""
        shrunk = min(1.0, self.attempt.reach / self.trial.task.target)
        return self.trial.volume * float(shrunk ** (len(self.trial.P) / 2))

    @property
    def hopeless(self) -> bool:
        """True if no effort that anybody has would gain anything."""
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
    begin : makes the attempt of a trial; it is told whether anything is proved already.
    effort : of all contenders.
    heat : operations of a candidate's first heat, which for some is the only one.
    boxes : that an attempt may bound.
    """

    begin: Callable[[Trial, bool], Attempt]
    effort: Effort
    heat: float
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
        """The contenders that more effort could make the best, the largest proved volume first."""
        most = self.best.proved
        can = [c for c in self.contenders if c is self.best or c.reach > _WORTH * most]
        return sorted((c for c in can if not c.attempt.done), key=lambda c: -c.proved)

    @property
    def gained(self) -> bool:
        """True if any contender's search has added to what it began with."""
        return any(c.attempt.gained for c in self.contenders)

    def is_settled_by(self, trial: Trial, most: float) -> bool:
        """Run one candidate for one heat. True if its proved volume leaves no other one worth its effort, because no
        set has a larger volume than `most`; it is entered only where its reach lets that be hoped for.

        Where the local rule proves most of the set, the candidate that is made for this rule could still be ahead by a
        little. If the race continues, it does so as if this trial had not been entered, which keeps what it has proved.
        """
        if most > _WORTH * trial.volume:
            return False
        before = len(self.contenders)
        self.enter([trial])
        if len(self.contenders) == before:  # a search of an earlier run has proved more
            return False
        claim = self.best.attempt.proof().claim
        if most <= _WORTH * self.best.proved and claim is not None and claim.local <= _RING * claim.roa:
            return True
        self.early = self.contenders.pop()
        return False

    def enter(self, trials: Iterable[Trial], heat: float | None = None) -> None:
        """A heat for each trial within whose reach lies more than is proved already, as long as there is effort left;
        without any too, until one proves something."""
        for trial in by_reach(list(trials)):
            known = self.early if self.early is not None and self.early.trial is trial else None
            if self.contenders and trial.volume <= _WORTH * self.best.proved:
                continue
            if known is None and self.proved and self.effort.over:
                continue
            self.contenders.append(known or Contender(trial, self.begin(trial, self.proved)))
            self.advance(self.contenders[-1], self.heat if heat is None else heat)

    def knock_out(self) -> None:
        """Heats among the better half, each round twice as long as the one before, until one is left.

        Those whose search has added nothing yet cannot be told apart by more of the same: they are out.
        """
        contenders, heat = [c for c in self.open if c.attempt.gained], self.heat
        while len(contenders) > 1 and not self.effort.over:
            contenders, heat = contenders[: (len(contenders) + 1) // 2], 2 * heat
            if len(contenders) == 1:
                break
            for contender in contenders:
                self.advance(contender, heat)
            contenders = [c for c in self.open if c in contenders]

    def advance(self, contender: Contender, operations: float, each: float = 0.0) -> None:
        """A heat, which ends after its first part where no effort would gain anything; none where a first gain is
        expected to take more than these operations, at so many for each box."""
        if contender.attempt.expected * each > operations:
            return
        for share in (1.0,) if isinstance(contender.attempt, Once) else (_FIRST_LOOK, 1 - _FIRST_LOOK):
            over = self.effort.over
            part = self.effort.part(_LEAST if over else share * operations, even_if_over=over)
            contender.advance(Budget(part, self.boxes), self.report)
            if contender.hopeless:
                return
