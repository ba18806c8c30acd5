"""`certify_roa`: the pipeline of stages for every claim and engine.

Nothing is PROVED before the checker, run as a process of its own, has accepted the very bytes that were written.
Whatever the checker refuses, the run ends with what it accepts: a refused leaf is split again, or the level lowered.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from certify.analysis.diagnosis import diagnose
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.saved_search import Keeper
from certify.analysis.stages.acceptance import Acceptance, Confirmation
from certify.analysis.stages.candidate import Candidate
from certify.analysis.stages.further import Beyond, ByRanks, Equilibrium, Route, Tube
from certify.analysis.stages.ring import Ring
from certify.analysis.stages.setting import Setting, setting_of
from certify.analysis.stages.simulation import Onwards, Simulation, goes_on
from certify.analysis.stages.state import Report, Stage, State, Tools, effort_of
from certify.certificates import PartitionTree, earlier_aside, sole_writer
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.errors import InputError, SoundnessError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.composition import composed
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.provers.execution import runner_at

__all__ = ["Report", "RoaOptions", "RoaResult", "certify_roa"]
# Shares of the effort for candidates and ring, where more is to come:
_BEFORE_TUBE, _BEFORE_OUTER = 0.5, 0.25
_BEFORE_MORE = 0.5  # the same of candidates alone, where each heat is a whole proof,
_A_PROOF = 5 * UNIT  # but so many operations, if there are as many: a proof at all comes first


def certify_roa(
    system: System,
    network: PolicyNetwork,
    out: Path,
    options: RoaOptions | None = None,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
    show: Callable[[bytes], None] | None = None,
    effort: Effort | None = None,
    keep: bool = True,
    tell: Callable[[str], None] | None = None,
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
    effort : counted work of the run; by default that of the options.
    keep : False if the folder does not outlive the caller, so that no search is kept for `--resume`.
    tell : told where an earlier run's certificate is kept, if this run ends without one.

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
    system, network = composed(system, network)
    begin = setting_of(ClosedLoop(system, network), options)
    aside = earlier_aside(out, tell or (lambda _: None), keep=options.resume)
    with one_thread(), sole_writer(out), aside, runner_at(options.cluster) as runner:
        can_keep, named = keep and options.engine == "bounds", options.P is not None or options.only is not None
        tools = Tools(
            out,
            runner,
            effort or effort_of(options.effort, options.time_limit, load_seconds),
            Keeper(out, can_keep, named),
            provenance or {},
            progress,
            show or (lambda _: None),
            load_seconds,
        )
        return _result(begin, tools)


def _result(state: State, tools: Tools) -> RoaResult:
    """Run the stages; a search that is stopped before its end is kept."""
    asked = state.loop.system, state.loop.network
    try:
        state = _through(state, tools)
    except (InputError, SoundnessError):
        raise
    except BaseException:  # Ctrl-C, a reader that has gone, a checker that cannot run: --resume continues from here
        tools.keeper.keep()
        raise
    state = _of_consistent_plants(state)
    result, first = state.result, tools.keeper.first
    gained = first is not None and first.attempt.gained
    cut = result.stop.ran_out or result.stop is Stop.CLUSTER or (result.stop is Stop.BOXES and gained)
    if tools.keeper.gains and cut:
        tools.keeper.keep()
    else:
        tools.keeper.drop()
    said = *state.notes, result.notice, tools.runner.remark, *tools.remarks
    notices = dict.fromkeys(text for text in said if text is not None)
    search = tools.keeper.path
    result = replace(result, seconds=tools.timings(), notice="; ".join(notices) or None)
    result = replace(result, search=search if search.exists() else None)
    return replace(result, diagnosis=diagnose(result, state.options, state.proof, asked, tools.effort))


def _of_consistent_plants(state: State) -> State:
    """The state without a refutation by parameters with which the measurements need not be consistent."""
    result = state.result
    if state.data is None or result.verdict is not Verdict.REFUTED or result.stop is Stop.DOMAIN:
        return state
    return state.with_result(verdict=Verdict.UNKNOWN).noting(
        "a condition fails for parameters in the ranges, with which the data need not be consistent: nothing is refuted"
    )


def _through(state: State, tools: Tools) -> State:
    """Through the setting, the search, and the stages that the claim asks for."""
    state = Setting(tools).extend(state, tools.effort)
    options = state.options
    if goes_on(state):
        whole_proofs = not (state.interruptible or state.loop.system.in_steps)
        half = max(_BEFORE_MORE * tools.effort.left, _A_PROOF)
        search = tools.effort.part(half) if whole_proofs else tools.effort
        state = _extended(state, [Candidate(tools)], search)
        return _extended(state, [Onwards(tools), Acceptance(tools), Simulation(tools)], tools.effort)
    share = _BEFORE_TUBE if options.enlarges else _BEFORE_OUTER if options.goes_beyond else 1.0
    search = tools.effort.share(share)
    state = _extended(state, [Candidate(tools), Ring(tools)], search)
    return _extended(state, _stages_after(state, tools), tools.effort)


def _extended(state: State, stages: Sequence[Stage], effort: Effort) -> State:
    """The state after these stages, or as many of them as come before its end."""
    for stage in stages:
        state = state if state.done else stage.extend(state, effort)
    return state


def _stages_after(state: State, tools: Tools) -> list[Stage]:
    """The stages that follow the search, by the claim and what is asked for beside it."""
    options, stages = state.options, list[Stage]()
    if isinstance(state.evidence, PartitionTree):  # nothing can be added to a solver's word
        if options.enlarges:
            stages.append(Tube(tools) if state.begin is None else Route(tools))
        if state.converging:
            stages.append(Equilibrium(tools))
        if options.goes_beyond:
            stages.append(Beyond(tools))
        if options.ranks:
            stages.append(ByRanks(tools))
    stages.append(Acceptance(tools))
    if options.engine == "both":
        stages.append(Confirmation(tools))
    return [*stages, Simulation(tools)]
