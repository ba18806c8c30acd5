"""The engine for a claim's outer set: falsifier, rules for boxes, a pass whose level gives way."""

from __future__ import annotations

from certify.provers.outer.falsify import Rise
from certify.provers.outer.mend import split_again, split_face_again
from certify.provers.outer.prove import Nothing, OuterProof, prove_outer

__all__ = ["Nothing", "OuterProof", "Rise", "prove_outer", "split_again", "split_face_again"]
