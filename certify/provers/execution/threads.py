"""Threads of this machine.

A batch is cut into pieces of the same boxes whatever the number of threads, so that this shows nowhere. A library of
linear algebra works on one thread here: pieces stay in a core's cache and meet once a batch, while its own threads
would meet at every product.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from certify.provers.execution.base import Bound, Work

Array = NDArray[np.float64]
_PIECE = 256  # boxes, at least


def cores() -> int:
    """The number of cores this process may use: OMP_NUM_THREADS, or all that the system gives it."""
    asked = os.environ.get("OMP_NUM_THREADS", "").split(",")[0].strip()
    return int(asked) if asked.isdigit() and int(asked) else len(os.sched_getaffinity(0))


def one_thread() -> AbstractContextManager[Any]:
    """Linear algebra on the thread that asks for it, so that rounding does not depend on how many there are.

    scipy has a library of its own, which a limit reaches only once it is loaded. The command line sets the variable.
    """
    if os.environ.get("OPENBLAS_NUM_THREADS") != "1":
        import scipy.linalg  # noqa: F401
    limits: AbstractContextManager[Any] = _libraries(len(sys.modules)).limit(limits=1, user_api="blas")
    return limits


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """The libraries that are loaded, looked for again once there are other modules: one comes with a module."""
    return ThreadpoolController()


def in_pieces(bound: Bound, each: Callable[..., Iterable[Any]] = map) -> Bound:
    """`bound`, as many boxes at a time as its `piece` says, if it has one; `each` may do so on threads."""
    size = max(_PIECE, getattr(bound, "piece", _PIECE))

    def cut(lo: Array, hi: Array, inner: float, outer: float) -> Any:
        count = lo.shape[1]
        if count == 1:  # sums over one box alone go another way (see `bounds/arrays.py`)
            lo, hi = np.repeat(lo, 2, axis=1), np.repeat(hi, 2, axis=1)
        ends = [*range(size, count - 1, size), lo.shape[1]]  # the last piece may be one box longer
        pieces = [slice(a, b) for a, b in zip([0, *ends], ends, strict=False)]
        los, his = ([np.ascontiguousarray(side[:, piece]) for piece in pieces] for side in (lo, hi))
        found = list(each(bound, los, his, [inner] * len(pieces), [outer] * len(pieces)))
        return type(found[0])(*(np.concatenate(parts, -1)[..., :count] for parts in zip(*found, strict=True)))

    return cut


class ThreadRunner:
    """The pieces of a batch on so many threads; a core each if no number is given."""

    def __init__(self, threads: int | None = None) -> None:
        self.threads = cores() if threads is None else threads

    @property
    def remark(self) -> None:
        """Nothing: all is done here."""

    @contextmanager
    def start(self, bound: Bound) -> Iterator[Bound]:
        """`bound` on the threads."""
        with one_thread():
            if self.threads == 1:
                yield in_pieces(bound)
                return
            with ThreadPoolExecutor(self.threads) as pool:
                yield in_pieces(bound, pool.map)

    def jobs(self, work: Work) -> nullcontext[None]:
        """Nothing is done elsewhere."""
        return nullcontext()
