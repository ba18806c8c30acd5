"""The search for ranks: the largest set of leaves that reach the target, found backwards from it.

A leaf has its rank as soon as an image lies in the target, or meets leaves of known ranks alone: the number of the
steps to that image, and the highest of those ranks. Leaves without a rank whose images meet some leaf with one are
halved and looked at again (Kalies, Mischaikow, VanderVorst 2005 do this without images of networks), first those whose
halves promise the most volume: large ones, of which some image lies in leaves with a rank for a large part. What has a
rank keeps it; so the search may end at any time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from certify.certificates import RankTree
from certify.certificates.claims import UNPROVED
from certify.provers.bounds.arrays import Array, Index, Mask
from certify.provers.ranks.cover import Cover
from certify.provers.ranks.images import Course, Images

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
_FIRST = 2**10  # leaves of the first tree
_BEFORE, _GAIN = 1 / 8, 1e-4  # relative growth of what is proved, since so few boxes, below which the search ends
_SHARE = 0.5  # share of all promise in the leaves that are halved next
_ANYWAY = 0.05  # share of a leaf that may gain a rank where its image, or a few of its states, say that nothing does
_MOST_LEAVES, _MOST_PAIRS = 400_000, 10_000_000  # of an image and a leaf that it meets, in one round
_POINTS = 5  # of a leaf, from which it is seen if the target may be reached
Promising = Callable[[Array], Mask]
"""True (N,) for states (N, n) that seem to reach the target."""


class Search:
    """Ranks of the leaves of a tree that grows; leaves with no `promising` state are halved last."""

    def __init__(self, course: Course, lo: Array, hi: Array, promising: Promising | None = None) -> None:
        self.promising, self.hope = promising, np.full(1, np.nan)
        self.course, self.cover = course, Cover(lo, hi, course.angles)
        K, n = len(course.counts), len(lo)
        self.rank, self.steps = np.full(1, UNPROVED), np.zeros(1, dtype=np.int64)
        self.place = np.zeros(1, dtype=np.int64)  # of a leaf's images among all; the first ones are none
        self.lo, self.hi = np.full((2, course.kept, course.ways, n, 1), np.nan)
        self.known, self.there = np.zeros((2, K, 1), dtype=bool)
        self.steep = np.zeros((n, 1))
        self.meets, self.loose = np.zeros(1, dtype=bool), np.zeros(1, dtype=bool)
        self.part, self.first = np.zeros(1), np.full((2, n, 1), np.nan)
        self.boxes, self.pairs, self.stands = 0, 0, list[tuple[int, float]]()

    def begin(self, most: float) -> Index:
        """The leaves of a first tree, all of one size, so many at most."""
        new, widths = np.zeros(1, dtype=np.int64), np.ones(len(self.cover.low))
        while 2 * len(new) <= min(most, _FIRST):
            axis = int(widths.argmax())
            widths[axis] /= 2
            new = self.halve(new, np.full(len(new), axis))
        return new

    def is_done(self, near: Index) -> bool:
        """True if no leaf is left whose halves could gain anything, or the last boxes have gained next to nothing."""
        share = self.share
        before = [earlier for boxes, earlier in self.stands if boxes <= _BEFORE * self.boxes]
        self.stands.append((self.boxes, share))
        stalled = before and 0 < share <= (1 + _GAIN) * before[-1]
        return bool(not len(near) or stalled)

    @property
    def full(self) -> bool:
        """True if leaves are too many, or those that images meet: then the search ends, whatever effort is left."""
        return len(self.cover.leaves) > _MOST_LEAVES or self.pairs > _MOST_PAIRS

    @property
    def gives_up(self) -> bool:
        """True if it is not worth going on."""
        return False

    @property
    def hopeless(self) -> bool:
        """True if another search has more hope."""
        return False

    def further(self, near: Index) -> Index:
        """The leaves to look at next: halves of the fewest that have their share of all promise."""
        promise = self.cover.widths(near).prod(0) * (_ANYWAY + self.part[near]) * (_ANYWAY + self._hope(near))
        order = np.argsort(-promise, kind="stable")
        sums = np.cumsum(promise[order])
        first = near[order[: 1 + int(np.searchsorted(sums, _SHARE * sums[-1]))]]
        return self.halve(first, self.steep[:, first].argmax(0))

    @property
    def unknown(self) -> Index:
        """Leaves without a rank."""
        leaves = self.cover.leaves
        unknown: Index = leaves[self.rank[leaves] == UNPROVED]
        return unknown

    @property
    def share(self) -> float:
        """The share of the root box's volume in leaves with a rank."""
        leaves = self.cover.leaves
        return float(self.cover.widths(leaves[self.rank[leaves] < UNPROVED]).prod(0).sum())

    def counted(self, x: Array) -> int:
        """The number of states (n, N) in leaves with a rank."""
        _, states, leaves = self.cover.met_by(x, x)
        return len(np.unique(states[self.rank[leaves] < UNPROVED]))

    def halve(self, nodes: Index, axes: Index) -> Index:
        """Halve leaves; their halves, of which nothing is known yet."""
        halves = self.cover.halve(nodes, axes)
        new = len(halves)

        def longer(v: Any, fill: float) -> Any:
            return np.concatenate([v, np.full((*v.shape[:-1], new), fill, dtype=v.dtype)], -1)

        self.rank, self.steps = longer(self.rank, UNPROVED), longer(self.steps, 0)
        self.place, self.steep = longer(self.place, 0), longer(self.steep, 0.0)
        self.meets, self.loose = longer(self.meets, False), longer(self.loose, False)
        self.hope, self.part = longer(self.hope, np.nan), longer(self.part, 0.0)
        self.first = longer(self.first, np.nan)
        return halves

    def take(self, nodes: Index, found: Images) -> None:
        """Take in the images of leaves."""
        further = np.where(found.there[:, :, None], np.nan, 0.0)
        self.place[nodes] = len(self.known[0]) + np.arange(len(nodes))
        self.lo = np.concatenate([self.lo, found.lo + further], -1)
        self.hi = np.concatenate([self.hi, found.hi + further], -1)
        self.known = np.concatenate([self.known, found.known], -1)
        self.there = np.concatenate([self.there, found.arrived], -1)
        self.steep[:, nodes] = found.steep
        self.meets[nodes], self.loose[nodes] = found.meets, found.loose
        self.first[..., nodes] = found.first
        self.rank[nodes[found.inside]] = 0
        self.boxes += len(nodes)

    def spread(self) -> Index:
        """Give ranks to all leaves that have one by now; those without that may meet the target, or whose images meet
        some leaf with a rank, or lie in the root box with a part only."""
        unknown, counts = self.unknown, np.array(self.course.counts)
        best, by = np.full(self.cover.size, UNPROVED), np.zeros(self.cover.size, dtype=np.int64)
        k, at = np.nonzero(self.there[:, self.place[unknown]])
        self._better(best, by, unknown[at], counts[k], counts[k])
        k, node, image, lo, hi = self.images(unknown)
        inside, pair, leaf = self.cover.met_by(lo, hi)
        starts, at, met = together(image, inside, pair, leaf)
        owners, steps, self.pairs = node[at], counts[k[at]], len(met)
        while True:
            highest = np.maximum.reduceat(self.rank[met], starts) if len(starts) else np.zeros(0, dtype=np.int64)
            known = (highest < UNPROVED) & (highest + steps < UNPROVED)
            self._better(best, by, owners[known], highest[known] + steps[known], steps[known])
            new = unknown[(best[unknown] < self.rank[unknown])]
            if not len(new):
                break
            self.rank[new], self.steps[new] = best[new], by[new]
        (low, high), first = self.cover.root, k[image] == 0
        sticks = first & ~inside & ((high > lo) & (low < hi)).all(0)
        self.part[unknown] = 0.0
        beside = self._toward(lo, hi, node[image], pair, leaf)
        others = self._loosely(), unknown[self.meets[unknown]], node[image[sticks]]
        near: Index = np.unique(np.concatenate([beside, *others]))
        waiting: Index = near[self.rank[near] == UNPROVED]
        return waiting

    def images(self, nodes: Index) -> tuple[Index, Index, Index, Array, Array]:
        """The images of leaves that do not lie in the target: for each number of steps of a leaf that number's index
        and the leaf, and for each image the index of these, and its corners (n, I)."""
        places, kept = self.place[nodes], self.course.kept
        k, at = np.nonzero(self.known[:kept, places] & ~self.there[:kept, places])
        node = nodes[at]
        lo, hi = self.lo[k, :, :, places[at]], self.hi[k, :, :, places[at]]
        image, way = np.nonzero(np.isfinite(lo[:, :, 0]))
        return k, node, image, lo[image, way].T, hi[image, way].T

    def _loosely(self) -> Index:
        """The leaves of which a part may pass, and whose first step leads in part to leaves with a rank or anywhere."""
        loose = self.unknown[self.loose[self.unknown]]
        known = np.isfinite(self.first[..., loose]).all((0, 1))
        anywhere, loose = loose[~known], loose[known]
        (least, most), (lo, hi) = self.cover.root, self.first[..., loose]
        turn = np.isin(np.arange(len(lo)), self.cover.angles)[:, None]
        lo, hi = np.where(turn, lo, lo.clip(least, most)), np.where(turn, hi, hi.clip(least, most))
        _, box, leaf = self.cover.met_by(lo, hi)
        return np.append(anywhere, self._toward(lo, hi, loose, box, leaf))

    def _toward(self, lo: Array, hi: Array, owners: Index, box: Index, leaf: Index) -> Index:
        """The owners (B,) of boxes (n, B) of places that meet leaves with a rank, by the pairs of a box and a leaf; the
        part of each box that lies in such leaves is noted."""
        known = self.rank[leaf] < UNPROVED
        box, leaf = box[known], leaf[known]
        parts = np.bincount(box, self.cover.overlap(lo[:, box], hi[:, box], leaf), minlength=len(owners))
        np.maximum.at(self.part, owners, parts)
        found: Index = owners[np.unique(box)]
        return found

    def _better(self, best: Index, by: Index, nodes: Index, ranks: Index, steps: Index) -> None:
        """Keep the lowest rank of each node, and its steps."""
        order = np.lexsort((steps, ranks))[::-1]
        nodes, ranks, steps = nodes[order], ranks[order], steps[order]
        lower = ranks < best[nodes]
        best[nodes[lower]], by[nodes[lower]] = ranks[lower], steps[lower]  # of several the last, the lowest, stays

    def _hope(self, nodes: Index) -> Array:
        """The shares of promising states among a few of each of these leaves; 1 if nothing says which are."""
        if self.promising is None:
            return np.ones(len(nodes))
        new = nodes[np.isnan(self.hope[nodes])]
        low, high = self.cover.low[:, new], self.cover.high[:, new]
        at = np.random.default_rng(0).uniform(size=(_POINTS, len(low), 1))
        states = (low + at * (high - low)).transpose(0, 2, 1)
        self.hope[new] = self.promising(states.reshape(-1, len(low))).reshape(_POINTS, -1).mean(0)
        return self.hope[nodes]

    def tighten(self) -> None:
        """Give all leaves the lowest ranks that their images show: some had a rank before others had a lower one."""
        leaves = self.cover.leaves
        again = leaves[(self.rank[leaves] < UNPROVED) & (self.rank[leaves] > 0)]
        self.rank[again], self.steps[again] = UNPROVED, 0
        self.spread()

    def evidence(self) -> RankTree:
        """The evidence: the tree as far as it has ranks."""
        known = (self.cover.axis < 0) & (self.rank < UNPROVED)
        tree, leaves = self.cover.preorder(known)
        rank = np.where(known[leaves], self.rank[leaves], UNPROVED)
        steps = np.where(known[leaves], self.steps[leaves], 0)
        lo, hi = (end[:, 0].copy() for end in self.cover.root)
        errors = self.course.frame, self.course.moving, self.course.memory
        return RankTree(lo, hi, tree, rank.astype(np.uint16), steps.astype(np.uint16), *errors)


def together(of: Index, inside: Mask, pair: Index, leaf: Index) -> tuple[Index, Index, Index]:
    """The leaves that images of the same (`of`) meet, from pairs of an image and a leaf: where those of each begin, of
    which they are, and the leaves. Left out is all of which an image does not lie inside the root box."""
    kept = np.bincount(of[~inside], minlength=int(of.max(initial=-1)) + 1) == 0
    pair, leaf = pair[kept[of[pair]]], leaf[kept[of[pair]]]
    order = np.argsort(of[pair], kind="stable")
    owner = of[pair][order]
    starts: Index = np.flatnonzero(np.diff(owner, prepend=-1))
    return starts, owner[starts], leaf[order]
