"""Bounds on boxes in batched torch float64: Taylor models of the plant, affine forms of the policy.

Untrusted: the checker repeats the proof with its own code. Rounding is still accounted for, so that what is proved
here is accepted there.
"""

from __future__ import annotations

from certify.enclosures.flow import Flow
from certify.enclosures.policy import PolicyEnclosure
from certify.enclosures.taylor import Models, Taylor, upper_bound

__all__ = ["Flow", "Models", "PolicyEnclosure", "Taylor", "upper_bound"]
