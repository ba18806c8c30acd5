"""The last stages: have the certificate accepted by the checker, state the verdict, and ask a solver as well."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from certify.analysis.acceptance import Accepted, Clerk, Desk
from certify.analysis.beyond import constraints_in_words, outer_facts, rank_facts, short_of
from certify.analysis.outcome import limited, short_of_target, with_levels
from certify.analysis.results import RoaResult
from certify.analysis.stages.state import State, Tools
from certify.certificates import Certificate, TrustedSolver
from certify.certificates.claims import Claim, Problem
from certify.certificates.drawn import nonlinearity_of
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.errors import BackendError, SoundnessError
from certify.loop.closed_loop import ClosedLoop

_CHECK = 2.0  # the checker's work for a leaf, relative to the operations that bound a box


def operations_of_check(loop: ClosedLoop) -> float:
    """Operations of the check of a leaf, about, as an `Effort` counts them."""
    from certify.provers.boxes.rule import operations_of_box

    return _CHECK * operations_of_box(loop)


@dataclass(frozen=True)
class Acceptance:
    """The stage that gives the verdict: PROVED only for bytes that the checker has accepted."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Have the certificate accepted, and state the verdict.

        Raises
        ------
        SoundnessError : the checker rejects what was proved, and no smaller set mends it.
        """
        problem = state.contest.best.trial.task.problem
        system, network = state.loop.system, state.loop.network
        parts = system, network, problem.V, state.claim, state.evidence, self.tools.provenance, state.data
        certificate = Certificate(*parts)  # type: ignore[arg-type]
        clerk = _Desk(state, self.tools).clerk()
        accepted = clerk.accepted(certificate, problem)
        state = replace(state, accepted=accepted).noting(accepted.mended)
        return _concluded(_with_facts(state, accepted), accepted)


@dataclass(frozen=True)
class _Desk:
    """The desk of a run, where certificates are written and checked."""

    state: State
    tools: Tools

    def clerk(self) -> Clerk:
        tools, claim = self.tools, self.state.claim
        ranked = claim is not None and claim.ranks is not None
        return Clerk(
            tools.out / "certificate.json",
            tools.timing,
            partial(tools.tell, "check"),
            tools.show,
            Desk(self.state.options.jobs, ranked).checked,
            self.state.options.cluster,
        )


def _with_facts(state: State, accepted: Accepted) -> State:
    """Add to the result the facts of the accepted claim beside its levels."""
    claim, problem, result = accepted.certificate.claim, state.contest.best.trial.task.problem, state.result
    if claim.kind != state.kind:
        result = replace(result, claim=claim.kind)
    if claim.start is None:
        result = replace(result, tube=None)
    constraints = constraints_in_words(accepted.certificate)
    result = replace(result, nonlinearity=nonlinearity_of(accepted.certificate))
    result = replace(result, ranks=rank_facts(accepted.certificate, state.ranked), constraints=constraints)
    if state.beyond is not None:
        if claim.outer is not None:
            result = replace(result, outer=outer_facts(problem, claim, claim.outer, state.beyond))
        else:
            state = state.noting("the checker refused the set beyond the ellipsoid, which is left out")
    return replace(state, result=result)


def _concluded(state: State, accepted: Accepted) -> State:
    """State the verdict: UNKNOWN if the accepted claim is less than was asked for."""
    from certify.analysis.stages.further import holds, named

    trial, options, result = state.contest.best.trial, state.options, state.result
    task, claim, proof = trial.task, accepted.certificate.claim, state.proof
    leaves = 0 if proof is None else proof.leaves
    found = _with_certificate(result, accepted, leaves)
    if options.lyapunov_level is not None and (claim.outer is None or claim.outer.level < options.lyapunov_level):
        why = short_of(task.problem, claim, options, state.beyond)
        return state.finished(replace(found, stop=Stop.BEYOND, detail=why))
    if state.begin is not None and claim.start is None:
        if not holds(task.problem, claim.roa, state.begin):
            tube = state.claim is not None and state.claim.start is not None
            why = (accepted.mended or "the checker refused the tube") if tube else state.missed
            return state.finished(replace(found, stop=Stop.PATH, detail=why))
        if state.claim is None or state.claim.start is None:
            state = state.noting(f"{named(state.begin)} lies in the proved set, and no tube is needed")
    if task.exactly and claim.roa < task.target:
        refused = replace(result, stop=Stop.REFUSED, detail=accepted.mended or "")
        return state.finished(short_of_target(refused, task, claim))
    lowered = state.claim is not None and claim.roa < state.claim.roa
    trusted = isinstance(accepted.certificate.evidence, TrustedSolver)
    found = replace(found, stop=Stop.REFUSED) if lowered else limited(found, task)
    return replace(state, result=replace(found, verdict=Verdict.TRUSTED if trusted else Verdict.PROVED))


def _with_certificate(result: RoaResult, accepted: Accepted, leaves: int) -> RoaResult:
    """The result with what the checker accepted, and its answer about these very bytes."""
    stated = with_levels(result, accepted.certificate.claim.levels, result.witness)
    return replace(stated, leaves=leaves, certificate=accepted.path, raw=accepted.data, checker=accepted.answer)


@dataclass(frozen=True)
class Confirmation:
    """The stage that asks dReal about every condition that the bounds engine has proved."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Add dReal's answers.

        Raises
        ------
        SoundnessError : dReal points at a genuine violation of what was proved and checked.
        """
        if state.accepted is None or isinstance(state.accepted.certificate.evidence, TrustedSolver):
            return state
        problem, claim = state.contest.best.trial.task.problem, state.accepted.certificate.claim
        return state.with_result(solver=self._asked(state, problem, claim, effort))

    def _asked(self, state: State, problem: Problem, claim: Claim, effort: Effort) -> dict[str, Any]:
        from certify.provers.dreal.backend import find_backend
        from certify.provers.dreal.proof import DrealOptions, confirm_with_dreal, record_of

        try:
            backend = find_backend()
        except BackendError as error:
            return {"solver": "dreal", "missing": str(error)}
        options = state.options
        allowed = DrealOptions(options.dreal_precision, options.jobs or 1, self.tools.whole / UNIT)
        asked, witness = confirm_with_dreal(problem, claim, backend, allowed)
        if witness is not None:
            path = self.tools.out / "contradiction.json"
            stated = {"x": [v.hex() for v in witness.x.tolist()], "kind": witness.kind, "V": witness.level}
            path.write_text(json.dumps({"witness": stated, "certificate": "certificate.json"}) + "\n", encoding="utf-8")
            raise SoundnessError(f"dReal and Arb contradict a checked certificate; {path} has the witness.")
        return record_of(backend.version, allowed, asked)
