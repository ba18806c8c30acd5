"""Words of claims that only some certificates have: outer, ranks, keep, data, samples, handover, claims without V."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import TYPE_CHECKING, Any

from . import words
from .boxes import LEAF
from .document import Certificate
from .sections import MAX_RANK, Axis, Data, Outer, Ranks, Trusted
from .words import decimal, expression, interval, number

if TYPE_CHECKING:
    from .rules import Tally


CLAIMS = {
    **words.CLAIMS,
    "enlarged": "the origin is asymptotically stable; every trajectory of the closed loop that starts in V <= {c.c2!r} "
    "stays there and converges to the origin, and every one that starts in x'Sx <= 1 stays in the domain, is in "
    "V <= {c.c2!r} after {time!r} units of time at the latest, and converges to the origin",
    "reached": "the origin is asymptotically stable; every trajectory of the closed loop that starts in V <= {c.c2!r} "
    "stays there and converges to the origin, and every one that starts in (x - c)'S(x - c) <= 1 stays in the domain, "
    "is in V <= {c.c2!r} after {time!r} units of time at the latest, and converges to the origin",
    "nearby": "every trajectory of the closed loop that starts in V <= {c.c2!r} {when[stays]}, enters V <= {c.c0!r} "
    "{when[enters]} and {when[remains]} from then on; and where what is uncertain is constant in time, there is "
    "exactly one equilibrium in V <= {c.c0!r}, and all of these trajectories converge to it",
}
_BY_STEPS = {
    "start": "",
    "stays": "is there at every later step",
    "enters": "after finitely many steps",
    "remains": "is there at every step",
}
_SAMPLED = {
    "start": " at a sampling instant",
    "stays": "is there at every later sampling instant, is in the domain at all times",
    "enters": "at some sampling instant",
    "remains": "is there at every sampling instant",
}
_SAMPLED_FROM_0 = {**_SAMPLED, "stays": "is there at all later times", "remains": "is there at all times"}


def claim(c: Certificate) -> list[str]:
    """The claim in sentences: its trajectories, and the additions of a sample, a rate, an outer set and others."""
    when, lines = _BY_STEPS if c.discrete else words.AT_ONCE, list[str]()
    bound, latest = "V(x(t)) <= V(x(0)) exp(-2 lambda t)", "after {} units of time at the latest"
    if c.discrete:
        bound, latest = "V(x_k) <= V(x_0) exp(-2 lambda k) after k steps", "after {} steps, rounded up, at the latest"
    if c.sample is not None:
        lo, hi = c.sample
        when = _SAMPLED if lo else _SAMPLED_FROM_0
        each = f"any sequence of periods in {interval(c.sample)}" if lo < hi else f"exactly {number(hi)}"
        lines.append(f"  the input is held from each sampling instant to the next, for {each} units of time")
        bound = "V(x(t_k)) <= V(x(t_0)) exp(-2 lambda (t_k - t_0)) at sampling instants"
        latest = "at every sampling instant that comes {} units of time or more after the start"
    lines += [*words.falls(c, bound, latest), *additions(c, when["start"])]
    if c.without_V:
        return [f"claim: {without_V(c, when['start'])}", *lines]
    return [words.said(CLAIMS[c.claim].format(c=c, time=duration(c), when=when)), *lines]


def stated(c: Certificate) -> list[str]:
    """The plant, the policy, V, the target, the tube's start, the second function and the claim, line by line."""
    target = [] if c.target is None else [f"{expression(tree)} <= 0" for tree in c.target.trees]
    return [
        *words.stated(c),
        *([f"target: {', '.join(target)}"] if target else []),
        *([] if c.tube is None else [f"S = {words.matrix(c.tube.start)}"]),
        *([] if c.tube is None or c.tube.centre is None else [f"c = {words.matrix(c.tube.centre[None])}"]),
        *([] if c.outer is None else [f"N(x) = {expression(c.outer.function.trees[0])}"]),
        *claim(c),
    ]


def answers(c: Certificate, tally: Tally) -> dict[str, Any]:
    """The parts of an answer that only some have."""
    answer, evidence = dict[str, Any](), c.evidence
    if isinstance(evidence, Trusted):
        said = [": ".join(pair) for pair in evidence.queries]
        answer |= {"solver": evidence.solver, "version": evidence.version, "answers": said}
    elif c.claim == "invariant":
        answer |= {"leaves": tally.rules["outer"], "margins": {"outer": tally.margins["outer"]}}
    if c.outer is not None:
        leaves = {"leaves": c.outer.tree.count(LEAF), "face_leaves": tally.rules["faces"]}
        answer["outer"] = {"level": c.outer.level, **leaves}
    if c.ranks is not None:
        _, steps = c.ranks.numbers
        answer["ranks"] = {"leaves": len(steps), "steps": c.ranks.most, "of": sum(map(bool, steps.tolist()))}
    if c.then is not None and tally.then is not None:
        stated = {"claim": c.then.claim, "levels": c.then.levels}
        of_rules = {"rules": tally.then.rules, "margins": tally.then.margins, "leaves": tally.then.rules["tree"]}
        answer["then"] = {"plant": c.then.name, **stated, **of_rules}
    if c.tube is not None:
        centre, longest = None if c.tube.centre is None else c.tube.centre.tolist(), duration(c)
        answer |= {
            "start": c.tube.start.tolist(),
            "centre": centre,
            "time": longest if math.isfinite(longest) else None,
        }
    return answer


def report(c: Certificate, answer: dict[str, Any]) -> list[str]:
    """The whole answer, line by line, with the statements of a certificate that takes over."""
    result, then, counted = answer["result"], list[str](), list[str]()
    if c.claim in ("reaches", "remains"):
        rest = f"leaves {answer['ranks']['leaves']}"
    elif c.claim == "invariant":
        margin = answer["margins"]["outer"]
        least = "" if margin is None else f"; smallest bound of -N'F on a leaf on which N may be its level {margin:.3g}"
        rest = f"leaves {answer['outer']['leaves']}{least}"
    elif result == "TRUSTED":
        rest = f"not checked, the solver's word: {', '.join(answer['answers'])}"
        result = f"TRUSTED {answer['solver']} {answer['version']}"
    else:
        rest = words.margins(c, answer, "D" if c.step else "Vdot")
    if c.then is not None:
        counts = ", ".join(f"{rule} {count}" for rule, count in answer["then"]["rules"].items())
        then, counted = [*handed_over(c, c.then), *stated(c.then)], [f"of the certificate that takes over: {counts}"]
    return [*stated(c), *then, *words.held(answer, counted), rest, words.verdict(c, result)]


def duration(c: Certificate) -> float:
    """The tube's duration, rounded up; infinite if it exceeds all binary64 numbers."""
    slabs = () if c.tube is None else c.tube.slabs
    try:
        return math.nextafter(math.fsum(slab.duration for slab in slabs), math.inf)
    except OverflowError:
        return math.inf


def additions(c: Certificate, start: str) -> list[str]:
    """The rest of the claim, line by line; `start` is when a trajectory starts."""
    lines = []
    if c.outer is not None and not c.without_V:
        lines.append(beyond(c, c.outer))
    if c.ranks is not None and not c.without_V:
        same = ", up to these multiples," if c.ranks.angles else ""
        rest = f", and from then on is{same} one of those above"
        lines.append(f"  and every trajectory that {by_ranks(c, c.ranks, start, rest)}")
    if c.keep is not None:
        until = ", until it is in the target" if c.claim == "reaches" else ""
        kept = ", ".join(f"{expression(tree)} < 0" for tree in c.keep.trees)
        lines.append(
            f"  and along every trajectory of these, {'at every step' if c.discrete else 'at all times'}{until}: {kept}"
        )
    if c.data is not None:
        lines.append(f"  {consistent(c, c.data)}")
    if c.samples is not None:
        from . import samples

        lines += samples.sampled(c, c.samples)
    return lines


def without_V(c: Certificate, start: str) -> str:
    """The claim of a set that is never left, or of a region that is reached."""
    if c.outer is not None:
        return (
            f"every trajectory of the closed loop that starts in a state of the domain with N(x) <= {c.outer.level!r} "
            "exists and is in such a state at all times, and in the interior of the domain; nothing is claimed of "
            "where it goes; u stays in its bounds"
        )
    if c.ranks is None:
        raise TypeError("a claim without V is about a set of N or about ranks")
    said = by_ranks(c, c.ranks, start, "")
    ending = "of later" if c.claim == "reaches" else "of where it goes"
    return f"every trajectory of the closed loop that {said}; nothing is claimed {ending}"


def beyond(c: Certificate, outer: Outer) -> str:
    """The statement of chapter outer."""
    return (
        f"  and every trajectory that starts in the union of V <= {c.c2!r} and of the states of the domain with "
        f"N(x) <= {outer.level!r} stays in this union, enters V <= {c.c2!r} in finite time, and from then on is "
        "one of those above; u stays in its bounds; states outside the domain are not meant, whatever N is there"
    )


def by_ranks(c: Certificate, ranks: Ranks, start: str, rest: str) -> str:
    """The statement of chapter ranks, with what comes after the target."""
    angles = ", ".join(c.states[i] for i in ranks.angles)
    places = f" up to multiples of 2 pi in {angles}" if angles else ""
    others = f"each state but {angles}" if angles else "the state"
    inside = f"{others} is in the interior of the domain and " if len(ranks.angles) < len(c.states) else ""
    each = memoryview(ranks.ranks).cast("H")  # of two bytes, whose order does not matter to what is asked
    count = sum(rank != MAX_RANK for rank in each)
    begins = f"starts in a leaf of finite rank ({count} of {len(each)} leaves){start}"
    steps = "steps" if c.discrete else "periods"
    if c.claim == "remains":
        return (
            f"{begins} exists at all times and is in such a leaf again{places} after {ranks.most} {steps} at most, and "
            f"so on for ever; at all times {inside}u stays in its bounds"
        )
    target = f"V <= {c.c2!r}" if c.target is None else "the target"
    return (
        f"{begins} is in {target}{places} after as many {steps} as the rank is, at the latest, {ranks.most} at most"
        f"{rest}; until then {inside}u stays in its bounds"
    )


def consistent(c: Certificate, data: Data) -> str:
    """The statement of chapter data."""
    priors = ", ".join(f"{name} in {interval(pair)}" for name, pair in zip(data.parameters, data.priors, strict=True))
    noise = ", ".join(f"{name} within {number(w)}" for name, w in zip(c.states, data.noise, strict=True))
    moved = [f"{name} + {number(q)}" for name, q in zip(c.states, data.origin, strict=True) if q]
    of = f"; measured are {', '.join(moved)}" if moved else ""
    axes = "".join(f", {a.name} = {_sum(a, data.parameters)}" for a in data.axes)
    such = f"{axes} (about; the file has exact numbers)" if axes else ""
    lasting = "" if data.period is None else f" of {_lasting(data.period)} units of time, with the input held"
    return (
        f"and so for every plant with constant {priors}{such} that is consistent with {data.transitions} measured "
        f"transitions{lasting}, in {len(data.runs)} runs ({noise}{of}; from a file with sha256 {data.sha256}): "
        "their parameters lie in the ranges above; of other plants nothing is claimed"
    )


def _sum(axis: Axis, parameters: tuple[str, ...]) -> str:
    return " + ".join([decimal(axis.at), *(f"({decimal(q)}) {p}" for q, p in zip(axis.by, parameters, strict=True))])


def _lasting(period: tuple[Fraction, Fraction]) -> str:
    lo, hi = period
    return number(lo) if lo == hi else f"some time in {interval(period)}"


def handed_over(c: Certificate, then: Certificate) -> list[str]:
    """The statement of chapter handover; what is stated of the second certificate follows."""
    left, each = ("x+ = g(k, x, u)", "step") if c.discrete else ("xdot = g(t, x, u)", "time")
    sampled = "; so are the plants that have functions of its samples" if c.samples or then.samples else ""
    return [
        f"handover: a plant {left} is one of a certificate if at every {each}, state in its domain and input in its "
        "bounds g is a value of its f, for some of what is uncertain, of which measured parameters are constant and "
        f"consistent with the measurements{sampled}",
        "  of every plant that is one of the certificate above and of the one below, every trajectory above enters "
        f"V <= {c.c0!r}, which lies in V <= {then.c2!r} of the one below, and from then on is one of those below",
        "certificate that takes over:",
    ]
