"""The partition that a pass grows, bounded in memory.

A split is five bytes (parent and axis), because everything else follows from them: the certificate is written from it,
and corners are rebuilt by replaying the same midpoints. A tree that was kept comes as bytes.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.errors import CertificateFormatError

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
LEAF = 255
MAX_DEPTH = 4096  # the most of a certificate's tree
MOST_SPLITS = 40_000_000  # the most that a certificate can hold, and two gibibytes
OPEN = 254  # a leaf of a tree that grows still, not bounded yet


class Grafted(NamedTuple):
    """Open boxes that came with a tree: numbers (B,) and corners (n, B), in its order."""

    number: Numbers
    lo: Array
    hi: Array


class Partition:
    """Halvings of the box |z_i| <= root_i, or of `lower <= z <= root`; or of K boxes, if these are (n, K).

    Boxes are numbered as they appear: the first K are whole, the halves of the k-th split are K + 2k (lower) and
    K + 2k + 1.
    """

    def __init__(self, root: Array, lower: Array | None = None) -> None:
        self.root = root
        self.lower = -root if lower is None else lower
        self._lo, self._hi = (side.reshape(len(root), -1) for side in (self.lower, self.root))
        self._whole = self._lo.shape[1]
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
        return np.arange(2 * first + self._whole, 2 * self.splits + self._whole)

    def halvings(self) -> Numbers:
        """The number of halvings of each axis, (n,)."""
        return np.bincount(self._axes[: self.splits], minlength=len(self.root))

    def leaves(self) -> Numbers:
        """The numbers of the boxes that are not split, ascending."""
        whole = np.ones(2 * self.splits + self._whole, dtype=bool)
        whole[self._parents[: self.splits]] = False
        return np.flatnonzero(whole)

    def corners(self, boxes: Numbers) -> tuple[Array, Array]:
        """Lower and upper corners (n, B), by the midpoints that made them."""
        steps: list[tuple[Numbers, Numbers, NDArray[np.bool_]]] = []  # from the box up to a whole one
        first, box, column = boxes.copy(), boxes, np.arange(len(boxes))
        while len(column):
            first[column] = box
            below = box >= self._whole
            box, column = box[below] - self._whole, column[below]
            split = box // 2
            steps.append((column, self._axes[split].astype(np.int64), box % 2 == 1))
            box = self._parents[split].astype(np.int64)
        lo, hi = self._lo.take(first, -1), self._hi.take(first, -1)
        for column, axis, upper in reversed(steps):
            _halve(lo, hi, column, axis, upper)
        return lo, hi

    def preorder(self, marks: Iterable[tuple[int, Numbers]] = ()) -> bytes:
        """The tree in preorder, or those of all whole boxes in turn: an axis for a split, 255 for a leaf, or the mark
        of those with these numbers."""
        place, whole = self._place(), self._whole
        tree = np.full(2 * self.splits + whole, LEAF, dtype=np.uint8)
        tree[place[self._parents[: self.splits]]] = self._axes[: self.splits]
        for mark, numbers in marks:
            tree[place[numbers]] = mark
        return tree.tobytes()

    def order(self, boxes: Numbers) -> Numbers:
        """The order (B,) of boxes (B,), none of them within another, in preorder."""
        return np.argsort(self._place()[boxes])

    def _place(self) -> NDArray[np.uint32]:
        """Each box's place in preorder."""
        calls = [slice(a, b) for a, b in zip(self._calls[:-1], self._calls[1:], strict=True)]
        whole = self._whole
        size = np.ones(2 * self.splits + whole, dtype=np.uint32)
        lower, upper = size[whole::2], size[whole + 1 :: 2]  # of the halves of each split
        for call in reversed(calls):
            size[self._parents[call]] = 1 + lower[call] + upper[call]
        place = np.zeros(2 * self.splits + whole, dtype=np.uint32)
        place[1:whole] = np.cumsum(size[: whole - 1])
        for call in calls:
            after = place[self._parents[call]] + np.uint32(1)
            place[whole::2][call], place[whole + 1 :: 2][call] = after, after + lower[call]
        return place

    def mark(self) -> tuple[int, int]:
        """The partition's present size, for `back_to`."""
        return self.splits, len(self._calls)

    def back_to(self, mark: tuple[int, int]) -> None:
        """Forget all splits since then."""
        self.splits, calls = mark
        del self._calls[calls:]

    def graft(self, tree: bytes) -> Grafted:
        """Split the first box as a tree in preorder says; its leaves that are `OPEN`.

        Raises
        ------
        CertificateFormatError : the bytes are not one tree, or it is too deep; then the partition is as it was.
        """
        nodes = np.frombuffer(tree, dtype=np.uint8)
        at, upper = _links(nodes, len(self.root))
        boxes, lo, hi = np.zeros(1, np.int64), self._lo[:, :1], self._hi[:, :1]
        ends: list[tuple[Numbers, Numbers, Array, Array]] = []
        begin = self.mark()
        while len(at):
            split, marked = nodes[at] < len(self.root), nodes[at] == OPEN
            ends.append((at[marked], boxes[marked], lo.compress(marked, -1), hi.compress(marked, -1)))
            above = at[split]
            # A chain of upper halves leaves no box open behind it: its depth shows only on the way.
            if len(ends) > MAX_DEPTH and len(above):
                self.back_to(begin)
                raise CertificateFormatError(f"a tree must not be deeper than {MAX_DEPTH}.")
            axis = nodes[above].astype(np.int64)
            boxes = self.split(boxes[split], axis) if len(above) else boxes[:0]
            at = np.stack([above + 1, upper[above]], 1).reshape(-1)
            lo, hi = (np.repeat(side.compress(split, -1), 2, axis=1) for side in (lo, hi))
            _halve(lo, hi, np.arange(len(at)), np.repeat(axis, 2), np.arange(len(at)) % 2 == 1)
        place, number, lo, hi = (np.concatenate(parts, -1) for parts in zip(*ends, strict=True))
        order = np.argsort(place)
        return Grafted(number[order], lo.take(order, -1), hi.take(order, -1))


def _halve(lo: Array, hi: Array, column: Numbers, axis: Numbers, upper: NDArray[np.bool_]) -> None:
    """In the place of boxes, columns of lo and hi (n, B), their upper or lower halves along an axis."""
    middle = 0.5 * lo[axis, column] + 0.5 * hi[axis, column]
    lo[axis[upper], column[upper]] = middle[upper]
    hi[axis[~upper], column[~upper]] = middle[~upper]


def _links(nodes: NDArray[np.uint8], n: int) -> tuple[Numbers, Numbers]:
    """The node at which a tree begins (1,), and for each split that of its upper half.

    Before a node in preorder, a tree has as many boxes open as splits less leaves so far: the upper half is the next
    node before which there are as many as before the split.
    """
    ends = nodes >= OPEN
    if np.any((nodes >= n) & ~ends):
        raise CertificateFormatError(f"a tree splits an axis that does not exist; it has {n}.")
    after = np.cumsum(np.where(ends, -1, 1))
    if not len(nodes) or after[-1] != -1 or np.any(after[:-1] < 0):
        raise CertificateFormatError(f"{len(nodes)} bytes are not a tree.")
    before = np.concatenate([[0], after[:-1]])
    if before.max() > MAX_DEPTH:
        raise CertificateFormatError(f"a tree must not be deeper than {MAX_DEPTH}; found {before.max()}.")
    upper = np.zeros(len(nodes), dtype=np.int64)
    order = np.argsort(before, kind="stable")
    upper[order[:-1]] = order[1:]
    return np.zeros(1, dtype=np.int64), upper
