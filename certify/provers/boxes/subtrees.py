"""Boxes that are grown elsewhere: the job that is sent, the work on it, and the answer.

A job is some open boxes with the levels of the moment; its answer are the bytes of their trees, whose leaves are
proved, still open, or to be looked at by whoever asked: there a condition fails, or halving has come to its end, and a
level has to give way, which is not decided elsewhere. Boxes do not know of each other: as long as no level moves, the
tree is the same whoever grows which, how far, and in which order. A job ends after so many boxes; the boxes that it
leaves open come back and are shared out anew, which balances the loads.

An answer is bytes and is not believed: it must be sealed for its job, lengths, counts and trees must fit, and a key
that is no number is refused, as is a box that is halved beyond the least width, or an answer that left all boxes as
they were. The checker sees again every leaf that a tree calls proved. An answer that is refused, or never comes, is
worked out here.
"""

from __future__ import annotations

import hashlib
import math
import struct
import time
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNIT
from certify.errors import BackendError, CertificateFormatError
from certify.provers.bounds.arrays import Array, Index, Mask
from certify.provers.boxes.frontier import Boxes, Frontier
from certify.provers.boxes.halving import Halves, split
from certify.provers.boxes.partition import LEAF, LOOK, MOST_SPLITS, OPEN, Grafted, Partition
from certify.provers.execution import Counted, Jobs, in_pieces

_MAGIC = b"subtree1"
_JOB = struct.Struct("<8sQQQQddd")  # n, boxes, batch, boxes to bound; inner and outer level, relative least width
_ANSWER = struct.Struct("<8sQQQQ16s")  # boxes bounded, boxes proved, bytes of the trees, open leaves, seal
_QUEUE = 2  # jobs a place, so that none waits for the next
_LEAST = 256  # boxes of a job, if there are as many
_FEW, _ENOUGH = 32, 2048  # boxes a place, or in all, from which on growing them elsewhere is worth a message
_TURN, _EACH = (0.25, 4.0), 8e-3  # units of effort of a job, the least and the most, and between them for each place
_POLL = 0.25  # seconds
_LATE = 300.0  # seconds after which a job is worked out here


def turn(places: int) -> float:
    """Operations of a job: those of many places have more, so that whoever gives them keeps up."""
    shortest, longest = _TURN
    return UNIT * min(longest, max(shortest, _EACH * places))


def enough(places: int) -> int:
    """Boxes from which on growing them elsewhere is worth a message."""
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


class Subtrees:
    """The work on a job."""

    def __init__(self, growth: Growth) -> None:
        self.growth = growth

    def __call__(self, job: bytes) -> bytes:
        """The answer to a job."""
        _, n, count, batch, most, *levels, least_width = _JOB.unpack_from(job)
        lo, hi, key = np.split(np.frombuffer(job, offset=_JOB.size), [n * count, 2 * n * count])
        lo, hi = lo.reshape(n, count), hi.reshape(n, count)
        growth = self.growth.at(*levels)
        bound = in_pieces(growth.bound)
        partition = Partition(hi, lo)
        frontier = Frontier(partition)
        frontier.add(lo, hi, key, np.arange(count))
        looks: list[Index] = []
        boxes = proved = 0
        while len(frontier) and (not boxes or boxes < most):
            now = frontier.take(batch, math.inf)
            found = bound(now.lo, now.hi, *growth.levels)
            boxes, proved = boxes + len(now.key), proved + int(found.proved.sum())
            looks.append(_grow(growth, partition, frontier, now, found, least_width))
        waiting, keys = frontier.waiting()
        look = np.concatenate(looks)
        trees = partition.preorder([(OPEN, waiting), (LOOK, look)])
        body = trees + keys[partition.order(waiting)].tobytes()
        counts = boxes, proved, len(trees), len(keys)
        return _ANSWER.pack(_MAGIC, *counts, _seal(job, counts, body)) + body


def _seal(job: bytes, counts: tuple[int, ...], body: bytes) -> bytes:
    """The hash that ties an answer to its job: a damaged answer, or another job's, has another one."""
    return hashlib.blake2b(job + struct.pack("<4Q", *counts) + body, digest_size=16).digest()


def _grow(
    growth: Growth, partition: Partition, frontier: Frontier, now: Boxes, found: Any, least_width: float
) -> Index:
    """Halve the boxes that are not proved; the numbers of those that somebody else has to look at."""
    look = growth.gives_way(now.lo, now.hi, found) & ~found.proved
    rest = type(found)(*(value.compress(~look, -1) for value in found))
    lo, hi, number, key = (value.compress(~look, -1) for value in now)
    halves = split(partition, lo, hi, number, rest, least_width * growth.half)
    keep, keys = growth.opened(halves, rest, key)
    frontier.add(*(a.compress(keep, -1) for a in (halves.lo, halves.hi, keys, halves.number)))
    return np.concatenate([now.number[look], number[halves.small]])


class Answer(NamedTuple):
    """The answer to a job: boxes bounded and proved, and the bytes of the trees with the keys of their open leaves."""

    boxes: int
    proved: int
    trees: bytes
    keys: Array


def _read(job: bytes, answer: bytes) -> Answer:
    """An answer to a job whose seal, lengths, counts and keys are in order.

    Raises
    ------
    CertificateFormatError : it is none.
    """
    if len(answer) < _ANSWER.size:
        raise CertificateFormatError(f"an answer must have {_ANSWER.size} bytes at least; found {len(answer)}.")
    magic, *counts, seal = _ANSWER.unpack_from(answer)
    boxes, proved, length, opened = counts
    body = answer[_ANSWER.size :]
    if magic != _MAGIC or len(body) != length + 8 * opened:
        raise CertificateFormatError(f"an answer must be {_MAGIC!r} and as long as it says; found {len(answer)} bytes.")
    if seal != _seal(job, tuple(counts), body):
        raise CertificateFormatError("an answer must have the seal of its job; it is damaged, or another job's.")
    trees, known = body[:length], np.frombuffer(body[length:])
    if np.isnan(known).any() or trees.count(OPEN) != opened:
        raise CertificateFormatError("an answer must have a number for each open leaf.")
    # Each node is bounded once at most, and a proved one is a leaf.
    if not proved <= boxes <= length or proved > trees.count(LEAF):
        raise CertificateFormatError(f"{boxes} boxes bounded and {proved} proved are not those of {length} nodes.")
    if opened == length:
        raise CertificateFormatError("an answer must have something done; all its boxes are open.")
    return Answer(boxes, proved, trees, known)


class Return(NamedTuple):
    """A job that has ended: the boxes that were sent, the answer, and in the partition the boxes that are open still,
    and those to look at."""

    sent: Boxes
    answer: Answer
    opened: Grafted
    looked: Grafted


class Held(NamedTuple):
    """Boxes that are out, the job that they are out with, and since when, in seconds of a clock that only rises."""

    boxes: Boxes
    job: bytes
    since: float


class Abroad:
    """The boxes of a pass that are being grown elsewhere.

    Parameters
    ----------
    batch, least_width : of the jobs, as in a budget.
    """

    def __init__(self, jobs: Jobs, growth: Growth, partition: Partition, batch: int, least_width: float) -> None:
        self.jobs, self.growth, self.partition = jobs, growth, partition
        self.batch, self.least_width = batch, least_width
        self.held: dict[int, Held] = {}
        self._least = least_width * growth.half[:, 0]

    def __len__(self) -> int:
        return sum(len(boxes.key) for boxes, _, _ in self.held.values())

    def least(self) -> float:
        """The smallest key of a box that is being grown; infinite if there is none."""
        return min((float(boxes.key.min()) for boxes, _, _ in self.held.values()), default=math.inf)

    def waiting(self) -> tuple[NDArray[np.int64], Array]:
        """Numbers (B,) and keys (B,) of the boxes."""
        held = [boxes for boxes, _, _ in self.held.values()]
        numbers = np.concatenate([np.zeros(0, np.int64), *(boxes.number for boxes in held)])
        return numbers, np.concatenate([np.zeros(0), *(boxes.key for boxes in held)])

    def is_worth(self, frontier: Frontier) -> bool:
        """True if work elsewhere pays; if nobody is there, boxes that were sent out come back into the frontier."""
        places = self.jobs.places
        if not places:
            self.recall(frontier)
        return places > 0 and (bool(self.held) or len(frontier) >= enough(places))

    def send(self, levels: tuple[float, float], frontier: Frontier, limit: float, left: float) -> None:
        """Share out boxes with keys up to about `limit`, until all places are busy, in jobs of well below the
        operations that are left."""
        places = self.jobs.places
        most = _QUEUE * places
        while len(self.held) < most and len(frontier):
            count = min(self.batch, max(_LEAST, len(frontier) // most))
            boxes = frontier.take(count, limit)
            n, count = boxes.lo.shape
            worth = int(min(turn(places), left / most) / self.growth.bound.operations)
            head = _JOB.pack(_MAGIC, n, count, self.batch, worth, *levels, self.least_width)
            job = head + b"".join(a.tobytes() for a in (boxes.lo, boxes.hi, boxes.key))
            try:
                self.held[self.jobs.give(job)] = Held(boxes, job, time.monotonic())
            except BackendError:
                frontier.add(boxes.lo, boxes.hi, boxes.key, boxes.number)
                raise

    def collect(self) -> list[Return]:
        """Jobs that have ended, after waiting a moment for one."""
        found = []
        ended = self.jobs.ended(_POLL)
        oldest = min(self.held, key=lambda number: self.held[number].since, default=None)
        if not ended and oldest is not None and time.monotonic() - self.held[oldest].since > _LATE:
            self.jobs.forget([oldest])
            ended = [(oldest, None)]
        for number, answer in ended:
            if number in self.held:
                found.append(self._planted(self.held[number], answer))
                del self.held[number]
        return found

    def _planted(self, held: Held, answer: bytes | None) -> Return:
        boxes, job, _ = held
        number, lo, hi = boxes.number, boxes.lo, boxes.hi
        if answer is not None:
            try:
                read = _read(job, answer)
                if self.partition.splits + len(read.trees) // 2 > MOST_SPLITS:
                    raise CertificateFormatError("an answer must not have more splits than a certificate can hold.")
                return Return(boxes, read, *self.partition.graft(number, lo, hi, read.trees, self._least))
            except CertificateFormatError:
                self.jobs.refuse()
        read = _read(job, Subtrees(self.growth)(job))
        return Return(boxes, read, *self.partition.graft(number, lo, hi, read.trees))

    def forget_above(self, level: float) -> None:
        """Do without boxes with keys above `level`."""
        gone = [number for number, (boxes, _, _) in self.held.items() if float(boxes.key.min()) > level]
        self.jobs.forget(gone)
        for number in gone:
            del self.held[number]

    def recall(self, frontier: Frontier) -> None:
        """Put all boxes that are out back into the frontier."""
        for boxes, _, _ in self.held.values():
            frontier.add(boxes.lo, boxes.hi, boxes.key, boxes.number)
        held, self.held = list(self.held), {}
        self.jobs.forget(held)
