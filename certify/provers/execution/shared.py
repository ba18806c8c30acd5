"""A call about many boxes shared out among the places, whose answer is that of a call here."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNIT
from certify.errors import BackendError, CertificateFormatError
from certify.provers.execution.base import Bound, Counted, Jobs, Runner
from certify.provers.execution.rows import Layout, sealed, unsealed
from certify.provers.execution.threads import in_pieces

Array = NDArray[np.float64]
_JOB = struct.Struct("<QQdd")  # n, boxes; two levels
_EACH = 2  # jobs a place and call, which balances the loads
_WORTH = 0.02 * UNIT  # operations of a job, at least
_POLL = 0.25  # seconds
_PATIENCE = 1200  # waits without an answer, after which all is done here


class Pieces:
    """The work on a job: a bound of its boxes."""

    def __init__(self, bound: Counted) -> None:
        self.bound = bound

    def __call__(self, job: bytes) -> bytes:
        """The rows of the boxes."""
        n, count, *levels = _JOB.unpack_from(job)
        lo, hi = np.frombuffer(job, offset=_JOB.size).reshape(2, n, count).copy()
        found = in_pieces(self.bound)(lo, hi, *levels)
        return sealed(job, Layout.of(found).write(found))


class Shared:
    """A bound of many boxes at a time, the answers of `here`: boxes that get none elsewhere are bounded here.

    Parameters
    ----------
    jobs : how work is done elsewhere; None if it is not.
    bound, here : the bound, and how it is worked out here.
    """

    def __init__(self, jobs: Jobs | None, bound: Counted, here: Bound) -> None:
        self.jobs, self.bound, self.here = jobs, bound, here

    def __call__(self, lo: Array, hi: Array, inner: float, outer: float) -> Any:
        """The bounds of boxes lo, hi (n, B)."""
        n, count = lo.shape
        size = self._size(count)
        if size >= count:
            return self.here(lo, hi, inner, outer)
        first = self.here(lo[:, :1].copy(), hi[:, :1].copy(), inner, outer)
        layout, rest = Layout.of(first), range(1, count, size)
        parts = [(lo[:, begin : begin + size].copy(), hi[:, begin : begin + size].copy()) for begin in rest]
        heads = (_JOB.pack(n, below.shape[1], inner, outer) for below, _ in parts)
        jobs = [b"".join([head, a.tobytes(), b.tobytes()]) for head, (a, b) in zip(heads, parts, strict=True)]
        rows = self._answers(jobs, layout)
        for k, (below, above) in enumerate(parts):
            rows[k] = rows[k] or layout.write(self.here(below, above, inner, outer))
        return layout.read(b"".join([layout.write(first), *rows]))

    def _size(self, count: int) -> int:
        """The boxes of a job, all if nothing is to be done elsewhere."""
        try:
            places = 0 if self.jobs is None else self.jobs.places
        except BackendError:
            self.jobs, places = None, 0
        least = math.ceil(_WORTH / self.bound.operations)
        return max(least, math.ceil((count - 1) / (_EACH * places))) if places else count

    def _answers(self, asked: list[bytes], layout: Layout) -> list[bytes]:
        """The rows that jobs gave, nothing for one that failed or was refused."""
        rows = [b""] * len(asked)
        if self.jobs is None:
            return rows
        out: dict[int, int] = {}
        waits = 0
        try:
            for k, job in enumerate(asked):
                out[self.jobs.give(job)] = k
            while out and waits < _PATIENCE and self.jobs.places:
                ended = self.jobs.ended(_POLL)
                waits = 0 if ended else waits + 1
                for number, answer in ended:
                    k = out.pop(number, -1)
                    if k >= 0 and answer is not None:
                        rows[k] = self._read(self.jobs, asked[k], answer, layout)
            self.jobs.forget(list(out))
        except BackendError:
            self.jobs = None
        return rows

    def _read(self, jobs: Jobs, job: bytes, answer: bytes, layout: Layout) -> bytes:
        """The rows of an answer; nothing if it is refused."""
        _, count, *_ = _JOB.unpack_from(job)
        try:
            rows = unsealed(job, answer)
        except CertificateFormatError:
            rows = b""
        if len(rows) != count * layout.row.itemsize:
            jobs.refuse()
            return b""
        return rows


@contextmanager
def shared(runner: Runner, bound: Counted) -> Iterator[Bound]:
    """A bound on a runner, whose calls are shared out if that can be."""
    with runner.start(bound) as here, runner.jobs(Pieces(bound)) as jobs:
        yield Shared(jobs, bound, here)
