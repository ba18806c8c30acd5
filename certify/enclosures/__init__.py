"""Bounds on boxes in batched torch float64: Taylor models of the plant, affine forms of the policy.

Untrusted: the checker repeats the proof with its own code. Rounding is still accounted for, so that what is proved
here is accepted there.
"""

from __future__ import annotations

from certify.enclosures.flow import Flow
from certify.enclosures.loop import LoopModels, loop_models
from certify.enclosures.neural import NeuralEnclosure, NeuralModels
from certify.enclosures.policy import PolicyEnclosure
from certify.enclosures.symbolic import SymbolicEnclosure, SymbolicModels
from certify.enclosures.taylor import Models, Taylor, upper_bound

__all__ = [
    "Flow",
    "LoopModels",
    "Models",
    "NeuralEnclosure",
    "NeuralModels",
    "PolicyEnclosure",
    "SymbolicEnclosure",
    "SymbolicModels",
    "Taylor",
    "loop_models",
    "upper_bound",
]
