"""Claims as data, and their conditions."""

from __future__ import annotations

from certify.certificates.claims.claim import (
    CLAIMS,
    MOST_KEPT,
    MOST_RANK,
    UNPROVED,
    Asymptotic,
    Claim,
    Enlarged,
    Nearby,
    Outer,
    Practical,
    Problem,
    Ranks,
    Reached,
)
from certify.certificates.claims.conditions import (
    BeforeClip,
    Condition,
    Guard,
    OfInput,
    OfState,
    Radicand,
    Vdot,
    conditions,
)
from certify.certificates.claims.invariant import Invariant, Remains
from certify.certificates.claims.reaches import MOST_TARGETS, Reaches

__all__ = [
    "CLAIMS",
    "MOST_KEPT",
    "MOST_RANK",
    "MOST_TARGETS",
    "UNPROVED",
    "Asymptotic",
    "BeforeClip",
    "Claim",
    "Condition",
    "Enlarged",
    "Guard",
    "Invariant",
    "Nearby",
    "OfInput",
    "OfState",
    "Outer",
    "Practical",
    "Problem",
    "Radicand",
    "Ranks",
    "Reached",
    "Reaches",
    "Remains",
    "Vdot",
    "conditions",
]
