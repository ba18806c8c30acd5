"""How a proof would spread over many workers: a simulation of the search on the tree of a certificate.

Run with `python benchmarks/scaling.py CERTIFICATE [--workers 1 2 8 64 256 1024] [--copies 1] [--overhead SECONDS]`.
The tree is known; what is simulated is who grows which part of it when, by the rules of `engines/bounds/subtrees.py`:
jobs of open boxes in the order of the lowest V, two a worker, of some seconds at most, whose open boxes come back and
are shared out anew. Costs are measured first, here: of a batch of boxes as a line in its size, of grafting a node, and
of a job of Dask from giving it to having its answer in hand (`local:1`), all of which is taken as time of the one
process that holds the search. A larger tree is that of several copies of the certificate's.

What it leaves out: networks slower than this machine's own, workers that differ, and the boxes that are bounded twice
because a level moved. Absolute times are this machine's; the ratios are what to look at.
"""

from __future__ import annotations

import argparse
import heapq
import math
import os
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from certify.certificates import Certificate, PartitionTree, leaves, read_certificate
from certify.certificates.claims import Problem
from certify.effort import UNIT
from certify.loop.closed_loop import ClosedLoop
from certify.provers.boxes import subtrees
from certify.provers.boxes.partition import Partition
from certify.provers.boxes.rule import VdotBound
from certify.provers.execution.cluster import ClusterJobs, connect

_BATCH = 2048
_SHELL = 16.0  # of the ring's search
_AT_HAND = 65_536
_WARM = 15.0  # seconds
Nodes = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Costs:
    """Seconds: of a batch whatever its size, of a box, of grafting a node, and of a job to the process that gave it."""

    batch: float
    box: float
    node: float
    job: float


@dataclass(frozen=True, slots=True)
class Tree:
    """The upper half of each split (the lower one is the next node), -1 for a leaf, and the lowest V on each box."""

    upper: Nodes
    key: NDArray[np.float64]
    roots: Nodes


@dataclass(frozen=True, slots=True)
class Outcome:
    """Seconds in all, those in which the master was busy, and jobs."""

    seconds: float
    master: float
    jobs: int


def measured(certificate: Certificate, evidence: PartitionTree, rule: VdotBound) -> Costs:
    """What things cost here."""
    lo, hi = leaves(evidence.tree, evidence.root)
    step = max(1, len(lo) // _BATCH)
    corners = [side[::step][:_BATCH].T.copy() for side in (lo, hi)]
    until = time.perf_counter() + _WARM
    while time.perf_counter() < until:  # compiled loops are loaded when they are worth it
        rule(*corners, certificate.inner, certificate.roa)
    times = []
    sizes = [size for size in (64, 256, 1024, _BATCH) if size <= corners[0].shape[1]]
    for size in sizes:
        part = [np.ascontiguousarray(side[:, :size]) for side in corners]
        each = []
        for _ in range(4):
            start = time.perf_counter()
            rule(*part, certificate.inner, certificate.roa)
            each.append(time.perf_counter() - start)
        times.append(min(each))
    box, batch = np.polyfit(sizes, times, 1)
    root, start = evidence.root, time.perf_counter()
    Partition(root).graft(np.zeros(1, np.int64), -root[:, None], root[:, None], evidence.tree)
    node = (time.perf_counter() - start) / len(evidence.tree)
    return Costs(max(0.0, float(batch)), float(box), node, _overhead(2 * 8 * len(root) * _BATCH))


def _overhead(size: int, count: int = 200) -> float:
    """Seconds of a job that does nothing with so many bytes."""
    with connect("local:1") as client:
        jobs = ClusterJobs(client, bytes)
        each = []
        for _ in range(5):
            start, open_ = time.perf_counter(), 0
            for _ in range(count // 5):
                jobs.give(bytes(size))
                open_ += 1
            while open_:
                open_ -= len(jobs.ended(1.0))
            each.append((time.perf_counter() - start) / (count // 5))
        jobs.close()
    return statistics.median(each)


def read_tree(evidence: PartitionTree, rule: VdotBound, copies: int) -> Tree:
    """The certificate's tree, so many times beside itself."""
    nodes = np.frombuffer(evidence.tree, dtype=np.uint8)
    split = nodes != 255
    before = np.concatenate([[0], np.cumsum(np.where(split, 1, -1))[:-1]])
    order = np.argsort(before, kind="stable")
    following = np.full(len(nodes), -1, dtype=np.int64)
    following[order[:-1]] = order[1:]
    upper = np.where(split, following, -1)
    n, root = len(evidence.root), evidence.root
    lo, hi = np.empty((n, len(nodes))), np.empty((n, len(nodes)))
    lo[:, 0], hi[:, 0] = -root, root
    level = np.zeros(1, dtype=np.int64)
    while len(level):
        level = level[split[level]]
        axis, low, high = nodes[level].astype(int), level + 1, upper[level]
        for child in (low, high):
            lo[:, child], hi[:, child] = lo[:, level], hi[:, level]
        middle = 0.5 * lo[axis, level] + 0.5 * hi[axis, level]
        hi[axis, low] = lo[axis, high] = middle
        level = np.concatenate([low, high])
    key = np.concatenate([rule.levels(a, b)[0] for a, b in _parts(lo, hi)])
    shift = len(nodes) * np.arange(copies)
    uppers = [np.where(upper < 0, -1, upper + s) for s in shift]
    return Tree(np.concatenate(uppers), np.tile(key, copies), shift)


def _parts(lo: NDArray[np.float64], hi: NDArray[np.float64]) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    cuts = range(0, lo.shape[1], 100_000)
    return [(lo[:, k : k + 100_000].copy(), hi[:, k : k + 100_000].copy()) for k in cuts]


class _Queue:
    """Nodes in the order of their keys; the lowest are at hand, sorted, so that taking some does not look at all."""

    def __init__(self, key: NDArray[np.float64], nodes: Nodes) -> None:
        self.key, self.near, self.at, self.far = key, nodes[np.argsort(key[nodes])], 0, [nodes[:0]]
        self.least_far, self.size = math.inf, len(nodes)

    def __len__(self) -> int:
        return self.size

    def add(self, nodes: Nodes) -> None:
        if len(nodes):
            self.far.append(nodes)
            self.least_far = min(self.least_far, float(self.key[nodes].min()))
            self.size += len(nodes)

    def _settle(self, count: int) -> None:
        left = self.near[self.at :]
        if len(left) >= count and self.key[left[count - 1]] <= self.least_far:
            return
        nodes = np.concatenate([left, *self.far])
        near = nodes
        self.far, self.least_far = [nodes[:0]], math.inf
        if len(nodes) > 2 * _AT_HAND:
            order = np.argpartition(self.key[nodes], _AT_HAND)
            near, far = nodes[order[:_AT_HAND]], nodes[order[_AT_HAND:]]
            self.far, self.least_far = [far], float(self.key[far].min())
        self.near, self.at = near[np.argsort(self.key[near])], 0

    def least(self) -> float:
        self._settle(1)
        return float(self.key[self.near[self.at]])

    def take(self, count: int, limit: float) -> Nodes:
        self._settle(min(count, self.size))
        left = self.near[self.at :]
        allowed = max(64, int(np.searchsorted(self.key[left], limit, side="right")))
        taken = left[: min(count, allowed)]
        self.at, self.size = self.at + len(taken), self.size - len(taken)
        return taken


def _grow(tree: Tree, costs: Costs, nodes: Nodes, seconds: float) -> tuple[float, int, Nodes]:
    """Seconds that a job takes, boxes that it bounds, and what it leaves open."""
    spent, boxes, queue = 0.0, 0, _Queue(tree.key, nodes)
    while len(queue) and (not boxes or spent < seconds):
        now = queue.take(_BATCH, math.inf)
        spent += costs.batch + costs.box * len(now)
        boxes += len(now)
        split = now[tree.upper[now] >= 0]
        queue.add(np.concatenate([split + 1, tree.upper[split]]))
    return spent, boxes, np.concatenate([queue.near[queue.at :], *queue.far])


def simulate(tree: Tree, costs: Costs, workers: int) -> Outcome:
    """The search with so many workers; with one, all is done by the process that holds it."""
    if workers == 1:
        spent, _, _ = _grow(tree, costs, tree.roots, np.inf)
        return Outcome(spent, spent, 0)
    clock = busy = 0.0  # of the master
    frontier, out, jobs = _Queue(tree.key, tree.roots), 0, 0
    free: list[tuple[float, int]] = [(0.0, w) for w in range(workers)]  # when a worker is next without work
    ended: list[tuple[float, int, int, Nodes]] = []
    lowest: list[tuple[float, int]] = []  # of the jobs that are out, and of some that are not any more
    gone: set[int] = set()
    while len(frontier) or ended:
        if not ended and len(frontier) < subtrees.enough(workers):
            seconds, _, opened = _grow(tree, costs, frontier.take(_BATCH, math.inf), 0.0)
            frontier.add(opened)
            clock, busy = clock + seconds, busy + seconds
            continue
        most = subtrees._QUEUE * workers
        while out < most and len(frontier):
            while lowest and lowest[0][1] in gone:
                gone.discard(heapq.heappop(lowest)[1])
            least = min(frontier.least(), lowest[0][0] if lowest else math.inf)
            count = min(_BATCH, max(subtrees._LEAST, len(frontier) // most))
            now = frontier.take(count, _SHELL * max(least, 0.0))
            clock, busy = clock + costs.job, busy + costs.job
            when, worker = heapq.heappop(free)
            seconds, boxes, opened = _grow(tree, costs, now, subtrees.turn(workers) / UNIT)
            end = max(when, clock) + seconds
            heapq.heappush(free, (end, worker))
            jobs, out = jobs + 1, out + 1
            heapq.heappush(lowest, (float(tree.key[now].min()), jobs))
            heapq.heappush(ended, (end, jobs, boxes, opened))
        end, number, boxes, opened = heapq.heappop(ended)
        seconds = costs.node * boxes
        clock, busy, out = max(clock, end) + seconds, busy + seconds, out - 1
        gone.add(number)
        frontier.add(opened)
    return Outcome(clock, busy, jobs)


def main() -> None:
    """Parse the arguments and run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("certificate", type=Path)
    parser.add_argument("--workers", nargs="*", type=int, default=[1, 2, 8, 64, 256, 1024])
    parser.add_argument("--copies", nargs="*", type=int, default=[1])
    parser.add_argument("--box", type=float, default=None, help="seconds per box, instead of a measurement")
    parser.add_argument("--overhead", type=float, default=None, help="seconds of a job, likewise")
    options = parser.parse_args()
    certificate = read_certificate(options.certificate)
    evidence = certificate.evidence
    if not isinstance(evidence, PartitionTree):
        raise SystemExit("the certificate has no tree")
    problem = Problem(ClosedLoop(certificate.system, certificate.network), certificate.V)
    rule = VdotBound(problem, evidence.T, order=evidence.order)
    costs = measured(certificate, evidence, rule)
    costs = Costs(costs.batch, options.box or costs.box, costs.node, options.overhead or costs.job)
    print(
        f"a batch {1e3 * costs.batch:.2f} ms and {1e6 * costs.box:.1f} us a box; grafting {1e9 * costs.node:.0f} ns a "
        f"node; a job {1e3 * costs.job:.2f} ms"
    )
    for copies in options.copies:
        tree = read_tree(evidence, rule, copies)
        alone = simulate(tree, costs, 1).seconds
        print(f"\n{len(tree.upper):,} boxes, {alone:,.0f} s on one core")
        print(" workers  seconds  speed-up  of ideal  master   jobs")
        for workers in options.workers:
            found = simulate(tree, costs, workers)
            ratio = alone / found.seconds
            print(
                f"{workers:8,} {found.seconds:8.1f} {ratio:9.1f} {ratio / workers:9.0%} "
                f"{found.master / found.seconds:7.0%} {found.jobs:6,}"
            )


if __name__ == "__main__":
    main()
