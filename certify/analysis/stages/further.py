"""The stages that add to a proved set: one equilibrium inside, a tube from a larger set, a set of another function,
boxes with ranks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from certify.analysis.asked import ellipsoid_around, ellipsoid_in
from certify.analysis.facts import TubeFacts
from certify.analysis.simulated import NEARLY_ALL, Simulator
from certify.analysis.stages.state import State, Tools
from certify.certificates.claims import Problem
from certify.certificates.ellipsoids import Box, sublevel_set, tube_start
from certify.certificates.tree import LEAF
from certify.certificates.verdict import Stop
from certify.effort import Effort
from certify.errors import OptionError
from certify.lyapunov import Neural, Polynomial, of_polynomial, volume
from certify.lyapunov.function import Quadratic
from certify.lyapunov.symbolic import Symbolic
from certify.provers.base import Budget, Progress
from certify.provers.boxes.mend import are_shown
from certify.provers.ranks import Enough, Question, Sublevel, prove_ranks, root_box, with_frame, with_order

if TYPE_CHECKING:
    from certify.provers.outer import Nothing, OuterProof

Array = NDArray[np.float64]
_FOR_SEARCH = 0.5  # share of the effort that is left, the rest being for the check
_FOR_CELLS = 0.7  # the same for a search of boxes with ranks, of which only those with one are checked
_FOR_RANKS = 0.35  # share of the whole effort, even if the search has left less
_FOR_LEARNING = 0.6  # share of the effort that is left, the rest being for the proof and its check
_MOST = 0.8  # share of what a learned function promised: with less proved it is taught again
_MORE = 0.02  # share of the region that another lesson has to promise beyond the last, if that kept its promise
_LEAST = 0.1  # share of the whole effort, with less of which it is not
_PROBES = 30  # states at which the order of the series in time is chosen, and the frame of errors
_BOXES, _LITTLE = 1e4, 0.02  # share of the width of one of so many equal boxes that an error of the series may be
_FOR_RING = 0.05  # share of the whole effort for the check of the ring, if it takes a series of a higher order


@dataclass(frozen=True)
class Equilibrium:
    """The stage that shows convergence to one equilibrium near the origin."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Strengthen the claim if the loop contracts around the floor."""
        from certify.provers.ball.contraction import contraction

        (claim, evidence), best = state.proved, state.contest.best.trial
        closer = None if claim.floor is None else contraction(best.task.problem, best.T, claim.floor)
        if closer is None:
            return state
        return replace(state, claim=claim.converging(), evidence=replace(evidence, contraction=closer))


@dataclass(frozen=True)
class Tube:
    """The stage that looks for a tube from a larger ellipsoid into the proved set."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Add the largest tube that the effort finds; a note says if there is none."""
        from certify.provers.tube.enlarge import enlarge
        from certify.provers.tube.tube import Around

        (claim, evidence), race = state.proved, state.contest
        trial, box = race.best.trial, state.options.box
        by_proved = sorted(race.contenders, key=lambda c: -c.proved)
        shapes = {c.trial.name: c.trial.P for c in (race.best, *by_proved)}
        shapes |= {"domain": ellipsoid_in(state.loop.system)}
        with self.tools.timing("tube"):
            self.tools.tell("tube")
            worth = volume(trial.P, claim.roa) if box is None else 0.0
            known, goal = Around.of(trial.task.problem.loop, evidence.cells), trial.P / claim.roa
            found = enlarge(known, goal, _shapes(state, shapes), effort.share(_FOR_SEARCH), worth)
        if found is None:
            return state.noting("no tube leads into the proved set from a larger one that the effort could reach")
        facts = TubeFacts(found.tube.start, found.shape, len(found.tube.slabs), found.tube.duration)
        state = state.with_result(tube=facts)
        return replace(
            state, claim=claim.with_tube(Quadratic(facts.start)), evidence=replace(evidence, tube=found.tube.slabs)
        )


@dataclass(frozen=True)
class Route:
    """The stage that looks for a tube around the trajectory from a state into the proved set."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Add the widest tube that the effort finds; `missed` says why there is none."""
        from certify.provers.tube.enlarge import surround

        (claim, evidence), begin, trial = state.proved, state.begin or (), state.contest.best.trial
        what = named(begin)
        if holds(trial.task.problem, claim.roa, begin):
            return replace(state, missed=f"the checker accepted only a lower level, and {what} lies above it")
        with self.tools.timing("tube"):
            self.tools.tell("tube")
            middle, goal = np.array([float(lo + hi) / 2 for lo, hi in begin]), trial.P / claim.roa
            shapes = _shapes(state, {trial.name: trial.P, "domain": ellipsoid_in(state.loop.system)})
            found, missed = surround(trial.task.problem.loop, middle, goal, shapes, effort.share(_FOR_SEARCH))
        if found is None:
            return replace(state, missed=missed)
        tube, at = found.tube, tuple(middle.tolist())
        facts = TubeFacts(tube.start, found.shape, len(tube.slabs), tube.duration, at)
        if not tube_start(tube.start, at).covers(begin):
            return replace(state, missed=_narrower(tube.start, at, begin))
        state = state.with_result(tube=facts)
        return replace(
            state, claim=claim.with_tube(Quadratic(tube.start), at), evidence=replace(evidence, tube=tube.slabs)
        )


def _shapes(state: State, shapes: Mapping[str, Array]) -> Mapping[str, Array]:
    """These shapes, or the one of the box that was asked for."""
    system, box = state.loop.system, state.options.box
    if box is not None:
        return {"box": ellipsoid_in(system, box)}
    around = None if state.begin is None else ellipsoid_around(system, state.begin)
    return shapes if around is None else {"box": around}


def _narrower(P: Array, centre: tuple[float, ...], begin: Box) -> str:
    """The reason why a box, or a state, does not lie in the start of a tube."""
    if all(lo == hi for lo, hi in begin):
        return "the tube is narrower than the rounding of that state"
    reach = np.array([float(hi - lo) / 2 for lo, hi in begin])
    share = min(1.0, float(reach @ np.abs(P) @ reach) ** -0.5)
    return f"the widest tube holds {share:.2g} of the box in each direction; ask for smaller boxes, one by one"


def named(begin: Box) -> str:
    """Names what a tube has to start around."""
    return "the state" if all(lo == hi for lo, hi in begin) else "the box"


def holds(problem: Problem, level: float, box: Box) -> bool:
    """True if {V <= level} is shown in rationals to hold a box, or a state."""
    return sublevel_set(problem.V.P, level).covers(box)


@dataclass(frozen=True)
class Beyond:
    """The stage that proves the largest set of another function that leads into the ellipsoid."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Add the outer set; a note says why there is none.

        Raises
        ------
        OptionError : the function is one of another number of states.
        """
        from certify.provers.outer import Nothing

        given, system = state.options.lyapunov, state.loop.system
        if given is not None and given.n != system.n:
            raise OptionError(f"`lyapunov` must be a function of {system.n} states; found one of {given.n}.")
        found = self._learned(state, effort) if given is None else self._proved(state, given, effort)
        if isinstance(found, Nothing):
            which = "the function `lyapunov`" if given is not None else "the learned function"
            return state.noting(f"no set of {which} is proved to lead into the ellipsoid: {found.why}")
        (claim, evidence) = state.proved
        return replace(
            state,
            beyond=found,
            claim=replace(claim, outer=found.outer),
            evidence=replace(evidence, outer=found.evidence),
        )

    def _proved(self, state: State, function: Neural | Polynomial | Symbolic, effort: Effort) -> OuterProof | Nothing:
        """The largest set of the function that a share of the effort proves."""
        from certify.provers.outer import prove_outer

        tools, (claim, _), trial, options = self.tools, state.proved, state.contest.best.trial, state.options
        N = of_polynomial(function, state.loop.system.states) if isinstance(function, Polynomial) else function
        report = None if tools.progress is None else partial(tools.report, stage="outer")
        with tools.timing("outer"):
            tools.tell("outer")
            budget = Budget(effort.share(_FOR_SEARCH), options.max_boxes)
            return prove_outer(
                trial.task.problem, claim.roa, trial.T, N, options.lyapunov_level, budget, tools.runner, report
            )

    def _learned(self, state: State, effort: Effort) -> OuterProof | Nothing:
        """The largest set of functions learned with shares of the effort, until it is nearly all of the region, or
        another lesson promises no more.

        Samples may miss where a function rises, and a proof may not: what it finds is then part of the next lesson.
        """
        from certify.lyapunov.learning import Network, Terms, learner_of
        from certify.provers.outer import Nothing

        options, problem, best = state.options, state.contest.best.trial.task.problem, None
        n, neural = problem.loop.system.n, options.learned == "neural"
        model = Network(n, tuple(options.hidden)) if neural else Terms(n, options.degree)
        share, learner, promised = effort.share(_FOR_LEARNING), None, 0.0
        while True:
            with self.tools.timing("learn"):
                self.tools.tell("learn")
                if learner is None:
                    learner = learner_of(problem.loop, problem.V, state.proved[0].roa, model, options.seed, share)
                learned = learner.learn(share)
            if best is not None and learned.cover < promised + _MORE:
                return best[1]
            found = self._proved(state, learned.function, effort)
            covered = 0.0 if isinstance(found, Nothing) else learner.cover(learned.function, found.outer.level)
            if best is None or covered > best[0]:
                best = covered, found
            if effort.left < _LEAST * self.tools.whole or covered >= NEARLY_ALL:
                return best[1]
            wrong = found.witness if isinstance(found, Nothing) or found.stop is Stop.WITNESS else None
            if wrong is not None and covered < _MOST * learned.cover:
                learner.correct(wrong.x, covered)
                promised = 0.0
            else:  # another lesson has to promise more
                promised = learned.cover
            share = effort.share(_FOR_LEARNING)


@dataclass(frozen=True)
class ByRanks:
    """The stage that proves from which boxes of the domain trajectories reach the proved set."""

    tools: Tools
    enough: Enough | None = None  # ends the search, if nobody asked for ranks

    def extend(self, state: State, effort: Effort) -> State:
        """Add the boxes; a note says why there are none."""
        tools, (claim, evidence), trial = self.tools, state.proved, state.contest.best.trial
        problem = trial.task.problem

        def report(share: float, boxes: int, waiting: int) -> None:
            tools.report(Progress(claim.roa, claim.roa, boxes, waiting, share, None), "ranks")

        with tools.timing("ranks"):
            tools.tell("ranks")
            least = _FOR_RANKS * tools.whole
            share = effort.part(max(least, effort.left - least), even_if_over=True)
            if self.enough is not None:
                share = effort.share(_FOR_CELLS)
            told = None if tools.progress is None else report
            target = Sublevel(problem.V, claim.roa)
            root = lo, hi = root_box(problem.loop)
            probes = np.random.default_rng(0).uniform(lo, hi, (_PROBES, len(lo))).T
            question = Question(problem.loop, target, claim.keep, root, evidence.order)
            ring, most = evidence.tree.count(LEAF), _FOR_RING * tools.whole
            little = _LITTLE * _BOXES ** (-1 / len(lo))
            longer = with_order(question, probes, share, little, ring, most)
            if longer.order == evidence.order or are_shown(problem, evidence, claim, longer.order):
                question = longer
            question = with_frame(question, probes, share)
            promising = partial(Simulator(problem.loop, problem.V, claim.roa).converge, effort=share)
            found = prove_ranks(question, share, tools.runner, told, enough=self.enough, promising=promising)
        if found is None:
            return state.noting("no box of the domain beyond the set is proved to lead into it")
        return replace(
            state,
            ranked=found,
            claim=replace(claim, ranks=found.ranks),
            evidence=replace(evidence, ranks=found.evidence, order=question.order),
        )
