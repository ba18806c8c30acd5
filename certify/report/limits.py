"""The limits of a result's level, in words."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from certify.report.timing import PLAIN, TimingInWords
from certify.report.words import below, number, symbol

_LIMITS = {
    "domain": "the domain",
    "inputs": "the input bounds: beyond it the policy asks for more than the actuator gives",
    "constraint": "a constraint: a larger set holds a state that violates it",
    "witness": "a point where Vdot >= 0",
    "effort": "the effort: more may be provable",
    "time": "the time limit: more may be provable",
    "refused by the checker": "the checker, which refuses some of what was found",
    "boxes": "the limit on boxes: more may be provable",
    "boxes too small": "boxes too small to be halved: more effort gains nothing",
    "requested": "the level that was asked for",
}
_OF_OUTER = {
    "domain": "the domain: a larger set reaches its boundary",
    "effort": "the effort: more may be provable",
    "time": "the time limit: more may be provable",
    "boxes": "the limit on boxes: more may be provable",
    "boxes too small": "boxes too small to be halved: more effort gains nothing",
    "requested": "the level that was asked for",
}
AT_A_POINT = frozenset({"domain", "vdot", "input", "keep"})
"""Kinds of limits that are met at a state, which is named; of others a run knows along which states it was hard."""
_TOUCHING = Fraction(1, 10**6)  # relative distance from the domain's limit below which a set is said to touch it


def limited_by(result: Mapping[str, Any]) -> str:
    """The limit of a result's level, in words; a reason that is a sentence already stays as it is.

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
    return _constraint(result) or limit_in_words(reason, TimingInWords.of_result(result))


def _constraint(result: Mapping[str, Any]) -> str:
    """The constraint that limits a level, in words; empty where none does."""
    name = (result.get("witness") or {}).get("constraint")
    if str(result["reason"]) != "constraint" or name is None:
        return ""
    said = (result.get("constraints") or {}).get(name)
    held = "sample" in (result.get("claim") or {})
    which = "from which a period may violate it" if held else "that violates it"
    return f"the constraint {name}{f': {said}' if said else ''}; a larger set holds a state {which}"


def hardest(weights: Mapping[str, float]) -> str:
    """The states that cost a proof most, in descending order.

    >>> hardest({"theta": 1.0, "x": 0.392})
    'θ; then x, 39 % as much, each measured by its domain'
    >>> hardest({"theta": 1.0})
    'θ'
    """
    first, *others = weights.items()
    then = ", ".join(f"{symbol(name)}, {100 * weight:.0f} % as much" for name, weight in others)
    return symbol(first[0]) + (f"; then {then}, each measured by its domain" if then else "")


def outer_limited_by(outer: Mapping[str, Any]) -> str:
    """The limit of an outer set's level, in words, from a result's entry on it.

    >>> outer_limited_by({"limit": "boxes"})
    'the limit on boxes: more may be provable'
    >>> outer_limited_by({"limit": "witness", "witness_level": 1.5, "violation": "keep", "constraint": "wall"})
    'a state at which the constraint wall is violated, where N = 1.5'
    """
    reason = str(outer["limit"])
    said = _OF_OUTER.get(reason, reason)
    if reason == "witness":
        said = f"a state at which {violated(outer.get('violation'), outer.get('constraint'))}"
    met = outer.get("witness_level")
    return said + (f", where N = {number(met)}" if reason == "witness" and met is not None else "")


def violated(kind: str | None, constraint: str | None, falling: str = "N does not fall") -> str:
    """The condition of an outer set that fails at a witness of this kind, in words."""
    if kind == "keep":
        return f"the constraint {constraint} is violated"
    return "an input leaves its bounds" if kind == "input" else falling


def limit_in_words(reason: str, timing: TimingInWords = PLAIN) -> str:
    """A reason that is a single word as a reader understands it; sentences stay as they are.

    >>> limit_in_words("time"), limit_in_words("domain: the effort ended 0.2 % below its limit")
    ('the time limit: more may be provable', 'the domain: the effort ended 0.2 % below its limit')
    """
    if reason == "witness" and not (timing.is_plain and not timing.rate):
        return f"a point where V does not fall{' at the rate asked for' if timing.rate else ''}{timing.over_what}"
    what, _, detail = reason.partition(": ")
    return f"{_LIMITS[what]}: {detail}" if what == "domain" and detail else _LIMITS.get(reason, reason)
