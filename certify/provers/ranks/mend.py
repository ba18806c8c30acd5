"""Evidence of ranks without a leaf that the checker refuses."""

from __future__ import annotations

import numpy as np

from certify.certificates import RankTree


def without_leaf(evidence: RankTree, leaf: int) -> RankTree | None:
    """The evidence without this leaf, and without all that may lead into it: the leaves of higher ranks. None if only
    leaves in the target are left."""
    dropped = evidence.ranks > evidence.ranks[leaf]
    dropped[leaf] = True
    left = evidence.without(dropped)
    return left if np.any(left.steps) else None
