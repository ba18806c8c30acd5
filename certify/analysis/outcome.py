"""Results of a run: a candidate, its levels, a witness; and an exact test of whether the claim is refuted.

Results are put together from the engines' proofs; PROVED is not said here, but by the run once the checker has spoken.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import flint
import numpy as np

from certify.analysis.candidates.trials import Trial
from certify.analysis.facts import Levels, Tried
from certify.analysis.results import RoaResult
from certify.analysis.selection import Contender
from certify.certificates.claims import Claim
from certify.certificates.verdict import Stop, Verdict
from certify.loop.closed_loop import ClosedLoop
from certify.loop.rigorous import eigenvalues, in_digits, instability
from certify.lyapunov import leaves_domain, slowest_decay
from certify.provers.base import Task
from certify.provers.falsify import Witness, refutes

_ENDED = {
    Stop.EFFORT: "the effort ended",
    Stop.TIME: "the time ended",
    Stop.BOXES: "the limit on boxes ended the search",
    Stop.SMALL: "boxes became too small",
}
_CLOSE, _TOUCHING = 1e-2, 1e-6  # relative distances below the domain's limit: too little to gain, and a rounding
_BY_KIND = {"vdot": Stop.WITNESS, "input": Stop.INPUTS, "keep": Stop.KEEP}


def result_about(result: RoaResult, trial: Trial) -> RoaResult:
    """The result with the candidate that it is about."""
    levels = Levels(domain_limit=trial.limit)
    return replace(result, problem=trial.task.problem, candidate=trial.name, notice=trial.notice, levels=levels)


def tried_row(contender: Contender, best: Contender) -> Tried:
    """A candidate's row in the result."""
    trial = contender.trial
    return Tried(
        trial.name, trial.task.target, trial.limited_by, trial.volume, contender is best, contender.proved or None
    )


def by_spectrum(loop: ClosedLoop) -> tuple[Verdict, Stop, tuple[str, ...]] | None:
    """REFUTED or UNKNOWN with the eigenvalues, or None if the spectrum is rigorously stable."""
    enclosures = eigenvalues(loop)
    if enclosures is None:
        approximate = not_stable(loop)
        # Without any, nearly multiple eigenvalues: the local proof decides.
        return (Verdict.UNKNOWN, Stop.SPECTRUM, approximate) if approximate else None
    shown = tuple(map(in_digits, enclosures))
    signs = [instability(loop, v) for v in enclosures]
    if any(v > 0 for v in signs):
        return Verdict.REFUTED, Stop.UNSTABLE, shown
    if not all(v < 0 for v in signs):
        return Verdict.UNKNOWN, Stop.SPECTRUM, shown
    return None


def not_stable(loop: ClosedLoop) -> tuple[str, ...]:
    """The eigenvalues, in floats, of a loop for which no Lyapunov equation has a solution; none if one has."""
    L, h = loop.mean_rate(), loop.step
    if slowest_decay(L, h) > 0:
        return ()
    return tuple(in_digits(flint.acb(v.real, v.imag)) for v in np.linalg.eigvals(np.eye(len(L)) + h * L if h else L))


def refuted_at_once(result: RoaResult, trial: Trial) -> RoaResult | None:
    """REFUTED where the level that was asked for leaves the domain or holds a witness."""
    task, result = trial.task, result_about(result, trial)
    if not task.exactly:
        return None
    if leaves_domain(trial.P, task.target, result.system.domain):
        detail = f"{{V <= {task.target:g}}} leaves the domain, whose limit is {trial.limit:.12g}"
        return replace(result, verdict=Verdict.REFUTED, stop=Stop.DOMAIN, detail=detail)
    return with_witness(result, task, task.witness) if is_refuted(task, task.witness) else None


def is_refuted(task: Task, witness: Witness | None) -> bool:
    """True if a witness refutes the claim for the level that the task asks for, exactly."""
    if witness is None or (task.kind != "asymptotic" and witness.kind != "keep"):
        return False  # near the origin V need not fall under a practical claim
    return refutes(task.problem, witness, task.target)


def with_witness(result: RoaResult, task: Task, witness: Witness | None) -> RoaResult:
    """REFUTED by a witness; as it is without one."""
    if witness is None:
        return result
    detail = witness.describe(result.system, task.problem.rate)
    levels = replace(result.levels, sampled_limit=witness.level)
    return replace(result, verdict=Verdict.REFUTED, stop=Stop.WITNESS, detail=detail, witness=witness, levels=levels)


def with_levels(result: RoaResult, levels: Mapping[str, float], witness: Witness | None) -> RoaResult:
    """The result with these levels, and the lowest violation that was met."""
    sampled = None if witness is None else witness.level
    return replace(result, levels=replace(result.levels, sampled_limit=sampled, **levels))


def short_of_target(result: RoaResult, task: Task, claim: Claim) -> RoaResult:
    """UNKNOWN, because only a lower level than the one asked for is proved."""
    if claim.at_rest:
        result = replace(result, levels=replace(result.levels, local=claim.local))
    missed = f"proved only up to V <= {claim.roa:.12g}, not {task.target:g}"
    return replace(result, detail=f"{result.detail}; {missed}" if result.detail else missed)


def lowest_witness(*witnesses: Witness | None) -> Witness | None:
    """The one with the lowest level; None if there is none."""
    return min((w for w in witnesses if w is not None), key=lambda w: w.level, default=None)


def limited(result: RoaResult, task: Task) -> RoaResult:
    """The result of a proved level with its limit, from what stopped the proof.

    A search that ends a little below the domain's limit is limited by the domain: to go on would gain next to nothing.
    """
    stop, witness = result.stop, result.witness
    level, limit = result.levels.roa, result.levels.domain_limit
    if stop in (Stop.WITNESS, Stop.REQUESTED) and witness is not None and not (stop is Stop.REQUESTED and task.exactly):
        return replace(result, stop=_BY_KIND[witness.kind])
    if task.exactly or witness is not None:
        return result
    if stop is Stop.REQUESTED:
        return replace(result, stop=Stop.DOMAIN)
    short = 1.0 if not (level and limit) else 1 - level / limit
    if stop not in _ENDED or short > _CLOSE:
        return result
    by = "" if short <= _TOUCHING else f"{_ENDED[stop]} {100 * short:.2g} % below its limit"
    return replace(result, stop=Stop.DOMAIN, detail=by)
