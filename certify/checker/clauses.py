"""Words of claims that only some certificates have: outer, ranks, keep, data, handover, and the claims without V."""

from __future__ import annotations

from fractions import Fraction

from .document import MAX_RANK, Certificate, Outer
from .sections import Data, Ranks
from .words import expression, interval, number


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
    return f"every trajectory of the closed loop that {said}; nothing is claimed of later"


def beyond(c: Certificate, outer: Outer) -> str:
    """The statement of chapter outer."""
    return (
        f"  and every trajectory that starts in the union of V <= {c.c2!r} and of the states of the domain with "
        f"N(x) <= {outer.level!r} stays in this union, enters V <= {c.c2!r} in finite time, and from then on is "
        "one of those above; u stays in its bounds; states outside the domain are not meant, whatever N is there"
    )


def by_ranks(c: Certificate, ranks: Ranks, start: str, rest: str) -> str:
    """The statement of chapter ranks, with what comes after the target."""
    target = f"V <= {c.c2!r}" if c.target is None else "the target"
    angles = ", ".join(c.states[i] for i in ranks.angles)
    places = f" up to multiples of 2 pi in {angles}" if angles else ""
    others = f"each state but {angles}" if angles else "the state"
    inside = f"{others} is in the interior of the domain and " if len(ranks.angles) < len(c.states) else ""
    each = memoryview(ranks.ranks).cast("H")  # of two bytes, whose order does not matter to what is asked
    count = sum(rank != MAX_RANK for rank in each)
    return (
        f"starts in a leaf of finite rank ({count} of {len(each)} leaves){start} is in {target}{places} after as many "
        f"{'steps' if c.discrete else 'periods'} as the rank is, at the latest, {ranks.most} at most{rest}; until then "
        f"{inside}u stays in its bounds"
    )


def consistent(c: Certificate, data: Data) -> str:
    """The statement of chapter data."""
    priors = ", ".join(f"{name} in {interval(pair)}" for name, pair in zip(data.parameters, data.priors, strict=True))
    noise = ", ".join(f"{name} within {number(w)}" for name, w in zip(c.states, data.noise, strict=True))
    moved = [f"{name} + {number(q)}" for name, q in zip(c.states, data.origin, strict=True) if q]
    of = f"; measured are {', '.join(moved)}" if moved else ""
    lasting = "" if data.period is None else f" of {_lasting(data.period)} units of time, with the input held"
    return (
        f"and so for every plant with constant {priors} that is consistent with {data.transitions} measured transitions"
        f"{lasting}, in {len(data.runs)} runs ({noise}{of}; from a file with sha256 {data.sha256}): their parameters "
        "lie in the ranges above; of other plants nothing is claimed"
    )


def _lasting(period: tuple[Fraction, Fraction]) -> str:
    lo, hi = period
    return number(lo) if lo == hi else f"some time in {interval(period)}"


def handed_over(c: Certificate, then: Certificate) -> list[str]:
    """The statement of chapter handover; what is stated of the second certificate follows."""
    left, each = ("x+ = g(k, x, u)", "step") if c.discrete else ("xdot = g(t, x, u)", "time")
    return [
        f"handover: a plant {left} is one of a certificate if at every {each}, state in its domain and input in its "
        "bounds g is a value of its f, for some of what is uncertain, of which measured parameters are constant and "
        "consistent with the measurements",
        "  of every plant that is one of the certificate above and of the one below, every trajectory above enters "
        f"V <= {c.c0!r}, which lies in V <= {then.c2!r} of the one below, and from then on is one of those below",
        "certificate that takes over:",
    ]
