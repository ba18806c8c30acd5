"""The words of a claim that another takes over from, on the page and in the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from certify.report.sampled import Sampled
from certify.report.words import above, below

if TYPE_CHECKING:
    from certify.report.claims import Words

_ENDS = {
    "asymptotic": "converges to the origin, which is asymptotically stable",
    "nearby": "converges, where what is uncertain near it is constant in time, to one equilibrium",
}


@dataclass(frozen=True, slots=True)
class TakingOver:
    """The claim that takes over: its kind, and its level c2' as people read it."""

    kind: str
    level: str


def with_handover(words: Words, then: TakingOver) -> Words:
    """The words of a practical claim with another that takes over."""
    both = (
        "Handover",
        "{V ≤ c₀} lies in {V′ ≤ c₂′}: c₂′P − c₀P′ is positive definite; states, inputs, policy and times are the same "
        "in both claims. All parts of the second claim hold as well",
        "in a certificate of its own within this one",
    )
    alone = (
        "Plants that only one of the two describes.",
        "Of a plant that the second equations do not describe near the origin, nothing is claimed inside {V ≤ c₀}. "
        "That a plant is one of both, or yours is, is not part of the claim.",
    )
    return replace(
        words,
        title="Region of attraction, by two claims",
        statement=words.statement.split(" That is all:")[0]
        + " A second claim takes over there: of every plant that is "
        "one of both (whose right-hand side has, in each domain, values that the equations of that claim have), every "
        f"such trajectory is from then on one from {{{{V′(x) ≤ {then.level}}}}}, and {_ENDS[then.kind]}.",
        headline=words.headline.split("; nothing is claimed")[0]
        + f", and from there, if the plant is one of the second claim too, {_ENDS[then.kind]}",
        parts=(*words.parts, both),
        excluded=(alone, *words.excluded[1:]),
    )


def summary_lines(result: Mapping[str, Any]) -> list[str]:
    """The result of `certify compose` for the terminal."""
    name, then, levels = result["system"], result["then"], result["levels"]
    pair = name if name == then["system"] else f"{name}, then {then['system']}"
    sampled = Sampled.of_result(result)
    which = "of every plant that is one of both" if sampled is None else f"for every {sampled.consistent}"
    if result["verdict"] != "PROVED":
        return [f"UNKNOWN  {pair}: nothing was proved: {result['reason']}"]
    ends = _ENDS[result["claim"]["then"]["kind"]]
    return [
        f"PROVED  {pair}: {which}, every trajectory from {{V <= {below(levels['roa'])}}} "
        f"enters {{V <= {above(levels['floor'])}}}, which lies in {{V' <= {below(then['levels']['roa'])}}} of the "
        f"second, and {ends}",
        f"{['length', 'area', 'volume'][min(len(result['states']), 3) - 1]:<13}{below(result['volume'])}",
        *([] if sampled is None else [f"consistent   {sampled.assumed}"]),
        f"handover     on the floor V' is at most {above(100 * result['share'], 3)} % of its level",
        f"checker      {result['checked']}"
        + (f", reference {result['reference']}" if result["reference"] is not None else ""),
    ]
