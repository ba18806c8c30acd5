"""The partition that a pass grows, bounded in memory.

A split is five bytes (parent and axis), because everything else follows from them: the certificate is written from it,
and corners are rebuilt by replaying the same midpoints.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
LEAF = 255


class Partition:
    """Halvings of the box |z_i| <= root_i, or of `lower <= z <= root`.

    Boxes are numbered as they appear: the root is 0, the halves of the k-th split are 2k + 1 (lower) and 2k + 2.
    """

    def __init__(self, root: Array, lower: Array | None = None) -> None:
        self.root = root
        self.lower = -root if lower is None else lower
        self.splits = 0
        self._parents = np.zeros(1024, dtype=np.uint32)
        self._axes = np.zeros(1024, dtype=np.uint8)
        self._calls = [0]  # splits of one call are of boxes that were there before it

    def split(self, boxes: Numbers, axes: Numbers) -> Numbers:
        """Split boxes (B,) along axes (B,); returns the numbers of the halves, lower and upper in turn (2B,)."""
        first, self.splits = self.splits, self.splits + len(boxes)
        while self.splits > len(self._parents):
            self._parents = np.concatenate([self._parents, np.zeros_like(self._parents)])
            self._axes = np.concatenate([self._axes, np.zeros_like(self._axes)])
        self._parents[first : self.splits] = boxes
        self._axes[first : self.splits] = axes
        self._calls.append(self.splits)
        return np.arange(2 * first + 1, 2 * self.splits + 1)

    def halvings(self) -> Numbers:
        """How often each axis was halved, (n,)."""
        return np.bincount(self._axes[: self.splits], minlength=len(self.root))

    def leaves(self) -> Numbers:
        """The numbers of the boxes that are not split, ascending."""
        whole = np.ones(2 * self.splits + 1, dtype=bool)
        whole[self._parents[: self.splits]] = False
        return np.flatnonzero(whole)

    def corners(self, boxes: Numbers) -> tuple[Array, Array]:
        """Lower and upper corners (n, B), by the midpoints that made them."""
        count = len(boxes)
        lo, hi = (np.repeat(side[:, None], count, axis=1) for side in (self.lower, self.root))
        steps: list[tuple[Numbers, Numbers, NDArray[np.bool_]]] = []  # from the box up to the root
        box, column = boxes, np.arange(count)
        while len(column):
            below = box > 0
            box, column = box[below], column[below]
            split = (box - 1) // 2
            steps.append((column, self._axes[split].astype(np.int64), box % 2 == 0))
            box = self._parents[split].astype(np.int64)
        for column, axis, upper in reversed(steps):
            middle = 0.5 * lo[axis, column] + 0.5 * hi[axis, column]
            lo[axis[upper], column[upper]] = middle[upper]
            hi[axis[~upper], column[~upper]] = middle[~upper]
        return lo, hi

    def preorder(self) -> bytes:
        """The tree in preorder: an axis for a split, 255 for a leaf."""
        calls = [slice(a, b) for a, b in zip(self._calls[:-1], self._calls[1:], strict=True)]
        size = np.ones(2 * self.splits + 1, dtype=np.uint32)
        lower, upper = size[1::2], size[2::2]  # of the halves of each split
        for call in reversed(calls):
            size[self._parents[call]] = 1 + lower[call] + upper[call]
        place = np.zeros(2 * self.splits + 1, dtype=np.uint32)
        for call in calls:
            after = place[self._parents[call]] + np.uint32(1)
            place[1::2][call], place[2::2][call] = after, after + lower[call]
        tree = np.full(2 * self.splits + 1, LEAF, dtype=np.uint8)
        tree[place[self._parents[: self.splits]]] = self._axes[: self.splits]
        return tree.tobytes()
