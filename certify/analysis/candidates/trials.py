"""Candidates for V, each with what it could give at most: whether it is worth a proof, and which one first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from certify.analysis.candidates.economical import FEW_STATES, Forecast, economical_candidate
from certify.analysis.candidates.peak import peak_candidate
from certify.analysis.candidates.robust import robust_candidate
from certify.analysis.options import RoaOptions
from certify.certificates import require_short
from certify.certificates.claims import Problem
from certify.certificates.claims.claim import Kind
from certify.effort import UNLIMITED, Effort
from certify.errors import BackendError, InputError
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov import (
    SOLVED,
    choose_candidate,
    diagonalising_coordinates,
    domain_limit,
    increment_matrix,
    is_positive_definite,
    leaves_domain,
    optimise_repeatedly,
    solve_lyapunov,
    volume,
)
from certify.lyapunov.function import Quadratic
from certify.lyapunov.optimised import FIRM
from certify.provers.base import FEW, MANY, Task
from certify.provers.falsify import Witness, falsify, survey, touch

Array = NDArray[np.float64]
Ended = Literal["domain", "sampled"]
_BELOW = 1e-9  # relative distance from a limit that is itself out of reach (the domain's open condition)
_BELOW_WITNESS = 1e-3
_NEXT_TO = 1e-6  # share of a level: violations below it are next to the equilibrium
_SMALLEST = 1e-120  # the least level: squares of states and products of bounds must not underflow
_BLENDS = (0.05, 0.15, 0.3)
_BOXES_SUFFICE = 0.1  # share of a volume within reach
_MORE = 10.0  # boxes to be economical for, relative to those there are, from where a ball shows much: as much or more
OPTIMISING = 0.2  # share of the effort that the optimised candidate may take
SAMPLING = 0.25  # further share of that for sampling what a candidate could give
FOR_PEAK = 0.4  # share of the effort for a candidate that may be the only one
_SAMPLES, _MANY_SAMPLES = 4000, 20_000  # samples for one of many candidates and for the only one; a proof finds others


@dataclass(frozen=True, slots=True)
class Trial:
    """A candidate and what is asked for with it.

    Parameters
    ----------
    name : where P comes from.
    task : the problem, and the largest level within reach: below the domain's limit and the lowest violation found.
    T : (n, n), the coordinates x = T z of its proof.
    limit : the domain's limit of V.
    limited_by : what its reach ends at.
    volume : of the largest set within reach, of a practical claim in few states less its floor's; sampled, not proved.
    notice : why it is not the candidate that was asked for.
    """

    name: str
    task: Task
    T: Array
    limit: float
    limited_by: Ended
    volume: float
    notice: str | None = None

    @property
    def P(self) -> Array:
        """The matrix of V, (n, n)."""
        return self.task.problem.V.P

    @property
    def unit(self) -> Array:
        """P scaled so that the largest set within reach is {V <= 1}."""
        return self.P / self.task.target


def trial(
    loop: ClosedLoop,
    P: Array,
    name: str,
    options: RoaOptions,
    effort: Effort = UNLIMITED,
    notice: str | None = None,
) -> Trial:
    """Sample what V = x'Px could give, more coarsely once the effort is over.

    Raises
    ------
    InputError : P is not positive definite, too long for a certificate, or its levels are too small or too large.
    """
    n = loop.system.n
    if P.shape != (n, n) or not is_positive_definite(P):
        raise InputError(f"`P` must be a symmetric positive definite matrix of shape ({n}, {n}).")
    require_short(P)
    problem = Problem(loop, Quadratic(P), options.rate)
    T = diagonalising_coordinates(P, loop.mean_rate(), loop.step)
    limit = domain_limit(P, loop.system.domain)
    level = options.level or limit * (1 - _BELOW)
    if not _SMALLEST < level < 1 / _SMALLEST:
        raise InputError(
            f"levels of V must lie between {_SMALLEST:g} and {1 / _SMALLEST:g}; found {level:g}. Scale the states or P."
        )
    kind: Kind = "practical" if options.claim == "practical" else "asymptotic"
    task = Task(problem, kind, level, options.level is not None)
    if options.level is not None and leaves_domain(P, options.level, loop.system.domain):
        return Trial(name, task, T, limit, "domain", volume(P, limit), notice)
    if kind == "practical" and (met := touch(problem, T, level)) is not None:
        level = level if task.exactly else met.level * (1 - _BELOW_WITNESS)
        task = replace(task, target=level, witness=met)
    within: Ended = "domain" if task.witness is None else "sampled"
    if kind == "practical" and n > FEW:  # a ball decides, and no survey could
        return Trial(name, task, T, limit, within, volume(P, level), notice)
    if kind == "practical":
        bands = survey(problem, T, level, effort=effort)
        reach = bands[0].above if bands else 0.0
        worth = max((volume(P, band.above) - volume(P, band.floor) for band in bands), default=0.0)
        return Trial(name, task, T, limit, "sampled" if reach < level else within, worth, notice)
    witness = falsify(problem, T, level, _MANY_SAMPLES if _only_one(options) else _SAMPLES, 0, effort)
    below = level if witness is None or task.exactly else witness.level * (1 - _BELOW_WITNESS)
    task = Task(problem, kind, below, task.exactly, witness)
    return Trial(name, task, T, limit, "domain" if witness is None else "sampled", volume(P, below), notice)


def named(loop: ClosedLoop, options: RoaOptions, effort: Effort) -> Trial:
    """The one candidate that the options ask for."""
    name = options.only or "lyapunov"
    if options.P is not None:
        return trial(loop, options.P, "given", options, effort)
    if name == "peak":
        return trial(loop, peak_candidate(loop, _for_making(effort)), name, options, effort)
    if name == "robust":
        return trial(loop, robust_candidate(loop, _for_making(effort)), name, options, effort)
    chosen = choose_candidate(loop, name, options.Q, options.R, _for_making(effort))
    return trial(loop, chosen.P, chosen.name, options, effort, chosen.notice)


def _only_one(options: RoaOptions) -> bool:
    return options.only is not None or options.P is not None


def _for_making(effort: Effort) -> Effort:
    """The part of the effort for a candidate that its making may take; the rest is for sampling."""
    return effort.share(1 / (1 + SAMPLING))


def solutions(loop: ClosedLoop, options: RoaOptions) -> dict[str, Array]:
    """P of each candidate that solves a Lyapunov equation, (n, n); one that falls near the origin at the rate that is
    asked for.

    Raises
    ------
    InputError : a weight is not positive, or the linearisation is not stable.
    """
    return {name: _fast(loop, choose_candidate(loop, name, options.Q, options.R).P, options.rate) for name in SOLVED}


def _fast(loop: ClosedLoop, P: Array, rate: float) -> Array:
    """The solution of P's own Lyapunov equation with the rate as decay, if P falls more slowly and there is one."""
    A, h = loop.mean_rate(), loop.step
    D = increment_matrix(P, A, h)
    if not rate or is_positive_definite(-(D + 2 * rate * P)):
        return P
    try:
        return solve_lyapunov(A, -(D + D.T) / 2, h, rate)
    except InputError:
        return P


def solved(loop: ClosedLoop, found: Mapping[str, Array], options: RoaOptions, effort: Effort) -> list[Trial]:
    """Sample these `solutions`: one at least, and as many as the effort allows."""
    trials = list[Trial]()
    for name, P in found.items():
        if not trials or not effort.over:
            trials.append(trial(loop, P, name, options, effort))
    return trials


def optimised(loop: ClosedLoop, options: RoaOptions, effort: Effort) -> Trial | None:
    """The candidate of the largest sampled set, or None if it is not to be had.

    Under `practical` it is that of the loop whose policy is centred: near the origin no V decreases under this one, and
    away from it the two differ little. If an input is held, it is that of the loop whose input follows at once: a
    period is short, and Vdot cheap.
    """
    return _optimised(loop, "optimised", None, options, effort)


def firm(loop: ClosedLoop, options: RoaOptions, effort: Effort) -> Trial | None:
    """The optimised candidate of a large margin, or None if it is not to be had: where the corners of ranges take most
    of a small margin, boxes prove next to nothing of the largest sampled set, and most of one a little smaller."""
    return _optimised(loop, "firm", FIRM, options, effort)


def _optimised(
    loop: ClosedLoop, name: str, decays: tuple[float, ...] | None, options: RoaOptions, effort: Effort
) -> Trial | None:
    try:
        about = _at_rest(loop, options)
        about = about if loop.system.sample is None else replace(about, system=about.system.with_sample(None))
        chosen = choose_candidate(about, "optimised", options.Q, options.R, _for_making(effort), decays)
    except (BackendError, InputError):
        return None
    return trial(loop, chosen.P, name, options, effort) if chosen.notice is None else None


def robust(loop: ClosedLoop, options: RoaOptions, effort: Effort) -> Trial | None:
    """The candidate that the local rule likes best, or None if it is not to be had."""
    try:
        P = robust_candidate(_at_rest(loop, options), _for_making(effort))
        return trial(loop, P, "robust", options, effort)
    except (BackendError, InputError):
        return None


def economical(
    loop: ClosedLoop,
    found: Mapping[str, Array],
    boxes: float,
    options: RoaOptions,
    effort: Effort,
    largest: Trial | None = None,
) -> Trial | None:
    """The candidate that these boxes are forecast to prove most with, from `solutions` on, or None if they prove more
    than a small part of what is within the reach of the largest, or of the first of these."""
    first = largest or trial(loop, next(iter(found.values())), "", options, effort)
    level = first.task.target * _BOXES_SUFFICE ** (2 / loop.system.n)
    if Forecast(loop, effort, FEW_STATES).boxes(first.P, level) <= boxes:
        return None
    P = economical_candidate(loop, list(found.values()), boxes, effort)
    return trial(loop, P, "economical", options, effort)


def economical_from(
    loop: ClosedLoop, certain: Trial, others: Sequence[Trial], boxes: float, options: RoaOptions, effort: Effort
) -> Trial | None:
    """The candidate for these boxes from `certain` on, or None if they suffice for the largest of all these trials, or
    more is forecast to be proved with one of them."""
    forecast, given = Forecast(loop, effort, FEW_STATES), by_reach([certain, *others])
    if forecast.boxes(given[0].P, given[0].task.target) <= boxes:
        return None

    def promised(one: Trial) -> float:
        return min(one.volume, volume(one.P, forecast.level(one.P, boxes)))

    found = trial(loop, economical_candidate(loop, [certain.P], _MORE * boxes, effort), "economical", options, effort)
    return found if promised(found) > max(map(promised, given)) else None


def share_of_robust(loop: ClosedLoop) -> float:
    """Share of the effort that it may take to be made.

    In many states it is three times as much as for others: there no ring can make up for what is left out.
    """
    return OPTIMISING * (3 if loop.system.n > MANY else 1)


def peak(loop: ClosedLoop, options: RoaOptions, effort: Effort) -> Trial | None:
    """The candidate of a practical claim whose floor is small beside the set, or None if it is not to be had."""
    try:
        return trial(loop, peak_candidate(loop, _for_making(effort)), "peak", options, effort)
    except (BackendError, InputError):
        return None


def _at_rest(loop: ClosedLoop, options: RoaOptions) -> ClosedLoop:
    """A loop that rests at the origin: itself, or under a practical claim that whose policy is centred, in floats."""
    if options.claim != "practical" or loop.network.centre != "none":
        return loop
    return replace(loop, network=replace(loop.folded, centre="output"))


def corrected(
    loop: ClosedLoop,
    last: Trial,
    witnesses: Sequence[Witness],
    options: RoaOptions,
    effort: Effort,
    decays: tuple[float, ...] | None = None,
) -> Trial | None:
    """An optimised candidate once more, with violations that its samples had missed, or other margins than the usual
    ones; None if there is none larger, or if that of the loop whose input follows at once is none over a period."""
    known = np.array([w.x for w in witnesses]) if witnesses else None
    try:
        P = optimise_repeatedly(_at_rest(loop, options), last.P, _for_making(effort), known, decays)
    except (BackendError, InputError):
        return None
    return trial(loop, P, last.name, options, effort)


def blends(loop: ClosedLoop, large: Trial, provable: Trial, options: RoaOptions, effort: Effort) -> Iterator[Trial]:
    """Between a candidate whose set is large and one that is easier to prove, where what can be proved is largest."""
    for share in _BLENDS:
        if effort.over:
            return
        yield blend(loop, large, provable, share, options, effort)


def blend(
    loop: ClosedLoop, large: Trial, provable: Trial, share: float, options: RoaOptions, effort: Effort = UNLIMITED
) -> Trial:
    """The candidate that has this share of the one that is easier to prove."""
    P = (1 - share) * large.unit + share * provable.unit
    return trial(loop, (P + P.T) / 2, f"{large.name} with {share:.0%} of {provable.name}", options, effort)


def below_violations(trial: Trial, effort: Effort) -> Trial | None:
    """The candidate up to a level of the lowest violation that sampling finds but for those next to the equilibrium, of
    which V's own place is a rounding; None where there is no such level."""
    lowest = survey(trial.task.problem, trial.T, trial.task.target, effort=effort)[-1:]
    if not lowest or lowest[0].below > _NEXT_TO * lowest[0].top:
        return None
    task = replace(trial.task, target=lowest[0].above)
    return replace(trial, task=task, limited_by="sampled", volume=volume(trial.P, task.target))


def by_reach(trials: Sequence[Trial]) -> list[Trial]:
    """The largest volume within reach first."""
    return sorted(trials, key=lambda t: -t.volume)
