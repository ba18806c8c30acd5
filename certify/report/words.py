"""What a report says, and how: names, units and numbers as people read them, and each kind of claim in words.

Shared by the terminal summary, the figures and the page. Numbers are rounded in a direction wherever a reader could
take them for a bound: `below` what is claimed of a set, `above` what contains it.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any

from certify.errors import CertificateFormatError

MINUS, TIMES, ABSENT = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{EN DASH}"
_LETTERS = "alpha beta gamma delta epsilon zeta eta theta kappa mu nu xi rho sigma tau phi chi psi omega"
_GREEK = {name: unicodedata.lookup(f"GREEK SMALL LETTER {name}") for name in _LETTERS.split()}
_SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")
_SUPERSCRIPTS = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
_DOT = "\u0307"


def symbol(name: str) -> str:
    """A name as a symbol: Greek letters, subscripts, a dot for `_dot`.

    >>> symbol("theta"), symbol("x1"), symbol("speed")
    ('θ', 'x₁', 'speed')
    """
    if name.endswith("_dot") and len(name) > len("_dot"):
        base = symbol(name.removesuffix("_dot"))
        return base[:1] + _DOT + base[1:]
    match = re.fullmatch(r"([A-Za-z]+?)_?(\d*)", name)
    if match is None:
        return name
    letters, digits = match.groups()
    return _GREEK.get(letters, letters) + digits.translate(_SUBSCRIPTS)


def label(name: str, unit: str) -> str:
    """Symbol and unit of an axis."""
    return f"{symbol(name)} ({pretty_unit(unit)})" if unit else symbol(name)


def deviation(name: str, x_eq: Fraction, unit: str) -> str:
    """Symbol and unit of an axis along which a state's deviation from its operating point is drawn.

    >>> deviation("h", Fraction(1, 100), "m"), deviation("h", Fraction(0), "m")
    ('h − 0.01 (m)', 'h (m)')
    """
    if not x_eq:
        return label(name, unit)
    value = number(float(abs(x_eq)))
    shifted = f"{symbol(name)} {MINUS if x_eq > 0 else '+'} {value}"
    return f"{shifted} ({pretty_unit(unit)})" if unit else shifted


def at_rest(names: Sequence[str], x_eq: Sequence[Fraction], units: Sequence[str]) -> str:
    """The operating point in words, such as `h = 0.01 m, v = 0 m/s`; nothing where it is 0 in all states."""
    if not any(x_eq):
        return ""
    each = zip(names, x_eq, units, strict=True)
    return ", ".join(f"{symbol(name)} = {number(float(q))} {pretty_unit(unit)}".rstrip() for name, q, unit in each)


def point(names: Sequence[str], values: Sequence[float | Fraction], units: Sequence[str]) -> str:
    """A state in words, such as `p = 1.5 m, v = 0 m/s`; of a float the shortest decimal that reads back as it.

    >>> point(["p", "theta"], [1.5, -0.1], ["m", ""])
    'p = 1.5 m, θ = −0.1'
    """
    each = zip(names, values, units, strict=True)
    return ", ".join(f"{symbol(name)} = {shortest(float(v))} {pretty_unit(unit)}".rstrip() for name, v, unit in each)


def pretty_unit(unit: str) -> str:
    """`m/s^2` as `m/s²`."""
    return re.sub(r"\^(-?\d+)", lambda match: match.group(1).translate(_SUPERSCRIPTS), unit)


def volume_name(n: int) -> str:
    """What the n-dimensional volume is called."""
    return {1: "length", 2: "area"}.get(n, "volume")


def volume_unit(units: Sequence[str]) -> str:
    """Unit of the product of the states, or nothing if a state has none."""
    return " · ".join(pretty_unit(u) for u in units) if all(units) and len(units) <= 3 else ""


def number(value: float | None, digits: int = 6) -> str:
    """A number rounded to the nearest, for reading; a dash if it is absent.

    >>> number(1.25e-6), number(-2.5)
    ('1.25 × 10⁻⁶', '−2.5')
    """
    return ABSENT if value is None or math.isnan(value) else _typeset(f"{value:.{digits}g}")


def shortest(value: float) -> str:
    """The shortest decimal that reads back as this number.

    >>> shortest(0.1), shortest(-2.0), shortest(1e-9)
    ('0.1', '−2', '1 × 10⁻⁹')
    """
    return _typeset(repr(value).removesuffix(".0"))


def below(value: float | Fraction, digits: int = 6) -> str:
    """A number rounded down to so many digits: the decimal that is shown is not above the exact value.

    >>> below(7.1670597510), below(2e-7), below(Fraction(2, 3), 3)
    ('7.16705', '1.99999 × 10⁻⁷', '0.666')
    """
    return _rounded(value, digits, math.floor)


def above(value: float | Fraction, digits: int = 6) -> str:
    """A number rounded up to so many digits: the decimal that is shown is not below the exact value.

    >>> above(7.1670597510), above(0.5), above(Fraction(2, 3), 3)
    ('7.16706', '0.5', '0.667')
    """
    return _rounded(value, digits, math.ceil)


def _rounded(value: float | Fraction, digits: int, direction: Callable[[Fraction], int]) -> str:
    if isinstance(value, float) and not math.isfinite(value):
        return number(value, digits)
    exact = Fraction(value)
    if exact == 0:
        return "0"
    coefficient, last = _decimal(exact, digits, direction)
    text = str(abs(coefficient))
    exponent = last + len(text) - 1
    text = text.rstrip("0")
    if -5 < exponent < digits:  # as format code g does
        whole = text[: exponent + 1].ljust(exponent + 1, "0") if exponent >= 0 else "0"
        fraction = text[exponent + 1 :] if exponent >= 0 else "0" * (-exponent - 1) + text
        shown = whole + ("." + fraction if fraction else "")
    else:
        shown = text[0] + ("." + text[1:] if text[1:] else "") + f"e{exponent}"
    return _typeset(("-" if coefficient < 0 else "") + shown)


def _decimal(exact: Fraction, digits: int, direction: Callable[[Fraction], int]) -> tuple[int, int]:
    """(coefficient, exponent of ten) of a nonzero number rounded to so many digits."""
    size = abs(exact)
    exponent = len(str(size.numerator)) - len(str(size.denominator))  # of the leading digit, or one more
    exponent -= Fraction(10) ** exponent > size
    last = exponent - digits + 1
    return direction(exact / Fraction(10) ** last), last


def kept_apart(value: float, limit: Fraction) -> str:
    """`value < limit`, the value rounded up and the limit down, in as many digits as keep the one below the other.

    >>> kept_apart(1.9999999, Fraction(2)), kept_apart(1.0, Fraction(2))
    ('1.9999999 < 2', '1 < 2')
    """
    if 0 < value < limit:
        for digits in range(6, 30):
            (a, at), (b, below_at) = _decimal(Fraction(value), digits, math.ceil), _decimal(limit, digits, math.floor)
            if a * Fraction(10) ** at < b * Fraction(10) ** below_at:
                return f"{above(value, digits)} < {below(limit, digits)}"
    return f"{above(value)}, domain {below(limit)}"


def _typeset(text: str) -> str:
    mantissa, e, exponent = text.partition("e")
    power = f" {TIMES} 10{str(int(exponent)).translate(_SUPERSCRIPTS)}" if e else ""
    return mantissa.replace("-", MINUS) + power


def seconds(value: float | None) -> str:
    """A duration; a dash if it is absent."""
    return ABSENT if value is None else f"{value:.2f} s" if value >= 0.095 else f"{value * 1000:.0f} ms"


@dataclass(frozen=True, slots=True)
class Words:
    """One kind of claim in words. In texts, {inner} and {outer} stand for its levels in digits, {duration} for how long
    its tube is, {centre} for the state that it begins around.

    Parameters
    ----------
    title : the page's.
    inner, inner_word : symbol and name of the inner level.
    inner_set : what the figures call the inner set.
    statement : the claim, after which nothing has to be added.
    headline : the same in a line of the terminal.
    meaning : of the outer set, for captions.
    decay : what of a falling V is part of the claim and what is not; {word} is "proved" or "claimed".
    simulated : which runs count in the simulated figures.
    settles, runs : what becomes of a run that counts, and what a legend calls such runs.
    parts : name, condition, and how it is shown from a partition; None where that is in the condition.
    excluded : head and text of what this claim, other than its siblings, does not say.
    start : what the start of its tube is called; nothing where it has none.
    sets : what the claim is about, in the caption of what is not.
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
    parts: tuple[tuple[str, str, str], ...]
    excluded: tuple[tuple[str, str], ...]
    start: str = ""
    sets: str = "{V ≤ c₂}"


SMOOTH = ("Equations", "The closed loop is locally Lipschitz on {V ≤ c₂}: solutions exist and are unique.", "")
DEFINITE = ("Lyapunov function", "P is symmetric positive definite, so that {V ≤ c₂} is compact.", "")
DOMAIN = ("Domain", "{V ≤ c₂} lies strictly inside the domain.", "")
INPUTS = ("Inputs", "On {V ≤ c₂} the input stays in its bounds, so that an actuator that clips changes nothing.", "")
LEAF_BY_LEAF = "leaf by leaf of a partition that covers the set by construction"
CHECKED_ALWAYS = frozenset({"Lyapunov function", "Equilibrium", "Domain"})
"""The parts that the checker checks whatever the evidence is; the others are then the solver's word."""

CLAIMS: Mapping[str, Words] = {
    "asymptotic": Words(
        title="Region of attraction",
        inner="c₁",
        inner_word="local",
        inner_set="local set",
        statement="Every trajectory of the closed loop that starts in the set {{V(x) ≤ {outer}}} stays in it for all "
        "time and converges to the origin, which is asymptotically stable.",
        headline="{{V <= {outer}}} is invariant and attracted by the origin",
        meaning="in which every trajectory converges to the origin",
        decay="That V falls to 0 is {word}; how fast is not.",
        simulated="stay in the domain and come near the origin",
        settles="settle",
        runs="trajectories that settle",
        parts=(
            SMOOTH,
            ("Equilibrium", "P is symmetric positive definite and f(0, u_eq) = 0 exactly.", ""),
            DOMAIN,
            (
                "Local",
                "V̇(x) < 0 for all x with 0 < V(x) ≤ c₁",
                "by the linearisation and a bound on its remainder that holds at all smaller radii: there is no hole "
                "around the origin",
            ),
            ("Ring", "V̇(x) < 0 for all x with c₁ ≤ V(x) ≤ c₂", LEAF_BY_LEAF),
            INPUTS,
        ),
        excluded=(("Speed and cost.", "Trajectories converge; how fast, and at what cost, is not part of the claim."),),
    ),
    "practical": Words(
        title="Practical stability",
        inner="c₀",
        inner_word="floor",
        inner_set="inner set",
        statement="Every trajectory of the closed loop that starts in the set {{V(x) ≤ {outer}}} stays in it for all "
        "time, enters the smaller set {{V(x) ≤ {inner}}} in finite time, and stays there from then on. That is all: "
        "of what happens inside the smaller set nothing is said.",
        headline="from {{V <= {outer}}} every trajectory enters {{V <= {inner}}} and stays there; nothing is said of "
        "the origin",
        meaning="from which every trajectory enters the green set and stays there",
        decay="That V falls below c₀ in finite time and stays there is {word}; how soon, and what V does below c₀, is "
        "not.",
        simulated="stay in the domain and enter {V ≤ c₀}",
        settles="enter {V ≤ c₀}",
        runs="trajectories that enter",
        parts=(
            SMOOTH,
            DEFINITE,
            DOMAIN,
            ("Ring", "V̇(x) < 0 for all x with c₀ ≤ V(x) ≤ c₂, both boundaries included", LEAF_BY_LEAF),
            INPUTS,
        ),
        excluded=(
            (
                "Anything inside {V ≤ c₀}.",
                "Trajectories end up in this set and remain there, whatever they do in it: circle, jitter, or rest "
                "somewhere. The origin need not attract them, and need not be an equilibrium at all.",
            ),
            ("Speed and cost.", "The time to reach {V ≤ c₀} is finite; how long, and at what cost, is not stated."),
        ),
    ),
}


_ASYMPTOTIC = CLAIMS["asymptotic"]
CLAIMS = {
    **CLAIMS,
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
                "Each ellipsoid {x′P(t)x ≤ 1} lies strictly inside the domain; on it the closed loop is twice "
                "continuously differentiable, no clip acts, and the input stays in its bounds.",
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
        "after {duration} at the latest, and converges to the origin as well. These two sets are all that the claim is "
        "about; nothing is said of what starts between them.",
        headline="{{V <= {outer}}} is invariant and attracted by the origin, and every trajectory from an ellipsoid "
        "around the state enters it",
        decay="That V is at most c₂ once the tube has ended, and falls to 0, is {word}; how fast from then on is not.",
        parts=(
            *_ASYMPTOTIC.parts,
            (
                "Tube",
                "With c(t) and P(t), which begin as c₀ and P₀, no trajectory from the start leaves "
                "{(x − c(t))′P(t)(x − c(t)) ≤ 1}: on its edge the form falls along every trajectory; and at its end "
                "this ellipsoid lies in {V ≤ c₂}",
                "one slab of time after the other, by the linearisation and a bound on its remainder that knows "
                "directions and the motion of c(t)",
            ),
            (
                "Along the tube",
                "Each ellipsoid of the tube lies strictly inside the domain; on it the closed loop is twice "
                "continuously differentiable, no clip acts, and the input stays in its bounds.",
                "",
            ),
        ),
        excluded=(
            (
                "What lies between.",
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


def words_for(kind: str) -> Words:
    """The words of a claim.

    Raises
    ------
    CertificateFormatError : there are none for this kind; a page must not guess.
    """
    if kind not in CLAIMS:
        raise CertificateFormatError(f"reports know the claims {', '.join(CLAIMS)}; found {kind!r}.")
    return CLAIMS[kind]


def inner_level(kind: str, value: float | Fraction, digits: int = 6) -> str:
    """The inner level rounded to the safe side: down where something is claimed inside it, up where outside."""
    return above(value, digits) if kind == "practical" else below(value, digits)


_LIMITS = {
    "domain": "the domain",
    "inputs": "the input bounds: beyond it the policy asks for more than the actuator gives",
    "witness": "a point where Vdot >= 0",
    "time": "the time limit: more may be provable",
    "refused by the checker": "the checker, which refuses some of what was found",
    "boxes": "the limit on boxes: more may be provable",
    "requested": "the level that was asked for",
}
_TOUCHING = Fraction(1, 10**6)  # relative distance from the domain's limit below which a set is said to touch it


def limited_by(result: Mapping[str, Any]) -> str:
    """What limits the level of a result, in words; reasons that are sentences already stay as they are.

    An engine may stop short of the domain's limit by a margin of its own, such as a solver's precision. Then the
    margin limits, and it is named with its size.
    """
    reason = str(result["reason"])
    levels = result["levels"]
    level, limit = levels.get("roa"), levels.get("domain_limit")
    if reason == "domain" and level and limit:
        short = 1 - Fraction(level) / Fraction(limit)
        if short > _TOUCHING:
            solver: Mapping[str, Any] = result.get("solver") or {}
            precision = solver.get("precision")
            apart = f"{number(float(100 * short), 3)} % below the domain's limit {below(limit)}"
            if precision is None:
                return f"a margin that the engine keeps: {apart}"
            return f"the precision of {solver['solver']} (delta {number(precision)}), which stops {apart}"
    return limit_in_words(reason)


def limit_in_words(reason: str) -> str:
    """A reason that is a single word as a reader understands it; sentences stay as they are.

    >>> limit_in_words("time")
    'the time limit: more may be provable'
    """
    return _LIMITS.get(reason, reason)
