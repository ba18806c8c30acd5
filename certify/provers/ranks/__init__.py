"""The prover of ranks: boxes of states from which a loop in discrete time, or with held inputs, reaches a set."""

from __future__ import annotations

from certify.provers.ranks.mend import without_leaf
from certify.provers.ranks.search import RankProof, prove_ranks, root_box

__all__ = ["RankProof", "prove_ranks", "root_box", "without_leaf"]
