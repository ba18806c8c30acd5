"""The search for boxes that are never left: the largest set of leaves from each of which an image lies in the set.

All leaves whose images are in the root box are in it at first; those of which no image lies in the set are taken out,
until none is left to take out (the greatest fixed point; Bertsekas 1972 for sets of states, Dellnitz and Hohmann 1997
for boxes). The rest is halved and taken in again, so that the set only grows.
"""

from __future__ import annotations

import math

import numpy as np

from certify.certificates.claims import UNPROVED
from certify.provers.bounds.arrays import Array, Index, Mask
from certify.provers.ranks.images import Course, Images
from certify.provers.ranks.search import Search, together
from certify.provers.ranks.wanted import SearchFrom, Wanted

_LARGEST = 0.7  # share of the leaves to be halved that are, the largest ones
_FOR_CORE = 5.0  # leaves looked at for the seeds alone, relative to those of the first tree


class Remaining(SearchFrom):
    """The leaves that are never left; the rank of each is the number of steps after which it is in one of them again.

    First the leaves are looked for that hold `seeds` (n, N), states that runs come to, and all that these need; then
    the leaves whose images meet one of these. `lost` are leaves, by their numbers, from which no trajectory remains.
    """

    def __init__(self, course: Course, lo: Array, hi: Array, seeds: Array) -> None:
        super().__init__(course, lo, hi, Wanted(lo, hi))
        self.seeds, self.lost, self.most, self.core = seeds, np.zeros(1, dtype=bool), math.inf, True

    def begin(self, most: float) -> Index:
        """The leaves of a first tree, all of one size, that hold seeds."""
        self.most = _FOR_CORE * most
        return super().begin(most)

    def halve(self, nodes: Index, axes: Index) -> Index:
        """Halve leaves; nothing is lost of their halves yet."""
        halves = super().halve(nodes, axes)
        self.lost = np.append(self.lost, np.zeros(len(halves), dtype=bool))
        return halves

    def take(self, nodes: Index, found: Images) -> None:
        """Take in the images of leaves."""
        super().take(nodes, found)
        self.lost[nodes] = found.fails

    def is_done(self, near: Index) -> bool:
        """True if no leaf is left whose halves could gain anything, or the last rounds have gained next to nothing."""
        return not self.core and Search.is_done(self, near)

    def spread(self) -> Index:
        """Find all leaves that remain by now; those that may do so once they are halved."""
        self._settle(self._live)
        return self._live

    def further(self, near: Index) -> Index:
        """The leaves to look at next."""
        if self.core:
            needed = self._needed()
            new, waiting = self._unseen(needed), np.intersect1d(needed, near)
            self.core = self.boxes < self.most and len(new) + len(waiting) > 0
            if self.core:
                return new if len(new) else self._halves(waiting)
        new = self._unseen(self.cover.leaves)
        return new if len(new) else self._halves(self._beside(near))

    def _halves(self, nodes: Index) -> Index:
        """Halves of the largest of these leaves."""
        volumes = self.cover.widths(nodes).prod(0)
        large = nodes[volumes >= np.quantile(volumes, 1 - _LARGEST)]
        return self.halve(large, self.steep[:, large].argmax(0))

    @property
    def _live(self) -> Index:
        unknown = self.unknown
        live: Index = unknown[self.seen[unknown] & ~self.lost[unknown]]
        return live

    @property
    def _own(self) -> Index:
        """The leaves that hold seeds."""
        return self._met(self.seeds, self.seeds)

    def _beside(self, near: Index) -> Index:
        """The leaves among some that have no image, or one that meets a leaf that remains; all if there are none."""
        _, node, image, lo, hi = self.images(near)
        _, pair, leaf = self.cover.met_by(lo, hi)
        none = near[~self.known[:, self.place[near]].any(0)]
        beside: Index = np.union1d(none, node[image[pair[self.rank[leaf] < UNPROVED]]])
        return beside if len(beside) else near

    def tighten(self) -> None:
        """Give all leaves the fewest steps that their images show."""
        self._again(self.cover.leaves)

    def without(self, leaf: int) -> bool:
        """Take a leaf out, by its number in the evidence, and all that need it; False if none is left."""
        _, leaves = self.cover.preorder(self._known)
        self.lost[leaves[leaf]] = True
        self._again(np.setdiff1d(leaves, leaves[leaf]))
        return bool(np.any(self._known))

    @property
    def _known(self) -> Mask:
        known: Mask = (self.cover.axis < 0) & (self.rank < UNPROVED)
        return known

    def _again(self, leaves: Index) -> None:
        """Find those of these leaves that remain, among those that did."""
        kept = leaves[self.rank[leaves] < UNPROVED]
        self.rank[self._known], self.steps[self._known] = UNPROVED, 0
        self._settle(kept)

    def _settle(self, live: Index) -> None:
        """Find which of these leaves remain, together with those that do so already; and which are lost."""
        counts = np.array(self.course.counts)
        k, node, image, lo, hi = self.images(live)
        inside, pair, leaf = self.cover.met_by(lo, hi)
        starts, at, leaf = together(image, inside, pair, leaf)
        owner, steps, self.pairs = node[at], counts[k[at]], len(leaf)

        def within(some: Mask) -> Mask:
            """True for images all of whose leaves are among some."""
            inside: Mask = np.logical_and.reduceat(some[leaf], starts) if len(starts) else np.zeros(0, dtype=bool)
            return inside

        settled = self._known
        kept = settled.copy()
        kept[live] = True
        while True:
            good, left = within(kept), settled.copy()
            left[owner[good]] = True
            if np.array_equal(left, kept):
                break
            kept = left
        best, by = np.full(self.cover.size, UNPROVED), np.zeros(self.cover.size, dtype=np.int64)
        self._better(best, by, owner[good], steps[good], steps[good])
        some = np.flatnonzero(kept & ~settled)
        self.rank[some], self.steps[some] = best[some], by[some]
        straight, (least, most) = self.course.straight, self.cover.root
        away = ((lo[straight] > most[straight]) | (hi[straight] < least[straight])).any(0)
        self.lost[node[np.bincount(image[~away], minlength=len(k)) == 0]] = True
        while np.any(new := within(self.lost) & ~self.lost[owner]):
            self.lost[owner[new]] = True
