"""The prover of ranks: boxes of states from which a loop in discrete time, or with held inputs, reaches a set."""

from __future__ import annotations

from certify.provers.ranks.mend import without_leaf
from certify.provers.ranks.search import RankProof, Wanted, prove_ranks, root_box
from certify.provers.ranks.targets import Region, Sublevel

__all__ = ["RankProof", "Region", "Sublevel", "Wanted", "prove_ranks", "root_box", "without_leaf"]
