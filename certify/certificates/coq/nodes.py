"""A partition for Coq while the search divides it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.certificates.coq.evidence import Leaf, Split, Tree

Array = NDArray[np.float64]


class Nodes:
    """A partition while it grows."""

    def __init__(self, n: int) -> None:
        self.n, self.depth = n, 0
        self.axis: list[int] = []
        self.at: list[float] = []
        self.children: list[tuple[int, int]] = []
        self.k: list[float] = []

    def new(self) -> int:
        """A box that is not divided."""
        self.axis.append(-1)
        self.at.append(0.0)
        self.children.append((-1, -1))
        self.k.append(0.0)
        return len(self.axis) - 1

    def split(self, node: int, axis: int, at: float) -> tuple[int, int]:
        """Divide a box: the halves below and above."""
        self.axis[node], self.at[node], self.children[node] = axis, at, (self.new(), self.new())
        return self.children[node]

    def around(self, core: Array, root: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Divide the root box so that the core is one box, done; the others with their ends."""
        lo, hi = -root.copy(), root.copy()
        middle, places, lows, highs = self.new(), [], [], []
        for axis in range(self.n):
            if core[axis] >= root[axis]:
                continue
            for at, side in ((-core[axis], 0), (core[axis], 1)):
                halves = self.split(middle, axis, float(at))
                outer_lo, outer_hi = lo.copy(), hi.copy()
                (outer_hi if side == 0 else outer_lo)[axis] = at
                (lo if side == 0 else hi)[axis] = at
                places.append(halves[side])
                middle = halves[1 - side]
                lows.append(outer_lo)
                highs.append(outer_hi)
        shape = (len(places), self.n)
        return np.array(places, dtype=np.intp), np.array(lows).reshape(shape), np.array(highs).reshape(shape)

    def close(self, places: NDArray[np.intp], k: Array) -> None:
        """Boxes that are done."""
        for place, multiplier in zip(places.tolist(), k.tolist(), strict=True):
            self.k[place] = multiplier

    def divide(
        self, places: NDArray[np.intp], lo: Array, hi: Array, axes: NDArray[np.intp]
    ) -> tuple[NDArray[np.intp], Array, Array]:
        """Halve boxes: their halves with their ends."""
        self.depth += 1
        rows = np.arange(len(places))
        middle = np.ldexp((lo + hi)[rows, axes], -1)
        halves = [self.split(*each) for each in zip(places.tolist(), axes.tolist(), middle.tolist(), strict=True)]
        below, above = hi.copy(), lo.copy()
        below[rows, axes] = above[rows, axes] = middle
        flat = np.array(halves, dtype=np.intp).reshape(-1, 2)
        return flat.T.reshape(-1), np.concatenate([lo, above]), np.concatenate([below, hi])

    def tree(self, node: int = 0) -> Tree:
        """The partition from a node on."""
        if self.axis[node] < 0:
            return Leaf(self.k[node])
        below, above = self.children[node]
        return Split(self.axis[node], self.at[node], self.tree(below), self.tree(above))
