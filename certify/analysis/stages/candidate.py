"""The candidates for V: those that are asked for, or several in a race."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from certify.analysis.asked import ellipsoid_in
from certify.analysis.candidates.converging import is_nearby
from certify.analysis.candidates.robust import NoCandidateError
from certify.analysis.candidates.trials import (
    FOR_PEAK,
    OPTIMISING,
    SAMPLING,
    Trial,
    below_violations,
    blend,
    blends,
    by_reach,
    corrected,
    economical,
    economical_from,
    firm,
    named,
    optimised,
    peak,
    robust,
    share_of_robust,
    solutions,
    solved,
)
from certify.analysis.options import RoaOptions
from certify.analysis.outcome import refuted_at_once
from certify.analysis.saved_search import NothingYetError, load
from certify.analysis.selection import Contender, Race
from certify.analysis.stages.acceptance import operations_of_check
from certify.analysis.stages.state import State, Tools
from certify.certificates.verdict import Stop
from certify.effort import UNIT, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov import volume
from certify.lyapunov.optimised import DECAYS, FURTHER
from certify.provers.base import FEW, MANY, Attempt, Budget
from certify.provers.boxes.rule import operations_of_box
from certify.provers.falsify import Witness

_HEAT = 0.04  # share of the effort for a candidate's first heat
_SEARCH = 0.6  # share of the effort that is left for a search that cannot be interrupted
_AROUND_FIRST = 0.3  # the same in many states, for the first of several, of which the later ones are to be the larger
_HALF = 0.5  # of the effort left, for the largest candidate in many states before the others are made
_TO_FIND = 0.5  # share of the effort before an outer set for a candidate, where its one heat gets the rest
_GRACE, _LEAST = 1.0 * UNIT, 0.05  # operations, or of the whole, for a local level where nothing is proved yet
_FOR_BALL = 0.2  # of the whole, for a set from a ball around the equilibrium, even if no effort is left
_LITTLE = 0.01  # share of the domain's ellipsoid: a smaller set counts for less than a claim of convergence
_FOR_PROOF = 0.4  # share of the whole in which no further candidate is optimised
_WORTH = 1.05  # growth of a volume that another candidate must promise
_SMALL = 0.1  # share of the volume within a candidate's reach: if less is proved, another one is worth its effort
_MOST = 0.5  # the same: where more is proved, others are not worth theirs
_NEAR = 1e-3  # the same: where less is proved, its own correction is not
_MISLED = 0.9  # share of its reach: a violation below it is one that the samples missed
_REACHED = 0.9  # share of its target: a level above it leaves nothing to a candidate that is easier to prove
_ALL = 0.99  # share of its target: a level above it is all that a candidate can give
_APART = 1 / 16  # shares of a blend that are no farther apart are not told apart

Array = NDArray[np.float64]
Make = Callable[[RoaOptions, Effort], Trial | None]


@dataclass(frozen=True)
class Candidate:
    """The stage that chooses P, by what a first heat proves with each candidate."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Let the candidates race; end the run if the level that was asked for is refuted at once."""
        tools, options = self.tools, state.options
        race = Race(partial(self._begun, state, effort), effort, 0.0, options.max_boxes, None)
        race.heat = _HEAT * effort.left if state.interruptible else self._only_heat(state, effort)
        race.report = None if tools.progress is None else tools.report
        state = replace(state, race=race)
        tools.keeper.begin(state.loop, options.rate, race, state.interruptible)
        if options.resume:
            state = _resumed(state, tools)
        if tools.keeper.winner is not None:
            return state
        if options.P is None and options.only is None:
            _Choice(state, tools, effort, race).run()
            return state
        share = share_of_robust(state.loop) if options.only == "robust" else OPTIMISING
        try:
            with tools.timing("candidate"):
                one = named(state.loop, options, _granted(effort, tools.whole, share))
        except NoCandidateError as error:
            ended = Budget(effort).ended_by if error.ran_out else Stop.LOCAL
            none = replace(state.result, stop=ended, detail=str(error), candidate=options.only)
            return state.finished(none)
        refuted = refuted_at_once(state.result, one)
        if refuted is not None:
            return state.finished(refuted)
        race.enter([one])
        tools.keeper.winner = race.contenders[0]
        return state

    def _only_heat(self, state: State, effort: Effort) -> float:
        """Operations of the only heat of a search that cannot be interrupted."""
        return (1.0 if state.options.engine == "dreal" else _SEARCH) * effort.left

    def _begun(self, state: State, effort: Effort, trial: Trial, proved: bool) -> Attempt:
        """The attempt of a trial, which begins with its local level."""
        options, tools = state.options, self.tools
        if options.engine == "dreal":
            from certify.provers.dreal.proof import DrealEngine

            return DrealEngine(trial.T, options.dreal_precision, options.jobs or 1).begin(trial.task)
        from certify.provers.boxes.engine import BoundsEngine

        least = 0.0 if proved else max(_GRACE, _LEAST * tools.whole)
        first = effort if effort.left >= least else effort.part(least, even_if_over=True)
        return BoundsEngine(trial.T, tools.runner, first).begin(trial.task)


def _granted(effort: Effort, whole: float, share: float = OPTIMISING) -> Effort:
    """A share of the whole for a candidate, and what sampling adds, as far as there is effort left."""
    return effort.part((1 + SAMPLING) * min(share * whole, effort.left / (1 + SAMPLING)))


def _resumed(state: State, tools: Tools) -> State:
    """Enter the contender whose search an earlier run has left, as the winner if that was decided.

    Raises
    ------
    InputError : there is no search, or it is of another claim.
    """
    path, race = tools.keeper.path, state.contest
    try:
        found = load(path, state.loop, state.options.rate) if state.kind == "asymptotic" or path.exists() else None
    except NothingYetError:
        return state.noting("the run before this one was stopped before it had a candidate: it is begun anew")
    if found is None or state.kind != "asymptotic":
        raise InputError("a search for a practical claim cannot be resumed; run without --resume.")
    with tools.timing("candidate"):
        attempt = race.begin(found.trial, race.proved)
        if found.state.tree:
            attempt.restore(found.state)
        race.contenders.append(Contender(found.trial, attempt))
        race.contenders[0].advance(Budget(tools.effort.part(1.0), state.options.max_boxes), race.report)
    tools.keeper.winner = race.contenders[0] if found.decided else None
    return state


@dataclass
class _Trials:
    """Candidates that are made and tried, within a run's effort."""

    state: State
    tools: Tools
    effort: Effort
    race: Race
    cut_short: bool = False  # the effort ended the making of the last candidate

    @property
    def loop(self) -> ClosedLoop:
        return self.state.loop

    def _made(self, make: Make, share: float = OPTIMISING) -> Trial | None:
        """A trial that has its share of the effort to be made with, or None where none is left."""
        if self.effort.over:
            self.cut_short = True
            return None
        granted = self._granted(share)
        with self.tools.timing("candidate"):
            made = make(self.state.options, granted)
        self.cut_short = granted.spent >= granted.granted / (1 + SAMPLING)
        return made

    def _granted(self, share: float = OPTIMISING) -> Effort:
        alone = self.state.interruptible or not self.state.options.goes_beyond
        return _granted(self.effort if alone else self.effort.share(_TO_FIND), self.tools.whole, share)

    def _for_others(self) -> Effort:
        """The effort for sampling the candidates that are solved for; a search that cannot be interrupted keeps half of
        what is left to its heats, without which a candidate is worth nothing."""
        granted = self._granted()
        return granted if self.state.interruptible else granted.part(min(granted.left, _TO_FIND * self.effort.left))

    def _enter_alone(self, trial: Trial, share: float = _SEARCH) -> Contender | None:
        """Enter a trial with a heat of this share of the effort that is left; None if its reach is not worth one."""
        before = len(self.race.contenders)
        self.race.enter([trial], share * self.effort.left)
        return self.race.contenders[-1] if len(self.race.contenders) > before else None

    def _is_left_for_more(self) -> bool:
        return self.effort.left > _FOR_PROOF * self.tools.whole

    def _reaches(self, trial: Trial, nearby: bool = False) -> bool:
        """True if nothing easier to prove could gain more: about all within the trial's reach is proved, or that is
        not worth a heat. With `nearby` it is left out again where it is not shown that all converge to one equilibrium.
        """
        entered = self._enter_alone(trial)
        return entered is None or self._has_reached(entered, nearby)

    def _has_reached(self, entered: Contender, nearby: bool) -> bool:
        """True if about all within its reach is proved, with `nearby` also that all converge to one equilibrium."""
        trial = entered.trial
        if nearby and entered is self.race.best and not self._is_nearby(entered):
            self.race.contenders.remove(entered)
            self._leave_out(entered)
            return False
        return (entered.attempt.level or 0.0) >= _REACHED * trial.task.target

    def _leave_out(self, contender: Contender) -> None:
        """Say that a set is larger than the one that is claimed, and that less is known of it."""
        if contender.proved:
            self.tools.remarks.append(
                f"with {contender.trial.name} a set of volume {contender.proved:.6g} is proved as well, but not that "
                "all converge to one equilibrium in it: the claim `practical` would have it"
            )

    def _is_best_nearby(self) -> bool:
        """True if convergence to one equilibrium is claimed, and shown of the best so far."""
        return self.state.converging and self._is_nearby(self.race.best)

    def _is_nearby(self, contender: Contender) -> bool:
        """True if all converge to one equilibrium in its set."""
        with self.tools.timing("candidate"):
            proof, path = contender.attempt.proof(), self.tools.out / "certificate.json"
            return is_nearby(contender.trial.task.problem, proof, path)

    def _improve(self) -> None:
        """The optimised candidate again, from where it is, as long as its proofs reach as far as its samples do.

        A proof that comes upon a violation far below its candidate's reach tells the next round of it.
        """
        race, witnesses = self.race, list[Witness]()
        while self._is_left_for_more():
            last = [c for c in race.contenders if c.trial.name == "optimised"][-1:]
            if not last or not last[0].attempt.done:
                return
            found = last[0].attempt.proof().witness
            misled = found is not None and found.level < _MISLED * last[0].trial.task.target
            if found is not None and misled:
                witnesses.append(found)
            elif not self.cut_short:
                return
            again = self._made(partial(corrected, self.loop, last[0].trial, witnesses))
            if again is None or (not misled and again.volume <= _WORTH * race.best.proved):
                return
            race.enter([again])

    def _largest(self, found: dict[str, Array]) -> tuple[Trial | None, bool]:
        """The largest candidate, and True if no other is worth its effort beside this one, or beside one for the boxes
        that there are: before the others are made, of which `robust` takes longest."""
        loop, ranges = self.loop, self.loop.system.ranges
        if not ranges and self._enters_thrifty(partial(economical, loop, found)):
            return None, True
        large = self._made(partial(optimised, loop))
        if large is None:
            return None, False
        starts = {**found, large.name: large.P}
        if ranges and self._enters_thrifty(partial(economical, loop, starts, largest=large)):
            return large, True
        most = volume(ellipsoid_in(loop.system), 1.0)
        return large, self.race.is_settled_by(large, most) or self._goes_far(large)

    def _goes_far(self, large: Trial) -> bool:
        """True if half of the effort proves more than a little of the largest candidate in many states, where a search
        gains nothing at first, and others take much to be made; it is tried where a gain is expected in that."""
        entered = None
        if self.loop.system.n > FEW and not self.loop.system.ranges:
            entered = self._enter_alone(large, _HEAT)
        if entered is None:
            return False
        self.race.advance(entered, _HALF * self.effort.left, operations_of_box(self.loop))
        if entered.proved <= _SMALL * large.volume:
            return False
        self._improve()
        return True

    def _enters_thrifty(self, make: Callable[[float, RoaOptions, Effort], Trial | None]) -> bool:
        """Enter a candidate for the boxes that the effort left can bound and check; False if these are not what limits
        it, since nothing is proved, or its samples have missed a violation."""
        if not FEW < self.loop.system.n <= MANY or self.state.options.engine == "dreal":
            return False
        each = operations_of_box(self.loop) + operations_of_check(self.loop)
        boxes = (self.effort.left - OPTIMISING * self.tools.whole) / each
        cut_short = self.cut_short
        made = self._made(partial(make, boxes)) if boxes >= 1 else None
        if made is None:
            self.cut_short = cut_short
            return False
        self.race.enter([made])
        return self.race.proved and not (self.race.contenders[-1].attempt.done and self._is_left_for_more())


@dataclass
class _Choice(_Trials):
    """The choice among several candidates."""

    def run(self) -> None:
        """Every candidate for a little effort, and more for the better ones."""
        state, race, loop = self.state, self.race, self.loop
        self.tools.tell("candidate")
        with self.tools.timing("candidate"):
            found = solutions(loop, state.options)
        if state.kind == "practical" and state.options.engine != "dreal" and loop.system.n > FEW:
            with self.tools.timing("candidate"):
                trials = solved(loop, found, state.options, self._granted())
            rests = loop.network.is_moved and not loop.system.ranges
            return self._around_its_rest(trials, found) if rests else self._around_a_level(trials)
        if state.interruptible:
            large, settled = self._largest(found)
            if settled:
                return None
        else:
            large = self._made(partial(optimised, loop)) if state.options.engine != "dreal" else None
        trials = [] if large is None else [large]
        if not self.effort.over or not race.proved:
            with self.tools.timing("candidate"):
                trials = [*solved(loop, found, state.options, self._for_others()), *trials]
        if state.interruptible:
            return self._among(trials, large)
        for one in by_reach(trials):
            race.enter([one])
            if race.proved or self.effort.over or state.options.engine == "dreal":
                break
        if loop.network.is_moved:
            self._improve()
        little = race.best.proved < _LITTLE * volume(ellipsoid_in(loop.system), 1.0)
        ranks = loop.system.in_steps and (state.options.ranks or (state.options.goes_on and loop.system.n <= FEW))
        wanted = state.insists or (state.converging and little and not ranks)  # which reach a large set from far more
        if wanted and race.best.proved and not self._is_best_nearby():
            self._closer(trials)
        return None

    def _closer(self, trials: list[Trial]) -> None:
        """A set that is shown to converge to one equilibrium instead of the largest one, which is not: with the V of
        which samples fall from the equilibrium on up to the largest level, from a ball around it."""
        race = self.race
        with self.tools.timing("candidate"):
            within = [one for trial in trials if (one := below_violations(trial, self.effort)) is not None]
        for one in by_reach(within)[:1]:
            least = self.effort.part(_FOR_BALL * self.tools.whole, even_if_over=True)
            entered = Contender(one, race.begin(one, True))
            entered.advance(Budget(least, race.boxes), race.report)
            if entered.proved and self._is_nearby(entered):
                self._leave_out(race.best)
                race.contenders[:] = [entered]

    def _among(self, trials: list[Trial], large: Trial | None) -> None:
        """The best of these, of `robust`, and of what lies between the two that are largest and best proved; or `firm`
        if that proves most of its set."""
        loop, race = self.loop, self.race
        if large is not None and loop.system.ranges and self._is_firm(large):
            return race.knock_out()
        certain = self._made(partial(robust, loop), share_of_robust(loop))
        if certain and self._enters_thrifty(partial(economical_from, loop, certain, trials)):
            return
        begun = {id(c.trial) for c in race.contenders}
        race.enter([one for one in [*trials, *([certain] if certain else [])] if id(one) not in begun])
        self._improve()
        unproved = [c for c in race.open if c.trial.name == "optimised"]
        others = [c for c in race.contenders if c.trial.name != "optimised" and c.proved]
        if unproved and others and not self.effort.over:
            with self.tools.timing("candidate"):
                best = max(others, key=lambda c: c.proved).trial
                between = list(blends(loop, unproved[0].trial, best, self.state.options, self._granted()))
            race.enter(between, None if race.gained else 0.0)  # without a gain their local levels tell
        race.knock_out()

    def _is_firm(self, large: Trial) -> bool:
        """True if most is proved of the candidate of a large margin, tried where next to nothing is of the largest."""
        race = self.race
        race.enter([large])
        if race.best.attempt.done or race.best.proved >= _SMALL * large.volume:
            return False
        made = self._made(partial(firm, self.loop))
        entered = None if made is None else self._enter_alone(made, _HEAT)
        if entered is None:
            return False
        race.advance(entered, _SEARCH * self.effort.left, operations_of_box(self.loop))
        return entered.proved > _MOST * entered.trial.volume

    def _around_a_level(self, trials: list[Trial]) -> None:
        """A practical claim in many states, where no tree of boxes can carry what a ball does not: the candidate made
        for that, then others until one proves something; then the largest sampled one, and what lies between the two,
        if there is effort left."""
        race, first = self.race, self._made(partial(peak, self.loop), FOR_PEAK)
        for one in ([] if first is None else [first]) + by_reach(trials):
            self._enter_alone(one, _AROUND_FIRST)
            if race.best.proved:
                break
        if race.best.proved and self._is_left_for_more():
            sure, large = race.best.trial, self._made(partial(optimised, self.loop))
            if large is not None and not self._reaches(large):
                self._between(large, sure)
            elif large is not None and self.loop.system.ranges:
                self._tighten(large)

    def _tighten(self, sure: Trial) -> None:
        """The optimised candidate once more, from where it is, with the least margin of which as much is proved as is
        within reach: that of loops without ranges at first, then between one that is too small and one that is not."""
        race, small, enough = self.race, DECAYS[-1], FURTHER[-1]
        if race.best.trial is not sure or (race.best.attempt.level or 0.0) < _ALL * sure.task.target:
            return
        margin, nearby = small, self._is_best_nearby()
        while self.effort.left > _LEAST * self.tools.whole:
            again = self._made(partial(corrected, self.loop, sure, [], decays=(margin,)))
            entered = None if again is None else self._enter_alone(again)
            if again is None or entered is None:
                return
            if self._has_reached(entered, nearby):
                sure, enough = again, margin
            else:
                small = margin
            if enough <= small:
                return
            margin = math.sqrt(small * enough)

    def _between(self, large: Trial, sure: Trial) -> None:
        """Blends of a large candidate and of one with which a set is proved: a search for the share of the latter with
        which most is proved, as if there were one maximum. A larger set of which less is claimed counts for nothing."""
        race, low, high = self.race, 0.0, 1.0
        best, nearby = float(race.best.trial is not large), self._is_best_nearby()
        while high - low > _APART and self.effort.left > _LEAST * self.tools.whole:
            within = min(max(best, low), high)
            share = (low + within) / 2 if within - low >= high - within else (within + high) / 2
            one, before = blend(self.loop, large, sure, share, self.state.options), race.best
            if one.volume <= _WORTH * before.proved:  # nor are those with more of the smaller one worth a heat
                high = share
                continue
            reaches = self._reaches(one, nearby)
            if race.best is not before:
                low, high = (max(low, best), high) if best < share else (low, min(best, high))
                best, high = share, share if reaches else high
            elif share < best:
                low = share
            else:
                high = share

    def _around_its_rest(self, trials: list[Trial], found: dict[str, Array]) -> None:
        """A practical claim in many states of a loop that rests where V is 0: a ball carries there as much as it does
        of a loop that rests exactly, and the largest candidates come first as they do there, but where boxes limit
        them."""
        race, large = self.race, self._made(partial(optimised, self.loop))
        if self._enters_thrifty(partial(economical, self.loop, found, largest=large)):
            return
        if large is not None:
            self._enter_alone(large, _AROUND_FIRST)
        if large is not None and race.best.proved > _NEAR * large.volume:
            self._improve()
        little = large is None or race.best.proved < _SMALL * large.volume
        if little and self._is_left_for_more():
            certain = self._made(partial(robust, self.loop), share_of_robust(self.loop))
            if certain is not None:
                self._enter_alone(certain, _AROUND_FIRST)
            if large is not None and certain is not None and race.best.proved:
                self._between(large, certain)
        for one in by_reach(trials):
            if race.contenders and race.best.proved:
                break
            self._enter_alone(one, _AROUND_FIRST)
