"""The boxes of a partition that are still open, bounded in memory: one whose turn is far away is twelve bytes."""

from __future__ import annotations

import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.provers.bounds.arrays import Array, Index, joined
from certify.provers.boxes.partition import Partition

_HANDFUL = 64  # boxes that cost hardly more together than one alone


class Boxes(NamedTuple):
    """Corners (n, B), numbers (B,) and keys (B,) of boxes."""

    lo: Array
    hi: Array
    number: Index
    key: Array


class Frontier:
    """Open boxes, taken in the order of a key, such as the lowest V on them.

    At most `capacity` boxes are at hand with their corners. When there are more, those with the highest keys are put
    away by number, in chunks sorted by key, and rebuilt when their turn comes.
    """

    def __init__(self, partition: Partition, capacity: int = 65_536) -> None:
        self.partition, self.capacity = partition, capacity
        n = len(partition.root)
        self.lo, self.hi = np.zeros((n, 0)), np.zeros((n, 0))
        self.key, self.number = np.zeros(0), np.zeros(0, dtype=np.int64)
        self._away: list[tuple[Array, NDArray[np.uint32]]] = []  # keys, ascending, and numbers

    def copy(self) -> Frontier:
        """The same boxes; a change of one of the two does not show in the other."""
        other = copy.copy(self)
        other._away = list(self._away)  # its arrays are never written to
        return other

    def __len__(self) -> int:
        return len(self.key) + sum(len(lowest) for lowest, _ in self._away)

    def least(self) -> float:
        """The smallest key of an open box; infinite if there is none."""
        at_hand = float(self.key.min()) if len(self.key) else np.inf
        return min(at_hand, self._least_away())

    def add(self, lo: Array, hi: Array, key: Array, number: Index) -> None:
        """Add boxes with corners (n, B), their keys (B,) and their numbers (B,)."""
        self.lo, self.hi = joined([self.lo, lo]), joined([self.hi, hi])
        self.key, self.number = joined([self.key, key]), np.concatenate([self.number, number])
        if len(self.key) > self.capacity:
            order = np.argsort(self.key, kind="stable")
            near, far = order[: self.capacity // 2], order[self.capacity // 2 :]
            self._away.append((self.key[far], self.number[far].astype(np.uint32)))
            self._keep(near)

    def take(self, count: int, limit: float) -> Boxes:
        """Remove and return up to `count` boxes, those with the smallest keys.

        More than `_HANDFUL` are taken only if their keys are at most `limit`.
        """
        if not len(self.key) or float(self.key.min()) > self._least_away():
            self._bring_back()
        order = np.argsort(self.key, kind="stable")
        least_away = self._least_away()
        wanted = max(_HANDFUL, int((self.key <= limit).sum()))
        allowed = min(wanted, int((self.key <= least_away).sum()))
        now = order[: min(count, allowed)]
        taken = Boxes(self.lo.take(now, -1), self.hi.take(now, -1), self.number[now], self.key[now])
        self._keep(order[len(now) :])
        return taken

    def near(self, count: int) -> Boxes:
        """Up to `count` of the boxes at hand, those with the smallest keys in any order; they stay."""
        index = np.arange(len(self.key)) if len(self.key) <= count else np.argpartition(self.key, count)[:count]
        return Boxes(self.lo.take(index, -1), self.hi.take(index, -1), self.number[index], self.key[index])

    def waiting(self) -> tuple[NDArray[np.int64], Array]:
        """Numbers (B,) and keys (B,) of all boxes."""
        numbers = joined([self.number, *(number for _, number in self._away)])
        return numbers.astype(np.int64), joined([self.key, *(lowest for lowest, _ in self._away)])

    def drop_above(self, level: float) -> None:
        """Forget boxes with keys above `level`."""
        self._keep(np.flatnonzero(self.key <= level))
        self._cut_away(level)

    def _keep(self, index: Index) -> None:
        self.lo, self.hi = self.lo.take(index, -1), self.hi.take(index, -1)
        self.key, self.number = self.key[index], self.number[index]

    def _least_away(self) -> float:
        return min((float(lowest[0]) for lowest, _ in self._away), default=np.inf)

    def _cut_away(self, level: float) -> None:
        """Drop the boxes that were put away and lie above `level`."""
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
        # Boxes on a grid share their keys: the next ones fill what room is left.
        for k, most in enumerate(up_to(min(later, default=high))):
            more = min(room, most - split[k])
            split[k], room = split[k] + more, room - more
        lowest = np.concatenate([v[:k] for (v, _), k in zip(self._away, split, strict=True)])
        number = np.concatenate([w[:k] for (_, w), k in zip(self._away, split, strict=True)]).astype(np.int64)
        self._away = [
            (v[k:].copy(), w[k:].copy()) if k else (v, w)
            for (v, w), k in zip(self._away, split, strict=True)
            if k < len(v)
        ]
        self.add(*self.partition.corners(number), lowest, number)
