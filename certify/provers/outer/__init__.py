"""The engine for a claim's outer set, and for a set that is never left: falsifier, rules for boxes, a pass whose level
gives way."""

from __future__ import annotations

from certify.provers.outer.falsify import Rise
from certify.provers.outer.mend import split_again, split_face_again, split_face_of, split_staying
from certify.provers.outer.prove import Nothing, OuterProof, prove_outer
from certify.provers.outer.staying import StayProof, prove_staying

__all__ = [
    "Nothing",
    "OuterProof",
    "Rise",
    "StayProof",
    "prove_outer",
    "prove_staying",
    "split_again",
    "split_face_again",
    "split_face_of",
    "split_staying",
]
