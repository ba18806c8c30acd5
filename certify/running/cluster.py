"""Processes and machines under Dask distributed, which runs from a laptop to Kubernetes, Slurm and the clouds.

There is no scheduler here: an address is another program's affair, and `local:4` four worker processes of this machine.
Whoever may connect to a Dask cluster may run code in it, and its scheduler may run code here: use one whose machines
are yours, over TLS. For what is proved nobody need trust it: results are bytes, which are validated, and the checker
decides.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from certify.errors import BackendError, InputError

if TYPE_CHECKING:
    from distributed import Client

_LOCAL = re.compile(r"local:([1-9]\d{0,3})")
_PLAIN = ["dask", "msgpack"]  # of results: bytes and numbers, nothing that unpickling would run


@contextmanager
def connect(address: str, patience: float = 30.0) -> Iterator[Client]:
    """A client of the cluster at `address`: `local:N`, or a scheduler's such as `tcp://host:8786` or `tls://host:8786`.

    Parameters
    ----------
    patience : seconds within which the scheduler must answer.

    Raises
    ------
    InputError : the address is neither.
    BackendError : Dask distributed is not installed, or no scheduler answers.

    Notes
    -----
    Certificates for TLS are taken from Dask's own configuration, `distributed.comm.tls`. Results of tasks must be
    bytes, numbers, strings, or lists and dictionaries of these.
    """
    local = _LOCAL.fullmatch(address)
    if local is None and not re.match(r"[a-z]+://[^/]+", address):
        raise InputError(
            "a cluster's address must be `local:N` with N worker processes, or a scheduler's, such as "
            f"tcp://host:8786; found {address!r}."
        )
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise BackendError(
            "a cluster needs Dask distributed, which is not installed; run `pip install 'certify[cluster]'`."
        ) from error
    if local is not None:
        count = int(local[1])
        with (
            LocalCluster(n_workers=count, threads_per_worker=1, dashboard_address=None, silence_logs=50) as here,
            Client(here.scheduler_address, deserializers=_PLAIN) as client,
        ):
            yield client
        return
    try:
        client = Client(address, timeout=patience, deserializers=_PLAIN)
    except (OSError, ValueError) as error:  # a time-out is an OSError
        raise BackendError(f"no scheduler answers at {address} within {patience:g} s: {error}") from error
    with client:
        yield client
