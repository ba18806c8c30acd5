"""Bounds on boxes in batches of binary64: Taylor models of the plant, affine forms of the policy.

Untrusted: the checker repeats the proof with its own code. Rounding is still accounted for, so that what is proved
here is accepted there.
"""

from __future__ import annotations

from certify.provers.bounds.flow import Flow
from certify.provers.bounds.loop import LoopModels, loop_models
from certify.provers.bounds.neural import NeuralEnclosure, NeuralModels
from certify.provers.bounds.policy import Enclosure, operations_of_policy, policy_enclosure
from certify.provers.bounds.symbolic import SymbolicEnclosure, SymbolicModels
from certify.provers.bounds.taylor import Models, Taylor, upper_bound

__all__ = [
    "Enclosure",
    "Flow",
    "LoopModels",
    "Models",
    "NeuralEnclosure",
    "NeuralModels",
    "SymbolicEnclosure",
    "SymbolicModels",
    "Taylor",
    "loop_models",
    "operations_of_policy",
    "policy_enclosure",
    "upper_bound",
]
