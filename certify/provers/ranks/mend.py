"""Evidence of ranks without a leaf that the checker refuses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from certify.certificates import RankTree

NONE = 65_535


def without_leaf(evidence: RankTree, leaf: int) -> RankTree | None:
    """The evidence without this leaf, and without all that may lead into it: the leaves of higher ranks. None if only
    leaves in the target are left."""
    dropped = (evidence.ranks > evidence.ranks[leaf]) & (evidence.ranks < NONE)
    dropped[leaf] = True
    ranks = np.where(dropped, NONE, evidence.ranks).astype(np.uint16)
    steps = np.where(dropped, 0, evidence.steps).astype(np.uint8)
    return replace(evidence, ranks=ranks, steps=steps) if np.any(steps) else None
