"""The words of each kind of claim.

A claim's words have placeholders `$name` for text that depends on the loop's timing and the claimed rate (phrases.py),
and placeholders in braces for its numbers. So there is one set of words per kind of claim, and not one per
combination.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from string import Template
from typing import Any

from certify.errors import CertificateFormatError
from certify.report.handover import TakingOver, with_handover
from certify.report.phrases import phrases_of
from certify.report.ranked import with_constraints, with_ranks
from certify.report.timing import PLAIN, TimingInWords
from certify.report.words import PRACTICAL, exact_number

Part = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class Words:
    """One kind of claim in words. In texts, {inner} and {outer} stand for its levels in digits, {duration} for how long
    its tube is, {centre} for the state that it begins around, {speed} for what a rate says (TimingInWords.speed),
    {constant} for the words that ask what is uncertain to be constant, {beyond} for the level of N, {steps} and
    {constraints} for what stands in ranked.py.

    Parameters
    ----------
    title : the page's title.
    inner, inner_word : symbol and name of the inner level.
    inner_set : the figures' name of the inner set.
    statement : the claim, complete.
    headline : the same in one line of the terminal.
    meaning : the meaning of the outer set, for captions.
    decay : the part of V's decrease that is claimed, and the part that is not; {word} is "proved" or "claimed".
    simulated : the runs that count in the simulated figures.
    settles, runs : the end of a run that counts, and the legend's name of such runs.
    parts : name, condition, and proof from a partition; None if the condition has it.
    excluded : heads and texts of the gaps of this kind of claim alone.
    start : the name of the start of its tube; empty without one.
    sets : the sets of the claim, for the caption of the gaps.
    """

    title: str
    inner: str
    inner_word: str
    inner_set: str
    statement: str
    headline: str
    meaning: str
    decay: str
    simulated: str
    settles: str
    runs: str
    parts: tuple[Part, ...]
    excluded: tuple[tuple[str, str], ...]
    start: str = ""
    sets: str = "{V ≤ c₂}"


SMOOTH = ("Equations", "The closed loop is locally Lipschitz on {V ≤ c₂}$unique.", "")
DEFINITE = ("Lyapunov function", "P is symmetric positive definite, so that {V ≤ c₂} is compact.", "")
DOMAIN = ("Domain", "{V ≤ c₂} lies strictly inside the domain.", "")
INPUTS = ("Inputs", "On {V ≤ c₂} the input stays in its bounds, so that an actuator that clips changes nothing.", "")
LEAF_BY_LEAF = "leaf by leaf of a partition that covers the set by construction"
RING = ("Ring", "$fall for all x with c₁ ≤ V(x) ≤ c₂$each", LEAF_BY_LEAF)
CHECKED_ALWAYS = frozenset({"Lyapunov function", "Equilibrium", "Domain"})
"""The parts that the checker checks whatever the evidence is; the others are then the solver's word."""

CLAIMS: Mapping[str, Words] = {
    "asymptotic": Words(
        title="Region of attraction",
        inner="c₁",
        inner_word="local",
        inner_set="local set",
        statement="Every trajectory of the closed loop that starts in the set {{V(x) ≤ {outer}}}$begins "
        "$stays$also converges to the origin, which is asymptotically stable.$held{speed}",
        headline="{{V <= {outer}}} is invariant$at and attracted by the origin$over{speed}",
        meaning="in which every trajectory converges to the origin",
        decay="That V falls to 0$instants$fast is {word}$slow.$between",
        simulated="stay in the domain and come near the origin",
        settles="settle",
        runs="trajectories that settle",
        parts=(
            SMOOTH,
            ("Equilibrium", "P is symmetric positive definite and f(0, u_eq) = 0 exactly.", ""),
            DOMAIN,
            (
                "Local",
                "$fall for all x with 0 < V(x) ≤ c₁$each",
                "by the linearisation and a bound on its remainder that holds at all smaller radii: there is no hole "
                "around the origin",
            ),
            RING,
            INPUTS,
        ),
        excluded=(("$speed", "$converge"),),
    ),
    "practical": Words(
        title="Practical stability",
        inner="c₀",
        inner_word="floor",
        inner_set="inner set",
        statement="Every trajectory of the closed loop that starts in the set {{V(x) ≤ {outer}}}$begins "
        "$stays, $enters {{V(x) ≤ {inner}}} $by, and $remains from then on.$held{speed} That is "
        "all: the claim says nothing about motion inside the smaller set.",
        headline="from {{V <= {outer}}} every trajectory enters {{V <= {inner}}} and $there; nothing is claimed about "
        "the origin$over{speed}",
        meaning="from which every trajectory enters the inner set {V ≤ c₀} and $there",
        decay="That V falls below c₀ $within and stays there$always is {word}; $later is not.$kept",
        simulated="stay in the domain and come near {V ≤ c₀}",
        settles="come near {V ≤ c₀}",
        runs="trajectories that come near",
        parts=(
            SMOOTH,
            DEFINITE,
            DOMAIN,
            ("Ring", "$fall for all x with c₀ ≤ V(x) ≤ c₂, both boundaries included$each", LEAF_BY_LEAF),
            INPUTS,
        ),
        excluded=(
            (
                "Anything inside {V ≤ c₀}.",
                "Trajectories end up in this set and remain there, whatever they do in it: circle, jitter, or rest "
                "somewhere. The origin need not attract them, and need not be an equilibrium at all.",
            ),
            ("$speed", "$finite"),
        ),
    ),
}


_ASYMPTOTIC = CLAIMS["asymptotic"]
_PRACTICAL = CLAIMS["practical"]
_BY_CONSTANTS = (
    "by models of the closed loop, with Lipschitz constants of what they leave out, on a ball that contains {V ≤ c₀}"
)
_PAIRS = "for all x other than y with V(x) ≤ c₀ and V(y) ≤ c₀"
CLAIMS = {
    **CLAIMS,
    "nearby": replace(
        _PRACTICAL,
        title="A nearby equilibrium",
        statement=_PRACTICAL.statement.split(" That is all:")[0] + " And {constant}there is exactly one equilibrium in "
        "the smaller set, and every one of these trajectories converges to it. The claim says nothing else about "
        "motion inside the smaller set.",
        headline="from {{V <= {outer}}} every trajectory enters {{V <= {inner}}} and $there; {constant}it converges to "
        "the one equilibrium in that set$over{speed}",
        parts=(
            *_PRACTICAL.parts,
            (
                "Contraction",
                f"2(x − y)′P(F(x) − F(y)) < 0 {_PAIRS}",
                _BY_CONSTANTS,
            ),
        ),
        excluded=(
            (
                "Where the equilibrium is.",
                "It lies in {V ≤ c₀}. Where in it, and how it depends on what is uncertain, is not stated; the origin "
                "need not be one.",
            ),
            (
                "Anything else inside {V ≤ c₀}.",
                "Where something uncertain changes with time, trajectories end up in this set and remain there, "
                "whatever they do in it.",
            ),
            _PRACTICAL.excluded[-1],
        ),
    ),
    "enlarged": replace(
        _ASYMPTOTIC,
        statement=_ASYMPTOTIC.statement + " Every trajectory that starts in the ellipsoid {{x′P₀x ≤ 1}}, the start of "
        "a tube, stays in the domain, is in {{V(x) ≤ {outer}}} after {duration} at the latest, and converges to the "
        "origin as well.",
        headline="{{V <= {outer}}} is invariant and attracted by the origin, and every trajectory from the tube's "
        "start enters it",
        decay="That V is at most c₂ once the tube has ended, and falls to 0, is {word}; how fast from then on is not.",
        parts=(
            *_ASYMPTOTIC.parts,
            (
                "Tube",
                "x′P(t)x falls along every trajectory in {x′P(t)x ≤ 1} but the origin; P(t) begins as P₀, and at its "
                "end {x′P(t)x ≤ 1} lies in {V ≤ c₂}",
                "one slab of time after the other, by the linearisation and a bound on its remainder that knows "
                "directions",
            ),
            (
                "Along the tube",
                "Each ellipsoid {x′P(t)x ≤ 1} lies strictly inside the domain; on it the closed loop is locally "
                "Lipschitz, no clip acts, and the input stays in its bounds.",
                "",
            ),
        ),
        excluded=(
            (
                "Staying in the start.",
                "A trajectory from the tube's start may leave that ellipsoid on its way: it stays in the tube, which "
                "lies inside the domain.",
            ),
            (
                "Speed and cost.",
                "The tube says by when {V ≤ c₂} is reached; how fast trajectories converge from there, and at what "
                "cost, is not part of the claim.",
            ),
        ),
        start="start of the tube",
        sets="{V ≤ c₂} and the tube's start",
    ),
    "reached": replace(
        _ASYMPTOTIC,
        statement=_ASYMPTOTIC.statement + " Every trajectory that starts in the ellipsoid "
        "{{(x − c₀)′P₀(x − c₀) ≤ 1}} around the state c₀, {centre}, stays in the domain, is in {{V(x) ≤ {outer}}} "
        "after {duration} at the latest, and converges to the origin as well. The claim is about these two sets alone; "
        "it says nothing about trajectories that start between them.",
        headline="{{V <= {outer}}} is invariant and attracted by the origin, and every trajectory from an ellipsoid "
        "around the state enters it",
        decay="That V is at most c₂ once the tube has ended, and falls to 0, is {word}; how fast from then on is not.",
        parts=(
            *_ASYMPTOTIC.parts,
            (
                "Tube",
                "With c(t) and P(t), which begin as c₀ and P₀, no trajectory from the start leaves "
                "{(x − c(t))′P(t)(x − c(t)) ≤ 1}: on its boundary the form falls along every trajectory; at its end "
                "this ellipsoid lies in {V ≤ c₂}",
                "one slab of time after the other, by the linearisation and a bound on its remainder that knows "
                "directions and the motion of c(t)",
            ),
            (
                "Along the tube",
                "Each ellipsoid of the tube lies strictly inside the domain; on it the closed loop is locally "
                "Lipschitz, no clip acts, and the input stays in its bounds.",
                "",
            ),
        ),
        excluded=(
            (
                "States between the two sets.",
                "The set is the union of {V ≤ c₂} and the ellipsoid around c₀. States on the way from the one to the "
                "other, the path of the tube among them, belong to it only where they lie in one of the two.",
            ),
            (
                "Staying near c₀, and the path.",
                "A trajectory may leave the ellipsoid around c₀ on its way: it stays in the tube, which lies inside "
                "the domain. The path c(t) itself need not be a trajectory.",
            ),
            (
                "Speed and cost.",
                "The tube says by when {V ≤ c₂} is reached; how fast trajectories converge from there, and at what "
                "cost, is not part of the claim.",
            ),
        ),
        start="start of the tube, around c₀",
        sets="{V ≤ c₂} and the ellipsoid around c₀",
    ),
}


_ON_CONES = (
    "by models on cones of directions, which together are all directions; the chords of relus and clips that may "
    "change sides are bounded there"
)
_AROUND_A_LEVEL = (
    "Local",
    "$fall for all x with c₀ ≤ V(x) ≤ c₁$each",
    "by models of the closed loop on a ball that contains {V ≤ c₁}",
)


_BEYOND = (
    (
        "Faces",
        "N(x) > n₂ for all x on the boundary of the domain, so that the outer set does not touch it",
        "leaf by leaf of a partition of each face",
    ),
    (
        "Outer set",
        "For all x of the domain with V(x) ≥ c₂ and N(x) ≤ n₂, N is continuously differentiable, N′(x)F(x) < 0, the "
        "closed loop is locally Lipschitz, and the policy's input stays in its bounds",
        "leaf by leaf of a partition that covers the domain by construction",
    ),
)
_NOT_BEYOND = (
    (
        "Other parts of {N ≤ n₂}.",
        "Only states of the domain belong to the outer set. The claim says nothing about states outside the domain.",
    ),
    (
        "V and N on the way.",
        "N falls along a trajectory from the outer set until {V ≤ c₂} is entered; V may rise meanwhile. From then on "
        "nothing is claimed about N, which need not be positive, nor least at the origin.",
    ),
    (
        "When {V ≤ c₂} is entered.",
        "The time is finite for each trajectory from the outer set; how long it is, is not stated.",
    ),
)


def _with_outer(words: Words) -> Words:
    """The words of a claim with an outer set."""
    return replace(
        words,
        statement=words.statement + " Moreover every trajectory that starts in the outer set, the states x of "
        "the domain with N(x) ≤ {beyond} and no others, enters {{V(x) ≤ {outer}}} in finite time, and from then on "
        "behaves as just stated; on the way it stays in the union of the two sets.",
        headline=words.headline
        + "; from every state of the domain with N(x) <= {beyond}, {{V <= {outer}}} is entered in finite time",
        decay="V may rise above c₂; that it comes down to c₂ in finite time is {word}. " + words.decay,
        parts=(*words.parts, *_BEYOND),
        excluded=(*words.excluded[:-1], *_NOT_BEYOND, words.excluded[-1]),
        sets="{V ≤ c₂} and the outer set",
    )


@dataclass(frozen=True, slots=True)
class Additions:
    """The parts that a claim may have: `ball` in its evidence, `kinked` if that has directions, a set `beyond`
    {V <= c2}, boxes that are `ranked`, with names of `angles`, constraints that are `kept`, and a claim that takes
    over at the floor, `then`."""

    ball: bool = False
    kinked: bool = False
    beyond: bool = False
    ranked: bool = False
    angles: tuple[str, ...] = ()
    kept: bool = False
    then: TakingOver | None = None


NONE = Additions()


def words_for(kind: str, timing: TimingInWords = PLAIN, has: Additions = NONE) -> Words:
    """The words of a claim about a loop in which time passes so.

    Raises
    ------
    CertificateFormatError : the kind has no words; a page must not guess.
    """
    if kind not in CLAIMS:
        raise CertificateFormatError(f"reports know the claims {', '.join(CLAIMS)}; found {kind!r}.")
    words = _with_outer(CLAIMS[kind]) if has.beyond else CLAIMS[kind]
    parts = _with_ball(kind, words.parts, has.ball)
    parts = _on_cones(kind, parts) if has.kinked else parts
    words = replace(words, parts=tuple(_in_steps(kind, parts, timing)))
    words = with_ranks(words, has.angles) if has.ranked else words
    words = with_constraints(words, ranked=has.ranked, beyond=has.beyond) if has.kept else words
    words = words if has.then is None else with_handover(words, has.then)
    phrases = phrases_of(timing)
    return Words(**{f.name: _filled(getattr(words, f.name), phrases) for f in fields(Words)})


def _with_ball(kind: str, parts: tuple[Part, ...], ball: bool) -> tuple[Part, ...]:
    """The parts of a practical claim whose ring ends at a ball around its inner set."""
    if kind not in PRACTICAL or not ball:
        return parts
    return tuple(one for part in parts for one in ((_AROUND_A_LEVEL, RING) if part[0] == "Ring" else (part,)))


def _on_cones(kind: str, parts: tuple[Part, ...]) -> tuple[Part, ...]:
    """The parts of a claim whose ball has relus or clips that may change sides."""
    near = "" if kind in PRACTICAL else "; they hold at all smaller radii: there is no hole around the origin"
    return tuple((*part[:2], _ON_CONES + near) if part[0] == "Local" else part for part in parts)


def _in_steps(kind: str, parts: tuple[Part, ...], timing: TimingInWords) -> Iterator[Part]:
    """The parts, with those that a loop needs that is spoken of at its samples or steps."""
    after = "F(x)" if timing.discrete else "φ(h)"
    for part in parts:
        yield _contraction_in_steps(part, timing) if part[0] == "Contraction" and not timing.is_plain else part
        if part[0] == "Domain" and timing.sample is not None:
            yield (
                "Within a period",
                f"From every x in {{V ≤ c₂}}, with the input held at π(x), the solution φ exists for "
                f"{exact_number(timing.sample[1])} s and stays strictly inside the domain",
                "by an enclosure of it on each of the sets below",
            )
        if part[0] == "Ring" and kind in PRACTICAL and not timing.is_plain:
            yield ("Inner set", f"V({after}) < c₀ for all x with V(x) ≤ c₀$every", "with the parts above")


def _contraction_in_steps(part: Part, timing: TimingInWords) -> Part:
    """The part about trajectories that come closer, with each step or over each period."""
    if timing.discrete:
        return part[0], f"V(F(x) − F(y)) < V(x − y) {_PAIRS}", part[2]
    closer = f"V(φ(h, x) − φ(h, y)) < V(x − y) {_PAIRS}$every, φ(h, x) being φ(h) from x"
    return part[0], f"{closer}; and φ(h, x) = x only where F(x) = 0", part[2]


def _filled(text: Any, phrases: Mapping[str, str]) -> Any:
    """Texts, and tuples of them, with the phrases in their places."""
    if isinstance(text, tuple):
        return tuple(_filled(one, phrases) for one in text)
    return Template(text).substitute(phrases)
