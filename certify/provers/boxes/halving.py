"""Halving boxes that a rule leaves undecided, along the axes that add most to its bound."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from certify.provers.bounds.arrays import Array, Index, Mask, joined
from certify.provers.boxes.partition import Partition


class Undecided(Protocol):
    """A rule's answer for boxes: `proved` (B,), `bound` (B,), and `score` (n, B), which each axis adds to the bound."""

    @property
    def proved(self) -> Mask: ...

    @property
    def bound(self) -> Array: ...

    @property
    def score(self) -> Array: ...


class Halves(NamedTuple):
    """Corners (n, H), numbers (H,) and `origin` (H,), the place in the batch of the box that each is a part of; and
    which boxes of the batch (B,) are too small to be halved."""

    lo: Array
    hi: Array
    number: Index
    origin: Index
    small: Mask


def split(partition: Partition, lo: Array, hi: Array, number: Index, found: Undecided, least_width: Array) -> Halves:
    """Halve the boxes that are not proved.

    A half whose bound would stay positive if the split took away three quarters of its axis's share is halved
    again at once, along the next axis.
    """
    undecided = ~found.proved
    origin = np.flatnonzero(undecided)
    lo, hi, bound, score = (a.take(origin, -1) for a in (lo, hi, found.bound, found.score))
    number = number[origin]
    # An axis that is already much thinner than the others, or too thin to halve, is not split.
    width = hi - lo
    relative = width / least_width
    score = np.where((relative * 2.0**12 < relative.max(0)) | (relative < 2), -np.inf, score)
    best = score.max(0)
    stuck = best == -np.inf
    small = undecided.copy()
    small[undecided] = stuck
    if stuck.any():
        lo, hi, bound, score, best = (a.compress(~stuck, -1) for a in (lo, hi, bound, score, best))
        number, origin = number[~stuck], origin[~stuck]
    order = np.argsort(-score, axis=0, kind="stable")
    lo, hi, number = halve(partition, lo, hi, number, order[0])
    origin = origin.repeat(2)
    if len(order) > 1:
        second = np.take_along_axis(score, order[1:2], 0)[0]
        again = ((bound - 0.75 * best > 0) & (second > -np.inf)).repeat(2)
        axis = order[1].repeat(2)[again]
        quarters = halve(partition, lo.compress(again, -1), hi.compress(again, -1), number[again], axis)
        halves = lo.compress(~again, -1), hi.compress(~again, -1), number[~again]
        lo, hi, number = (joined(pair) for pair in zip(halves, quarters, strict=True))
        origin = np.concatenate([origin[~again], origin[again].repeat(2)])
    return Halves(lo, hi, number, origin, small)


def halve(partition: Partition, lo: Array, hi: Array, number: Index, axis: Index) -> tuple[Array, Array, Index]:
    """Corners (n, 2B) and numbers (2B,) of the halves along `axis` (B,), lower and upper in turn."""
    n, count = lo.shape
    index = np.arange(count)
    middle = 0.5 * lo[axis, index] + 0.5 * hi[axis, index]
    lower_hi, upper_lo = hi.copy(), lo.copy()
    lower_hi[axis, index] = middle
    upper_lo[axis, index] = middle
    return (
        np.stack([lo, upper_lo], 2).reshape(n, 2 * count),
        np.stack([lower_hi, hi], 2).reshape(n, 2 * count),
        partition.split(number, axis),
    )
