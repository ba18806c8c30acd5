"""The search for the ranks of one box: only leaves are looked at that trajectories from it may meet.

A leaf is *needed* if it meets the box, or the image of a needed leaf: of all its images the one that counts is the
farthest that is not wider than the leaf itself, or else the one that has grown least. Needed leaves without a rank are
halved; all others wait.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from certify.certificates.claims import UNPROVED
from certify.provers.bounds.arrays import Array, Index
from certify.provers.ranks.images import Course, Images
from certify.provers.ranks.search import Search

COUNTS_FROM = (*range(1, 13), 14, 16, 20, 24, 32, 40, 50, 64, 80, 100, 120)
MOST_STEPS = 2_000  # of a leaf that are looked at
_GROWTH = 1.5  # of an image, relative to its leaf, that counts as none
_NARROW = 1e-11  # share of the root box below which leaves are not halved
_FALLS = 0.8  # of the volume without a rank from one round to the next, at most
_ROUNDS = 3  # after which it does not fall either
_SHARE = 0.7  # of the leaves that may be halved, the largest ones
_MOST_LEFT = 0.5  # share of the box without which a search of its own parts is worth all effort
_AROUND = 2  # steps beside those that simulated runs take
_OF_A_TURN = 0.01  # width of an angle below which it is not halved at first


@dataclass(frozen=True, slots=True)
class Wanted:
    """A box lo <= x <= hi (n,) of places, each of whose leaves is to have a rank of `most` at most; `direct` says how
    many boxes are looked at in the hope that images of parts of the box lie in the target, as where few steps suffice:
    so many, and more as long as they prove more and more of it. `arrivals`: the steps that simulated runs take."""

    lo: Array
    hi: Array
    most: int = UNPROVED - 1
    direct: int = 0
    arrivals: tuple[int, ...] = ()

    def straight(self, longest: int) -> tuple[int, ...]:
        """The steps after which an image may lie in the target: all around those that runs take, up to the longest or
        as many as suit the shortest run."""
        least, most = min(self.arrivals, default=0), max(self.arrivals, default=0)
        end = min(max(longest, _later(least)), _later(most))
        return tuple(range(max(1, least - _AROUND), end + 1))


def _later(steps: int) -> int:
    """The most steps that are looked at where a run takes so many."""
    return steps + steps // 2 + _AROUND


class SearchFrom(Search):
    """Ranks of the leaves that matter for a box."""

    def __init__(self, course: Course, lo: Array, hi: Array, wanted: Wanted) -> None:
        super().__init__(course, lo, hi)
        self.wanted, self.seen = wanted, np.zeros(1, dtype=bool)

    def begin(self, most: float) -> Index:
        """The leaves of a first tree, all of one size, that meet the box: the others cost nothing."""
        super().begin(math.inf)
        return self._own

    def halve(self, nodes: Index, axes: Index) -> Index:
        """Halve leaves; their halves are not seen yet."""
        halves = super().halve(nodes, axes)
        self.seen = np.append(self.seen, np.zeros(len(halves), dtype=bool))
        return halves

    def take(self, nodes: Index, found: Images) -> None:
        """Take in the images of leaves."""
        super().take(nodes, found)
        self.seen[nodes] = True

    def is_done(self, near: Index) -> bool:
        """True if the box is proved, or cannot be: it leaves the root, or leaves of it cannot be halved any more."""
        inside, _, met = self.cover.met_by(self.wanted.lo[:, None], self.wanted.hi[:, None])
        narrow = met[self.cover.widths(met).max(0) < _NARROW]
        proved = np.all(self.rank[met] <= self.wanted.most)
        return bool(proved or not inside[0] or np.any(self.rank[narrow] > self.wanted.most))

    def further(self, near: Index) -> Index:
        """The needed leaves that have not been seen; if all have, halves of those without a rank."""
        new = self._unseen(self._needed())
        while not len(new):
            self._halve_some(near)
            new = self._unseen(self._needed())
        return new

    def _halve_some(self, near: Index) -> None:
        """Halve needed leaves without a rank: those whose images meet one with a rank, or that have none."""
        needed = self._needed()
        waiting = needed[self.rank[needed] == UNPROVED]
        if not len(waiting):  # the box has ranks that are too high
            waiting = self._own[self.rank[self._own] > self.wanted.most]
            self.rank[waiting], self.steps[waiting] = UNPROVED, 0
        stuck = waiting[~self.known[:, self.place[waiting]].any(0)]
        chosen = np.union1d(stuck, np.intersect1d(waiting, near))
        chosen = chosen if len(chosen) else waiting
        volumes = self.cover.widths(chosen).prod(0)
        large = chosen[volumes >= np.quantile(volumes, 1 - _SHARE)]
        self.halve(large, self.steep[:, large].argmax(0))

    @property
    def _own(self) -> Index:
        """The leaves that meet the box."""
        return self._met(self.wanted.lo[:, None], self.wanted.hi[:, None])

    def _unseen(self, nodes: Index) -> Index:
        found: Index = nodes[~self.seen[nodes]]
        return found

    def _needed(self) -> Index:
        """All leaves that trajectories from the box may meet on the way, as far as images are known."""
        known = np.zeros(self.cover.size, dtype=bool)
        new = self._own
        while len(new):
            known[new] = True
            open_ = new[self.seen[new] & (self.rank[new] == UNPROVED)]
            leaves = self._met(*self._course_of(open_))
            new = leaves[~known[leaves]]
        found: Index = np.flatnonzero(known)
        return found

    def _course_of(self, nodes: Index) -> tuple[Array, Array]:
        """The images (n, I) that count, of the leaves that have some."""
        own, at = self.cover.high[:, nodes] - self.cover.low[:, nodes], self.place[nodes]
        known, widths = self.known[:, at], np.nan_to_num((self.hi[..., at] - self.lo[..., at]) / own)
        growth = np.where(known, widths.max((1, 2)), np.inf)
        far = np.where(growth <= _GROWTH, np.arange(len(growth))[:, None], -1).max(0)
        k = np.where(far >= 0, far, growth.argmin(0))
        use = known.any(0) & ~self.there[:, at].any(0)
        lo, hi = self.lo[k[use], :, :, at[use]], self.hi[k[use], :, :, at[use]]
        some = np.isfinite(lo[:, :, 0])
        return lo[some].T, hi[some].T

    def _met(self, lo: Array, hi: Array) -> Index:
        """The leaves that boxes meet."""
        _, _, leaves = self.cover.met_by(lo, hi)
        found: Index = np.unique(leaves)
        return found


class Direct(SearchFrom):
    """Ranks of parts of a box whose own images lie in the target: its tree is one of the box itself, but for angles,
    of which a tree has a turn. No other image is of use."""

    def __init__(self, course: Course, lo: Array, hi: Array, wanted: Wanted) -> None:
        turning = np.isin(np.arange(len(lo)), course.angles)
        super().__init__(course, np.where(turning, lo, wanted.lo), np.where(turning, hi, wanted.hi), wanted)
        self.left, self.stalls = math.inf, 0

    def begin(self, most: float) -> Index:
        """The whole box; of angles the parts of a turn, as narrow as the box, that meet it."""
        turn, new = self.cover.root[1] - self.cover.root[0], self._own
        for axis in self.course.angles:
            width = max(float(self.wanted.hi[axis] - self.wanted.lo[axis]), _OF_A_TURN) / float(turn[axis, 0])
            while self.cover.widths(new)[axis].max() > width:
                self.halve(new, np.full(len(new), axis))
                new = self._own
        return new

    @property
    def gives_up(self) -> bool:
        """True once enough boxes were looked at, and halves prove hardly more: at once where little of the box is
        proved, else after some rounds."""
        rounds = 1 if self.hopeless else _ROUNDS
        return self.boxes >= self.wanted.direct and self.stalls >= rounds

    @property
    def hopeless(self) -> bool:
        """True where so little of the box is proved that another search may prove more."""
        return self.left > _MOST_LEFT

    def further(self, near: Index) -> Index:
        """Halves of all parts without a rank."""
        open_ = self._open
        self.halve(open_, self.steep[:, open_].argmax(0))
        return self._unseen(self._own)

    def spread(self) -> Index:
        """Give ranks, and see how much of the box is left without."""
        near = super().spread()
        before, self.left = self.left, float(self.cover.widths(self._open).prod(0).sum())
        self.stalls = self.stalls + 1 if self.left >= _FALLS * before else 0
        return near

    @property
    def _open(self) -> Index:
        own = self._own
        found: Index = own[self.rank[own] == UNPROVED]
        return found
