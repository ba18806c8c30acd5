"""Jobs done in this process, by workers that follow a script: they fail, lie, come and go, or lose their scheduler."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from certify.errors import BackendError
from certify.provers.boxes import subtrees
from certify.provers.execution import ThreadRunner, Work

Play = Callable[[bytes, bytes], bytes | None]  # a job and its honest answer to what is answered
OPEN, LOOK, LEAF = b"\xfe", b"\xfd", b"\xff"


@dataclass
class Troupe:
    """What the workers do, and what came of it.

    `places` by how often it was asked for; `lost_after` so many answers the scheduler is gone, at once or when its next
    job is given.
    """

    play: Play = field(default=lambda job, answer: answer)
    places: Callable[[int], int] = field(default=lambda asked: 2)
    lost_after: int | None = None
    asked: int = 0
    given: int = 0
    answered: int = 0
    refused: int = 0
    forgotten: int = 0


class PlayedJobs:
    """Answers come when they are asked for, the last job's first, and not all at once."""

    def __init__(self, troupe: Troupe, work: Work) -> None:
        self.troupe = troupe
        self.work: Work = pickle.loads(pickle.dumps(work))
        self.open: dict[int, bytes] = {}

    @property
    def places(self) -> int:
        self._there()
        self.troupe.asked += 1
        return self.troupe.places(self.troupe.asked)

    def give(self, job: bytes) -> int:
        self._there()
        self.troupe.given += 1
        self.open[self.troupe.given] = job
        return self.troupe.given

    def ended(self, seconds: float) -> list[tuple[int, bytes | None]]:
        self._there()
        found = []
        for number in sorted(self.open, reverse=True)[: 1 + len(self.open) // 2]:
            job = self.open.pop(number)
            found.append((number, self.troupe.play(job, self.work(job))))
            self.troupe.answered += 1
        return found

    def refuse(self) -> None:
        self.troupe.refused += 1

    def forget(self, numbers: Iterable[int]) -> None:
        for number in numbers:
            self.troupe.forgotten += self.open.pop(number, None) is not None

    def _there(self) -> None:
        if self.troupe.lost_after is not None and self.troupe.answered >= self.troupe.lost_after:
            raise BackendError("the scheduler at tcp://nowhere:1 is gone: it was never there.")


class PlayedRunner(ThreadRunner):
    """Batches here, and jobs by a troupe."""

    def __init__(self, troupe: Troupe) -> None:
        super().__init__()
        self.troupe = troupe

    @contextmanager
    def jobs(self, work: Work) -> Iterator[PlayedJobs]:  # type: ignore[override]
        yield PlayedJobs(self.troupe, work)


def parts(answer: bytes) -> tuple[list[int], bytes, np.ndarray]:
    """The counts of an answer, its trees and the keys of what is open."""
    size = subtrees._ANSWER.size
    _, *counts, _ = subtrees._ANSWER.unpack_from(answer)
    return counts, answer[size : size + counts[2]], np.frombuffer(answer[size + counts[2] :])


def sealed(job: bytes, boxes: int, proved: int, trees: bytes, keys: np.ndarray | None = None) -> bytes:
    """An answer of somebody who knows how answers are made, with `trees` or `keys` of their own."""
    body = trees + (np.zeros(0) if keys is None else keys).tobytes()
    counts = boxes, proved, len(trees), 0 if keys is None else len(keys)
    return subtrees._ANSWER.pack(subtrees._MAGIC, *counts, subtrees._seal(job, counts, body)) + body


def boxes_of(job: bytes) -> tuple[int, int]:
    """States, and boxes of a job."""
    _, n, count, *_ = subtrees._JOB.unpack_from(job)
    return n, count
