"""The search for ranks: the largest set of leaves that reach the target, found backwards from it.

A leaf has its rank as soon as an image lies in the target, or meets leaves of known ranks alone: the number of the
steps to that image, and the highest of those ranks. Leaves without a rank whose images meet some leaf with one are
halved, the largest first, and looked at again (Kalies, Mischaikow, VanderVorst 2005 do this without images of
networks). What has a rank keeps it; so the search may end at any time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from certify.certificates import RankTree
from certify.certificates.claims import Ranks
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression
from certify.loop.plants import System
from certify.provers.bounds.arrays import Array, Index
from certify.provers.execution import Runner
from certify.provers.ranks.cover import Cover
from certify.provers.ranks.images import Course, Images
from certify.provers.ranks.targets import Target

NONE = 65_535
COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
_HALF_TURN = 3.1416  # and a little more
_SLIVER = 1e-6
_FIRST = 2**12  # leaves of the first tree
_LARGEST = 0.7  # share of the leaves to be halved that are, the largest ones
_MOST_LEAVES = 400_000


@dataclass(frozen=True, slots=True)
class RankProof:
    """Leaves from which the target is reached, with their evidence.

    Parameters
    ----------
    ranks, evidence : as the claim and the certificate have them.
    share : of the root box's volume.
    leaves : of finite rank; `boxes` were looked at, in `rounds` rounds.
    done : no leaf is left whose halves could gain anything, or the box that was wanted is proved.
    """

    ranks: Ranks
    evidence: RankTree
    share: float
    leaves: int
    boxes: int
    rounds: int
    done: bool


@dataclass(frozen=True, slots=True)
class Wanted:
    """A box lo <= x <= hi (n,) of places, each of whose leaves is to have a rank of `most` at most."""

    lo: Array
    hi: Array
    most: int = NONE - 1


class Search:
    """Ranks of the leaves of a tree that grows."""

    def __init__(self, course: Course, lo: Array, hi: Array) -> None:
        self.course, self.cover = course, Cover(lo, hi, course.angles)
        K, n = len(course.counts), len(lo)
        self.rank, self.steps = np.full(1, NONE), np.zeros(1, dtype=np.int64)
        self.lo, self.hi = np.full((K, n, 1), np.nan), np.full((K, n, 1), np.nan)
        self.there, self.steep = np.zeros((K, 1), dtype=bool), np.zeros((n, 1))
        self.boxes = 0

    @property
    def unknown(self) -> Index:
        """Leaves without a rank."""
        leaves = self.cover.leaves
        unknown: Index = leaves[self.rank[leaves] == NONE]
        return unknown

    @property
    def share(self) -> float:
        """The share of the root box's volume in leaves with a rank."""
        leaves = self.cover.leaves
        widths = (self.cover.high - self.cover.low) / (self.cover.root[1] - self.cover.root[0])
        return float(widths[:, leaves[self.rank[leaves] < NONE]].prod(0).sum())

    def halve(self, nodes: Index, axes: Index) -> Index:
        """Halve leaves; their halves, of which nothing is known yet."""
        halves = self.cover.halve(nodes, axes)
        new = len(halves)

        def longer(v: Any, fill: float) -> Any:
            return np.concatenate([v, np.full((*v.shape[:-1], new), fill, dtype=v.dtype)], -1)

        self.rank, self.steps = longer(self.rank, NONE), longer(self.steps, 0)
        self.lo, self.hi = longer(self.lo, np.nan), longer(self.hi, np.nan)
        self.there, self.steep = longer(self.there, False), longer(self.steep, 0.0)
        return halves

    def take(self, nodes: Index, found: Images) -> None:
        """Take in the images of leaves."""
        self.lo[..., nodes], self.hi[..., nodes] = found.lo, found.hi
        self.there[:, nodes], self.steep[:, nodes] = found.there, found.steep
        self.rank[nodes[found.inside]] = 0
        self.boxes += len(nodes)

    def spread(self) -> Index:
        """Give ranks to all leaves that have one by now; those without whose images meet some leaf with a rank."""
        unknown, counts = self.unknown, np.array(self.course.counts)
        k, at = np.nonzero(np.isfinite(self.lo[:, 0, unknown]))
        node, there = unknown[at], self.there[k, unknown[at]]
        best, by = np.full(self.cover.size, NONE), np.zeros(self.cover.size, dtype=np.int64)
        self._better(best, by, node[there], counts[k[there]], counts[k[there]])
        node, k = node[~there], k[~there]
        inside, pair, leaf = self.cover.met_by(self.lo[k, :, node].T, self.hi[k, :, node].T)
        kept = inside[pair]
        order = np.argsort(pair[kept], kind="stable")
        pair, leaf = pair[kept][order], leaf[kept][order]
        starts = np.flatnonzero(np.diff(pair, prepend=-1))
        owners = node[pair[starts]]
        steps = counts[k[pair[starts]]]
        while True:
            highest = np.maximum.reduceat(self.rank[leaf], starts) if len(starts) else np.zeros(0, dtype=np.int64)
            known = (highest < NONE) & (highest + steps < NONE)
            self._better(best, by, owners[known], highest[known] + steps[known], steps[known])
            new = unknown[(best[unknown] < self.rank[unknown])]
            if not len(new):
                break
            self.rank[new], self.steps[new] = best[new], by[new]
        some = np.logical_or.reduceat(self.rank[leaf] < NONE, starts) if len(starts) else np.zeros(0, dtype=bool)
        near: Index = np.unique(owners[some])
        waiting: Index = near[self.rank[near] == NONE]
        return waiting

    def _better(self, best: Index, by: Index, nodes: Index, ranks: Index, steps: Index) -> None:
        """Keep the lowest rank of each node, and its steps."""
        order = np.lexsort((steps, ranks))[::-1]
        nodes, ranks, steps = nodes[order], ranks[order], steps[order]
        lower = ranks < best[nodes]
        best[nodes[lower]], by[nodes[lower]] = ranks[lower], steps[lower]  # of several the last, the lowest, stays

    def has(self, wanted: Wanted) -> bool:
        """True if the box is proved."""
        inside, _, met = self.cover.met_by(wanted.lo[:, None], wanted.hi[:, None])
        return bool(inside[0] and np.all(self.rank[met] <= wanted.most))

    def next(self, near: Index) -> tuple[Index, Index]:
        """The leaves to halve next, and their axes."""
        widths = (self.cover.high - self.cover.low) / (self.cover.root[1] - self.cover.root[0])
        volumes = widths[:, near].prod(0)
        large = near[volumes >= np.quantile(volumes, 1 - _LARGEST)]
        return large, self.steep[:, large].argmax(0)

    def evidence(self) -> tuple[RankTree, int]:
        """The evidence, and the most steps."""
        tree, leaves = self.cover.preorder()
        rank, steps = self.rank[leaves], self.steps[leaves]
        lo, hi = (end[:, 0].copy() for end in self.cover.root)
        most = int(rank[rank < NONE].max(initial=1))
        return RankTree(lo, hi, tree, rank.astype(np.uint16), steps.astype(np.uint8)), max(1, most)


def root_box(system: System) -> tuple[Array, Array]:
    """The box of places of a plant, corners (n,): a turn of each angle around 0, of other states the domain but for a
    sliver along its ends."""
    ends = np.array([[float(end) for end in pair] for pair in system.domain])
    inwards = _SLIVER * np.abs(ends).max(1)
    lo, hi = ends[:, 0] + inwards, ends[:, 1] - inwards
    angles = np.array([s.name in system.angles for s in system.states])
    return np.where(angles, -_HALF_TURN, lo), np.where(angles, _HALF_TURN, hi)


def prove_ranks(
    loop: ClosedLoop,
    target: Target,
    keep: Sequence[Expression],
    root: tuple[Array, Array],
    effort: Effort,
    runner: Runner,
    report: Callable[[float, int, int], None] | None = None,
    order: int = 2,
    wanted: Wanted | None = None,
) -> RankProof | None:
    """Prove from which leaves of a box trajectories reach a target.

    Parameters
    ----------
    keep : expressions that stay negative on the way.
    root : corners lo and hi (n,) of the box, in deviations; of an angle more than a turn apart.
    report : called after every round with the share that is proved, the boxes looked at, and the leaves that wait.
    order : of the series in time, where inputs are held.
    wanted : a box on which alone it depends; the search ends once it is proved.

    Returns
    -------
    RankProof | None : None if no leaf has a rank.
    """
    system = loop.system
    lo, hi = root
    named = [i for i, s in enumerate(system.states) if s.name in system.angles]
    course = Course(loop, target, named, keep, hi - lo, COUNTS, order)
    search, rounds, done = Search(course, lo, hi), 0, False
    new = np.zeros(1, dtype=np.int64)
    widths = np.ones(len(lo))
    while len(new) < _FIRST:
        axis = int(widths.argmax())
        widths[axis] /= 2
        new = search.halve(new, np.full(len(new), axis))
    with runner.start(course) as bound:
        while True:
            effort.charge(len(new) * course.operations)
            search.take(new, bound(search.cover.low[:, new], search.cover.high[:, new], 0.0, 0.0))
            near, rounds = search.spread(), rounds + 1
            if report is not None:
                report(search.share, search.boxes, len(search.unknown))
            done = not len(near) or (wanted is not None and search.has(wanted))
            if done or effort.over or len(search.cover.leaves) > _MOST_LEAVES:
                break
            new = search.halve(*search.next(near))
    tree, most = search.evidence()
    leaves = int((tree.ranks < NONE).sum())
    if not leaves:
        return None
    return RankProof(Ranks(system.angles, most), tree, search.share, leaves, search.boxes, rounds, done)
