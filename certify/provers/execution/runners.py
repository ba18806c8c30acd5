"""The runner at an address."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from certify.provers.execution.base import Runner
from certify.provers.execution.threads import ThreadRunner


@contextmanager
def runner_at(address: str | None) -> Iterator[Runner]:
    """Workers of the Dask cluster at `address`, or the threads of this process if that is None.

    Raises
    ------
    InputError, BackendError : as `cluster.connect`.
    """
    if address is None:
        yield ThreadRunner()
        return
    from certify.provers.execution.cluster import ClusterRunner, connect

    with connect(address) as client:
        yield ClusterRunner(client)
