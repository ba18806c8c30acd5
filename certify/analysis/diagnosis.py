"""The limit of a result, in the plant's own names, and the next step to try: computed from the run, in floats.

For a plant with ranges, the modes and the input that leaves its bounds are those at the nominal values.

Nothing here is part of a proof. The next step is worked out: more effort from how the proof grew, a wider domain from
samples beyond it, another candidate only if others were left untried.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.analysis.candidates.trials import trial
from certify.analysis.facts import Diagnosis, Share, Step
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.simulated import NEARLY_ALL
from certify.analysis.suggested import (
    beyond_the_ellipsoid,
    by_centring,
    by_clipping,
    by_learning,
    commands_too_much,
    limited_outside,
    side,
    wider,
)
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, UNLIMITED, WHOLE, Effort
from certify.errors import InputError
from certify.loop.activations import activation
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, require_equilibrium
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import domain_limit, extents, increment_matrix, slowest_decay, volume
from certify.provers.ball.local import corners_in_a_period
from certify.provers.base import FEW, Proof
from certify.provers.tube.tube import Around, find_tube
from certify.report.timing import TimingInWords
from certify.report.words import number, quantity, symbol

Array = NDArray[np.float64]
_WIDER, _SLIGHTLY_WIDER = Fraction(3, 2), Fraction(5, 4)  # factors of the side of the domain that binds
_BINDS = 0.99  # of the largest share of a side of the domain: another side that binds as well
_WORTH = 1.1  # growth of the volume that makes a wider domain worth a word
_MOST = 1000.0  # an effort that may be suggested
_LONGER, _LOOK = 1.1, 2 * UNIT  # a tube's start relative to the proved set; operations for looking
_LITTLE = 25.0  # per cent of the volume that sampling allows, below which the bounds are to blame
_BENT = 1.0  # bends of the hidden units, as a share of the linear part, that are worth flattening
_TELLING = 1000  # boxes: a limit below it is what ended the search, and says nothing of the policy
_FASTEST = 0.9  # of the slowest mode's decay: a V that falls so fast may still have a set
_SAME, _BELOW = 1e-6, 0.99  # relative: rates that are as good as equal; a rate that is safely below another
_FEW = 3  # states, for which a function beyond the ellipsoid is suggested
_ALL = 0.995  # share of the box that has ranks: more effort gains little
_HALVINGS = 6  # of a period that is too long, before the policy is to blame
_ENDED = (Stop.EFFORT, Stop.BOXES, Stop.SMALL, Stop.LOCAL)


def diagnose(
    result: RoaResult,
    options: RoaOptions,
    proof: Proof | None,
    asked: tuple[System, PolicyNetwork] | None = None,
    effort: Effort = UNLIMITED,
) -> Diagnosis:
    """Find what limits `result`, whose engine found `proof`; the next step is looked for with this effort.

    `asked` are the plant and the policy as they were given, if the result is about them as seen from where they rest.
    """
    system = result.system
    loop = ClosedLoop(system, result.network)
    fastest, slowest = _modes(loop)
    binds, kind, name, side, point = _binding(result)
    scale = np.array([min(-float(lo), float(hi)) for lo, hi in system.domain])
    direction = _direction(result, proof, point, loop)
    weights = np.zeros(system.n) if direction is None else np.abs(direction) / scale
    weights = weights / (weights.max() or 1.0)
    hurts = sorted(zip((s.name for s in system.states), weights.tolist(), strict=True), key=lambda pair: -pair[1])
    shares: tuple[Share, ...] = ()
    if result.ellipsoid is not None:
        reach = extents(*result.ellipsoid)
        each = zip(system.states, reach.tolist(), scale.tolist(), strict=True)
        shares = tuple(Share(s.name, system.units.get(s.name, ""), e, e / d) for s, e, d in each)
    return Diagnosis(
        binds,
        kind,
        name,
        side,
        None if point is None else tuple(point.tolist()),
        shares,
        fastest,
        slowest,
        tuple(pair for pair in hurts if pair[1] >= 0.1),
        _next(result, options, proof, asked or (system, result.network), effort),
    )


def _modes(loop: ClosedLoop) -> tuple[float | None, float | None]:
    """Real parts of the fastest and the slowest eigenvalue at the origin."""
    try:
        real = np.linalg.eigvals(loop.linearise()[0]).real
    except InputError:
        return None, None
    return float(np.min(real)), float(np.max(real))


def _binding(result: RoaResult) -> tuple[str, str, str | None, str | None, Array | None]:
    """Words, kind, name, side and point of what limits the level."""
    system, P, level, witness = result.system, result.P, result.levels.roa, result.witness
    limit = result.levels.domain_limit
    if result.stop in (Stop.DOMAIN, Stop.MARGIN) and P is not None and limit is not None:
        columns = np.asarray(np.linalg.inv(P), dtype=np.float64)
        i = int(np.argmax(_shares(system, P)))
        lo, hi = system.domain[i]
        side = "lower" if -lo < hi else "upper"
        sign = -1.0 if side == "lower" else 1.0
        point = sign * columns[:, i] * math.sqrt((level or limit) / columns[i, i])
        name = str(system.states[i].name)
        end, at, unit = lo if side == "lower" else hi, system.exact_x_eq()[i], system.units.get(name, "")
        where = f"the {side} side of the domain in {symbol(name)}, {quantity(end + at, unit)}"
        where += f" ({quantity(abs(end), unit)} from the operating point)" if at else ""
        return where, "domain", name, side, point
    if witness is not None and result.stop in (Stop.WITNESS, Stop.INPUTS, Stop.KEEP):
        each = zip(system.states, witness.x.tolist(), system.exact_x_eq(), strict=True)
        where = _named(system, {s.name: v + float(at) for s, v, at in each})
        if witness.kind != "input" and witness.values:
            where += f" with {_named(system, {name: float(q) for name, q in witness.values.items()})}"
        if witness.kind == "input":
            found = _input_out_of_bounds(result, witness.x)
            if found is not None:
                name, side, value = found
                bound = quantity(value, system.units.get(name, ""))
                return f"{symbol(name)} leaves its {side} bound, {bound}, at {where}", "input", name, side, witness.x
        if witness.kind == "keep":
            edge = f"{witness.constraint}: {result.constraints.get(witness.constraint, '')}".removesuffix(" < 0")
            return f"{edge} = 0 near {where}, V = {number(witness.level, 6)}", "keep", None, None, witness.x
        what = (
            "Vdot = 0"
            if result.timing.is_plain and not result.timing.rate
            else f"V does not fall enough{TimingInWords.of(result.system).over_what}"
        )
        return f"{what} near {where}", "vdot", None, None, witness.x
    return result.reason, result.stop.name.lower(), None, None, None


def _named(system: System, values: Mapping[str, float]) -> str:
    """Quantities of a plant with their names and units."""
    return ", ".join(f"{symbol(name)} = {quantity(v, system.units.get(name, ''), 4)}" for name, v in values.items())


def _input_out_of_bounds(result: RoaResult, x: Array) -> tuple[str, str, float] | None:
    system = result.system
    u = ClosedLoop(system, result.network).policy(x[None])[0]
    for one, value, (lo, hi) in zip(system.inputs, u.tolist(), system.input_bounds, strict=True):
        if value < lo or value > hi:
            return (one.name, "lower", float(lo)) if value < lo else (one.name, "upper", float(hi))
    return None


def _direction(result: RoaResult, proof: Proof | None, point: Array | None, loop: ClosedLoop) -> Array | None:
    """A direction (n,) of states: of the point that binds, else along which boxes had to be halved most, else of the
    eigenvector that decays least."""
    if point is not None:
        return point
    if proof is not None and proof.direction is not None:
        return np.array(proof.direction)
    try:
        values, vectors = np.linalg.eig(loop.linearise()[0])
    except InputError:
        return None
    return np.asarray(np.abs(vectors[:, np.argmax(values.real)]))


def _next(
    result: RoaResult,
    options: RoaOptions,
    proof: Proof | None,
    asked: tuple[System, PolicyNetwork],
    effort: Effort,
) -> Step:
    if (correction := _correction(result, options, asked[0])) is not None:
        return correction
    if (boxes := _boxes(result, options)) is not None:
        return boxes
    if (amiss := commands_too_much(*asked)) is not None:
        return Step((), amiss)
    ended = result.stop in (Stop.INPUTS, Stop.BOXES, Stop.SMALL, Stop.STALLED) or result.stop.ran_out
    simulated = result.simulated
    little = simulated is not None and ((simulated.share or 0.0) < NEARLY_ALL or simulated.more > 0)
    if (ended or little) and (outside := limited_outside(*asked)) is not None:
        return Step((), outside)
    weaker = result.claim in ("practical", "nearby")
    if weaker and (centred := by_centring(result, options, asked, effort)) is not None:
        return centred
    if (flatter := _flatter(result, options, proof)) is not None:
        return flatter
    if (clipped := by_clipping(result, asked)) is not None:
        return clipped
    if (beyond := beyond_the_ellipsoid(result, options, effort)) is not None:
        return beyond
    if result.stop is Stop.DOMAIN and options.level is None:
        return _wider_domain(result, options, effort)
    if result.stop is Stop.PATH:
        why = "the set that the tube has to reach grows with the effort, and so do the widths that are tried"
        return Step((("--effort", _round(4 * options.effort)),), why)
    if result.stop is Stop.CLUSTER:
        kept = result.search is not None
        why = "what was done is kept" if kept else "the search was not kept"
        return Step((("--resume", ""),) if kept else (), f"{why}; see to the cluster first, or leave it out")
    if result.stop.ran_out or result.stop is Stop.BOXES:
        step = _longer(result, options, proof, effort)
        return step if result.search is None else replace(step, options=(*step.options, ("--resume", "")))
    if (around := _around_a_corner(result, options)) is not None:
        return around
    if options.claim == "asymptotic" and options.only is not None and _is_free(options):
        return Step((("--candidate", "auto"),), f"only the candidate {options.only} was tried")
    if result.stop is Stop.STALLED and _may_have_tube(result, options) and _has_tube(result, effort):
        return Step((("--enlarge", ""),), f"a tube leads into this set from one {_LONGER:g} times as long, at least")
    if result.stop is Stop.STALLED:
        worst = ", ".join(symbol(one) for one, _ in _hurting(result, proof)[:3])
        why = f"the bounds are too wide beyond the local set, most of all along {worst}; "
        return Step((), why + "a policy that bends less there helps", flattens=_can_be_flattened(result))
    if result.stop is Stop.KEEP:
        return _around_a_constraint(result, options)
    if result.stop in (Stop.WITNESS, Stop.INPUTS, Stop.SMALL):
        return _another_candidate(result, options)
    if result.stop is Stop.REQUESTED and result.levels.roa is not None:
        return Step((), f"the level that was asked for is proved; leave --level out for the largest{_whose(options)}")
    return Step((), result.reason)


def _without_level(options: RoaOptions) -> Step:
    """The step to the largest level, of a run for one that cannot be proved."""
    return Step((), f"leave --level out for the largest level that can be proved{_whose(options)}")


def _whose(options: RoaOptions) -> str:
    """A remark on the V of a level, where only the level chose it: that of a run without may be another one."""
    if options.P is not None or replace(options, level=None).only is not None:
        return ""
    return "; the level is of the V of --candidate lyapunov, as none is named, which need not be that of such a run"


def _around_a_corner(result: RoaResult, options: RoaOptions) -> Step | None:
    """The step where a corner at the operating point leaves no ball around it, and boxes alone may do without one."""
    system = result.system
    if result.stop is not Stop.LOCAL or result.claim != "asymptotic" or options.enlarges or options.goes_beyond:
        return None
    if system.n > FEW or not corners_in_a_period(system):
        return None
    return Step((("--claim", "practical"),), "a set is left out that is as small as its boxes show")


def _flatter(result: RoaResult, options: RoaOptions, proof: Proof | None) -> Step | None:
    """The step where little is proved because the policy bends; None where that is not so, or not known yet."""
    few = result.stop is Stop.BOXES and options.max_boxes < _TELLING
    if result.stop not in _ENDED or few or not _is_bent(result, proof):
        return None
    share = number(_share_proved(result), 2)
    why = (
        f"proved is {share} % of the volume that sampling allows, and bounds see more of the hidden units' bends "
        "than of the policy's linear part: a flatter policy that does the same may be proved on more"
    )
    return Step((), why, flattens=True)


def _is_free(options: RoaOptions) -> bool:
    """True if several candidates are tried once none is named: P, weights and a level say which one it is."""
    return all(given is None for given in (options.P, options.Q, options.R, options.level))


def _another_candidate(result: RoaResult, options: RoaOptions) -> Step:
    """The step where this V shows no more: another candidate, a function of higher degree, or another policy."""
    tried = max((t.volume for t in result.tried), default=0.0)
    reached = max((t.proved_volume or 0.0 for t in result.tried), default=0.0)
    if reached and tried > _WORTH * reached:
        return Step((("--effort", _round(4 * options.effort)),), "another candidate reaches further")
    if (learned := by_learning(result, options, "neural")) is not None:
        return learned
    return Step((), "what this V can show is proved; a larger set needs another policy or another kind of V")


def _boxes(result: RoaResult, options: RoaOptions) -> Step | None:
    """The step where boxes of the domain may be proved to lead into the set; None where they may not, or are."""
    free = options.level is None and options.P is None and not options.resume and options.engine == "bounds"
    if result.verdict is not Verdict.PROVED or not result.system.in_steps or result.system.n > _FEW or not free:
        return None
    simulated = result.simulated
    if simulated is not None and (simulated.share or 0.0) >= NEARLY_ALL:
        return None
    if options.ranks:
        found = result.ranks
        if found is None or found.done or found.covered > _ALL:
            return None
        why = f"{number(100 * (1 - found.covered), 2)} % of the box has no rank yet, and its boxes get smaller"
        return Step((("--effort", _round(4 * options.effort)),), why)
    if result.ranks is not None:
        return None
    return Step((("--ranks", ""),), "boxes of the domain may be proved to lead into this set")


def _around_a_constraint(result: RoaResult, options: RoaOptions) -> Step:
    """The step where a constraint ends the set: a V that is shaped around it, if that was not tried."""
    shaped = any(one.candidate.startswith("optimised") for one in result.tried)
    if options.level is not None:
        return _without_level(options)
    several = options.claim == "asymptotic"  # one of them is shaped so
    given = options.P is not None or options.resume
    if not shaped and not given and (not several or (options.only is not None and _is_free(options))):
        why = "other candidates are shaped around the constraints, this one is not"
        return Step((("--candidate", "auto" if several else "optimised"),), why)
    tried = max((t.volume for t in result.tried), default=0.0)
    if tried > _WORTH * (result.volume or 0.0) > 0:
        return Step((("--effort", _round(4 * options.effort)),), "another candidate reaches further")
    why = "a larger set needs a looser constraint, or a policy that turns away from it in time"
    return Step((), f"V is shaped around the constraints already; {why}" if shaped else why)


def _can_be_flattened(result: RoaResult) -> bool:
    """True if `controllers flatten` takes the policy and judges it by the loop that is certified."""
    network, system = result.network, result.system
    layers = network.network.is_chain and bool(network.network.functions)
    return layers and not (system.in_steps or system.ranges)


def _share_proved(result: RoaResult) -> float:
    """The volume that is proved, in per cent of what sampling allows at most."""
    allowed = max((one.volume for one in result.tried), default=0.0)
    return 100 * (result.volume or 0.0) / allowed if allowed else 100.0


def _is_bent(result: RoaResult, proof: Proof | None) -> bool:
    """True if little of what sampling allows is proved, and the pace of the proof does not say when more will be."""
    known = proof is not None and proof.left is not None and result.levels.roa is not None
    if not _can_be_flattened(result) or known or _share_proved(result) >= _LITTLE:
        return False
    half_widths = np.array([min(-float(lo), float(hi)) for lo, hi in result.system.domain])
    return _bend(result.network.folded(result.system.exact_u_eq()), half_widths) > _BENT


def _bend(network: PolicyNetwork, half_widths: Array) -> float:
    """Bends of the hidden units on a box as bounds see them, over the policy's linear part there, to first order.

    The sum over all hidden units of their distance from their tangent at 0, at both ends of what the box drives them
    through, times their gain towards the inputs.
    """
    y, J, units = np.zeros(network.n), np.eye(network.n), list[tuple[Array, Array, Array]]()
    phi = activation(network.activation)
    for W, b in zip(network.weights[:-1], network.biases[:-1], strict=True):
        y, J = W @ y + b, W @ J
        (t, slope), reach = phi.pair(y), np.abs(J) @ half_widths
        ends = [np.abs(phi.pair(y + v)[0] - t - slope * v) for v in (reach, -reach)]
        units.append((W, slope, (ends[0] + ends[1]) / 2))
        y, J = t, slope[:, None] * J
    gain, total = network.weights[-1], 0.0
    linear = float(np.sum(np.abs(gain @ J) @ half_widths))
    for W, slope, departure in reversed(units):
        total += float(np.sum(np.abs(gain) @ departure))
        gain = (gain * slope) @ W
    return total / linear if linear else 0.0


def _may_have_tube(result: RoaResult, options: RoaOptions) -> bool:
    """True if a tube may be asked for: in steps there is none; with ranges or constraints none is looked for here."""
    odd = result.system.ranges or result.system.in_steps or result.constraints or result.claim != "asymptotic"
    return not (odd or options.rate or options.enlarges or options.goes_beyond) and options.engine == "bounds"


def _has_tube(result: RoaResult, effort: Effort) -> bool:
    """True if a tube is found with little effort that leads from a larger multiple of the proved set into it."""
    if result.P is None or result.levels.roa is None:
        return False
    goal = result.P / result.levels.roa
    return (
        find_tube(
            Around.of(ClosedLoop(result.system, result.network), ()),
            goal / _LONGER**2,
            goal,
            effort.part(_LOOK, even_if_over=True),
        )
        is not None
    )


def _correction(result: RoaResult, options: RoaOptions, plant: System) -> Step | None:
    """Correct the policy, the plant or the level, where no other option helps; None where one may."""
    if result.stop is Stop.UNSTABLE:
        if (sooner := _shorter_period(result)) is not None:
            return sooner
        other = "another policy, which stabilises the plant"
        if result.verdict is Verdict.REFUTED:
            return Step((), f"{other}: no V can prove the claim for this one")
        return Step((), f"{other}; for this one no Lyapunov equation has a solution, so that you must give P yourself")
    if (slower := _slower(result, options)) is not None:
        return slower
    failed = result.verdict is Verdict.REFUTED or (result.witness is not None and result.levels.roa is None)
    if options.level is not None and failed:
        return _without_level(options)
    if result.levels.roa is None:
        try:
            require_equilibrium(plant)
        except InputError as error:
            return Step((), str(error))
    return None


def _shorter_period(result: RoaResult) -> Step | None:
    """The first half, quarter, ... of the period for which an input that is held leaves the linearisation stable."""
    system = result.system
    if system.sample is None:
        return None
    for halvings in range(1, _HALVINGS + 1):
        period = system.sample[1] / 2**halvings
        loop = ClosedLoop(system.with_sample((period, period)), result.network)
        if slowest_decay(loop.mean_rate(), loop.step) > 0:
            why = f"with the input held for {float(period):g} s the linearisation is stable"
            return Step((("--sample-time", f"{float(period):g}"),), why)
    return None


def _slower(result: RoaResult, options: RoaOptions) -> Step | None:
    """A rate below the one at which V falls near the origin, or any V if none is given, if that is no faster than was
    asked for; else None."""
    if not options.rate or result.P is None or result.levels.roa is not None or result.claim != "asymptotic":
        return None
    loop, P = ClosedLoop(result.system, result.network), result.P
    A, any_v = loop.mean_rate(), options.P is None and options.only is None
    D = increment_matrix(P, A, loop.step)
    falls = slowest_decay(A, loop.step) if any_v else -float(np.max(np.linalg.eigvals(np.linalg.solve(P, D)).real)) / 2
    if not 0 < falls <= (1 + _SAME) * options.rate:
        return None
    fastest = f"{number(falls, 4)} {TimingInWords.of(result.system).per_time}"
    which, below = ("every", _FASTEST) if any_v else ("this", _BELOW)
    why = f"near the origin {which} V falls at the rate {fastest} at most, and equality is not enough"
    return Step((("--rate", f"{below * falls:.3g}"),), why)


def _hurting(result: RoaResult, proof: Proof | None) -> list[tuple[str, float]]:
    direction = _direction(result, proof, None, ClosedLoop(result.system, result.network))
    names = [s.name for s in result.system.states]
    if direction is None:
        return [(name, 0.0) for name in names]
    scale = np.array([min(-float(lo), float(hi)) for lo, hi in result.system.domain])
    return sorted(zip(names, (np.abs(direction) / scale).tolist(), strict=True), key=lambda pair: -pair[1])


def _longer(result: RoaResult, options: RoaOptions, proof: Proof | None, effort: Effort) -> Step:
    """An effort with which the ring is done, as the growth so far says, or ten times as much."""
    left = None if proof is None else proof.left
    if result.stop is Stop.BOXES and options.max_boxes <= result.boxes:
        return Step((("--max-boxes", f"{10 * options.max_boxes}"),), "the limit on boxes ended the search")
    if result.stop is Stop.TIME and options.time_limit is not None:
        needed = "" if left is None else f": the ring needs about {_round(effort.seconds_for(left))} s more"
        return Step((("--time-limit", _round(10 * options.time_limit)),), f"the time limit ended the search{needed}")
    if left is not None and options.effort + 2 * left / WHOLE < _MOST:
        more = options.effort + 2 * left / WHOLE  # the check grows with the tree
        seconds = _round(effort.seconds_for(left))
        return Step((("--effort", _round(more)),), f"the ring needs about {seconds} s more at this pace")
    ended = "nothing was proved yet" if result.levels.roa is None else "the set still grew"
    return Step((("--effort", _round(10 * options.effort)),), f"{ended} when the effort ended")


def _wider_domain(result: RoaResult, options: RoaOptions, effort: Effort) -> Step:
    """A domain that is wider in a state that binds, where samples show that a V reaches further in it.

    This V is tried there, and one that is stretched along with the domain, unless V is given.
    """
    system, problem, level = result.system, result.problem, result.levels.roa
    if problem is None or level is None:
        return Step((), result.reason)
    free = _is_free(options) and options.engine != "dreal"
    kinds = [(_WIDER, False)] + [(factor, True) for factor in (_WIDER, _SLIGHTLY_WIDER) if free]
    share, look = _shares(system, problem.V.P), effort.part(_LOOK, even_if_over=True)
    proved = volume(problem.V.P, level)
    binding = [int(i) for i in np.argsort(-share, kind="stable") if share[i] >= _BINDS * np.max(share)]
    for i in binding:
        found = list[tuple[float, Fraction, bool]]()
        for factor, stretched in kinds:
            least = max((grown for grown, _, _ in found), default=0.0)
            reach = _reach(result, options, i, factor, stretched, look, max(least, _WORTH) * proved)
            if reach is not None:
                found.append((reach / proved, factor, stretched))
        grown, factor, stretched = max(found, key=lambda one: one[0], default=(0.0, _WIDER, False))
        if grown >= _WORTH:
            which = "a V that is stretched along with the domain" if stretched else "this V"
            why = f"if the equations hold there, samples allow {grown:.3g} times the volume to {which}"
            other = (("--candidate", "auto"),) if stretched and options.only not in (None, "optimised") else ()
            return Step((("--domain", side(wider(system, i, factor), i)), *other), why)
        if len(found) < len(kinds):  # samples cannot tell, or the operations for them have ended
            why = "if the equations hold there, the set may be larger"
            return Step((("--domain", side(wider(system, i, _WIDER), i)),), why)
    which = ", and to one that is stretched along with the domain," if free else ""
    where = " or ".join(symbol(system.states[i].name) for i in binding)
    return Step((), f"samples allow hardly more to this V{which} where the domain is wider in {where}")


def _shares(system: System, P: Array) -> Array:
    """The shares (n,) of the domain that an ellipsoid {x'Px <= const} extends to, in proportion to each other."""
    least = np.array([min(-float(lo), float(hi)) for lo, hi in system.domain])
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(P))) / least)


def _reach(
    result: RoaResult, options: RoaOptions, i: int, factor: Fraction, stretched: bool, effort: Effort, least: float
) -> float | None:
    """The volume that V reaches in samples where state i has a domain wider by this factor; None if that is unknown.

    Where the domain allows less than `least`, the volume that it allows: samples could only lower it.
    """
    system, problem = result.system, result.problem
    if problem is None or (result.claim in ("practical", "nearby") and system.n > FEW):
        return None
    there = wider(system, i, factor)
    scale = np.ones(system.n)
    scale[i] = 1 / float(factor) if stretched else 1.0
    P = scale[:, None] * problem.V.P * scale
    try:
        allowed = volume(P, domain_limit(P, there.domain))
        if allowed < least:
            return allowed
        found = trial(ClosedLoop(there, result.network), P, "", options, effort)
    except InputError:
        return 0.0
    return None if effort.over else found.volume


def _round(value: float) -> str:
    """Two digits, rounded up."""
    unit = Fraction(10) ** (math.floor(math.log10(max(value, 0.01))) - 1)
    return f"{float(math.ceil(value / unit) * unit):g}"
