"""Claims as data, and their conditions."""

from __future__ import annotations

from certify.certificates.claims.claim import (
    CLAIMS,
    Asymptotic,
    Claim,
    Enlarged,
    Nearby,
    Outer,
    Practical,
    Problem,
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

__all__ = [
    "CLAIMS",
    "Asymptotic",
    "BeforeClip",
    "Claim",
    "Condition",
    "Enlarged",
    "Guard",
    "Nearby",
    "OfInput",
    "OfState",
    "Outer",
    "Practical",
    "Problem",
    "Radicand",
    "Reached",
    "Vdot",
    "conditions",
]
