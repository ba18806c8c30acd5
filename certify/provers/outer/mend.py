"""The remedy for a leaf of an outer set's trees that the checker refuses: split it again (see `boxes.mend`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from certify.certificates import OuterTree
from certify.certificates.claims import Claim, Outer, Problem
from certify.certificates.tree import LEAF
from certify.errors import InputError
from certify.provers.boxes.mend import cut_leaf
from certify.provers.outer.prove import face_box
from certify.provers.outer.rule import FaceBound, FallBound

Array = NDArray[np.float64]


def split_again(problem: Problem, evidence: OuterTree, claim: Claim, leaf: int) -> OuterTree:
    """The evidence with the leaf of this number, counted in preorder, cut into eight."""
    outer = _outer(claim)
    lo, hi = _corners(evidence.tree, -evidence.root, evidence.root, leaf)
    rule = FallBound(problem, claim.roa, evidence.T, outer.function)
    tree = cut_leaf(evidence.tree, leaf, lo, hi, lambda a, b: rule(a, b, 0.0, outer.level).score)
    return replace(evidence, tree=tree)


def split_face_again(problem: Problem, evidence: OuterTree, claim: Claim, face: int, leaf: int) -> OuterTree:
    """The evidence with a leaf of a face's tree, counted likewise, cut into eight."""
    outer, (axis, side) = _outer(claim), divmod(face, 2)
    lo, hi = _corners(evidence.faces[face], *face_box(problem.loop.system, axis, side), leaf)
    rule = FaceBound(problem.loop.system, axis, side, outer.function)
    tree = cut_leaf(evidence.faces[face], leaf, lo, hi, lambda a, b: rule(a, b, 0.0, outer.level).score)
    return replace(evidence, faces=(*evidence.faces[:face], tree, *evidence.faces[face + 1 :]))


def _outer(claim: Claim) -> Outer:
    if claim.outer is None:
        raise InputError("only a claim with an outer set has trees of one; found a claim without.")
    return claim.outer


def _corners(tree: bytes, lower: Array, upper: Array, leaf: int) -> tuple[Array, Array]:
    """The corners (n,) of a leaf, by the midpoints that the checker takes."""
    waiting, found = [(lower, upper)], -1
    for axis in tree:
        lo, hi = waiting.pop()
        if axis == LEAF:
            found += 1
            if found == leaf:
                return lo, hi
            continue
        lower_hi, upper_lo = hi.copy(), lo.copy()
        lower_hi[axis] = upper_lo[axis] = 0.5 * lo[axis] + 0.5 * hi[axis]
        waiting += [(upper_lo, hi), (lo, lower_hi)]
    raise InputError(f"`leaf` must be one of {found + 1}; found {leaf}.")
