"""The prover of ranks: boxes of states from which a loop in discrete time, or with held inputs, reaches a set."""

from __future__ import annotations

from certify.provers.ranks.mend import without_leaf
from certify.provers.ranks.prove import (
    Enough,
    Question,
    RankProof,
    affordable,
    prove_ranks,
    prove_remaining,
    root_box,
    turning,
    with_errors,
    with_frame,
    with_order,
)
from certify.provers.ranks.targets import Nothing, Region, Sublevel
from certify.provers.ranks.wanted import MOST_STEPS, Wanted

__all__ = [
    "MOST_STEPS",
    "Enough",
    "Nothing",
    "Question",
    "RankProof",
    "Region",
    "Sublevel",
    "Wanted",
    "affordable",
    "prove_ranks",
    "prove_remaining",
    "root_box",
    "turning",
    "with_errors",
    "with_frame",
    "with_order",
    "without_leaf",
]
