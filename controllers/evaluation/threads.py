"""The number of threads on which torch works."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from certify.loop.policies import PolicyNetwork

_SMALL_NETWORK = 10_000  # weights


@contextmanager
def threads_for(network: PolicyNetwork) -> Iterator[None]:
    """One thread for a small network: its operations are shorter than the threads' handshakes."""
    threads = torch.get_num_threads()
    if network.network.entries < _SMALL_NETWORK:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
