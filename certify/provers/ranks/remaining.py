"""The search for boxes that are never left: the largest set of leaves from each of which an image lies in the set.

All leaves whose images are in the root box are in it at first; those of which no image lies in the set are taken out,
until none is left to take out (the greatest fixed point; Dellnitz and Hohmann 1997, Bertsekas 1972 for sets of states).
The rest is halved, but for *lost* leaves, which no trajectory stays in the root box from, and taken in again, so that
the set only grows.
"""

from __future__ import annotations

import numpy as np

from certify.certificates.claims import UNPROVED
from certify.provers.bounds.arrays import Array, Index, Mask
from certify.provers.ranks.images import Course, Images
from certify.provers.ranks.search import Search


class Remaining(Search):
    """The leaves that are never left; the rank of each is the number of steps after which it is in one of them again.

    `lost` are leaves, by their numbers, that no trajectory starts from which remains.
    """

    def __init__(self, course: Course, lo: Array, hi: Array) -> None:
        super().__init__(course, lo, hi)
        self.lost = np.zeros(1, dtype=bool)

    def halve(self, nodes: Index, axes: Index) -> Index:
        """Halve leaves; nothing is lost of their halves yet."""
        halves = super().halve(nodes, axes)
        self.lost = np.append(self.lost, np.zeros(len(halves), dtype=bool))
        return halves

    def take(self, nodes: Index, found: Images) -> None:
        """Take in the images of leaves."""
        super().take(nodes, found)
        self.lost[nodes] = found.fails

    def spread(self) -> Index:
        """Find all leaves that remain by now; those that may do so once they are halved."""
        unknown = self.unknown
        self._settle(unknown[~self.lost[unknown]])
        waiting: Index = unknown[~self.lost[unknown] & (self.rank[unknown] == UNPROVED)]
        return waiting

    def tighten(self) -> None:
        """Give all leaves the fewest steps that their images show."""
        self._again(self.cover.leaves)

    def without(self, leaf: int) -> bool:
        """Take a leaf out, by its number in the evidence, and all that need it; False if none is left."""
        _, leaves = self.cover.preorder(self._known)
        self.lost[leaves[leaf]] = True
        self._again(np.setdiff1d(leaves, leaves[leaf]))
        self.rank[leaves[leaf]] = UNPROVED
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
        k, at = np.nonzero(np.isfinite(self.lo[:, 0, live]))
        node, lo, hi = live[at], self.lo[k, :, live[at]].T, self.hi[k, :, live[at]].T
        _, image, leaf = self.cover.met_by(lo, hi)
        order = np.argsort(image, kind="stable")
        image, leaf, self.pairs = image[order], leaf[order], len(image)
        starts = np.flatnonzero(np.diff(image, prepend=-1))
        owner, steps = node[image[starts]], counts[k[image[starts]]]

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
        self.lost[node[away]] = True
        while np.any(new := within(self.lost) & ~self.lost[owner]):
            self.lost[owner[new]] = True
