"""Remedies for leaves that the checker refuses: split them again, or keep the level below one. And the leaves that are
shown, bounded by another series in time.

Producer and checker round in their own ways, and a bound that is barely negative for the one may be barely positive for
the other. Neither remedy starts anew: the tree stays, with one leaf more finely cut, or with a lower level.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from certify.certificates import PartitionTree
from certify.certificates.claims import Claim, Problem
from certify.certificates.tree import leaves
from certify.provers.boxes.partition import LEAF
from certify.provers.boxes.rule import VdotBound

Array = NDArray[np.float64]
_DEPTH = 3  # halvings of a leaf that was refused
_TOGETHER = 4096  # leaves that are bounded at once
_SLACK = 2e-9  # relative distance of a level from the leaves that it leaves out


def split_again(problem: Problem, evidence: PartitionTree, claim: Claim, refused: Sequence[int]) -> PartitionTree:
    """The tree with the leaves of these numbers, counted in preorder, cut into eight along the axes that matter
    most."""
    lo, hi = leaves(evidence.tree, evidence.root)
    rule, tree = VdotBound(problem, evidence.T, order=evidence.order), evidence.tree
    for leaf in sorted(refused, reverse=True):  # a cut moves the numbers of those that come later
        tree = cut_leaf(tree, leaf, lo[leaf], hi[leaf], lambda a, b: rule(a, b, claim.inner, claim.roa).score)
    return replace(evidence, tree=tree)


def cut_leaf(tree: bytes, leaf: int, lo: Array, hi: Array, score: Callable[[Array, Array], Array]) -> bytes:
    """The tree with this leaf, of corners (n,), cut into eight, along the axes of the highest score (n, B)."""
    at = int(np.flatnonzero(np.frombuffer(tree, dtype=np.uint8) == LEAF)[leaf])
    return tree[:at] + _cut(score, lo[:, None], hi[:, None], _DEPTH) + tree[at + 1 :]


def _cut(score: Callable[[Array, Array], Array], lo: Array, hi: Array, depth: int) -> bytes:
    """A box (n, 1) as a subtree of this depth."""
    twice = (np.repeat(v, 2, axis=1) for v in (lo, hi))  # sums over one box alone go another way
    axis = int(score(*twice)[:, 0].argmax())
    middle = 0.5 * lo[axis] + 0.5 * hi[axis]
    if depth == 0 or not bool(lo[axis] < middle) or not bool(middle < hi[axis]):
        return bytes([LEAF])
    lower_hi, upper_lo = hi.copy(), lo.copy()
    lower_hi[axis] = upper_lo[axis] = middle
    halves = ((lo, lower_hi), (upper_lo, hi))
    return bytes([axis]) + b"".join(_cut(score, low, high, depth - 1) for low, high in halves)


def below_leaves(problem: Problem, evidence: PartitionTree, refused: Sequence[int]) -> float:
    """A level that leaves these leaves outside; it may be negative, if one holds the origin."""
    lowest, _ = leaf_levels(problem, evidence)
    return float(np.min(lowest[list(refused)])) * (1 - _SLACK)


def leaf_levels(problem: Problem, evidence: PartitionTree) -> tuple[Array, Array]:
    """Bounds of V from below and above on the leaves, (N,) each, in the order of the tree."""
    lo, hi = leaves(evidence.tree, evidence.root)
    rule = VdotBound(problem, evidence.T)
    return rule.levels(lo.T.copy(), hi.T.copy())


def are_shown(problem: Problem, evidence: PartitionTree, claim: Claim, order: int) -> bool:
    """True if the leaves hold with a series in time of this order too: across a corner only the first has a bound."""
    if claim.roa <= claim.inner:  # nothing lies between
        return True
    rule = VdotBound(problem, evidence.T, evidence.local is None, order)
    lo, hi = (corners.T for corners in leaves(evidence.tree, evidence.root))
    met = np.flatnonzero(rule.levels(lo, hi)[0] <= claim.roa)
    parts = (met[first : first + _TOGETHER] for first in range(0, len(met), _TOGETHER))
    return all(rule(lo[:, part], hi[:, part], claim.inner, claim.roa).proved.all() for part in parts)
