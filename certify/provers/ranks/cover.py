"""The tree of boxes that a search grows, as arrays, and the leaves that boxes of places meet."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from certify.provers.bounds.arrays import Array, Index, Mask
from certify.provers.boxes.partition import LEAF
from certify.provers.ranks.targets import TURN

_SLACK = 1e-12  # of a turn
_POINT = 1e-300  # width of a point


class Cover:
    """A partition of the box lo <= x <= hi (n,) into leaves; all nodes have numbers, the root is 0.

    `low`, `high` are the corners of nodes (n, N), `axis` says where a node is split, -1 if it is a leaf.
    """

    def __init__(self, lo: Array, hi: Array, angles: Sequence[int]) -> None:
        self.angles = tuple(angles)
        self.low, self.high = lo[:, None].copy(), hi[:, None].copy()
        self.axis, self.split = np.array([-1]), np.zeros(1)
        self.left, self.right = np.array([-1]), np.array([-1])

    @property
    def size(self) -> int:
        """The number of nodes."""
        return len(self.axis)

    @property
    def leaves(self) -> Index:
        """The leaves, ascending."""
        return np.flatnonzero(self.axis < 0)

    @property
    def root(self) -> tuple[Array, Array]:
        """The corners of the root box, (n, 1)."""
        return self.low[:, :1], self.high[:, :1]

    def widths(self, nodes: Index) -> Array:
        """The widths of nodes as shares of the root's, (n, N)."""
        least, most = self.root
        widths: Array = (self.high[:, nodes] - self.low[:, nodes]) / (most - least)
        return widths

    def halve(self, nodes: Index, axes: Index) -> Index:
        """Split leaves at the middles of these axes; the numbers of their halves."""
        middle = 0.5 * self.low[axes, nodes] + 0.5 * self.high[axes, nodes]
        first, count = self.size, len(nodes)
        lower, upper = first + np.arange(count), first + count + np.arange(count)
        self.axis[nodes], self.split[nodes], self.left[nodes], self.right[nodes] = axes, middle, lower, upper
        low, high = self.low[:, nodes], self.high[:, nodes]
        below, above = high.copy(), low.copy()
        below[axes, np.arange(count)] = above[axes, np.arange(count)] = middle
        self.low, self.high = np.hstack([self.low, low, above]), np.hstack([self.high, below, high])
        none = np.full(2 * count, -1)
        self.axis, self.split = np.append(self.axis, none), np.append(self.split, np.zeros(2 * count))
        self.left, self.right = np.append(self.left, none), np.append(self.right, none)
        return np.append(lower, upper)

    def met_by(self, lo: Array, hi: Array) -> tuple[Mask, Index, Index]:
        """Boxes (n, B) of places: where (B,) they lie in the root box, and pairs of a box and a leaf that it meets."""
        owner, low, high = self._places(lo, hi)
        (least, most), inside = self.root, np.ones(lo.shape[1], dtype=bool)
        outside = ~((low >= least) & (high <= most)).all(0)
        inside[owner[outside]] = False
        kept = inside[owner]
        box, node = np.flatnonzero(kept), np.zeros(int(kept.sum()), dtype=np.int64)
        boxes, leaves = list[Index](), list[Index]()
        while len(box):
            ends = self.axis[node] < 0
            boxes.append(box[ends])
            leaves.append(node[ends])
            box, node = box[~ends], node[~ends]
            axis, split = self.axis[node], self.split[node]
            below, above = low[axis, box] <= split, high[axis, box] >= split
            box, node = np.append(box[below], box[above]), np.append(self.left[node[below]], self.right[node[above]])
        if not boxes:
            return inside, np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
        return inside, owner[np.concatenate(boxes)], np.concatenate(leaves)

    def _places(self, lo: Array, hi: Array) -> tuple[Index, Array, Array]:
        """Boxes in the root box's period: the number of the box that each is a piece of, and corners (n, M)."""
        owner, low, high = np.arange(lo.shape[1]), lo.copy(), hi.copy()
        for i in self.angles:
            least, most = self.low[i, 0], self.high[i, 0]
            turns = np.rint((0.5 * (low[i] + high[i]) - 0.5 * (least + most)) / TURN)
            slack = np.where(turns == 0, 0.0, _SLACK * TURN * (1 + np.abs(turns)))
            low[i] -= TURN * turns + slack
            high[i] += slack - TURN * turns
            wide = high[i] - low[i] > TURN * (1 - _SLACK)
            low[i], high[i] = np.where(wide, least, low[i]), np.where(wide, most, high[i])
            under, over = np.flatnonzero(low[i] < least), np.flatnonzero(high[i] > most)
            more = low[:, np.append(under, over)].copy(), high[:, np.append(under, over)].copy()
            more[0][i] = np.append(low[i, under] + TURN * (1 - 4 * _SLACK), np.full(len(over), least))
            more[1][i] = np.append(np.full(len(under), most), high[i, over] - TURN * (1 - 4 * _SLACK))
            low[i], high[i] = np.maximum(low[i], least), np.minimum(high[i], most)
            owner = np.concatenate([owner, owner[under], owner[over]])
            low, high = np.hstack([low, more[0]]), np.hstack([high, more[1]])
        return owner, low, high

    def overlap(self, lo: Array, hi: Array, leaf: Index) -> Array:
        """The shares of boxes (n, B) of places that lie in these leaves, one for each."""
        low, high = self.low[:, leaf], self.high[:, leaf]
        for i in self.angles:
            turns = TURN * np.rint((low[i] + high[i] - lo[i] - hi[i]) / (2 * TURN))
            low[i], high[i] = low[i] - turns, high[i] - turns
        both = np.maximum(np.minimum(hi, high) - np.maximum(lo, low), 0.0)
        shares: Array = ((both + _POINT) / (hi - lo + _POINT)).prod(0)
        return shares

    def preorder(self, kept: Mask) -> tuple[bytes, Index]:
        """The tree's bytes, and the leaves in their order there; a node below which no leaf is `kept`, (N,), is a leaf
        itself."""
        tree, leaves, waiting = bytearray(), list[int](), [0]
        axes, lefts, rights, some = self.axis.tolist(), self.left.tolist(), self.right.tolist(), kept.tolist()
        for node in range(self.size - 1, -1, -1):  # halves have higher numbers
            if axes[node] >= 0:
                some[node] = some[lefts[node]] or some[rights[node]]
        while waiting:
            node = waiting.pop()
            if axes[node] < 0 or not some[node]:
                tree.append(LEAF)
                leaves.append(node)
                continue
            tree.append(axes[node])
            waiting += [rights[node], lefts[node]]
        return bytes(tree), np.array(leaves)
