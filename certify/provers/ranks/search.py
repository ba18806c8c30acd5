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
from certify.certificates.claims import Problem, Ranks
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression
from certify.provers.bounds.arrays import Array, Index
from certify.provers.execution import Runner
from certify.provers.ranks.cover import Cover
from certify.provers.ranks.images import TURN, Course, Images

NONE = 65_535
COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
_HALF_TURN = 3.1416  # and a little more
_SLIVER, _SAMPLES = 1e-6, 64
_FIRST = 2**12  # leaves of the first tree
_LARGEST = 0.7  # share of the leaves to be halved that are, the largest ones
_MOST_LEAVES = 400_000
_ROUNDS, _GAIN = 6, 1e-4  # relative growth of what is proved, in so many rounds, below which the search ends


@dataclass(frozen=True, slots=True)
class RankProof:
    """Leaves from which the target is reached, with their evidence.

    Parameters
    ----------
    ranks, evidence : as the claim and the certificate have them.
    share : of the root box's volume.
    leaves : of finite rank; `boxes` were looked at, in `rounds` rounds.
    done : no leaf is left whose halves could gain anything.
    """

    ranks: Ranks
    evidence: RankTree
    share: float
    leaves: int
    boxes: int
    rounds: int
    done: bool


class Search:
    """Ranks of the leaves of a tree that grows."""

    def __init__(self, course: Course, lo: Array, hi: Array) -> None:
        self.course, self.cover = course, Cover(lo, hi, course.angles)
        K, n = len(course.counts), len(lo)
        self.rank, self.steps = np.full(1, NONE), np.zeros(1, dtype=np.int64)
        self.lo, self.hi = np.full((K, n, 1), np.nan), np.full((K, n, 1), np.nan)
        self.there, self.steep, self.meets = np.zeros((K, 1), dtype=bool), np.zeros((n, 1)), np.zeros(1, dtype=bool)
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
        self.there, self.steep, self.meets = (
            longer(self.there, False),
            longer(self.steep, 0.0),
            longer(self.meets, False),
        )
        return halves

    def take(self, nodes: Index, found: Images) -> None:
        """Take in the images of leaves."""
        self.lo[..., nodes], self.hi[..., nodes] = found.lo, found.hi
        self.there[:, nodes], self.steep[:, nodes], self.meets[nodes] = found.there, found.steep, found.meets
        self.rank[nodes[found.inside]] = 0
        self.boxes += len(nodes)

    def spread(self) -> Index:
        """Give ranks to all leaves that have one by now; those without that may meet the target, or whose images meet
        some leaf with a rank."""
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
        near: Index = np.unique(np.append(owners[some], unknown[self.meets[unknown]]))
        waiting: Index = near[self.rank[near] == NONE]
        return waiting

    def _better(self, best: Index, by: Index, nodes: Index, ranks: Index, steps: Index) -> None:
        """Keep the lowest rank of each node, and its steps."""
        order = np.lexsort((steps, ranks))[::-1]
        nodes, ranks, steps = nodes[order], ranks[order], steps[order]
        lower = ranks < best[nodes]
        best[nodes[lower]], by[nodes[lower]] = ranks[lower], steps[lower]  # of several the last, the lowest, stays

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


def turning(loop: ClosedLoop) -> list[int]:
    """The plant's angles, by their numbers, if the policy is the same after a turn of each of them at samples; else
    none: a policy that reads an angle itself counts turns."""
    system = loop.system
    angles = [i for i, s in enumerate(system.states) if s.name in system.angles]
    x = np.random.default_rng(0).uniform(-1, 1, (_SAMPLES, system.n))
    u = loop.policy(x)
    moved = (loop.policy(x + TURN * np.eye(system.n)[i]) for i in angles)
    return angles if all(np.allclose(u, v, rtol=1e-9, atol=1e-9) for v in moved) else []


def root_box(loop: ClosedLoop) -> tuple[Array, Array]:
    """The box of places of a plant, corners (n,): a turn of each angle around 0, of other states the domain but for a
    sliver along its ends."""
    system, turns = loop.system, turning(loop)
    ends = np.array([[float(end) for end in pair] for pair in system.domain])
    inwards = _SLIVER * np.abs(ends).max(1)
    lo, hi = ends[:, 0] + inwards, ends[:, 1] - inwards
    angles = np.isin(np.arange(system.n), turns)
    return np.where(angles, -_HALF_TURN, lo), np.where(angles, _HALF_TURN, hi)


def prove_ranks(
    problem: Problem,
    level: float,
    keep: Sequence[Expression],
    root: tuple[Array, Array],
    effort: Effort,
    runner: Runner,
    report: Callable[[float, int, int], None] | None = None,
    order: int = 2,
) -> RankProof | None:
    """Prove from which leaves of a box trajectories reach {V <= level}.

    Parameters
    ----------
    keep : expressions that stay negative on the way.
    root : corners lo and hi (n,) of the box, in deviations; of an angle more than a turn apart.
    report : called after every round with the share that is proved, the boxes looked at, and the leaves that wait.
    order : of the series in time, where inputs are held.

    Returns
    -------
    RankProof | None : None if no leaf beyond the set has a rank.
    """
    system = problem.loop.system
    lo, hi = root
    named = turning(problem.loop)
    course = Course(problem, level, named, keep, hi - lo, COUNTS, order)
    search, rounds, done = Search(course, lo, hi), 0, False
    new = np.zeros(1, dtype=np.int64)
    widths = np.ones(len(lo))
    while len(new) < _FIRST:
        axis = int(widths.argmax())
        widths[axis] /= 2
        new = search.halve(new, np.full(len(new), axis))
    with runner.start(course) as bound:
        shares = [0.0]
        while True:
            effort.charge(len(new) * course.operations)
            search.take(new, bound(search.cover.low[:, new], search.cover.high[:, new], 0.0, level))
            near, rounds = search.spread(), rounds + 1
            shares.append(search.share)
            if report is not None:
                report(shares[-1], search.boxes, len(search.unknown))
            done = not len(near) or (len(shares) > _ROUNDS and 0 < shares[-1] <= (1 + _GAIN) * shares[-1 - _ROUNDS])
            if done or effort.over or len(search.cover.leaves) > _MOST_LEAVES:
                break
            new = search.halve(*search.next(near))
    tree, most = search.evidence()
    leaves = int((tree.ranks < NONE).sum())
    if not np.any(tree.steps):
        return None
    return RankProof(
        Ranks(tuple(system.states[i].name for i in named), most), tree, search.share, leaves, search.boxes, rounds, done
    )
