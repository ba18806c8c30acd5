"""The ring: one best-first pass of branch and bound that finds the largest provable level as it goes.

Boxes are taken in the order of the lowest V on them. Everything below the lowest undecided box is proved, so the answer
is ready whenever the pass stops: for a witness, a budget, or because nothing is left. No trial level is ever
proved again from scratch. A violation met on the way is handed to the falsifier, which lowers the level aimed at.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.engines.falsify import Witness, descend
from certify.engines.partition import LEAF, Frontier, Partition
from certify.engines.vdot import BoxBounds, VdotBound
from certify.obligations import Obligations

Array = NDArray[np.float64]
Bound = Callable[[Tensor, Tensor, float, float], BoxBounds]
_SLACK = 1e-9  # relative distance kept from every level, so that the checker's own rounding agrees
_BELOW_WITNESS = 1e-3  # relative distance kept from a violation
_SHELL = 16.0  # a batch reaches up to this multiple of the lowest open level
_CHUNK = 256  # boxes that make a thread worth its while
_MOST_SPLITS = 40_000_000  # what a certificate can hold, and two gibibytes


@dataclass(frozen=True, slots=True)
class Budget:
    """What the pass may use; `least_width` is the smallest box, relative to the root box."""

    boxes: int = 4_000_000
    seconds: float = 600.0
    batch: int = 2048
    least_width: float = 2.0**-24


@dataclass(frozen=True, slots=True)
class RingProgress:
    """Where the pass stands: `level` is proved, `target` aimed at, `boxes` were bounded and `open` wait.

    `proved` is the share of the ring's volume below `level`; `seconds_left` is extrapolated, None at first.
    """

    level: float
    target: float
    boxes: int
    open: int
    proved: float
    seconds_left: float | None


@dataclass(frozen=True, slots=True)
class RingProof:
    """`level` is proved from `inner` on (equal to it if the ring is empty); `reason` says what stopped the pass.

    `tree` is the partition in preorder: an axis for a split, 255 for a leaf; `root` its half-widths (n,) in z.
    `witness` is the lowest violation found along the way.
    """

    level: float
    reason: str
    tree: bytes
    root: Array
    boxes: int
    leaves: int
    witness: Witness | None


def prove_ring(
    obligations: Obligations,
    inner: float,
    target: float,
    budget: Budget,
    device: torch.device,
    progress: Callable[[RingProgress], None] | None = None,
    rule: VdotBound | None = None,
) -> RingProof:
    """Prove Vdot < 0 (and the input bounds) on `inner <= V <= level` for the largest level up to `target`.

    Parameters
    ----------
    inner, target : levels, 0 < inner <= target.
    progress : called after every batch.
    rule : another bound for boxes, to compare with; None for `VdotBound`.

    Notes
    -----
    Deterministic for a machine and a number of threads, unless `budget.seconds` stops the pass.
    """
    S = obligations.T.T @ obligations.P @ obligations.T
    root = np.sqrt(target * np.diag(np.linalg.inv(S))) * (1 + 1e-9)
    if inner >= target:  # the ring is empty
        return RingProof(target, "requested", bytes([LEAF]), root, 0, 1, None)
    start = time.monotonic()
    rule = rule or VdotBound(obligations, device)
    partition = Partition(root)
    frontier = Frontier(partition, device)
    half = torch.tensor(root, device=device)[:, None]
    frontier.add(-half, half, rule.levels(-half, half)[0], torch.zeros(1, dtype=torch.int64, device=device))
    clock = _Clock(inner, len(root))
    boxes, reason = 0, "requested"
    witness: Witness | None = None
    with _threaded(rule, device) as bound:
        while len(frontier):
            full = boxes >= budget.boxes or partition.splits + 3 * budget.batch > _MOST_SPLITS
            if full or time.monotonic() - start > budget.seconds:
                reason = "boxes" if full else "time"
                target = frontier.least() * (1 - 2 * _SLACK)
                break
            count = min(budget.batch, budget.boxes - boxes)
            lo, hi, number = frontier.take(count, _SHELL * max(frontier.least(), inner))
            boxes += lo.shape[1]
            found = bound(lo, hi, inner, target)
            centres = 0.5 * lo + 0.5 * hi
            at = torch.where(found.violated, rule.levels_at(centres), math.inf)
            if float(at.min()) <= target:
                lower = descend(obligations, centres[:, at.argmin()].cpu().numpy())
                if lower is not None and (witness is None or lower.level < witness.level):
                    witness = lower
                target = min(float(at.min()), math.inf if witness is None else witness.level) * (1 - _BELOW_WITNESS)
                reason = "witness"
            lo, hi, number, stuck = _split(rule, partition, lo, hi, number, found, budget.least_width * half)
            if stuck < target:
                target, reason = stuck * (1 - _SLACK), "boxes"
            lowest, highest = rule.levels(lo, hi)
            keep = (lowest <= target * (1 + _SLACK)) & (highest >= inner * (1 - _SLACK))
            frontier.add(lo[:, keep], hi[:, keep], lowest[keep], number[keep])
            frontier.drop_above(target * (1 + _SLACK))
            if progress is not None:
                progress(clock.read(min(frontier.least(), target), target, boxes, len(frontier)))
    del frontier
    if target <= inner:  # nothing beyond the local level, which needs no tree
        return RingProof(inner, reason, bytes([LEAF]), root, boxes, 1, witness)
    tree = partition.preorder()
    return RingProof(target, reason, tree, root, boxes, tree.count(bytes([LEAF])), witness)


def _split(
    rule: VdotBound, partition: Partition, lo: Tensor, hi: Tensor, number: Tensor, found: BoxBounds, least_width: Tensor
) -> tuple[Tensor, Tensor, Tensor, float]:
    """Halve the boxes that are not proved; returns the halves and the lowest V on a box too small to halve.

    A half whose bound would stay positive if the split took away three quarters of its axis's share is halved
    again at once, along the next axis.
    """
    undecided = ~found.proved
    lo, hi, number = lo[:, undecided], hi[:, undecided], number[undecided]
    bound, score = found.bound[undecided], found.score[:, undecided]
    # An axis that is already much thinner than the others, or too thin to halve, is not split.
    width = hi - lo
    relative = width / least_width
    score = torch.where((relative * 2.0**12 < relative.amax(0)) | (relative < 2), -torch.inf, score)
    best = score.amax(0)
    stuck = best == -torch.inf
    bottom = math.inf
    if bool(stuck.any()):
        bottom = float(rule.levels(lo[:, stuck], hi[:, stuck])[0].min())
        lo, hi, number, bound, score, best = (a[..., ~stuck] for a in (lo, hi, number, bound, score, best))
    order = score.argsort(dim=0, descending=True, stable=True)
    lo, hi, number = _halve(partition, lo, hi, number, order[0])
    if len(order) > 1:
        second = score.gather(0, order[1:2])[0]
        again = ((bound - 0.75 * best > 0) & (second > -torch.inf)).repeat_interleave(2)
        axis = order[1].repeat_interleave(2)[again]
        quarters = _halve(partition, lo[:, again], hi[:, again], number[again], axis)
        halves = lo[:, ~again], hi[:, ~again], number[~again]
        lo, hi, number = (torch.cat(pair, -1) for pair in zip(halves, quarters, strict=True))
    return lo, hi, number, bottom


def _halve(partition: Partition, lo: Tensor, hi: Tensor, number: Tensor, axis: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Corners (n, 2B) and numbers (2B,) of the halves along `axis` (B,), lower and upper in turn."""
    n, count = lo.shape
    index = torch.arange(count, device=lo.device)
    middle = 0.5 * lo[axis, index] + 0.5 * hi[axis, index]
    lower_hi, upper_lo = hi.clone(), lo.clone()
    lower_hi[axis, index] = middle
    upper_lo[axis, index] = middle
    halves = partition.split(number.cpu().numpy(), axis.cpu().numpy())
    return (
        torch.stack([lo, upper_lo], 2).reshape(n, 2 * count),
        torch.stack([lower_hi, hi], 2).reshape(n, 2 * count),
        torch.tensor(halves, device=lo.device),
    )


@contextmanager
def _threaded(rule: VdotBound, device: torch.device) -> Iterator[Bound]:
    """The rule with each batch cut into one piece a thread.

    Pieces stay in a core's cache and meet once a batch, where torch's own threads meet at every operation.
    """
    threads = torch.get_num_threads()
    if device.type != "cpu" or threads == 1:
        yield rule
        return
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:

            def bound(lo: Tensor, hi: Tensor, inner: float, outer: float) -> BoxBounds:
                pieces = max(1, min(threads, lo.shape[1] // _CHUNK))
                if pieces == 1:
                    return rule(lo, hi, inner, outer)
                los, his = lo.tensor_split(pieces, 1), hi.tensor_split(pieces, 1)
                found = list(pool.map(rule, los, his, [inner] * pieces, [outer] * pieces))
                return BoxBounds(*(torch.cat(parts, -1) for parts in zip(*found, strict=True)))

            yield bound
    finally:
        torch.set_num_threads(threads)


class _Clock:
    """Extrapolates how long the pass still takes: seconds grow about as a power of the level."""

    def __init__(self, inner: float, n: int) -> None:
        self.start, self.inner, self.n = time.monotonic(), inner, n
        self.history: list[tuple[float, float]] = []

    def read(self, level: float, target: float, boxes: int, open_: int) -> RingProgress:
        seconds = time.monotonic() - self.start
        level = max(level, self.inner)
        self.history.append((seconds, level))
        a, b, c = (v ** (self.n / 2) for v in (self.inner, level, target))
        earlier = next((v for t, v in reversed(self.history) if t <= seconds / 2), level)
        left = None
        if self.inner < earlier < level:
            growth = math.log(2) / math.log(level / earlier)
            left = seconds * math.expm1(min(700.0, growth * math.log(target / level)))
        return RingProgress(level, target, boxes, open_, (b - a) / (c - a), left)
