"""The setting: which claim is aimed at, where V is to be 0, and whether the linearisation allows any."""

from __future__ import annotations

from dataclasses import dataclass, replace

from certify.analysis.asked import (
    box_in,
    constraints_in_words,
    ellipsoid_around,
    ellipsoid_in,
    require_kept_at_origin,
    require_one_that_knows,
    values_of,
)
from certify.analysis.options import RoaOptions
from certify.analysis.outcome import by_spectrum, not_stable
from certify.analysis.results import RoaResult
from certify.analysis.stages.state import State, Tools
from certify.analysis.suggested import centring
from certify.certificates import require_within_limits
from certify.certificates.claims.claim import Kind
from certify.certificates.verdict import Stop, Verdict
from certify.effort import Effort
from certify.errors import InputError, OptionError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import Rest, find_rest, seen_from
from certify.loop.plants import Measurements, Samples, require_no_jumps, require_origin_inside


@dataclass(frozen=True)
class Setting:
    """The first stage."""

    tools: Tools

    def extend(self, state: State, effort: Effort) -> State:
        """Choose the claim and the origin; end the run where the spectrum decides.

        Raises
        ------
        InputError : the loop or an option cannot be used.
        """
        options, system, network = state.options, state.loop.system, state.loop.network
        require_within_limits(system, network)
        require_origin_inside(system)
        require_no_jumps(system)
        require_one_that_knows(system, options)
        if options.box is not None:
            ellipsoid_in(system, options.box)
        if options.ranks and not (system.time == "discrete" or system.sample is not None):
            raise OptionError(
                "`ranks` needs a loop whose time goes in steps: discrete time, or a held input (`sample_time`)."
            )
        begin = None if options.reach_from is None else box_in(system, options.reach_from)
        if begin is not None and options.box is not None and ellipsoid_around(system, begin) is not None:
            raise OptionError("`box` is about the tube around a state; leave it out where `reach_from` is a box.")
        state = replace(state, begin=begin)
        if system.measurements is not None and not system.measurements.runs:
            state = _without_data(state)
        elif system.measurements is not None:
            with self.tools.timing("data"):
                state = _identified(state, system.measurements)
        if system.samples is not None and not system.samples.taken:
            state = _without_samples(state)
        elif system.samples is not None:
            with self.tools.timing("data"):
                state = _sampled(state, system.samples)
        with self.tools.timing("candidate"):
            state = _with_claim(state)
            rest, loop = _rest(state.loop, state.options)
            require_kept_at_origin(loop)
            state = replace(state, loop=loop)
            state = state.with_result(
                system=loop.system,
                network=loop.network,
                claim=state.kind,
                constraints=constraints_in_words(loop.system),
                reach_from=None if begin is None else values_of(loop.system, begin),
            )
            return _by_spectrum(state, rest)


def _at_origin(centre: str | None) -> str:
    """The step to a loop that rests at the origin, by this centring, or to an answer about a state without a tube."""
    if centre is not None:
        return f"With --centre {centre} it is; the centred policy is then the one to run."
    return "`certify roa` proves the set around the loop's equilibrium, and its --contains whether a state lies in it."


def setting_of(loop: ClosedLoop, options: RoaOptions) -> State:
    """The state before the first stage."""
    unknown = RoaResult(Verdict.UNKNOWN, Stop.REQUESTED, loop.system, loop.network, engine=options.engine)
    return State(loop, options, unknown)


def _without_data(state: State) -> State:
    """The plant for its ranges as they stand, whatever they rest on."""
    loop = ClosedLoop(replace(state.loop.system, measurements=None), state.loop.network)
    return replace(state, loop=loop).noting(
        "the plant's ranges are taken as they stand; `data` makes the measurements, on which they rest, a part of the "
        "claim"
    )


def _without_samples(state: State) -> State:
    """The plant with its equations as they stand, whatever they were fitted to."""
    loop = ClosedLoop(replace(state.loop.system, samples=None), state.loop.network)
    return replace(state, loop=loop).noting(
        "the plant's equations and their bounds are taken as they stand; `data` makes the samples, to which they were "
        "fitted, a part of the claim"
    )


def _sampled(state: State, samples: Samples) -> State:
    """The plant with evidence that its equations stand for all functions of the samples.

    Raises
    ------
    InputError : they do not, or another claim is asked for than one that may have samples.
    """
    from certify.analysis.fitting.standing import standing_for

    system = state.loop.system
    if state.options.claim == "nearby":
        raise OptionError("a claim with samples must be practical or asymptotic; leave out `data`.")
    if any(system.exact_x_eq()) or state.loop.network.is_moved:
        raise InputError("a claim with samples must be around x = 0, as is what was sampled; leave out `data`.")
    turning = next((v for one in samples.unknowns for v in one.variables if v in system.angles), None)
    if turning is not None:
        raise InputError(f"a claim with samples must have {turning} as a number; leave it out of [angles].")
    return replace(state, data=standing_for(system, samples))


def _identified(state: State, measurements: Measurements) -> State:
    """The plant with the measurements alone that its ranges rest on, and evidence that they do.

    Raises
    ------
    InputError : a range does not hold all that the measurements leave, or no plant is consistent with them.
    """
    from certify.provers.data import identify

    system = state.loop.system
    found = identify(system, measurements)
    for name, (lo, hi) in (found.turned or found.ranges).items():
        least, most = system.ranges[name]
        if not least <= lo <= hi <= most:
            raise InputError(
                f"the range of {name} must hold all that the data leave, [{float(lo):.9g}, {float(hi):.9g}]; found "
                f"[{float(least):.9g}, {float(most):.9g}]. `certify identify` writes a plant with such ranges."
            )
    loop = ClosedLoop(replace(system, measurements=found.measurements), state.loop.network)
    return replace(state, loop=loop, data=found.bounds)


def _with_claim(state: State) -> State:
    """The claim: as asked, or by whether the loop rests at the origin; a note says why it is the weaker one.

    Raises
    ------
    InputError : the claim `asymptotic` is asked for, and the loop does not rest at the origin.
    """
    options = state.options
    converging = options.claim in ("auto", "nearby") and state.loop.system.samples is None
    kind, why = _kind_of(state.loop, options)
    state = replace(state, converging=converging, insists=options.claim == "nearby")
    if why is not None:
        or_nearby = ", or a nearby equilibrium" if converging else ""
        state = state.noting(f"practical stability is claimed{or_nearby}, because {why}")
    if kind == "practical" and options.enlarges:
        centre = centring(state.loop.system, state.loop.network)
        if options.reach_from is not None:
            said = f"a tube from a state needs a loop whose equilibrium is the origin; {'; '.join(state.notes)}."
            raise InputError(f"{said} {_at_origin(centre)}")
        with_it = "" if centre is None else f"; with --centre {centre} it is"
        state = state.noting(f"a tube needs a loop whose equilibrium is the origin, and is not looked for{with_it}")
        options = replace(options, enlarge=False, box=None)
    return replace(state, options=replace(options, claim=kind))


def _kind_of(loop: ClosedLoop, options: RoaOptions) -> tuple[Kind, str | None]:
    """The claim, and why it is the weaker one."""
    if options.claim in ("practical", "nearby"):
        return "practical", None
    try:
        loop.require_rest()
    except InputError as error:
        if options.claim == "asymptotic":
            raise
        return "practical", str(error).split(". ")[0].rstrip(".")
    return "asymptotic", None


def _rest(loop: ClosedLoop, options: RoaOptions) -> tuple[Rest | None, ClosedLoop]:
    """The loop's equilibrium, if that is worth saying, and the loop as seen from where V is to be 0.

    Raises
    ------
    OptionError : V is to be 0 at the equilibrium, and no stable one is found.
    """
    if loop.network.is_moved:
        return None, loop
    if options.claim != "practical" or loop.network.centre != "none" or loop.system.samples is not None:
        if options.around == "rest" and options.claim == "practical":
            raise OptionError("`around` rest needs a policy without centring, and a plant without samples.")
        return None, loop
    rest = find_rest(loop)
    given = options.P is not None or options.level is not None or options.lyapunov is not None
    if options.around == "rest" and (rest is None or not rest.stable):
        found = "none was found" if rest is None else f"the one at {', '.join(rest.x)} is not"
        raise OptionError(f"`around` rest needs a stable equilibrium; {found}.")
    if rest is None or not rest.stable or options.around == "origin" or (options.around == "auto" and given):
        return rest, loop
    moved = seen_from(loop, rest)
    return rest, moved if moved.network.is_moved else loop


def _by_spectrum(state: State, rest: Rest | None) -> State:
    """End the run if an eigenvalue decides; otherwise add the equilibrium."""
    options = state.options
    if state.kind == "asymptotic":
        unstable = by_spectrum(state.loop)
        if unstable is not None:
            verdict, stop, shown = unstable
            detail = f"eigenvalues {', '.join(shown)}" + (" touch the axis" if stop is Stop.SPECTRUM else "")
            return state.finished(replace(state.result, verdict=verdict, stop=stop, detail=detail, eigenvalues=shown))
    state = state.with_result(rest=rest)
    if state.kind == "practical" and options.P is None and not options.resume and (shown := not_stable(state.loop)):
        detail = f"eigenvalues {', '.join(shown)} where V is to be 0"
        return state.finished(replace(state.result, stop=Stop.UNSTABLE, detail=detail, eigenvalues=shown))
    return state
