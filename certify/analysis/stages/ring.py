"""The proof of the best candidate: a ring that grows for as long as there is effort."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from certify.analysis.outcome import (
    is_refuted,
    lowest_witness,
    result_about,
    short_of_target,
    tried_row,
    with_levels,
    with_witness,
)
from certify.analysis.results import RoaResult
from certify.analysis.selection import Contender
from certify.analysis.stages.acceptance import operations_of_check
from certify.analysis.stages.state import State, Tools
from certify.certificates.verdict import Stop
from certify.effort import UNIT, Effort
from certify.provers.base import Budget, Progress, Proof

_PATIENCE = 0.1  # share of the whole for a ring that gains nothing
_SAVING = 60.0  # seconds between two savings of a search
_MUCH = 0.1  # share of the whole: if more was kept for the check, a notice says so
_CAUTION = 1.5  # on the check, where a limit on the clock must hold on a machine of unknown pace
_YEAR = 3.156e7  # seconds


@dataclass(frozen=True)
class Ring:
    """The stage that gives the rest of the search to the best contender, less what the check of its proof will take."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Grow the ring of the best candidate and take over its claim; end the run if it makes none."""
        race, tools = state.contest, self.tools
        check = operations_of_check(state.loop) * (1.0 if state.options.time_limit is None else _CAUTION)
        if race.open:
            tools.keeper.winner = race.open[0]
            self._grow(state, race.open[0], effort, check)
        best = race.best
        for stage in ("local", "ring"):
            tools.seconds[stage] = sum(c.attempt.seconds.get(stage, 0.0) for c in race.contenders)
        proof = best.attempt.proof()
        result = _described(state, best, proof)
        kept = check * proof.leaves / tools.whole
        if proof.stop.ran_out and best is tools.keeper.winner and kept > _MUCH:
            result = replace(result, detail=f"about {kept:.0%} of it was kept for the check")
        if proof.stop.ran_out and proof.claim is not None and best.hopeless:
            result = _stalled(result, best, proof, state)
        state = replace(state, proof=proof, claim=proof.claim, evidence=proof.evidence)
        return _short(replace(state, result=result), best, proof)

    def _grow(self, state: State, winner: Contender, effort: Effort, check: float) -> None:
        boxes, attempt = state.options.max_boxes, winner.attempt

        def is_on() -> bool:
            lost = state.options.cluster is not None and attempt.proof().stop is Stop.CLUSTER
            return not (attempt.done or lost or effort.over) and attempt.boxes < boxes

        while is_on() and not (attempt.gained or winner.hopeless):
            winner.advance(Budget(effort.part(_PATIENCE * self.tools.whole), boxes), self._keeping())
        if state.interruptible and is_on() and attempt.gained:
            winner.advance(Budget(effort, boxes, check=check), self._keeping())

    def _keeping(self) -> Callable[[Progress], None]:
        """A report that saves the search now and then."""
        last = time.monotonic()

        def report(progress: Progress) -> None:
            nonlocal last
            if time.monotonic() - last > _SAVING:
                self.tools.keeper.keep()
                last = time.monotonic()
            self.tools.report(progress)

        return report


def _described(state: State, best: Contender, proof: Proof) -> RoaResult:
    """The result with the candidate, all that were tried, and what stopped the proof."""
    contenders, witness = state.contest.contenders, lowest_witness(best.trial.task.witness, proof.witness)
    result = replace(result_about(state.result, best.trial), tried=tuple(tried_row(c, best) for c in contenders))
    return replace(
        with_levels(result, proof.partial, witness),
        stop=proof.stop,
        detail=proof.detail,
        witness=witness,
        boxes=sum(c.attempt.boxes for c in contenders),
        solver=proof.solver,
    )


def _stalled(result: RoaResult, best: Contender, proof: Proof, state: State) -> RoaResult:
    """The result of a search that no effort would bring further than the local level."""
    from certify.provers.boxes.rule import operations_of_box

    years = best.attempt.expected * operations_of_box(state.loop) / UNIT / _YEAR
    needed = f"about {best.attempt.expected:.0e} are needed before anything is, {years:.0e} years of two cores"
    detail = f"{proof.boxes:,} boxes added nothing to the local level, and {needed}"
    return replace(result, stop=Stop.STALLED, detail=detail)


def _short(state: State, best: Contender, proof: Proof) -> State:
    """End the run if nothing is proved, or less than was asked for."""
    task, claim, witness = best.trial.task, proof.claim, state.result.witness
    if claim is not None and not (task.exactly and claim.roa < task.target):
        return state
    if task.exactly and is_refuted(task, witness):
        return state.finished(with_witness(state.result, task, witness))
    return state.finished(state.result if claim is None else short_of_target(state.result, task, claim))
