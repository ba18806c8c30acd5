"""The remedy for a leaf of an outer set's trees that the checker refuses: split it again (see `boxes.mend`)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from certify.certificates import OuterTree
from certify.certificates.claims import Claim, Invariant, Outer, Problem
from certify.certificates.tree import LEAF
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System
from certify.provers.boxes.mend import cut_leaf
from certify.provers.outer.prove import face_box
from certify.provers.outer.rule import FaceBound, FallBound, LoopOnN
from certify.provers.outer.stay import StayBound

Array = NDArray[np.float64]


def split_again(problem: Problem, evidence: OuterTree, claim: Claim, leaf: int) -> OuterTree:
    """The evidence with the leaf of this number, counted in preorder, cut into eight."""
    outer = _outer(claim)
    return _split(FallBound(problem, claim.roa, evidence.T, outer.function), outer.level, evidence, leaf)


def split_staying(loop: ClosedLoop, claim: Invariant, evidence: OuterTree, leaf: int) -> OuterTree:
    """The same of a set that is never left."""
    rule = StayBound(loop, claim.keep, evidence.T, claim.outer.function)
    return _split(rule, claim.outer.level, evidence, leaf)


def _split(rule: LoopOnN, level: float, evidence: OuterTree, leaf: int) -> OuterTree:
    lo, hi = _corners(evidence.tree, -evidence.root, evidence.root, leaf)
    tree = cut_leaf(evidence.tree, leaf, lo, hi, lambda a, b: rule(a, b, 0.0, level).score)
    return replace(evidence, tree=tree)


def split_face_again(problem: Problem, evidence: OuterTree, claim: Claim, face: int, leaf: int) -> OuterTree:
    """The evidence with a leaf of a face's tree, counted likewise, cut into eight."""
    return split_face_of(problem.loop.system, _outer(claim), evidence, face, leaf)


def split_face_of(system: System, outer: Outer, evidence: OuterTree, face: int, leaf: int) -> OuterTree:
    """The same for a plant and a set {N <= n2}."""
    axis, side = divmod(face, 2)
    lo, hi = _corners(evidence.faces[face], *face_box(system, axis, side), leaf)
    rule = FaceBound(system, axis, side, outer.function)
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
