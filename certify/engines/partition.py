"""The partition that a pass grows, and the boxes of it that are still open; both bounded in memory.

A split is five bytes (parent and axis), because everything else follows from them: the certificate is written from it,
and corners are rebuilt by replaying the same midpoints. So an open box whose turn is far away is twelve bytes.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
LEAF = 255


class Partition:
    """Halvings of the box |z_i| <= root_i.

    Boxes are numbered as they appear: the root is 0, the halves of the k-th split are 2k + 1 (lower) and 2k + 2.
    """

    def __init__(self, root: Array) -> None:
        self.root = root
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

    def corners(self, boxes: Numbers) -> tuple[Array, Array]:
        """Lower and upper corners (n, B), by the midpoints that made them."""
        count = len(boxes)
        lo, hi = (np.repeat(side[:, None], count, axis=1) for side in (-self.root, self.root))
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


class Frontier:
    """Open boxes, taken in the order of the lowest V on them.

    At most `capacity` boxes are at hand with their corners. When there are more, those with the highest V are put
    away by number and rebuilt when their turn comes.
    """

    def __init__(self, partition: Partition, device: torch.device, capacity: int = 65_536) -> None:
        self.partition, self.device, self.capacity = partition, device, capacity
        n = len(partition.root)
        self.lo, self.hi = (torch.zeros(n, 0, dtype=torch.float64, device=device) for _ in range(2))
        self.lowest = torch.zeros(0, dtype=torch.float64, device=device)
        self.number = torch.zeros(0, dtype=torch.int64, device=device)
        self._away_lowest: list[Array] = []
        self._away_number: list[NDArray[np.uint32]] = []
        self._away_least = np.inf
        self._ceiling = np.inf

    def __len__(self) -> int:
        return len(self.lowest) + sum(len(a) for a in self._away_number)

    def least(self) -> float:
        """The lowest V on any open box; infinite if there is none."""
        at_hand = float(self.lowest.min()) if len(self.lowest) else np.inf
        return min(at_hand, self._away_least)

    def add(self, lo: Tensor, hi: Tensor, lowest: Tensor, number: Tensor) -> None:
        """Add boxes with corners (n, B), the lowest V on them (B,) and their numbers (B,)."""
        self.lo, self.hi = torch.cat([self.lo, lo], 1), torch.cat([self.hi, hi], 1)
        self.lowest, self.number = torch.cat([self.lowest, lowest]), torch.cat([self.number, number])
        if len(self.lowest) > self.capacity:
            order = torch.argsort(self.lowest, stable=True)
            away = order[self.capacity // 2 :]
            self._away_lowest.append(self.lowest[away].cpu().numpy())
            self._away_number.append(self.number[away].cpu().numpy().astype(np.uint32))
            self._away_least = min(self._away_least, float(self._away_lowest[-1][0]))
            self._keep(order[: self.capacity // 2])

    def drop_above(self, level: float) -> None:
        """Forget boxes on which V is above `level` everywhere."""
        self._keep(torch.nonzero(self.lowest <= level)[:, 0])
        self._ceiling = level
        if self._away_least > level:
            self._away_lowest, self._away_number, self._away_least = [], [], np.inf

    def take(self, count: int, limit: float) -> tuple[Tensor, Tensor, Tensor]:
        """Remove and return corners and numbers of up to `count` boxes, those with the lowest V, at most `limit`."""
        if not len(self.lowest) or float(self.lowest.min()) > self._away_least:
            self._bring_back()
        order = torch.argsort(self.lowest, stable=True)
        allowed = int((self.lowest <= min(limit, self._away_least)).sum())
        now = order[: min(count, allowed)]
        taken = self.lo[:, now], self.hi[:, now], self.number[now]
        self._keep(order[len(now) :])
        return taken

    def _keep(self, index: Tensor) -> None:
        self.lo, self.hi = self.lo[:, index], self.hi[:, index]
        self.lowest, self.number = self.lowest[index], self.number[index]

    def _bring_back(self) -> None:
        """The lowest boxes that were put away, half a capacity of them."""
        lowest, number = np.concatenate(self._away_lowest), np.concatenate(self._away_number)
        self._away_lowest, self._away_number, self._away_least = [], [], np.inf
        below = lowest <= self._ceiling
        lowest, number = lowest[below], number[below]
        if len(lowest) > self.capacity // 2:
            order = np.argpartition(lowest, self.capacity // 2)
            near, far = order[: self.capacity // 2], order[self.capacity // 2 :]
            self._away_lowest, self._away_number = [lowest[far]], [number[far]]
            self._away_least = float(lowest[far].min())
            lowest, number = lowest[near], number[near]
        lo, hi = self.partition.corners(number.astype(np.int64))
        corners = (torch.tensor(side, device=self.device) for side in (lo, hi))
        self.add(*corners, *(torch.tensor(a, device=self.device) for a in (lowest, number.astype(np.int64))))
