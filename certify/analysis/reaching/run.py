"""`certify_reach`: simulate, refute what can be refuted, prove ranks, and have them accepted.

Nothing is PROVED before the checker, run as a process of its own, has accepted the very bytes that were written.
"""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.acceptance import Clerk
from certify.analysis.beyond import constraints_in_words, rank_facts
from certify.analysis.reaching.following import with_following, without_boxes
from certify.analysis.reaching.goals import Goal, Stated, goal_of, leaves_of, with_ranks
from certify.analysis.reaching.never import Search
from certify.analysis.reaching.options import ReachOptions
from certify.analysis.reaching.results import ReachResult
from certify.analysis.reaching.runs import Simulation, begins, is_nominal, is_refuted
from certify.analysis.stages.state import Report, effort_of
from certify.analysis.without_v import Tools, accepted, require_periodic
from certify.certificates import (
    RankTree,
    earlier_aside,
    require_within_limits,
    sole_writer,
)
from certify.certificates.claims import UNPROVED, Ranks
from certify.certificates.ellipsoids import Box
from certify.certificates.ranked import Ranked, steps_from
from certify.certificates.tree import leaves_within
from certify.certificates.verdict import Verdict
from certify.effort import Effort
from certify.errors import OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.composition import composed
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import ball, evaluate_arb
from certify.provers.base import Progress
from certify.provers.execution import Runner, runner_at
from certify.provers.ranks import (
    MOST_STEPS,
    Question,
    RankProof,
    Wanted,
    affordable,
    prove_ranks,
    root_box,
    with_errors,
    without_leaf,
)

Array = NDArray[np.float64]
_PROBES = 30  # states at which the order of the series in time is chosen, and the frame of errors
_RUNS = 1e10  # operations for simulated runs, a few seconds, which no effort is charged with
_FOR_SEARCH = 0.7  # share of the effort, the rest being for the check
_DIRECT = 4000  # boxes that are looked at first where runs need few steps
_SLOW, _DOUBT = 200, 1e-9  # runs from what is not proved; of the box's volume
_PARTS = np.array([1.0, 3.0, 9.0])  # of a box in each direction, on which ways to bound errors are tried
_NARROW, _PLACES = np.array([2.0**9, 2.0**18]), 24  # the same elsewhere in it
_MENDED = 20  # leaves that the checker may refuse


def certify_reach(
    system: System,
    network: PolicyNetwork,
    out: Path,
    options: ReachOptions,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
    tell: Callable[[str], None] | None = None,
) -> ReachResult:
    """Prove from which boxes of a plant's domain every trajectory reaches a region, or the set of a certificate.

    Parameters
    ----------
    system, network : the closed loop, in discrete time or with a held input.
    out : folder for `certificate.json`; it is made if it is not there.
    load_seconds : time already spent on reading, for the report.
    provenance : entries for the certificate that the checker ignores.
    progress : called with the stage and where it stands.
    tell : told where an earlier run's certificate is kept, if this run ends without one.

    Raises
    ------
    InputError : the closed loop or an option cannot be used, `out` cannot be written or is another run's, or the
        checker does not accept the certificate whose set is the target.
    SoundnessError : the checker rejects what was proved.
    BackendError : the same with a cluster, or no scheduler answers.
    """
    from certify.provers.execution.threads import one_thread

    start, tools = time.perf_counter(), Tools(progress)
    system, network = composed(system, network)
    loop = ClosedLoop(system, network)
    require_within_limits(system, network)
    if not system.in_steps:
        raise OptionError(
            "`target` needs a loop whose time goes in steps: discrete time, or an input that is held (`sample_time`)."
        )
    path = out / "certificate.json"
    if options.certificate is not None and options.certificate.resolve() == path.resolve():
        raise OptionError(f"`target` must lie in another folder than `out`, which gets such a file too; found {path}.")
    with tools.timing("target"):
        goal = goal_of(loop, options.target, options.certificate)
    options = _seen_from(goal, options)
    _require_inside(goal.loop.system, options)
    effort = effort_of(options.effort, options.time_limit, load_seconds)
    with one_thread(), sole_writer(out), earlier_aside(out, tell or (lambda _: None)):
        result = ReachResult(Verdict.UNKNOWN, "", goal.loop.system, goal.loop.network, options, given=goal.given)
        with tools.timing("target"):
            _require_periodic(goal, tools.clerk(path, options.jobs, False, options.cluster))
            _require_met(goal)
        result = _simulated(result, goal, tools)
        if not result.reason:
            result = _proved(result, goal, effort, tools, path, provenance or {})
    seconds = {"load": load_seconds, **tools.seconds, "total": load_seconds + time.perf_counter() - start}
    return replace(result, seconds=seconds, notice=tools.notice(system))


def _seen_from(goal: Goal, options: ReachOptions) -> ReachOptions:
    """The options with the box in deviations from where the goal's loop has its origin."""
    network = goal.loop.network
    if options.begin is None or not network.is_moved:
        return options
    each = zip(options.begin, map(Fraction, network.origin.tolist()), strict=True)
    return replace(options, begin=tuple((lo - q, hi - q) for (lo, hi), q in each))


def _require_inside(system: System, options: ReachOptions) -> None:
    """Refuse a box that does not lie in the interior of the domain.

    Raises
    ------
    OptionError : it does not, in some state.
    """
    each = zip(system.states, options.begin or (), system.domain, system.exact_x_eq(), strict=options.begin is not None)
    for s, (lo, hi), (least, most), q in each:
        if s.name not in system.angles and not least < lo <= hi < most:
            raise OptionError(
                f"`reach_from` must lie in the interior of the domain, {s.name} between {float(least + q):g} and "
                f"{float(most + q):g}; found {float(lo + q):g}..{float(hi + q):g}. --domain widens it."
            )


def _require_met(goal: Goal) -> None:
    """Refuse a region that has no state of the domain, as bounds of its expressions there show.

    Raises
    ------
    OptionError : it has none.
    """
    loop = goal.loop
    lo, hi = (list(map(Fraction, corner.tolist())) for corner in root_box(loop))
    places = {s: ball(a).union(ball(b)) for s, a, b in zip(loop.system.states, lo, hi, strict=True)}
    if any(bool(evaluate_arb(t, places) > 0) for t in goal.expressions):
        raise OptionError(
            "`target` must have states of the domain, beyond which nothing is followed; nowhere in it do all of its "
            "comparisons hold. `domain` widens it."
        )


def _require_periodic(goal: Goal, clerk: Clerk) -> None:
    """Refuse a question that is not about places, whatever its answer would be: a target that counts turns."""
    system, question = goal.loop.system, goal.bare_question()
    angles = system.angles if goal.given is None else tuple(system.states[i].name for i in goal.turned)
    require_periodic(system, angles, question.root, partial(goal.certificate, question, provenance={}), clerk)


def _simulated(result: ReachResult, goal: Goal, tools: Tools) -> ReachResult:
    """The result with simulated runs from the box; final if one of them does not get there."""
    options = result.options
    if options.begin is None:
        return result
    with tools.timing("simulate"):
        simulation = Simulation(goal.loop, goal.expressions, options.begin, goal.turned)
        runs = simulation.runs(options.within, Effort(_RUNS))
        if runs.longest is None and runs.failing is None:  # they take long
            runs = simulation.runs(options.within, Effort(_RUNS), begins(options.begin)[:1])
    result = replace(result, runs=runs)
    if runs.failing is None:
        return result
    with tools.timing("refute"):
        refuted = not goal.turned and is_refuted(goal.loop, goal.expressions, runs.failing, options.within)
    told = result.told(runs.failing)
    if refuted:
        return replace(result, verdict=Verdict.REFUTED, reason=f"{told}, shown in Arb")
    result = replace(result, reason=f"in a simulation, {told}")
    late = np.array([[float(q) for q in runs.failing.x]])
    return _never(result, goal, late, tools) if runs.failing.end == "late" else result


def _never(result: ReachResult, goal: Goal, near: Array, tools: Tools) -> ReachResult:
    """REFUTED, if a start of the box is shown never to arrive; it is looked for near states (N, n) above all."""
    begin, system = result.options.begin, goal.loop.system
    if begin is None or goal.turned or not is_nominal(system):
        return result
    simulation = Simulation(goal.loop, goal.expressions, begin)
    with tools.timing("refute"):
        states = np.concatenate([near, begins(begin)])
        stay = Search(goal.loop, goal.expressions, begin, simulation, Effort(_RUNS)).found(states)
    if stay is None:
        return result
    reason = f"{result.reason}; {result.told_of(stay)}"
    return replace(result, verdict=Verdict.REFUTED, stay=stay, reason=reason, following=None)


def _proved(
    result: ReachResult,
    goal: Goal,
    effort: Effort,
    tools: Tools,
    path: Path,
    provenance: Mapping[str, Any],
) -> ReachResult:
    """The result of the search, and of the check of what it finds."""
    options, system = result.options, goal.loop.system
    whole = tuple(zip(*map(_exactly, root_box(goal.loop)), strict=True))
    arrivals = () if result.runs is None else result.runs.arrivals
    clerk = tools.clerk(path, options.jobs, True, options.cluster)
    search = effort.share(_FOR_SEARCH)
    question = goal.question(begins(options.begin or whole)[:_PROBES].T, search, clerk.tried)
    if options.begin is not None:
        with tools.timing("ranks"):
            most = min(max(arrivals, default=0) or MOST_STEPS, affordable(question, search))
            lo, hi, weights = _parts(options.begin)
            question = with_errors(question, lo, hi, most, search, weights)
    with tools.timing("ranks"), runner_at(options.cluster) as runner:
        found = _searched(question, options, arrivals, search, runner, tools)
    evidence = None if found is None else _within(found.evidence, options.within)
    if found is None or evidence is None:
        why = ": the effort is over" if search.over else ""
        result = replace(result, reason=f"no box of the domain is proved to lead into the target{why}")
        result = with_following(result, effort) if search.over else without_boxes(result)
        return _never(result, goal, begins(options.begin or whole)[:1], tools)
    ranks = Ranks(found.ranks.angles, max(1, evidence.most))
    certificate = goal.certificate(question, evidence, ranks, provenance)
    certificate, raw, answer = accepted(certificate, clerk, _without_leaf, _MENDED)
    facts, kept = rank_facts(certificate, found), constraints_in_words(certificate)
    result = replace(result, ranks=facts, boxes=found.boxes, constraints=kept)
    result = replace(result, certificate=path, raw=raw, checker=answer)
    further = result if found.done or found.full else with_following(result, effort)
    if options.begin is None:
        return replace(further, verdict=Verdict.PROVED, reason="effort" if effort.over or not found.done else "done")
    turned = tuple(i for i, s in enumerate(system.states) if s.name in found.ranks.angles)
    steps = steps_from(Ranked(leaves_of(certificate), goal.ellipsoid, turned), options.begin)
    if steps is None:
        many = "images meet too many boxes for more effort to help"
        over = many if found.full else "the effort is over"
        why = over if not found.done else "no leaf is left whose halves could gain anything"
        part, states = _part(result, goal, leaves_of(certificate))
        return _never(replace(further, reason=f"{part}: {why}"), goal, states, tools)
    return replace(result, verdict=Verdict.PROVED, reason="requested", steps=steps)


def _searched(
    question: Question, options: ReachOptions, arrivals: tuple[int, ...], effort: Effort, runner: Runner, tools: Tools
) -> RankProof | None:
    """Leaves from which the region is reached: those that the box needs, or else all that the effort finds. Where
    simulated runs arrive after few steps, there is hope that images of parts of the box lie in it."""

    def report(share: float, boxes: int, waiting: int) -> None:
        tools.tell("ranks", Progress(0.0, 0.0, boxes, waiting, share, effort.left))

    wanted = None
    if options.begin is not None:
        lo, hi = (np.array([float(pair[k]) for pair in options.begin]) for k in (0, 1))
        most = UNPROVED - 1 if options.within is None else options.within
        direct = _DIRECT if 0 < min(filter(None, arrivals), default=0) <= MOST_STEPS else 0
        wanted = Wanted(np.nextafter(lo, -np.inf), np.nextafter(hi, np.inf), most, direct, arrivals)
    found = prove_ranks(question, effort, runner, report, wanted)
    if runner.remark is not None:
        tools.remarks.append(runner.remark)
    return found


def _parts(box: Box) -> tuple[Array, Array, Array]:
    """Corners (n, B) of a box, of smaller ones in its middle and of narrow ones anywhere, and weights that make each of
    these two kinds as important as the other."""
    lo, hi = (np.array([float(pair[k]) for pair in box])[:, None] for k in (0, 1))
    at = np.random.default_rng(0).uniform(0.01, 0.99, (len(lo), _PLACES)).repeat(len(_NARROW), 1)
    middle = np.hstack([(0.5 * (lo + hi)).repeat(len(_PARTS), 1), lo + at * (hi - lo)])
    reach = 0.5 * (hi - lo) / np.append(_PARTS, np.tile(_NARROW, _PLACES))
    return middle - reach, middle + reach, np.repeat((at.shape[1], len(_PARTS)), (len(_PARTS), at.shape[1]))


def _exactly(corner: Array) -> list[Fraction]:
    return [Fraction(v) for v in corner.tolist()]


def _within(evidence: RankTree, most: int | None) -> RankTree | None:
    """The evidence without leaves of higher ranks than that; None if none is left."""
    if most is not None:
        evidence = evidence.without(evidence.ranks > most)
    return evidence if np.any(evidence.proved) else None


def _part(result: ReachResult, goal: Goal, tree: RankTree) -> tuple[str, Array]:
    """The part of the box that is proved, in words; and where the rest lies, and how long runs from there take. Some
    states of the rest, (N, n)."""
    begin = result.options.begin or ()
    least, most = (np.array([float(pair[k]) for pair in begin]) for k in (0, 1))
    lower, upper = leaves_within(tree.tree, tree.lo, tree.hi)
    lower, upper = np.maximum(lower, least), np.minimum(upper, most)
    wide = most > least
    met = np.all(upper >= lower, axis=1)
    sizes = np.where(met, np.prod((upper - lower)[:, wide] / (most - least)[wide], axis=1), 0.0)
    rest = ~tree.proved & (sizes > 0)
    percent = math.floor(1e4 * (1 - math.fsum(sizes[rest]))) / 100
    twice = abs(math.fsum(sizes) - 1) > _DOUBT  # angles, and leaves that meet at the box
    if twice or percent <= 0 or not np.any(rest):
        return "of the box only a part is proved, or none", begins(begin)[:1]
    largest = np.flatnonzero(rest)[np.argsort(-sizes[rest])][:_SLOW]
    states = 0.5 * lower[largest] + 0.5 * upper[largest]
    runs = Simulation(goal.loop, goal.expressions, begin, goal.turned).runs(None, Effort(_RUNS), states)
    slowest = "do not all get there" if runs.failing is not None else f"take up to {runs.longest:,} steps"
    values = result.values([Fraction(v) for v in states[0].tolist()])
    where = ", ".join(f"{name} = {float(q):.6g}" for name, q in values.items())
    return f"{percent:g} % of the box is proved; of the rest, with a part around {where}, runs {slowest}", states


def _without_leaf(certificate: Stated, at: str) -> Stated | None:
    """The certificate without the rank of the leaf that the checker refuses, and of those that need it."""
    refused = re.fullmatch(r"rank leaf (\d+)", at)
    lower = None if refused is None else without_leaf(leaves_of(certificate), int(refused[1]))
    if lower is None or certificate.claim.ranks is None:
        return None
    return with_ranks(certificate, Ranks(certificate.claim.ranks.angles, max(1, lower.most)), lower)
