"""Processes and machines under Dask distributed, which runs from a laptop to Kubernetes, Slurm and the clouds.

There is no scheduler here: an address is another program's affair, and `local:4` four worker processes of this machine.
Whoever may connect to a Dask cluster may run code in it, and its scheduler may run code here: use one whose machines
are yours, over TLS. For what is proved nobody need trust it: results are bytes, which are validated, and the checker
decides.
"""

from __future__ import annotations

import pickle
import queue
import re
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from typing import TYPE_CHECKING, Any

import torch

from certify.errors import BackendError, InputError
from certify.running.base import Bound, Work
from certify.running.threads import ThreadRunner

if TYPE_CHECKING:
    from distributed import Client

_LOCAL = re.compile(r"local:([1-9]\d{0,3})")
_CENSUS = 1.0  # seconds for which the number of places is believed
_DEAF = 20.0  # seconds without a word from the scheduler, after which it is lost
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


class ClusterRunner:
    """Batches are bounded on the threads of this machine, and jobs done by the workers of a cluster, one a thread."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self._here = ThreadRunner()

    @property
    def device(self) -> torch.device:
        """Where the boxes of a batch lie: this machine's processor."""
        return self._here.device

    def start(self, bound: Bound) -> AbstractContextManager[Bound]:
        """`bound` on the threads of this machine."""
        return self._here.start(bound)

    @contextmanager
    def jobs(self, work: Work) -> Iterator[ClusterJobs]:
        """Jobs for the workers; what they have not done at the end is taken from them."""
        jobs = ClusterJobs(self.client, work)
        try:
            yield jobs
        finally:
            jobs.close()


class ClusterJobs:
    """Jobs as tasks of Dask, which does those of a lost worker again on another one.

    The work itself is a task as well, so that it too survives the worker that holds it.
    """

    def __init__(self, client: Client, work: Work) -> None:
        self._client = client
        self._payload = pickle.dumps(work)
        self._work: Any = None
        self._futures: dict[int, Any] = {}
        self._ended: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._given = 0
        self._places, self._counted = 0, -_CENSUS

    @property
    def places(self) -> int:
        """Threads of all workers that are there, as of a second ago.

        Raises
        ------
        BackendError : the scheduler is gone.
        """
        if time.monotonic() - self._counted >= _CENSUS:
            with self._lost_if_fails():
                self._places = sum(self._client.nthreads().values())
            self._counted = time.monotonic()
        return self._places

    def give(self, job: bytes) -> int:
        """Have a job done; its number."""
        number, self._given = self._given, self._given + 1
        with self._lost_if_fails():
            if self._work is None:
                self._work = self._client.submit(_unpacked, self._payload, pure=False)
            future = self._client.submit(_done, self._work, job, pure=False)
        self._futures[number] = future
        future.add_done_callback(lambda _: self._ended.put(number))
        return number

    def ended(self, seconds: float) -> list[tuple[int, bytes | None]]:
        """Numbers and answers of the jobs that have ended, after waiting so long for one; None for one that failed."""
        numbers = []
        with suppress(queue.Empty):
            numbers.append(self._ended.get(timeout=max(0.0, seconds)))
            while True:
                numbers.append(self._ended.get_nowait())
        known = [number for number in numbers if number in self._futures]
        if not known:
            _ = self.places  # asks whether somebody is there
            return []
        good = [number for number in known if self._futures[number].status == "finished"]
        with self._lost_if_fails():
            answers = self._client.gather([self._futures[number] for number in good], errors="skip")
        found = dict.fromkeys(known)
        if len(answers) == len(good):  # else one was lost on its way, and is done again by whoever asked
            found |= {
                n: bytes(a) if isinstance(a, bytes | bytearray) else None for n, a in zip(good, answers, strict=True)
            }
        for number in known:
            del self._futures[number]
        return list(found.items())

    def forget(self, numbers: Iterable[int]) -> None:
        """Do without the answers to these jobs."""
        futures = [self._futures.pop(number) for number in numbers if number in self._futures]
        with suppress(Exception):  # whoever is gone has forgotten them
            self._client.cancel(futures, force=True)

    def close(self) -> None:
        """Forget all jobs, and the work."""
        self.forget(list(self._futures))
        self._work = None

    @contextmanager
    def _lost_if_fails(self) -> Iterator[None]:
        address = self._client.scheduler.address if self._client.scheduler is not None else "the cluster"
        if self._client.status != "running":
            raise BackendError(f"the scheduler at {address} is gone: its connection is {self._client.status}.")
        try:
            yield
        except (OSError, RuntimeError, ValueError) as error:
            raise BackendError(f"the scheduler at {address} is gone: {error or type(error).__name__}.") from error


def _unpacked(payload: bytes) -> Work:
    """The work, on a worker."""
    work: Work = pickle.loads(payload)
    return work


def _done(work: Work, job: bytes) -> bytes:
    """The answer to a job, on a worker."""
    return work(job)
