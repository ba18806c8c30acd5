"""Threads of this machine, or its GPU."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from certify.provers.execution.base import Bound, Work

_CHUNK = 256  # boxes that make a thread worth its while
_SMALL_NETWORK = 10_000  # weights


@contextmanager
def threads_for(weights: Sequence[NDArray[np.float64]]) -> Iterator[None]:
    """One thread of torch's for a small network: its operations are shorter than the threads' handshakes."""
    threads = torch.get_num_threads()
    if sum(W.size for W in weights) < _SMALL_NETWORK:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


class ThreadRunner:
    """Each batch cut into one piece a thread of torch's; one piece on a device other than the processor.

    Pieces stay in a core's cache and meet once a batch, where torch's own threads meet at every operation.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self._device = device if device is not None else torch.device("cpu")

    @property
    def device(self) -> torch.device:
        """Where the boxes of a batch lie."""
        return self._device

    @property
    def remark(self) -> None:
        """Nothing: all is done here."""

    @contextmanager
    def start(self, bound: Bound) -> Iterator[Bound]:
        """`bound` on the threads; torch's own are one while it is in use."""
        threads = torch.get_num_threads()
        if self._device.type != "cpu" or threads == 1:
            yield bound
            return
        torch.set_num_threads(1)
        try:
            with ThreadPoolExecutor(threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:

                def cut(lo: Tensor, hi: Tensor, inner: float, outer: float) -> Any:
                    pieces = max(1, min(threads, lo.shape[1] // _CHUNK))
                    if pieces == 1:
                        return bound(lo, hi, inner, outer)
                    los, his = lo.tensor_split(pieces, 1), hi.tensor_split(pieces, 1)
                    found = list(pool.map(bound, los, his, [inner] * pieces, [outer] * pieces))
                    return type(found[0])(*(torch.cat(parts, -1) for parts in zip(*found, strict=True)))

                yield cut
        finally:
            torch.set_num_threads(threads)

    def jobs(self, work: Work) -> nullcontext[None]:
        """Nothing is done elsewhere."""
        return nullcontext()
