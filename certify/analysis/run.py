"""`certify_roa`: choose candidates, falsify, prove, have it checked. One pipeline for every claim and engine.

Nothing is PROVED before the checker, run as a process of its own, has accepted the very bytes that were written.
Whatever the checker refuses, the run ends with what it accepts: a refused leaf is split again, or the level lowered.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from certify.analysis.acceptance import Accepted, Clerk
from certify.analysis.asked import ellipsoid_in, require_one_that_knows, state_in, values_of
from certify.analysis.beyond import outer_facts, short_of
from certify.analysis.candidates.trials import (
    FOR_PEAK,
    OPTIMISING,
    SAMPLING,
    Trial,
    blends,
    by_reach,
    corrected,
    named,
    optimised,
    peak,
    robust,
    share_of_robust,
    solutions,
    solved,
)
from certify.analysis.diagnosis import diagnose
from certify.analysis.options import RoaOptions
from certify.analysis.outcome import (
    by_spectrum,
    is_refuted,
    limit_of,
    lowest_witness,
    not_stable,
    refuted_at_once,
    result_about,
    short_of_target,
    tried_row,
    with_levels,
    with_witness,
)
from certify.analysis.results import RoaResult, TubeFacts
from certify.analysis.saved_search import NothingYetError, Unfinished, load, save, save_nothing_yet
from certify.analysis.selection import Contender, Race
from certify.certificates import (
    SEARCH,
    Certificate,
    PartitionTree,
    TrustedSolver,
    remove,
    require_within_limits,
    run_checker,
    set_aside,
    sole_writer,
)
from certify.certificates.claims import Asymptotic, Claim, Enlarged, Nearby, Practical, Problem, Reached
from certify.certificates.claims.claim import Kind
from certify.certificates.verdict import Stop, Verdict
from certify.errors import BackendError, InputError, OptionError, SoundnessError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import Rest, find_rest, seen_from
from certify.loop.plants import System
from certify.loop.policies import TanhNetwork
from certify.lyapunov import (
    Neural,
    Polynomial,
    are_inside,
    of_polynomial,
    volume,
)
from certify.lyapunov.function import Quadratic
from certify.provers.ball.contraction import contraction
from certify.provers.base import FEW, Attempt, Budget, Progress, Proof
from certify.provers.falsify import Witness

if TYPE_CHECKING:
    from certify.provers.dreal.proof import DrealOptions
    from certify.provers.execution import Runner
    from certify.provers.outer import OuterProof

__all__ = ["RoaOptions", "RoaResult", "certify_roa"]
Array = NDArray[np.float64]
Stage = Literal["candidate", "ring", "tube", "learn", "outer", "check"]
Report = Callable[[Stage, Progress | None], None]
# Shares of the time limit:
_HEAT = 0.04  # a candidate's first heat
_PATIENCE = 0.1  # for a ring that gains nothing
_SEARCH = 0.6  # for a search that cannot be interrupted, the rest being its check's
_KEPT = 0.03  # for what comes after the search: writing, the checker's start
_BEFORE_TUBE = 0.5  # for candidates and ring, where a tube is to be looked for
_BEFORE_OUTER = 0.25  # the same, where a set beyond theirs is
_FOR_LEARNING = 0.4  # of what is left then, the rest being the proof's and its check's
_GRACE, _LEAST = 1.0, 0.05  # seconds, or of the time limit, for a local level where nothing is proved, whatever is left
_FOR_SEARCH = 0.5  # of what is left then, the rest being the tube's check
_FOR_PROOF = 0.4  # of the time limit, that no further candidate is optimised in
_WORTH = 1.05  # growth of a volume that another candidate must promise
_SMALL = 0.1  # of the volume within a candidate's reach: where less is proved, another one is worth its time
_NEAR = 1e-3  # the same: where less is proved, its own correction is not
_MISLED = 0.9  # of its reach: a violation below it is one that the samples missed
_SAMPLE = 2000  # leaves whose check is timed
_START = 0.2  # seconds that a checker takes to start
_CAUTION = 1.2  # on the time that a check is expected to take
_MUCH = 0.1  # of the time limit: where more was kept for the check it is said
_LONG = 1_000_000  # bytes of a certificate, from which on several processes check it
_MOST_JOBS = 64
_YEAR = 3.156e7  # seconds
_SAVING = 60.0  # seconds between two savings of a search


def certify_roa(
    system: System,
    network: TanhNetwork,
    out: Path,
    options: RoaOptions | None = None,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
    show: Callable[[bytes], None] | None = None,
) -> RoaResult:
    """Certify a region of attraction of `system` under `network`.

    Parameters
    ----------
    system, network : the closed loop.
    out : folder for `certificate.json`; it is made if it is not there.
    options : see `RoaOptions`.
    load_seconds : time already spent on reading, for the report.
    provenance : entries for the certificate that the checker ignores.
    progress : called with ("candidate", None), with ("ring", where the pass stands) after every batch, and with
        ("check", None).
    show : called with the bytes of a certificate that the run ends with if they are accepted, before they are checked.

    Returns
    -------
    RoaResult : PROVED only if the checker accepted the certificate; TRUSTED where a solver's word stands for it.

    Raises
    ------
    InputError : the closed loop or an option cannot be used, or `out` cannot be written or is another run's.
    BackendError : the checker process failed, no scheduler answers, or the checker rejects what was proved with a
        cluster, and no smaller set mends it.
    SoundnessError : the checker rejects what the engine proved, and no smaller set mends it.
    """
    from certify.provers.execution.threads import one_thread

    options = options or RoaOptions()
    with one_thread(), sole_writer(out):
        set_aside(out, keep=options.resume)
        with _runner_for(options) as runner:
            return _Run(system, network, out, options, runner, load_seconds, provenance or {}, progress, show).result()


@contextmanager
def _runner_for(options: RoaOptions) -> Iterator[Runner]:
    """Where boxes are bounded."""
    if options.cluster is not None:
        from certify.provers.execution.cluster import ClusterRunner, connect

        with connect(options.cluster) as client:
            yield ClusterRunner(client)
        return
    from certify.provers.execution import ThreadRunner

    yield ThreadRunner()


@dataclass
class _Run:
    """One run: what was asked for, and the stopwatch."""

    system: System
    network: TanhNetwork
    out: Path
    options: RoaOptions
    runner: Runner
    load: float
    provenance: Mapping[str, Any]
    progress: Report | None
    show: Callable[[bytes], None] | None = None
    clock: Callable[[], float] = time.perf_counter
    seconds: dict[str, float] = field(default_factory=dict)
    start: float = field(init=False)
    proof: Proof | None = None
    cut_short: bool = False
    notices: list[str] = field(default_factory=list)  # what a person should know; nothing takes one away
    race: Race | None = None
    winner: Contender | None = None  # of the race, once that is decided
    underway: bool = False  # whether there is a loop to search about
    check_takes: tuple[float, float] = (0.0, 0.0)  # seconds without a leaf, and for each
    centre: tuple[Fraction, ...] | None = None  # of a tube around a path, in deviations
    missed: str = ""  # why there is no such tube
    converging: bool = False  # of a practical claim: to ask for one equilibrium as well
    share: float = 1.0  # of the time, up to which a stage may go on
    checked: str | None = None  # by whom, where a cluster was asked
    asked: tuple[System, TanhNetwork] = field(init=False)  # the loop as it was given

    def __post_init__(self) -> None:
        self.asked, self.start = (self.system, self.network), self.clock()

    def result(self) -> RoaResult:
        try:
            result = self._decide()
        except (InputError, SoundnessError):
            raise
        except BaseException:  # Ctrl-C, a reader that has gone, a checker that cannot run: --resume goes on from here
            self._keep()
            raise
        gained = self._first is not None and self._first.attempt.gained
        if self._can_go_on and (result.stop in (Stop.TIME, Stop.CLUSTER) or (result.stop is Stop.BOXES and gained)):
            self._keep()
        else:
            remove(self.out / SEARCH)  # it has come to its end
        result = replace(result, seconds={"load": self.load, **self.seconds, "total": self.spent})
        said = *self.notices, result.notice, self.runner.remark, self.checked
        notices = dict.fromkeys(text for text in said if text is not None)
        result = replace(result, notice="; ".join(notices) or None)
        search = self.out / SEARCH
        result = replace(result, search=search if search.exists() else None)
        left = max(0.0, self.options.time_limit - self.spent)
        return replace(result, diagnosis=diagnose(result, self.options, self.proof, self.asked, left))

    @property
    def spent(self) -> float:
        """Seconds since the run began, reading included."""
        return self.load + self.clock() - self.start

    def left(self) -> float:
        """Seconds that the search may still take."""
        return self.share * (1 - _KEPT) * self.options.time_limit - self.spent

    def _decide(self) -> RoaResult:
        """Choose, falsify, prove, check."""
        options, loop = self.options, ClosedLoop(self.system, self.network)
        require_within_limits(self.system, self.network)
        require_one_that_knows(self.system, options)
        if options.box is not None:
            ellipsoid_in(self.system, options.box)
        self.centre = None if options.reach_from is None else state_in(self.system, options.reach_from)
        with self._stage("candidate"):
            claim = self._claim(loop)
            if claim == "practical" and options.enlarges:
                if options.reach_from is not None:
                    why = "; ".join(self.notices)
                    raise InputError(f"a tube from a state needs a loop that rests at the origin; {why}.")
                self.notices.append("a tube needs a set from which trajectories converge, and is not looked for")
                options = replace(options, enlarge=False, box=None)
            self.options = options = replace(options, claim=claim)
            rest, loop = self._rest(loop)
        self.share = _BEFORE_TUBE if options.enlarges else _BEFORE_OUTER if options.goes_beyond else 1.0
        kind = _kind_of(options)
        result = RoaResult(
            Verdict.UNKNOWN,
            Stop.REQUESTED,
            self.system,
            self.network,
            kind,
            engine=options.engine,
            reach_from=None if self.centre is None else values_of(self.system, self.centre),
        )
        if kind == "asymptotic":
            with self._stage("candidate"):
                unstable = by_spectrum(loop)
            if unstable is not None:
                verdict, stop, shown = unstable
                detail = f"eigenvalues {', '.join(shown)}" + (" touch the axis" if stop is Stop.SPECTRUM else "")
                return replace(result, verdict=verdict, stop=stop, detail=detail, eigenvalues=shown)
        result = replace(result, rest=rest)
        if kind == "practical" and options.P is None and not options.resume and (shown := not_stable(loop)):
            detail = f"eigenvalues {', '.join(shown)} where V is to be 0"
            return replace(result, stop=Stop.UNSTABLE, detail=detail, eigenvalues=shown)
        self.underway = True
        if options.resume:
            self._resume(loop, kind)
        if self.winner is not None:
            race = self._contest()
        elif options.P is None and options.only is None:
            race = self._race(loop)
        else:
            with self._stage("candidate"):
                one = named(loop, self._granted(share_of_robust(loop) if options.only == "robust" else OPTIMISING))
            refuted = refuted_at_once(result, one)
            if refuted is not None:
                return refuted
            race = self._contest()
            race.enter([one], self._heat())
            self.winner = race.contenders[0]
        self._finish(race)
        return self._conclude(result, race)

    def _claim(self, loop: ClosedLoop) -> Kind:
        """The claim: as asked, or by whether the loop rests at the origin; a notice says why it is the weaker one.

        Raises
        ------
        InputError : the claim `asymptotic` is asked for, and the loop does not rest at the origin.
        """
        self.converging = self.options.claim in ("auto", "nearby") and not self.system.in_steps
        if self.options.claim in ("practical", "nearby"):
            return "practical"
        try:
            loop.require_rest()
        except InputError as error:
            if self.options.claim == "asymptotic":
                raise
            self.notices.append(f"practical stability is claimed, because {_first_sentence(error)}")
            return "practical"
        return "asymptotic"

    def _rest(self, loop: ClosedLoop) -> tuple[Rest | None, ClosedLoop]:
        """Where the loop rests, if that is worth saying, and the loop as seen from where V is to be 0: from now on
        that is the run's.

        Raises
        ------
        InputError : V is to be 0 where the loop rests, and no stable point of rest is found.
        """
        options = self.options
        if loop.network.is_moved:
            return None, loop
        if options.claim != "practical" or loop.system.time == "discrete" or loop.network.centre != "none":
            if options.around == "rest" and options.claim == "practical":
                raise OptionError("`around` rest needs a policy without centring and a plant in continuous time.")
            return None, loop
        rest = find_rest(loop)
        given = options.P is not None or options.level is not None or options.lyapunov is not None
        if options.around == "rest" and (rest is None or not rest.stable):
            found = "none was found" if rest is None else f"the one at {', '.join(rest.x)} is not"
            raise OptionError(f"`around` rest needs a stable point of rest; {found}.")
        if rest is None or not rest.stable or options.around == "origin" or (options.around == "auto" and given):
            return rest, loop
        moved = seen_from(loop, rest)
        if not moved.network.is_moved:
            return rest, loop
        self.system, self.network = moved.system, moved.network
        return rest, moved

    def _race(self, loop: ClosedLoop) -> Race:
        """Every candidate for a little time, and more for the better ones."""
        heat, options = self._heat(), self.options
        self._tell("candidate")
        with self._stage("candidate"):
            found = solutions(loop, options)
        if self.options.claim == "practical" and options.engine != "dreal" and loop.system.n > FEW:
            with self._stage("candidate"):
                trials = solved(loop, found, self._granted())
            rests = self.network.is_moved and not loop.system.ranges
            return (self._around_its_rest if rests else self._around_a_level)(loop, trials)
        large = self._optimised(partial(optimised, loop)) if options.engine != "dreal" else None
        race, most = self._contest(), volume(ellipsoid_in(self.system), 1.0)
        if self.interruptible and large is not None and race.is_settled_by(large, heat, most):
            return race  # before the others are made, of which `robust` takes longest
        trials = [] if large is None else [large]
        if self.left() > 0 or not race.proved:
            with self._stage("candidate"):
                trials = [*solved(loop, found, self._granted()), *trials]
        if not self.interruptible:
            race.enter(by_reach(trials)[:1], heat)
            if self.network.is_moved:
                self._improve(race, loop, heat)
            return race
        certain = self._optimised(partial(robust, loop), share_of_robust(loop))
        trials += [] if certain is None else [certain]
        race.enter(trials, heat)
        self._improve(race, loop, heat)
        unproved = [c for c in race.open if c.trial.name == "optimised"]
        others = [c for c in race.contenders if c.trial.name != "optimised" and c.proved]
        if unproved and others and self.left() > 0:
            with self._stage("candidate"):
                best = max(others, key=lambda c: c.proved).trial
                between = list(blends(loop, unproved[0].trial, best, self._granted()))
            race.enter(between, heat if race.gained else 0.0)  # without a gain their local levels tell
        race.knock_out(heat)
        return race

    def _around_a_level(self, loop: ClosedLoop, trials: list[Trial]) -> Race:
        """A practical claim in many states, where no tree of boxes can carry what a ball does not: the candidate made
        for that, then others until one proves something; then the largest sampled one, if there is time."""
        race, first = self._contest(), self._optimised(partial(peak, loop), FOR_PEAK)
        for one in ([] if first is None else [first]) + by_reach(trials):
            race.enter([one], self._heat())
            if race.best.proved:
                break
        if race.best.proved and self.left() > _FOR_PROOF * self.options.time_limit:
            large = self._optimised(partial(optimised, loop))
            race.enter([] if large is None else [large], self._heat())
        return race

    def _around_its_rest(self, loop: ClosedLoop, trials: list[Trial]) -> Race:
        """A practical claim in many states of a loop that rests where V is 0: a ball carries there as much as it does
        of a loop that rests exactly, and the largest candidates come first as they do there."""
        race, large = self._contest(), self._optimised(partial(optimised, loop))
        race.enter([] if large is None else [large], self._heat())
        if large is not None and race.best.proved > _NEAR * large.volume:
            self._improve(race, loop, self._heat())
        little = large is None or race.best.proved < _SMALL * large.volume
        if little and self.left() > _FOR_PROOF * self.options.time_limit:
            certain = self._optimised(partial(robust, loop), share_of_robust(loop))
            race.enter([] if certain is None else [certain], self._heat())
        for one in by_reach(trials):
            if race.contenders and race.best.proved:
                break
            race.enter([one], self._heat())
        return race

    def _improve(self, race: Race, loop: ClosedLoop, heat: float) -> None:
        """The optimised candidate again, from where it is, as long as its proofs reach as far as its samples do.

        A proof that comes upon a violation far below its candidate's reach tells the next round of it.
        """
        witnesses: list[Witness] = []
        while self.left() > _FOR_PROOF * self.options.time_limit:
            last = [c for c in race.contenders if c.trial.name == "optimised"][-1:]
            if not last or not last[0].attempt.done:
                return
            found = last[0].attempt.proof().witness
            misled = found is not None and found.level < _MISLED * last[0].trial.task.target
            if found is not None and misled:
                witnesses.append(found)
            elif not self.cut_short:
                return
            again = self._optimised(partial(corrected, loop, last[0].trial, witnesses))
            if again is None or (not misled and again.volume <= _WORTH * race.best.proved):
                return
            race.enter([again], heat)

    def _optimised(self, make: Callable[[RoaOptions], Trial | None], share: float = OPTIMISING) -> Trial | None:
        """A trial that has its share of the time to be made in, or None where there is no time left; `cut_short` says
        whether that ended it."""
        if self.left() <= 0:
            self.cut_short = True
            return None
        begin, granted = self.clock(), self._granted(share)
        with self._stage("candidate"):
            made = make(granted)
        self.cut_short = self.clock() - begin >= OPTIMISING * granted.time_limit
        return made

    def _granted(self, share: float = OPTIMISING) -> RoaOptions:
        """The options with a limit of which this share, and what sampling adds, is no more than there is left."""
        most = self.left() / (share * (1 + SAMPLING))
        return replace(self.options, time_limit=max(1e-3, min(self.share * self.options.time_limit, most)))

    @property
    def interruptible(self) -> bool:
        """Whether attempts can be worked on a little at a time."""
        return self.options.claim == "asymptotic" and self.options.engine != "dreal"

    def _heat(self) -> float:
        """Seconds of a candidate's first heat, which for some is the only one."""
        if self.interruptible:
            return _HEAT * self.share * self.options.time_limit
        return (1.0 if self.options.engine == "dreal" else _SEARCH) * self.left()

    def _contest(self) -> Race:
        """The race of this run."""
        if self.race is None:
            report = None if self.progress is None else self._report
            self.race = Race(self._begin, self.left, self.options.max_boxes, report)
        return self.race

    def _report(self, state: Progress, stage: Stage = "ring") -> None:
        if self.progress is not None:
            known = state.seconds_left
            self.progress(stage, replace(state, seconds_left=self.left() if known is None else min(known, self.left())))

    def _tell(self, stage: Stage) -> None:
        if self.progress is not None:
            self.progress(stage, None)

    def _begin(self, trial: Trial) -> Attempt:
        if self.options.engine == "dreal":
            from certify.provers.dreal.proof import DrealEngine

            return DrealEngine(trial.T, self.options.dreal_precision, self.options.jobs or 1).begin(trial.task)
        from certify.provers.boxes.engine import BoundsEngine

        proved = self.race is not None and self.race.proved
        least = 0.0 if proved else max(_GRACE, _LEAST * self.options.time_limit)
        return BoundsEngine(trial.T, self.runner, self.clock() + max(least, self.left())).begin(trial.task)

    def _finish(self, race: Race) -> None:
        """What is left of the time for the best contender, less what the check of its proof will take."""
        if not race.open:
            return
        self.winner = winner = race.open[0]
        boxes = self.options.max_boxes

        def lost() -> bool:
            return self.options.cluster is not None and winner.attempt.proof().stop is Stop.CLUSTER

        while (
            not (winner.attempt.gained or winner.attempt.done or winner.hopeless)
            and self.left() > 0
            and winner.attempt.boxes < boxes
            and not lost()
        ):
            winner.advance(Budget(self._within(_PATIENCE * self.options.time_limit), boxes), self._keeping())
        if not self.interruptible or winner.attempt.done or lost() or not winner.attempt.gained:
            return
        while self.left() > 0 and not winner.attempt.done and winner.attempt.boxes < boxes and not lost():
            whole, each, known = self._check_takes(winner)
            self.check_takes, before = (whole, each), winner.attempt.boxes
            searching = self._within(self.left() - _CAUTION * whole)
            if known:
                budget = Budget(searching, boxes, check=_CAUTION * each)
            else:  # few leaves say little: some more, and then again
                budget = Budget(min(searching, _PATIENCE * self.options.time_limit), boxes)
            winner.advance(budget, self._keeping())
            self._keep()
            if known or winner.attempt.boxes == before:
                return

    def _keeping(self) -> Callable[[Progress], None]:
        """Who reports, and keeps the search now and then."""
        last = time.monotonic()

        def report(progress: Progress) -> None:
            nonlocal last
            if time.monotonic() - last > _SAVING:
                self._keep()
                last = time.monotonic()
            self._report(progress)

        return report

    @property
    def _first(self) -> Contender | None:
        """The contender whose search is worth most; None if there is none."""
        race = self.race
        if self.winner is not None or race is None:
            return self.winner
        begun = [*race.contenders, *([] if race.early is None else [race.early])]
        return max(begun, key=lambda c: c.proved, default=None)

    @property
    def _can_go_on(self) -> bool:
        """True if more time may gain something that a kept search saves."""
        one = self._first
        return self.interruptible and one is not None and not (one.attempt.done or one.hopeless)

    def _keep(self) -> None:
        """Leave a search with which `--resume` goes on."""
        options, path, one = self.options, self.out / SEARCH, self._first
        if not self.underway or options.engine != "bounds":
            return
        if one is not None and self.interruptible:
            save(path, Unfinished.of(one.trial, one.attempt.state(), one is self.winner))
        elif options.P is None and options.only is None:  # else it could not say which candidate was asked for
            save_nothing_yet(path, self.system, self.network, options.rate)

    def _resume(self, loop: ClosedLoop, kind: Kind) -> None:
        """Enter the contender whose search an earlier run has left, as the winner if that was decided."""
        path = self.out / SEARCH
        try:
            found = load(path, loop, self.options.rate) if kind == "asymptotic" or path.exists() else None
        except NothingYetError:
            self.notices.append("the run before this one was stopped before it had a candidate: it is begun anew")
            return
        if found is None or kind != "asymptotic":
            raise InputError("a search for a practical claim cannot be gone on with; run without --resume.")
        with self._stage("candidate"):
            race = self._contest()
            attempt = self._begin(found.trial)
            if found.state.tree:
                attempt.restore(found.state)
            race.contenders.append(Contender(found.trial, attempt))
            race.contenders[0].advance(Budget(1e-3, self.options.max_boxes), race.report)
        self.winner = race.contenders[0] if found.decided else None

    def _within(self, seconds: float) -> float:
        return max(1e-3, min(seconds, self.left()))

    def _check_takes(self, contender: Contender) -> tuple[float, float, bool]:
        """Seconds that the check takes here and now without a leaf, and for each, from certificates with some of what
        is proved already; and whether there were enough leaves to tell.

        The certificates are good ones, and the last stays if the run is interrupted.
        """
        proof, problem = contender.attempt.proof(), contender.trial.task.problem
        claim, tree = proof.claim, proof.evidence
        if claim is None or not isinstance(tree, PartitionTree) or contender.trial.task.exactly:
            return _START, 0.0, True
        from certify.provers.boxes.mend import level_with_leaves

        def check(level: float) -> float:
            before = self.seconds.get("check", 0.0)
            some = Certificate(self.system, self.network, problem.V, replace(claim, roa=level), tree, self.provenance)
            self._clerk().ask(some)
            return self.seconds["check"] - before

        level, count = level_with_leaves(problem, tree, claim, _SAMPLE)
        taken, known = check(level), count >= _SAMPLE / 2
        if known or taken < 2 * _START:
            return min(_START, taken), max(0.0, taken - _START) / max(1, count), known
        whole = min(taken, check(claim.inner))  # what few leaves took may be what any file takes
        return whole, (taken - whole) / max(1, count), taken > 2 * whole  # then the leaves have taken most of it

    def _conclude(self, result: RoaResult, race: Race) -> RoaResult:
        """The verdict on what the engine says, the only place that gives one after the search."""
        best = race.best
        task, proof = best.trial.task, best.attempt.proof()
        self.proof = proof
        for stage in ("local", "ring"):
            self.seconds[stage] = sum(c.attempt.seconds.get(stage, 0.0) for c in race.contenders)
        witness = lowest_witness(task.witness, proof.witness)
        result = replace(result_about(result, best.trial), tried=tuple(tried_row(c, best) for c in race.contenders))
        result = replace(
            with_levels(result, proof.partial, witness),
            stop=proof.stop,
            detail=proof.detail,
            witness=witness,
            boxes=sum(c.attempt.boxes for c in race.contenders),
            solver=proof.solver,
        )
        reserved = _CAUTION * (self.check_takes[0] + self.check_takes[1] * proof.leaves)
        if proof.stop is Stop.TIME and best is self.winner and reserved > _MUCH * self.options.time_limit:
            result = replace(result, detail=f"about {reserved:.0f} s of it were kept for the check")
        if proof.stop is Stop.TIME and proof.claim is not None and best.hopeless:
            pace = proof.boxes / max(1e-3, proof.seconds.get("ring", 0.0))
            years = best.attempt.expected / pace / _YEAR
            needed = f"about {best.attempt.expected:.0e} are needed before anything is, {years:.0e} years at this pace"
            detail = f"{proof.boxes:,} boxes added nothing to the local level, and {needed}"
            result = replace(result, stop=Stop.STALLED, detail=detail)
        claim = proof.claim
        if claim is None or (task.exactly and claim.roa < task.target):
            if task.exactly and is_refuted(task, witness):
                return with_witness(result, task, witness)
            return result if claim is None else short_of_target(result, task, claim)
        evidence, facts = proof.evidence, None
        if self.options.enlarges and isinstance(claim, Asymptotic) and isinstance(evidence, PartitionTree):
            around = self._enlarge if self.centre is None else self._surround
            facts, claim, evidence = around(race, claim, evidence)
        if self.converging and isinstance(claim, Practical) and isinstance(evidence, PartitionTree):
            closer = contraction(task.problem, best.trial.T, claim.floor)
            if closer is not None:
                claim = Nearby(claim.roa, claim.local, claim.floor, rate=claim.rate)
                evidence = replace(evidence, contraction=closer)
        beyond = None
        if self.options.goes_beyond and isinstance(evidence, PartitionTree):
            beyond = self._beyond(best.trial, claim)
            if beyond is not None:
                claim, evidence = replace(claim, outer=beyond.outer), replace(evidence, outer=beyond.evidence)
        certificate = Certificate(self.system, self.network, task.problem.V, claim, evidence, self.provenance)  # type: ignore[arg-type]
        accepted = self._clerk().accepted(certificate, task.problem)
        certificate = accepted.certificate
        if accepted.mended is not None:
            self.notices.append(accepted.mended)
        if isinstance(certificate.claim, Nearby):
            result = replace(result, claim=certificate.claim.kind)
        if certificate.claim.outer is not None and beyond is not None:
            facts_beyond = outer_facts(task.problem, certificate.claim, certificate.claim.outer, beyond)
            result = replace(result, outer=facts_beyond)
        elif beyond is not None:
            self.notices.append("the checker refused the set beyond the ellipsoid, which is left out")
        if self.options.lyapunov_level is not None and (
            certificate.claim.outer is None or certificate.claim.outer.level < self.options.lyapunov_level
        ):
            why = short_of(task.problem, certificate.claim, self.options, beyond)
            smaller = _with_certificate(result, accepted, witness, proof.leaves)
            return replace(smaller, stop=Stop.BEYOND, detail=why)
        if isinstance(certificate.claim, Enlarged | Reached):
            result = replace(result, claim=certificate.claim.kind, tube=facts)
        elif self.centre is not None and not _holds(task.problem, certificate.roa, self.centre):
            why = self.missed if facts is None else accepted.mended or "the checker refused the tube"
            without = _with_certificate(result, accepted, witness, proof.leaves)  # the state
            return replace(without, stop=Stop.PATH, detail=why)
        if task.exactly and certificate.roa < task.target:
            return short_of_target(
                replace(result, stop=Stop.REFUSED, detail=accepted.mended or ""), task, certificate.claim
            )
        if self.centre is not None and facts is None:
            self.notices.append("the state lies in the proved set, and no tube is needed")
        trusted = isinstance(proof.evidence, TrustedSolver)
        if not trusted and self.options.engine == "both":
            result = replace(result, solver=self._confirm(task.problem, certificate.claim))
        return replace(
            _with_certificate(result, accepted, witness, proof.leaves),
            verdict=Verdict.TRUSTED if trusted else Verdict.PROVED,
            stop=Stop.REFUSED if certificate.roa < claim.roa else limit_of(result.stop, task, witness),
        )

    def _enlarge(
        self, race: Race, claim: Asymptotic, evidence: PartitionTree
    ) -> tuple[TubeFacts | None, Asymptotic, PartitionTree]:
        """The claim and its evidence with the tube from the largest ellipsoid that there is time for."""
        from certify.provers.ball.models import paths
        from certify.provers.tube.enlarge import enlarge

        self.share = 1.0
        P = race.best.trial.P
        shapes = {c.trial.name: c.trial.P for c in (race.best, *_by_proved(race))} | {
            "domain": ellipsoid_in(self.system)
        }
        if self.options.box is not None:
            shapes = {"box": ellipsoid_in(self.system, self.options.box)}
        end = self.spent + _FOR_SEARCH * self.left()
        with self._stage("tube"):
            self._tell("tube")
            known = paths(race.best.trial.task.problem.loop)
            worth = volume(P, claim.roa) if self.options.box is None else 0.0
            found = enlarge(known, P / claim.roa, shapes, lambda: end - self.spent, worth)
        if found is None:
            self.notices.append("no tube leads into the proved set from a larger one, as far as there was time to look")
            return None, claim, evidence
        tube = found.tube
        facts = TubeFacts(tube.start, found.shape, len(tube.slabs), tube.duration)
        enlarged = Enlarged(roa=claim.roa, local=claim.local, start=Quadratic(tube.start))
        return facts, enlarged, replace(evidence, tube=tube.slabs)

    def _surround(
        self, race: Race, claim: Asymptotic, evidence: PartitionTree
    ) -> tuple[TubeFacts | None, Asymptotic, PartitionTree]:
        """The claim and its evidence with the widest tube around the trajectory from a state that there is time for."""
        from certify.provers.tube.enlarge import surround

        trial, centre = race.best.trial, self.centre or ()
        if _holds(trial.task.problem, claim.roa, centre):
            self.missed = "the checker accepted only a lower level, and the state lies above it"
            return None, claim, evidence
        self.share = 1.0
        box = self.options.box
        shapes = {trial.name: trial.P, "domain": ellipsoid_in(self.system)}
        shapes = shapes if box is None else {"box": ellipsoid_in(self.system, box)}
        end = self.spent + _FOR_SEARCH * self.left()
        with self._stage("tube"):
            self._tell("tube")
            middle = np.array([float(q) for q in centre])
            loop = trial.task.problem.loop
            found, self.missed = surround(loop, middle, trial.P / claim.roa, shapes, lambda: end - self.spent)
        if found is None:
            return None, claim, evidence
        tube, at = found.tube, tuple(middle.tolist())
        facts = TubeFacts(tube.start, found.shape, len(tube.slabs), tube.duration, at)
        if not facts.contains([centre]):
            self.missed = "the tube is narrower than the rounding of that state"
            return None, claim, evidence
        reached = Reached(roa=claim.roa, local=claim.local, start=Quadratic(tube.start), centre=at)
        return facts, reached, replace(evidence, tube=tube.slabs)

    def _learned(self, trial: Trial, claim: Claim) -> Neural | Polynomial:
        """A function whose set may reach beyond the ellipsoid, learned in a share of what is left of the time."""
        from certify.lyapunov.learning import fit_polynomial, learn

        options, loop, V = self.options, trial.task.problem.loop, trial.task.problem.V
        with self._stage("learn"):
            self._tell("learn")
            seconds = _FOR_LEARNING * self.left()
            if options.learned == "neural":
                return learn(loop, V, claim.roa, options.hidden, options.seed, seconds).function
            return fit_polynomial(loop, V, claim.roa, options.degree, options.seed, seconds).function

    def _beyond(self, trial: Trial, claim: Claim) -> OuterProof | None:
        """The largest set of another function that is proved to lead into {V <= c2} in the time that is left; None, and
        a notice says why, if there is none."""
        from certify.provers.outer import Nothing, prove_outer

        self.share = 1.0
        function = self.options.lyapunov or self._learned(trial, claim)
        if function.n != self.system.n:
            raise OptionError(f"`lyapunov` must be a function of {self.system.n} states; found one of {function.n}.")
        N = of_polynomial(function, self.system.states) if isinstance(function, Polynomial) else function
        level = self.options.lyapunov_level
        report = None if self.progress is None else partial(self._report, stage="outer")
        with self._stage("outer"):
            self._tell("outer")
            budget = Budget(max(1e-3, _FOR_SEARCH * self.left()), self.options.max_boxes)
            found = prove_outer(trial.task.problem, claim.roa, trial.T, N, level, budget, self.runner, report)
        if isinstance(found, Nothing):
            why = f"no set of the function `lyapunov` is proved to lead into the ellipsoid: {found.why}"
            self.notices.append(why)
            return None
        return found

    def _clerk(self) -> Clerk:
        show = self.show or (lambda _: None)
        tell = partial(self._tell, "check")
        return Clerk(
            self.out / "certificate.json", self.left, self._stage, tell, show, self._checked, self.options.cluster
        )

    def _checked(self, path: Path) -> Mapping[str, Any]:
        """The checker's answer about a file, patiently where it would be refused for what it takes else."""
        answer = self._answered(path, patient=False)
        if (answer.get("rule"), answer.get("at")) == ("limits", "operations"):
            answer = self._answered(path, patient=True)
            if answer["result"] != "REJECTED":
                self.checked = "its check takes more than ten minutes: type `certify check --patient` for another"
        return answer

    def _answered(self, path: Path, patient: bool) -> Mapping[str, Any]:
        """The checker's answer; where many leaves make a long file, several processes share them."""
        if self.options.cluster_checks:
            from certify.analysis.parts import check_in_parts

            try:
                _, answer = check_in_parts(path, self.runner, patient)
            except BackendError as error:
                self.checked = f"checked here, and not by the cluster: {str(error).rstrip('.')}"
            else:
                if "parts" in answer:
                    self.checked = (
                        f"checked in {answer['parts']} parts by the workers of {self.options.cluster}, whose word it is"
                    )
                return answer
        cores = len(os.sched_getaffinity(0)) if path.stat().st_size > _LONG else 1
        return run_checker(path, jobs=self.options.jobs or min(cores, _MOST_JOBS), patient=patient)

    def _confirm(self, problem: Problem, claim: Claim) -> dict[str, Any]:
        """dReal's answers about what the bounds engine proved.

        Raises
        ------
        SoundnessError : dReal points at a genuine violation of what was proved and checked.
        """
        from certify.provers.dreal.backend import find_backend
        from certify.provers.dreal.proof import DrealOptions, confirm_with_dreal, record_of

        try:
            backend = find_backend()
        except BackendError as error:
            return {"solver": "dreal", "missing": str(error)}
        allowed: DrealOptions = DrealOptions(
            self.options.dreal_precision, self.options.jobs or 1, self.options.time_limit
        )
        asked, witness = confirm_with_dreal(problem, claim, backend, allowed)
        if witness is not None:
            path = self.out / "contradiction.json"
            stated = {"x": [v.hex() for v in witness.x.tolist()], "kind": witness.kind, "V": witness.level}
            path.write_text(json.dumps({"witness": stated, "certificate": "certificate.json"}) + "\n", encoding="utf-8")
            raise SoundnessError(f"dReal and Arb contradict a checked certificate; {path} has the witness.")
        return record_of(backend.version, allowed, asked)

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        begin = self.clock()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + self.clock() - begin


def _by_proved(race: Race) -> list[Contender]:
    """The contenders, the largest proved volume first."""
    return sorted(race.contenders, key=lambda c: -c.proved)


def _holds(problem: Problem, level: float, state: Sequence[Fraction]) -> bool:
    return are_inside(problem.V.P, level, [state])[0]


def _kind_of(options: RoaOptions) -> Kind:
    return "practical" if options.claim == "practical" else "asymptotic"


def _first_sentence(error: Exception) -> str:
    return str(error).split(". ")[0].rstrip(".")


def _with_certificate(result: RoaResult, accepted: Accepted, witness: Witness | None, leaves: int) -> RoaResult:
    """The result with what the checker accepted, and its answer about these very bytes."""
    stated = with_levels(result, accepted.certificate.claim.levels, witness)
    return replace(stated, leaves=leaves, certificate=accepted.path, raw=accepted.data, checker=accepted.answer)
