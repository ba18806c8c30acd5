"""Boxes that are bounded elsewhere before a pass asks for them, so that the answer does not depend on it.

A pass takes its boxes in an order of its own, has each bounded at its levels, and counts its effort; whoever bounded
them shows in nothing. So a cluster has no part in the search: it guesses which boxes will be asked for, and bounds
these. A job is some open boxes with the levels of the moment. A worker bounds them, halves them as the pass will, and
so on for a while; its answer has all boxes that it met with their bounds, and those that it leaves open, which go out
anew. A guess that is not asked for, or was made for other levels, is dropped. A box that nobody has bounded when it is
asked for is bounded here.

Bounds from elsewhere are not believed (`execution/rows.py`). A worker that seals false ones well is found out by the
checker, which sees every leaf again.
"""

from __future__ import annotations

import heapq
import math
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from certify.effort import UNIT
from certify.errors import BackendError, CertificateFormatError
from certify.provers.base import Budget
from certify.provers.bounds.arrays import Array, Mask
from certify.provers.boxes.frontier import Boxes, Frontier
from certify.provers.boxes.halving import Halves, split
from certify.provers.boxes.partition import Partition
from certify.provers.execution import Bound, Counted, Jobs, Runner, in_pieces
from certify.provers.execution.rows import Layout, boxes_of, corners_of, pieces, sealed, unsealed

_JOB = struct.Struct("<QQQQddd")  # n, boxes, batch, boxes to bound; inner and outer level, relative least width
_COUNTS = struct.Struct("<QQ")  # boxes bounded, boxes open
_QUEUE = 2  # jobs a place, so that none waits for the next
_LEAST, _MOST = 256, 2**14  # boxes that a job is given, if there are as many, and that it bounds
_FEW, _ENOUGH = 32, 2048  # boxes a place, or in all, from which on bounding them elsewhere is worth a message
_TURN, _EACH = (0.25, 4.0), 8e-3  # units of effort of a job, the least and the most, and between them for each place
_KNOWN = 2**21  # boxes that are bounded ahead, or being bounded, at most
_POLL = 0.25  # seconds
_LATE = 300.0  # seconds after which a job's boxes are bounded here


def turn(places: int) -> float:
    """Operations of a job: those of many places have more, so that whoever gives them keeps up."""
    shortest, longest = _TURN
    return UNIT * min(longest, max(shortest, _EACH * places))


def enough(places: int) -> int:
    """Boxes from which on bounding them elsewhere is worth a message."""
    return min(_FEW * places, _ENOUGH)


class Growth(ABC):
    """A pass's rule for its boxes: a bound at its levels, and the order in which they are taken.

    Parameters
    ----------
    bound : the rule that bounds boxes.
    half : (n, 1) half-widths, in which the least width of a box is given.
    """

    def __init__(self, bound: Counted, half: Array) -> None:
        self.bound, self.half = bound, half

    @property
    @abstractmethod
    def levels(self) -> tuple[float, float]:
        """The inner and the outer level."""

    @abstractmethod
    def at(self, inner: float, outer: float) -> Growth:
        """The same at other levels."""

    @abstractmethod
    def gives_way(self, lo: Array, hi: Array, found: Any) -> Mask:
        """True for the boxes (B,), of corners (n, B), to which a level has to give way."""

    @abstractmethod
    def opened(self, halves: Halves, found: Any, key: Array) -> tuple[Mask, Array]:
        """True for halves (H,) that still have to be decided, and the keys (H,) of all, by those of the batch (B,)."""

    def reopen(self, frontier: Frontier, halves: Halves, found: Any, key: Array) -> None:
        """Put the halves that still have to be decided on the frontier."""
        keep, keys = self.opened(halves, found, key)
        frontier.add(*(a.compress(keep, -1) for a in (halves.lo, halves.hi, keys, halves.number)))


class Growing:
    """The work on a job: boxes are bounded and halved as a pass does it whose levels stay."""

    def __init__(self, growth: Growth) -> None:
        self.growth = growth

    def __call__(self, job: bytes) -> bytes:
        """The answer to a job."""
        n, count, batch, most, *levels, least_width = _JOB.unpack_from(job)
        lo, hi, key = np.split(np.frombuffer(job, offset=_JOB.size), [n * count, 2 * n * count])
        lo, hi = lo.reshape(n, count), hi.reshape(n, count)
        growth = self.growth.at(*levels)
        bound = in_pieces(growth.bound)
        frontier = Frontier(Partition(hi, lo))
        frontier.add(lo, hi, key, np.arange(count))
        boxes: list[bytes] = []
        rows: list[bytes] = []
        while len(frontier) and (not boxes or len(boxes) < most):
            now = frontier.take(batch, math.inf)
            found = bound(now.lo, now.hi, *growth.levels)
            boxes += boxes_of(now.lo, now.hi)
            rows.append(Layout.of(found).write(found))
            _grow(growth, frontier, now, found, least_width)
        numbers, keys = frontier.waiting()
        opened = boxes_of(*frontier.partition.corners(numbers))
        return sealed(job, b"".join([_COUNTS.pack(len(boxes), len(opened)), *boxes, *rows, *opened, keys.tobytes()]))


def _grow(growth: Growth, frontier: Frontier, now: Boxes, found: Any, least_width: float) -> None:
    """Halve the boxes that are not proved, but those at which a level gives way: from there on it is another one."""
    stays = ~(growth.gives_way(now.lo, now.hi, found) & ~found.proved)
    rest = type(found)(*(value.compress(stays, -1) for value in found))
    lo, hi, number, key = (value.compress(stays, -1) for value in now)
    halves = split(frontier.partition, lo, hi, number, rest, least_width * growth.half)
    growth.reopen(frontier, halves, rest, key)


class Sent(NamedTuple):
    """A job that is out, its boxes, and since when, in seconds of a clock that only rises."""

    job: bytes
    boxes: list[bytes]
    since: float


class Ahead:
    """A bound whose answers are those of `here`, whether they were worked out here or elsewhere.

    Parameters
    ----------
    jobs : how work is done elsewhere; None if it is not.
    here : the bound.
    budget : its `batch` and `least_width` are those of the jobs.

    Notes
    -----
    `lost` is a sentence about a cluster that went away, after which all is done here.
    """

    def __init__(self, jobs: Jobs | None, growth: Growth, here: Bound, budget: Budget) -> None:
        self.jobs, self.growth, self.here = jobs, growth, here
        self.batch, self.least_width = budget.batch, budget.least_width
        self.lost = ""
        self._levels = growth.levels
        self._left = 0.0  # boxes that the pass has effort for
        self._given = 0  # jobs so far
        self._layout: Layout | None = None
        self._forget()

    def _forget(self) -> None:
        self._known: dict[bytes, bytes] = {}  # rows by boxes
        self._sent: dict[int, Sent] = {}
        self._out: set[bytes] = set()  # the boxes of the jobs that are out
        self._open: set[bytes] = set()  # boxes that may go out
        self._order: list[tuple[float, bytes]] = []  # a heap of these by keys, and of some that are gone
        self._missed = True  # a box that was asked for was not known

    def close(self) -> None:
        """Take back all that is out, and forget what is known."""
        if self.jobs is not None and not self.lost:
            self.jobs.forget(list(self._sent))
        self._forget()

    def offer(self, frontier: Frontier, left: float) -> None:
        """Have boxes of a pass with so many operations left bounded, those with the smallest keys first."""
        if self.jobs is None or self._layout is None or self.lost:
            return
        try:
            places = self.jobs.places
            if not places:
                self.close()
                return
            self._collect(0.0)
            starved = len(self._open) < enough(places)
            if (starved or self._missed) and len(frontier) >= enough(places):
                near = frontier.near(self.batch * (_QUEUE * places if starved else _QUEUE))
                self._note(boxes_of(near.lo, near.hi), near.key.tolist())
                self._missed = False
            self._left = left / self.growth.bound.operations
            self._send(self.jobs, places)
        except BackendError as error:
            self.lost = str(error)
            self.close()

    def __call__(self, lo: Array, hi: Array, inner: float, outer: float) -> Any:
        """The bounds of boxes lo, hi (n, B) at these levels."""
        if self.jobs is None:
            return self.here(lo, hi, inner, outer)
        if (inner, outer) != self._levels:
            self.close()
            self._levels = inner, outer
        if not self._known and not self._out and not self._open:
            found = self.here(lo, hi, inner, outer)
            self._layout, self._missed = Layout.of(found), True
            return found
        boxes = boxes_of(lo, hi)
        self._open.difference_update(boxes)
        rows = dict.fromkeys(boxes, b"")
        self._work(rows, lo, hi, [k for k, box in enumerate(boxes) if box not in self._known and box not in self._out])
        self._await([box for box in boxes if box in self._out])
        for box in boxes:
            rows[box] = rows[box] or self._known.pop(box, b"")
        self._work(rows, lo, hi, [k for k, box in enumerate(boxes) if not rows[box]])
        return self._known_layout.read(b"".join([rows[box] for box in boxes]))

    @property
    def _known_layout(self) -> Layout:
        if self._layout is None:
            raise RuntimeError("nothing was bounded here so far.")
        return self._layout

    def _work(self, rows: dict[bytes, bytes], lo: Array, hi: Array, index: list[int]) -> None:
        """Bound some of the boxes here."""
        if index:
            lo, hi = lo.take(index, -1), hi.take(index, -1)
            written = self._known_layout.write(self.here(lo, hi, *self._levels))
            rows.update(zip(boxes_of(lo, hi), pieces(written, self._known_layout.row.itemsize), strict=True))
            self._missed = True

    def _await(self, boxes: Iterable[bytes]) -> None:
        """Wait until none of the boxes is out, or nobody is there any more; meanwhile as many jobs go out as there can
        be at a time, and no more, lest those be waited for that are given later."""
        given = self._given
        try:
            while self.jobs is not None and not self._out.isdisjoint(boxes):
                places = self.jobs.places
                if places:
                    self._collect(_POLL)
                    self._open.difference_update(boxes)  # what somebody leaves as it was does not go out again
                    if self._given < given + _QUEUE * places:
                        self._send(self.jobs, places)
                else:
                    self._take_back(list(self._sent))
        except BackendError as error:
            self.lost = str(error)
            self._sent, self._out = {}, set()

    def _note(self, boxes: list[bytes], keys: list[float]) -> None:
        """Have boxes wait to be sent, by their keys."""
        for box, key in zip(boxes, keys, strict=True):
            if len(self._open) < _KNOWN and not (box in self._open or box in self._known or box in self._out):
                self._open.add(box)
                heapq.heappush(self._order, (key, box))

    def _send(self, jobs: Jobs, places: int) -> None:
        """Share out boxes until all places are busy, in jobs of well below the boxes that are left."""
        most, n, left = _QUEUE * places, len(self.growth.half), self._left
        worth = int(min(turn(places) / self.growth.bound.operations, left / most, _MOST))
        room = min(_KNOWN, left) - len(self._known) - worth * len(self._sent)
        count = min(self.batch, max(_LEAST, len(self._open) // most))
        while len(self._sent) < most and len(self._open) >= enough(places) and room > 0:
            boxes, keys = self._next(count)
            head = _JOB.pack(n, len(boxes), self.batch, worth, *self._levels, self.least_width)
            job = b"".join([head, *(a.tobytes() for a in corners_of(boxes, n)), np.array(keys).tobytes()])
            self._sent[jobs.give(job)] = Sent(job, boxes, time.monotonic())
            self._out.update(boxes)
            self._given, room = self._given + 1, room - worth

    def _next(self, count: int) -> tuple[list[bytes], list[float]]:
        """Boxes to send, and their keys."""
        boxes: list[bytes] = []
        keys: list[float] = []
        while len(boxes) < count and self._open:
            key, box = heapq.heappop(self._order)
            if box in self._open:
                self._open.discard(box)
                boxes.append(box)
                keys.append(key)
        return boxes, keys

    def _collect(self, seconds: float) -> None:
        """Take in the jobs that have ended, after waiting so long for one."""
        if self.jobs is None or not self._sent:
            return
        for number, answer in self.jobs.ended(seconds):
            sent = self._sent.pop(number, None)
            if sent is not None:
                self._out.difference_update(sent.boxes)
                self._take(self.jobs, sent.job, answer)
        now = time.monotonic()
        self._take_back([number for number, sent in self._sent.items() if now - sent.since > _LATE])

    def _take(self, jobs: Jobs, job: bytes, answer: bytes | None) -> None:
        """Take in an answer; if there is none, or it is refused, its boxes are bounded here when they are asked for."""
        if answer is None:
            return
        try:
            boxes, rows, opened, keys = _read(job, answer, self._known_layout, len(self.growth.half))
        except CertificateFormatError:
            jobs.refuse()
            return
        self._known.update(zip(boxes, rows, strict=True))
        self._note(opened, keys)

    def _take_back(self, numbers: list[int]) -> None:
        if self.jobs is not None and numbers:
            self.jobs.forget(numbers)
            for number in numbers:
                self._out.difference_update(self._sent.pop(number).boxes)


class Answer(NamedTuple):
    """Boxes that were bounded and their rows, and those that are open and their keys."""

    boxes: list[bytes]
    rows: list[bytes]
    opened: list[bytes]
    keys: list[float]


def _read(job: bytes, answer: bytes, layout: Layout, n: int) -> Answer:
    """An answer to a job whose seal, lengths, keys and scores are in order.

    Raises
    ------
    CertificateFormatError : it is none.
    """
    body = unsealed(job, answer)
    if len(body) < _COUNTS.size:
        raise CertificateFormatError(f"an answer must have {_COUNTS.size} bytes at least; found {len(body)}.")
    bounded, opened = _COUNTS.unpack_from(body)
    sizes = 16 * n * bounded, layout.row.itemsize * bounded, 16 * n * opened, 8 * opened
    if not bounded or len(body) != _COUNTS.size + sum(sizes):
        raise CertificateFormatError(f"an answer must be as long as it says; found {len(body)} bytes.")
    ends = np.cumsum([_COUNTS.size, *sizes]).tolist()
    parts = [memoryview(body)[a:b] for a, b in pairwise(ends)]
    keys, scores = np.frombuffer(parts[3]), np.frombuffer(parts[1], layout.row)["score"]
    if np.isnan(keys).any() or np.isnan(scores).any():
        raise CertificateFormatError("an answer must have numbers for keys and scores.")
    boxes, opened = (pieces(part, 16 * n) for part in (parts[0], parts[2]))
    return Answer(boxes, pieces(parts[1], layout.row.itemsize), opened, keys.tolist())


@contextmanager
def ahead(runner: Runner, growth: Growth, budget: Budget, alone: bool = False) -> Iterator[Ahead]:
    """A pass's bound on a runner, some of which is worked out elsewhere if that can be and nobody asks to be alone."""
    with runner.start(growth.bound) as here, runner.jobs(Growing(growth)) as jobs:
        bound = Ahead(None if alone else jobs, growth, here, budget)
        try:
            yield bound
        finally:
            bound.close()
