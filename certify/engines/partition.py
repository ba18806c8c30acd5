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
_HANDFUL = 64  # boxes that cost hardly more together than one alone


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
    away by number, in chunks sorted by V, and rebuilt when their turn comes.
    """

    def __init__(self, partition: Partition, device: torch.device, capacity: int = 65_536) -> None:
        self.partition, self.device, self.capacity = partition, device, capacity
        n = len(partition.root)
        self.lo, self.hi = (torch.zeros(n, 0, dtype=torch.float64, device=device) for _ in range(2))
        self.lowest = torch.zeros(0, dtype=torch.float64, device=device)
        self.number = torch.zeros(0, dtype=torch.int64, device=device)
        self._away: list[tuple[Array, NDArray[np.uint32]]] = []  # lowest V, ascending, and number

    def __len__(self) -> int:
        return len(self.lowest) + sum(len(lowest) for lowest, _ in self._away)

    def least(self) -> float:
        """The lowest V on any open box; infinite if there is none."""
        at_hand = float(self.lowest.min()) if len(self.lowest) else np.inf
        return min(at_hand, self._least_away())

    def add(self, lo: Tensor, hi: Tensor, lowest: Tensor, number: Tensor) -> None:
        """Add boxes with corners (n, B), the lowest V on them (B,) and their numbers (B,)."""
        self.lo, self.hi = torch.cat([self.lo, lo], 1), torch.cat([self.hi, hi], 1)
        self.lowest, self.number = torch.cat([self.lowest, lowest]), torch.cat([self.number, number])
        if len(self.lowest) > self.capacity:
            order = torch.argsort(self.lowest, stable=True)
            near, far = order[: self.capacity // 2], order[self.capacity // 2 :]
            self._away.append((self.lowest[far].cpu().numpy(), self.number[far].cpu().numpy().astype(np.uint32)))
            self._keep(near)

    def take(self, count: int, limit: float) -> tuple[Tensor, Tensor, Tensor]:
        """Remove and return corners and numbers of up to `count` boxes, those with the lowest V.

        More than `_HANDFUL` are taken only if V is at most `limit` somewhere on them.
        """
        if not len(self.lowest) or float(self.lowest.min()) > self._least_away():
            self._bring_back()
        order = torch.argsort(self.lowest, stable=True)
        least_away = self._least_away()
        wanted = max(_HANDFUL, int((self.lowest <= limit).sum()))
        allowed = min(wanted, int((self.lowest <= least_away).sum()))
        now = order[: min(count, allowed)]
        taken = self.lo[:, now], self.hi[:, now], self.number[now]
        self._keep(order[len(now) :])
        return taken

    def drop_above(self, level: float) -> None:
        """Forget boxes on which V is above `level` everywhere."""
        self._keep(torch.nonzero(self.lowest <= level)[:, 0])
        self._cut_away(level)

    def _keep(self, index: Tensor) -> None:
        self.lo, self.hi = self.lo[:, index], self.hi[:, index]
        self.lowest, self.number = self.lowest[index], self.number[index]

    def _least_away(self) -> float:
        return min((float(lowest[0]) for lowest, _ in self._away), default=np.inf)

    def _cut_away(self, level: float) -> None:
        """Drop what was put away and lies above `level`."""
        if any(lowest[-1] > level for lowest, _ in self._away):
            kept = [(lowest[k], number[k]) for lowest, number in self._away for k in [lowest <= level]]
            self._away = [chunk for chunk in kept if len(chunk[0])]

    def _bring_back(self) -> None:
        """Rebuild the lowest boxes that were put away, about half a capacity of them."""
        room = self.capacity // 2

        def up_to(level: float) -> list[int]:
            return [int(np.searchsorted(v, level, side="right")) for v, _ in self._away]

        low, high = self._least_away(), max(float(lowest[-1]) for lowest, _ in self._away)
        while low < (middle := low + (high - low) / 2) < high:
            low, high = (middle, high) if sum(up_to(middle)) <= room else (low, middle)
        split = next((k for k in (up_to(high), up_to(low)) if sum(k) <= room), [0] * len(self._away))
        room -= sum(split)
        later = [float(v[k]) for (v, _), k in zip(self._away, split, strict=True) if k < len(v)]
        # Boxes on a grid share their lowest V: the next ones fill what room is left.
        for k, most in enumerate(up_to(min(later, default=high))):
            more = min(room, most - split[k])
            split[k], room = split[k] + more, room - more
        lowest = np.concatenate([v[:k] for (v, _), k in zip(self._away, split, strict=True)])
        number = np.concatenate([w[:k] for (_, w), k in zip(self._away, split, strict=True)]).astype(np.int64)
        self._away = [
            (v[k:].copy(), w[k:].copy()) if k else (v, w)
            for (v, w), k in zip(self._away, split, strict=True) if k < len(v)
        ]  # fmt: skip
        lo, hi = self.partition.corners(number)
        self.add(*(torch.tensor(a, device=self.device) for a in (lo, hi, lowest, number)))
