"""Jobs done in this process, by workers that follow a script: they fail, lie, come and go, or lose their scheduler."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np

from certify.errors import BackendError
from certify.provers.boxes import ahead
from certify.provers.execution import ThreadRunner, Work, rows

Play = Callable[[bytes, bytes], bytes | None]  # a job and its honest answer to what is answered


@dataclass
class Troupe:
    """What the workers do, and what came of it.

    `places` by how often it was asked for; `lost_after` so many answers the scheduler is gone, at once or when its next
    job is given. With a `seed` answers come in any order, some late, and now and then none.
    """

    play: Play = field(default=lambda job, answer: answer)
    places: Callable[[int], int] = field(default=lambda asked: 2)
    lost_after: int | None = None
    seed: int | None = None
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
        self.generator = None if troupe.seed is None else np.random.default_rng(troupe.seed)

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
        numbers = sorted(self.open, reverse=True)[: 1 + len(self.open) // 2]
        if self.generator is not None:
            some = int(self.generator.integers(0, len(self.open) + 1))
            numbers = self.generator.permutation(sorted(self.open))[:some].tolist()
        for number in numbers:
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


def parts(job: bytes, answer: bytes) -> tuple[bytes, bytes, bytes, np.ndarray]:
    """The boxes of an answer, their rows, those that are open, and the keys of these."""
    body, n = rows.unsealed(job, answer), counts_of(job)[0]
    bounded, opened = ahead._COUNTS.unpack_from(body)
    head, one = ahead._COUNTS.size, 16 * n
    a, b = head + one * bounded, len(body) - (one + 8) * opened
    return body[head:a], body[a:b], body[b : len(body) - 8 * opened], np.frombuffer(body[len(body) - 8 * opened :])


def sealed(job: bytes, boxes: bytes, found: bytes, opened: bytes, keys: np.ndarray) -> bytes:
    """An answer of somebody who knows how answers are made, with contents of their own."""
    one = 16 * counts_of(job)[0]
    counts = ahead._COUNTS.pack(len(boxes) // one, len(opened) // one)
    return rows.sealed(job, counts + boxes + found + opened + keys.tobytes())


def counts_of(job: bytes) -> tuple[int, int]:
    """States, and boxes of a job."""
    n, count, *_ = ahead._JOB.unpack_from(job)
    return n, count


def row_of(n: int) -> np.dtype:
    """The row of a box of the ring."""
    truths = [("violated", "u1"), ("smooth", "u1")]
    return np.dtype([("proved", "u1"), ("bound", "f8"), ("score", "f8", (n,)), *truths, ("decay", "f8")])
