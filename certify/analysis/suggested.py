"""Next steps that simulated runs suggest, in few states: each is tried on the spot, and suggested only where it gains.

Runs are no proof. A step says what they found, and the command that follows from it proves what it can.
"""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import numpy as np

from certify.analysis.facts import Step
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.simulated import FEW, MOST, NEARLY_ALL, Simulator, simulated_region
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System
from certify.loop.policies import Centre, PolicyNetwork
from certify.lyapunov import domain_limit, slowest_decay, solve_lyapunov
from certify.lyapunov.function import Quadratic
from certify.provers.ranks import turning
from certify.report.limits import violated
from certify.report.words import quantity, symbol

WIDER = Fraction(3, 2)
"""Factor of the side of the domain that is tried."""
_WORTH = 1.1  # growth of the simulated region that is worth a word
_NEAR = 1e-3  # of the largest level in the domain: a run that comes so low has converged
_ROUNDING, _DOUBLE = Fraction(2) ** -23, Fraction(2) ** -50  # of a number: where a precision rounds it
_INSIDE = 0.9  # of a side of the domain: a state in it is well inside
_ENDED = ("effort", "boxes")  # limits of an outer set that more effort lifts
_TAUGHT = 1.0  # an effort below it ends the lessons of a function before they are over
_LOOK = 3 * UNIT  # operations for one look
_DIGITS = 2  # of the width of a side, in the ends of one that is suggested
_NARROWER = Fraction(1, 4)  # of a range of periods, with which boxes are tried next


def centring(system: System, network: PolicyNetwork) -> Centre | None:
    """A centring with which the loop rests at the origin, exactly; None if it has one, or none can be had."""
    if network.centre != "none":
        return None
    centres: tuple[Centre, ...] = ("preactivation", "output")
    for centre in centres:
        try:
            ClosedLoop(system, replace(network, centre=centre)).require_rest()
        except InputError:
            continue
        return centre
    return None


def by_centring(
    result: RoaResult, options: RoaOptions, asked: tuple[System, PolicyNetwork], effort: Effort
) -> Step | None:
    """The step of a policy that is not centred where centring gains: the stronger claim, of a loop that is stable and
    converges from as many states of the domain, or more of these."""
    system, network = asked
    centre = centring(system, network)
    proved = result.verdict is Verdict.PROVED
    weaker = result.claim == "practical" or not proved
    if centre is None or (system.n > FEW and not weaker) or _rests(ClosedLoop(system, network)):
        return None
    loop, more = ClosedLoop(system, replace(network, centre=centre)), ""
    L = loop.mean_rate()
    if not slowest_decay(L, loop.step) > 0:
        return None
    if system.n <= FEW:
        P = solve_lyapunov(L, np.eye(system.n), loop.step)
        there = _share(loop, Quadratic(P), _NEAR * domain_limit(P, system.domain), effort)
        here = _converging(result)
        if there is None or here is None or there < (1.0 if weaker else _WORTH) * here:
            return None
        more = f"; in simulation {there / here:.3g} times as many states converge" if here and there > here else ""
    why = "shifted so that pi(0) = u_eq the operating point is the equilibrium, and the stronger claim can be tried"
    stronger = (("--claim", "auto"),) if options.claim == "practical" else ()
    return Step((("--centre", centre), *stronger), why + more)


def _rests(loop: ClosedLoop) -> bool:
    """True if the loop rests at the operating point already."""
    try:
        loop.require_rest()
    except InputError:
        return False
    return True


def commands_too_much(system: System, network: PolicyNetwork) -> str | None:
    """Say which input is out of its bounds at the operating point already: likely the policy was read amiss."""
    fits = (network.n, network.m) == (system.n, system.m)  # who asks for the loop says what does not
    if not fits or not all(lo < 0 < hi for lo, hi in system.domain):  # or there is no operating point
        return None
    u = network(np.zeros((1, system.n)), system.exact_u_eq())[0]
    for one, value, (lo, hi) in zip(system.inputs, u.tolist(), system.input_bounds, strict=True):
        if not float(lo) <= value <= float(hi):
            return (
                f"at the operating point the policy commands {one.name} = {value:.6g}, outside of "
                f"{float(lo):g}..{float(hi):g}: see what it reads and commands, of another program's file --states, "
                "--observes, --normaliser, --action-scale and --squash, then the plant's bounds"
            )
    return None


def limited_outside(system: System, network: PolicyNetwork) -> str | None:
    """Say which input is clipped or squashed beyond its bound by a rounding, as float32's 0.4 is beyond 2/5, and how to
    mend it."""
    ends, how, least = network.clip, "clipped at", Fraction(0)
    if ends is None and network.squash == "tanh" and network.centre != "output":
        reach = np.abs(network.scale)
        ends, how, least = (network.offset - reach, network.offset + reach), "squashed to", _DOUBLE
    for one, bounds, *pair in zip(system.inputs, system.input_bounds, *(ends or ((), ())), strict=False):
        for sign, end, bound in zip((-1, 1), pair, bounds, strict=True):
            if least * abs(bound) < sign * (Fraction(float(end)) - bound) <= _ROUNDING * abs(bound):
                return (
                    f"{one.name} is {how} {float(end):.17g}, by a rounding beyond its bound {float(bound):g}, so "
                    f"that nothing can be proved where it saturates there: clip it at {_bounds(system)} (--clip, where "
                    "the file of another program is read), or widen the bound a little"
                )
    return None


def _bounds(system: System) -> str:
    return ",".join(f"{float(least):g}..{float(most):g}" for least, most in system.input_bounds)


def by_clipping(result: RoaResult, asked: tuple[System, PolicyNetwork]) -> Step | None:
    """The step of a policy that asks for more than the actuator gives, where one that is clipped at the input bounds
    was simulated."""
    system, network = asked
    free, simulated = network.clip is None and network.squash == "identity", result.simulated
    if result.stop is not Stop.INPUTS or not free or simulated is None or simulated.clipped is None:
        return None
    why = (
        "the policy asks for more than the actuator gives; if the actuator saturates there, clip the policy at "
        f"{_bounds(system)}"
    )
    return Step((), f"{why} (--clip, where the file of another program is read), and the larger set can be tried")


def beyond_the_ellipsoid(result: RoaResult, options: RoaOptions, effort: Effort) -> Step | None:
    """The step after a set that goes beyond the ellipsoid, or where the ellipsoid is little of what there is; None
    where the ellipsoid's own limits come first."""
    simulated = result.simulated
    if result.verdict is not Verdict.PROVED or simulated is None or simulated.share is None:
        return None
    if result.outer is None and result.ranks is None:
        if result.stop in (Stop.BOXES, Stop.STALLED) or result.stop.ran_out:
            return None
        named = options.Q is not None or options.R is not None  # one candidate, with which auto does not go on
        other = "polynomial" if options.goes_on else "neural" if named else "auto"  # auto has tried a network
        return by_learning(result, options, other) if simulated.share < MOST else None
    if options.lyapunov_level is not None:
        return None
    said, outer = _share_in_words(result), result.outer
    grows = not result.ranks.done if result.ranks is not None else outer is not None and outer.limit in _ENDED
    more = Step((("--effort", f"{4 * options.effort:g}"),), f"{said}, and the set grows with the effort")
    young = outer is not None and options.lyapunov is None and options.effort < _TAUGHT
    if (grows or young) and simulated.share < MOST:
        return more
    if result.ranks is not None and result.ranks.full and simulated.share < MOST:
        return _in_shorter_images(result, said)
    inside = None if simulated.share >= NEARLY_ALL else _ends_inside(result)
    if inside is not None:
        step = by_learning(result, options, "polynomial") if options.goes_on else None
        return replace(step, why=f"{inside}; {step.why}") if step else Step((), f"{said}; {inside}")
    wider = _in_a_wider_domain(result, effort)
    if wider is not None:
        return wider
    if simulated.share >= NEARLY_ALL:
        return Step((), f"{said}, and hardly more converges in a wider domain: a larger set needs another policy")
    return more if grows else None


def _in_shorter_images(result: RoaResult, said: str) -> Step:
    """The step where images of boxes meet too many boxes for more effort to help: a narrower range of periods."""
    lo, hi = result.system.sample or (Fraction(0), Fraction(0))
    many = f"{said}; images of boxes meet so many boxes that more effort finds the same"
    if lo == hi:
        return Step((), f"{many}: narrower ranges of what is uncertain, or another policy, may show more")
    narrower = f"{float(hi - _NARROWER * (hi - lo)):g}..{float(hi):g}"
    return Step((("--sample-time", narrower),), f"{many}; if periods differ no more than that, images are shorter")


def by_learning(result: RoaResult, options: RoaOptions, candidate: str) -> Step | None:
    """The step by which a function is learned for an outer set, where that may gain something and is allowed."""
    system, free = result.system, options.level is None and options.P is None and not options.resume
    plain = not (options.rate or options.enlarges) and options.engine == "bounds"
    nearly = result.simulated is None or (result.simulated.share or 0.0) >= NEARLY_ALL
    if not (free and plain) or system.in_steps or nearly or options.goes_beyond:
        return None
    why = f"{_share_in_words(result)}; a function that is learned may show more of it, beyond the ellipsoid"
    return Step((("--candidate", candidate),), why)


def _share_in_words(result: RoaResult) -> str:
    share = None if result.simulated is None else result.simulated.share
    return f"{100 * (share or 0.0):.2g} % of what converges in simulation is proved"


def _ends_inside(result: RoaResult) -> str | None:
    """Say that N ends at a state well inside of the domain, where a wider one changes nothing; None if it does not."""
    system, outer = result.system, result.outer
    if outer is None or outer.limit != "witness" or outer.witness is None:
        return None
    ends = zip(outer.witness, system.domain, strict=True)
    if not all(_INSIDE * lo < x < _INSIDE * hi for x, (lo, hi) in ends):
        return None
    each = zip(system.states, outer.witness, system.exact_x_eq(), strict=True)
    at = ", ".join(f"{symbol(s.name)} = {quantity(x + float(q), system.units.get(s.name, ''), 4)}" for s, x, q in each)
    where = violated(outer.violation, outer.constraint, "it does not fall")
    return f"N ends where {where}, at {at}, well inside of the domain, so that a wider one would not help"


def _in_a_wider_domain(result: RoaResult, effort: Effort) -> Step | None:
    """The domain that is wider in the state for which the simulated region grows most, if it does."""
    system, here = result.system, _converging(result)
    if result.problem is None or result.levels.roa is None or not here:
        return None
    turned, found = turning(ClosedLoop(system, result.network)) if system.in_steps else [], list[tuple[float, int]]()
    for i, (lo, hi) in enumerate(system.domain):
        if i in turned:
            continue
        try:
            there = wider(system, i, WIDER)
            share = _share(ClosedLoop(there, result.network), result.problem.V, result.levels.roa, effort)
        except InputError:
            continue
        ratio = float((there.domain[i][1] - there.domain[i][0]) / (hi - lo))
        found.append((0.0 if share is None else ratio * share / here, i))
    grown, i = max(found, default=(0.0, 0))
    if grown < _WORTH:
        return None
    why = f"if the equations hold there, runs converge in simulation from {grown:.3g} times the volume"
    return Step((("--domain", side(wider(system, i, WIDER), i)),), why)


def _share(loop: ClosedLoop, V: Quadratic, level: float, effort: Effort) -> float | None:
    """The share of the domain's states from which runs come to {V <= level}; None if the effort ends before."""
    found = simulated_region(Simulator(loop, V, level), effort.part(_LOOK, even_if_over=True))
    return None if found is None else len(found.converging) / found.runs


def _converging(result: RoaResult) -> float | None:
    """The share of the domain's states that converge in simulation; 0 where nothing was proved."""
    if result.simulated is None:
        return 0.0 if result.levels.roa is None else None
    return result.simulated.converging / result.simulated.runs


def wider(system: System, i: int, factor: Fraction) -> System:
    """The plant on a domain that is wider by this factor on a state's side, about: its ends are rounded as values, and
    a state that is positive or negative in the domain stays so."""
    lo, hi = system.domain[i]
    at = system.exact_x_eq()[i]
    decimals = _DIGITS - math.floor(math.log10(hi - lo))
    ends = [round(at + factor * end, decimals) for end in (lo, hi)]
    if lo + at >= 0 > ends[0]:
        ends[0] = (lo + at) / 2
    if hi + at <= 0 < ends[1]:
        ends[1] = (hi + at) / 2
    return system.with_domain({system.states[i].name: (min(ends[0] - at, lo), max(ends[1] - at, hi))})


def side(system: System, i: int) -> str:
    """The option's value for a state's side of the domain: values, not deviations."""
    lo, hi = (float(end + system.exact_x_eq()[i]) for end in system.domain[i])
    return f"{system.states[i].name}={hi:.12g}" if lo == -hi else f"{system.states[i].name}={lo:.12g}..{hi:.12g}"
