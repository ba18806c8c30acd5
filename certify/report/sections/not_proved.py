"""The statements that a reader may take the claim to make, although it does not.

The gaps of one kind of claim alone stand with its words, in `certify/report/claims.py`.
"""

from __future__ import annotations

from collections.abc import Iterator

from certify.certificates import AnyCertificate, Certificate, InvariantCertificate, ReachCertificate, RemainCertificate
from certify.loop.plants import System, input_errors
from certify.report.claims import Words
from certify.report.measured import Measured
from certify.report.sampled import Sampled
from certify.report.sections.shared import timing_of
from certify.report.timing import TimingInWords
from certify.report.words import Varying, held_at, listed, symbol, varying_in


def not_proved_of(certificate: Certificate, words: Words) -> list[tuple[str, str]]:
    """Heads and texts of the claim's gaps."""
    items = [
        *words.excluded[:-1],
        (
            "Anything outside the set.",
            f"The true set may be larger: what starts outside {words.sets} may do the same or not.",
        ),
        *_not_of_the_plant(certificate.system),
        *_other_times(timing_of(certificate)),
        _rounding(certificate.system),
        *words.excluded[-1:],
        *_turns(certificate),
        (
            "Simulated figures.",
            "Trajectories, grids and the share of the simulated region are illustrations in floating point"
            + (f", all of them with {held} from beginning to end." if (held := held_at(certificate.system)) else "."),
        ),
    ]
    if certificate.claim.outer is not None:
        items.append(
            (
                "The size of the outer set.",
                "Its volume is estimated from samples, and its outline in the figures is drawn from a grid; only the "
                "inequality N(x) ≤ n₂ within the domain says which states belong to it.",
            )
        )
    if certificate.system.n > 2:
        items.append(
            (
                "The pictures as wholes.",
                "A section shows two states with all others 0, a projection two states whatever the others are; the "
                "claim is about all states together.",
            )
        )
    return items


def not_reached_of(certificate: ReachCertificate) -> list[tuple[str, str]]:
    """Heads and texts of the gaps of a claim that a region is reached."""
    system, timing = certificate.system, timing_of(certificate)
    return [
        ("What comes later.", "Once in the region, a trajectory may leave it at once; nothing is said of it any more."),
        ("Boxes without a rank.", "Of their states nothing is said: they may reach the region too, or not."),
        (
            "Fewer steps.",
            f"The numbers of {'steps' if timing.discrete else 'sampling instants'} are bounds: most trajectories need "
            "fewer.",
        ),
        *_not_of_the_plant(system),
        *(one for one in _other_times(timing) if "set" not in one[0]),
        _rounding(system),
        *_turns(certificate),
        ("Simulated figures.", "Runs that are drawn are illustrations in floating point."),
    ]


def not_staying_of(certificate: InvariantCertificate | RemainCertificate) -> list[tuple[str, str]]:
    """Heads and texts of the gaps of a claim that a set is never left."""
    system, timing = certificate.system, timing_of(certificate)
    return [
        (
            "Where trajectories go.",
            "Nothing is said of what they do in the set: they may come to rest or circle.",
        ),
        ("States outside the set.", "Of them nothing is said: they may enter it, or not. They need not be unsafe."),
        *_not_of_the_plant(system),
        *(one for one in _other_times(timing) if "set" not in one[0]),
        _rounding(system),
        *_turns(certificate),
        ("Simulated figures.", "Runs that are drawn, and the size of the set, are by samples in floating point."),
    ]


def _turns(certificate: AnyCertificate) -> Iterator[tuple[str, str]]:
    """The gap about angles, unless full turns of them are the same place."""
    ranks, said = (
        certificate.claim.ranks,
        "States are real numbers: a state that is an angle is not the origin after a full turn.",
    )
    if ranks is None or not ranks.angles:
        yield ("Wrapped angles.", said)
    elif certificate.system.n > len(ranks.angles):
        yield ("Other angles.", f"Full turns are the same place in {listed([symbol(a) for a in ranks.angles])} alone.")


def _other_times(timing: TimingInWords) -> Iterator[tuple[str, str]]:
    """In which other ways than the claim's time may pass in a loop."""
    if timing.discrete:
        yield (
            "Time between the steps.",
            "The equations say what the state is one step later, and nothing of what lies between two steps. Where "
            "they come from a plant in continuous time, that they are exact for it, and what it does between them, is "
            "not part of the claim.",
        )
    elif timing.sample is None:
        yield (
            "A sampled controller.",
            "u = π(x) acts in continuous time. An action that is held between samples is another closed loop.",
        )
    else:
        longer = "longer" if timing.from_zero else "longer or shorter"
        yield (
            "Other periods, and delay.",
            f"The input changes at the sampling instants, at once, and is held over {timing.periods}. With a period "
            f"that is {longer} even once, a sample that is missed, or the time that computing the input takes, it is "
            "another closed loop.",
        )
        if not timing.from_zero:
            yield (
                "The set between two sampling instants.",
                "At the sampling instants the state is in the set; between two of them it is in the domain, and may be "
                "outside the set.",
            )


def _not_of_the_plant(system: System) -> list[tuple[str, str]]:
    """The gaps about plant and surroundings; fewer if some quantity has a range."""
    if not system.ranges:
        return [
            (
                "Any other plant.",
                "The claim is about the equations above with exactly these numbers: no other mass, no friction, "
                "flexibility or actuator lag that is not in them.",
            ),
            ("Disturbances.", "No wind, no sensor noise, no estimation error, no delay."),
        ]
    data = Measured.of(system)
    if data is not None:
        return _not_of_the_measured(system, data)
    sampled = Sampled.of(system)
    if sampled is not None:
        return _not_of_the_sampled(system, sampled)
    names = listed([symbol(name) for name in system.ranges])
    within = "its range" if len(system.ranges) == 1 else "their ranges"
    return [
        (
            "Any other plant.",
            f"The claim is about the equations above: with every value of {names} in {within} and none outside, and "
            "with exactly these numbers in all else: no friction, flexibility or actuator lag that is not in them.",
        ),
        (
            "Other disturbances.",
            f"Only what {names} can be in these equations: no other force, no sensor noise, no estimation error, no "
            "delay.",
        ),
    ]


def _not_of_the_sampled(system: System, sampled: Sampled) -> list[tuple[str, str]]:
    """The gaps about a plant of which functions are known by samples."""
    others = [symbol(q.name) for q in sampled.others(varying_in(system))]
    beside = f" beside {listed(others)} in {'its range' if len(others) == 1 else 'their ranges'}" if others else ""
    zero = ", and that they are 0 at the origin" if any(f["vanishes"] for f in sampled.functions) else ""
    return [
        (
            "That the plant is one of these.",
            "That the functions depend on these variables alone, the bounds of their second derivatives, the bound of "
            f"the samples' errors{zero} are assumed: samples can contradict them and never show them. A single error "
            "that is larger, or a corner between two points of the grid, makes the plant another one, and so does "
            "anything else in the other equations.",
        ),
        (
            "Functions that change.",
            "Each is one function of its variables, when it was sampled and ever after.",
        ),
        ("Other disturbances.", f"None{beside}: no other force, no sensor noise for the policy, no delay."),
    ]


def _not_of_the_measured(system: System, data: Measured) -> list[tuple[str, str]]:
    """The gaps about a plant whose parameters are known by measurements."""
    others = [symbol(q.name) for q in data.others(varying_in(system))]
    beside = f" beside {listed(others)} in {'its range' if len(others) == 1 else 'their ranges'}" if others else ""
    return [
        (
            "That the plant is one of these.",
            "Measurements can contradict equations, priors, noise and period, and never show them: they are assumed. "
            f"Nothing is said of a plant with which the {data.transitions:,} transitions are not consistent, and a "
            "single error larger than the noise makes it such a plant.",
        ),
        (
            "Parameters that change.",
            f"{data.names} {'is' if len(data.priors) == 1 else 'are'} constant, and the same in all the measurements "
            "and for all time after them. What drifts is no parameter, but a disturbance of the equations.",
        ),
        (
            "Chances.",
            "No statement of statistics: no confidence, no distribution of the noise, and nothing about how likely a "
            "plant is.",
        ),
        ("Other disturbances.", f"None{beside}: no other force, no sensor noise for the policy, no delay."),
    ]


def _rounding(system: System) -> tuple[str, str]:
    """The gaps about the policy's evaluation; fewer if input errors are allowed."""
    errors = input_errors(system)
    exact = [s.name for s in system.inputs if s.name not in errors]
    if len(exact) == system.m:
        return (
            "Rounding in the controller.",
            "The policy is evaluated in exact real arithmetic on its binary64 numbers; an embedded float32 evaluation "
            "differs by its rounding errors.",
        )
    ranges = listed([Varying(e, *system.ranges[e], system.units.get(e, "")).words for e in errors.values()])
    others = f" {listed([symbol(name) for name in exact])} must be exact." if exact else ""
    return (
        "Larger errors of the controller.",
        f"An evaluation of the policy, in float32 for one, is covered as long as its error is {ranges}, at "
        f"every state of the set. That a certain program is, is not part of the claim.{others}",
    )
