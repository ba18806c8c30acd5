"""How a proof would spread over many workers: a simulation of the search on the tree of a certificate.

Run with `python benchmarks/scaling.py CERTIFICATE [--workers 1 2 8 64 256 1024] [--copies 1] [--overhead SECONDS]`.
The tree is known; what is simulated is who bounds which part of it when, by the rules of `provers/boxes/ahead.py`: jobs
of open boxes in the order of the lowest V, two a worker, of some seconds at most, whose open boxes go out anew. The
search itself takes every box, in its own order, with the bounds that came. Costs are measured first, here: of a batch
of boxes as a line in its size, of a box whose bounds came, and of a job of Dask from giving it to having its answer in
hand (`local:1`), all of which is taken as time of the one process that holds the search. A larger tree is that of
several copies of the certificate's.

What it leaves out: networks slower than this machine's own, workers that differ, that the search waits for the lowest
box first, and the boxes that are bounded twice because a level moved. Absolute times are this machine's; the ratios are
what to look at.
"""

from __future__ import annotations

import argparse
import heapq
import math
import os
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from numpy.typing import NDArray

from certify.certificates import Certificate, PartitionTree, leaves, read_certificate
from certify.certificates.claims import Problem
from certify.effort import UNIT
from certify.loop.closed_loop import ClosedLoop
from certify.provers.base import Budget
from certify.provers.boxes import ahead
from certify.provers.boxes.rule import VdotBound
from certify.provers.boxes.search import outwards
from certify.provers.execution import Bound, ThreadRunner, rows
from certify.provers.execution.cluster import ClusterJobs, connect

_BATCH = 2048
_REPLAYED = 50_000  # boxes
_AT_HAND = 65_536
_WARM = 15.0  # seconds
Nodes = NDArray[np.int64]
Corners = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Costs:
    """Seconds: of a batch whatever its size, of a box, of one whose bounds came, and of a job to whoever gave it."""

    batch: float
    box: float
    known: float
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
    known = _replayed(certificate, evidence)
    return Costs(max(0.0, float(batch)), float(box), known, _overhead(2 * 8 * len(evidence.root) * _BATCH))


class _Replay(ThreadRunner):
    """Bounds are worked out once, and known ahead the second time."""

    def __init__(self) -> None:
        super().__init__(1)
        self.boxes: list[bytes] = []
        self.rows: list[bytes] = []
        self.layout: rows.Layout | None = None
        self.known: dict[bytes, bytes] = {}
        self.seconds = 0.0  # of taking them in

    @contextmanager
    def start(self, bound: Bound) -> Iterator[Bound]:
        def recorded(lo: Corners, hi: Corners, inner: float, outer: float) -> Any:
            found = bound(lo, hi, inner, outer)
            self.layout = rows.Layout.of(found)
            self.boxes += rows.boxes_of(lo, hi)
            self.rows.append(self.layout.write(found))
            return found

        def replayed(lo: Corners, hi: Corners, inner: float, outer: float) -> Any:
            if layout is None:
                raise RuntimeError("nothing is known.")
            return layout.read(b"".join([self.known.pop(box) for box in rows.boxes_of(lo, hi)]))

        layout = self.layout
        yield recorded if layout is None else replayed

    def arrive(self) -> None:
        """Take in all that was recorded, as an answer."""
        job, n = b"", len(self.boxes[0])
        answer = rows.sealed(job, b"".join(self.boxes + self.rows))
        start = time.process_time()
        body = rows.unsealed(job, answer)
        one = self.layout.row.itemsize if self.layout else 1
        end = n * len(self.boxes)
        self.known.update(zip(rows.pieces(body[:end], n), rows.pieces(body[end:], one), strict=True))
        self.seconds = time.process_time() - start


def _replayed(certificate: Certificate, evidence: PartitionTree) -> float:
    """Seconds for a box whose bounds came, from the arrival of these to its halves."""
    runner, problem = _Replay(), Problem(ClosedLoop(certificate.system, certificate.network), certificate.V)
    levels, budget = (certificate.inner, certificate.roa), Budget(boxes=_REPLAYED)
    outwards(problem, evidence.T, *levels, runner).advance(budget)
    each = []
    for _ in range(8):
        runner.arrive()
        ring = outwards(problem, evidence.T, *levels, runner)
        start = time.process_time()
        ring.advance(budget)
        each.append((runner.seconds + time.process_time() - start) / ring.boxes)
    return min(each)


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

    def take(self, count: int) -> Nodes:
        self._settle(min(count, self.size))
        taken = self.near[self.at :][:count]
        self.at, self.size = self.at + len(taken), self.size - len(taken)
        return taken


def _grow(tree: Tree, costs: Costs, nodes: Nodes, seconds: float, most: float) -> tuple[float, int, Nodes]:
    """Seconds that a job takes, boxes that it bounds, and what it leaves open."""
    spent, boxes, queue = 0.0, 0, _Queue(tree.key, nodes)
    while len(queue) and (not boxes or (spent < seconds and boxes < most)):
        now = queue.take(_BATCH)
        spent += costs.batch + costs.box * len(now)
        boxes += len(now)
        split = now[tree.upper[now] >= 0]
        queue.add(np.concatenate([split + 1, tree.upper[split]]))
    return spent, boxes, np.concatenate([queue.near[queue.at :], *queue.far])


def simulate(tree: Tree, costs: Costs, workers: int) -> Outcome:
    """The search with so many workers; with one, all is done by the process that holds it."""
    if workers == 1:
        spent, _, _ = _grow(tree, costs, tree.roots, np.inf, np.inf)
        return Outcome(spent, spent, 0)
    clock = busy = 0.0  # of the master
    frontier, out, jobs = _Queue(tree.key, tree.roots), 0, 0
    free: list[tuple[float, int]] = [(0.0, w) for w in range(workers)]  # when a worker is next without work
    ended: list[tuple[float, int, int, Nodes]] = []
    while len(frontier) or ended:
        if not ended and len(frontier) < ahead.enough(workers):
            seconds, _, opened = _grow(tree, costs, frontier.take(_BATCH), 0.0, 0.0)
            frontier.add(opened)
            clock, busy = clock + seconds, busy + seconds
            continue
        most = ahead._QUEUE * workers
        while out < most and len(frontier) >= ahead.enough(workers):
            now = frontier.take(min(_BATCH, max(ahead._LEAST, len(frontier) // most)))
            clock, busy = clock + costs.job, busy + costs.job
            when, worker = heapq.heappop(free)
            seconds, boxes, opened = _grow(tree, costs, now, ahead.turn(workers) / UNIT, ahead._MOST)
            end = max(when, clock) + seconds
            heapq.heappush(free, (end, worker))
            jobs, out = jobs + 1, out + 1
            heapq.heappush(ended, (end, jobs, boxes, opened))
        end, _, boxes, opened = heapq.heappop(ended)
        seconds = costs.known * boxes
        clock, busy, out = max(clock, end) + seconds, busy + seconds, out - 1
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
    costs = Costs(costs.batch, options.box or costs.box, costs.known, options.overhead or costs.job)
    print(
        f"a batch {1e3 * costs.batch:.2f} ms and {1e6 * costs.box:.1f} us a box; {1e6 * costs.known:.1f} us one "
        f"whose bounds came; a job {1e3 * costs.job:.2f} ms"
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
