"""Processes and machines under Dask distributed, which runs from a laptop to Kubernetes, Slurm and the clouds.

There is no scheduler here: an address is another program's affair, and `local:4` four worker processes of this machine.
Whoever may connect to a Dask cluster may run code in it, and its scheduler may run code here: use one whose machines
are yours, over TLS. For what is proved nobody need trust it: results are bytes, which are validated, and the checker
decides.
"""

from __future__ import annotations

import logging
import pickle
import queue
import re
import signal
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from functools import partial
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING, Any

from certify.errors import BackendError, InputError
from certify.provers.execution.base import Bound, Work
from certify.provers.execution.threads import ThreadRunner

if TYPE_CHECKING:
    from distributed import Client

_LOCAL = re.compile(r"local:([1-9]\d{0,3})")
_CENSUS = 1.0  # seconds for which the number of places is believed
_DEAF = 20.0  # seconds without a word from the scheduler, after which it is lost
_FETCH = 10.0  # seconds for answers that are there
_FAREWELL = 5.0  # seconds for taking leave of it
_OVER = ("error", "lost", "cancelled")
_NO_INTERRUPTS = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)\n"  # a terminal sends them to all
_PLAIN = ["dask", "msgpack"]  # serialisers of results: bytes and numbers, nothing that unpickling would run


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
    if local is None and not re.fullmatch(r"[a-z]+://[^/\s]+", address):
        raise InputError(
            "a cluster's address must be `local:N` with N worker processes, or a scheduler's, such as "
            f"tcp://host:8786; found {address!r}."
        )
    try:
        from distributed import Client, LocalCluster
    except ImportError as error:
        raise BackendError(
            "a cluster needs Dask distributed, which is not installed; run "
            "`pip install '.[cluster]'` in the project's folder."
        ) from error
    with _quiet(), ExitStack() as stack:
        if local is not None:
            with signals_later():  # half a cluster cannot be closed
                local_one = LocalCluster(
                    n_workers=int(local[1]),
                    threads_per_worker=1,
                    dashboard_address="127.0.0.1:0",  # None is Dask's own port, with a warning where that is taken
                    silence_logs=logging.CRITICAL,
                    preload=_NO_INTERRUPTS,
                )
                address = stack.enter_context(local_one).scheduler_address
        try:
            client = Client(address, timeout=patience, deserializers=_PLAIN, set_as_default=False)
        except (OSError, ValueError, TypeError, RuntimeError) as error:  # TLS without certificates is a TypeError
            why = str(error) or type(error).__name__
            raise BackendError(
                f"no scheduler answers at {address} within {patience:g} s: {why}. Start one with `dask scheduler`, or "
                "see to the address and, for tls://, to Dask's settings distributed.comm.tls."
            ) from error
        stack.callback(_close, client)
        yield client


def _close(client: Client) -> None:
    with suppress(Exception):  # a scheduler that is gone cannot be told
        client.close(timeout=_FAREWELL)


@contextmanager
def signals_later() -> Iterator[None]:
    """Signals that end a run come when this is over. Threads that start meanwhile, and their processes, leave Ctrl-C to
    the main thread from their first moment on."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    ending = (signal.SIGINT, signal.SIGTERM)
    handlers = {one: signal.getsignal(one) for one in ending if callable(signal.getsignal(one))}
    for one in handlers:
        signal.signal(one, lambda number, _: came.append(number))
    resource_tracker.ensure_running()  # which unblocks signals where it starts
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for one, handler in handlers.items():
            signal.signal(one, handler)
        if came:
            signal.raise_signal(came[0])


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Dask's own log lines: what a person should know is said in one sentence."""
    names = ["distributed", *(name for name in logging.root.manager.loggerDict if name.startswith("distributed."))]
    loggers = [logging.getLogger(name) for name in names]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


class ClusterRunner:
    """Batches are bounded on the threads of this machine, and jobs done by the workers of a cluster, one a thread."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self._here = ThreadRunner()
        self._failed = self._refused = 0
        self._lost = ""

    @property
    def remark(self) -> str | None:
        """A remark if the scheduler went away, or jobs had to be done here."""
        said = [self._lost.rstrip(".")] if self._lost else []
        if self._failed or self._refused:
            said.append(
                f"{self._failed} jobs of the cluster failed and {self._refused} had answers that were refused; they "
                "were done here. Its workers need the same sources of certify and the same numpy as this machine"
            )
        return "; ".join(said) or None

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
            self._failed, self._refused = self._failed + jobs.failed, self._refused + jobs.refused
            self._lost = self._lost or jobs.lost
            jobs.close()


class ClusterJobs:
    """Jobs as tasks of Dask, which does those of a lost worker again on another one.

    The work itself is a task as well, so that it too survives the worker that holds it. `failed` and `refused` count
    jobs without an answer, and answers that were refused; `lost` says how the scheduler went away.
    """

    def __init__(self, client: Client, work: Work) -> None:
        self.failed = self.refused = 0
        self.lost = ""
        self._client = client
        self._address = "the cluster" if client.scheduler is None else client.scheduler.address
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
            self._count()
        return self._places

    def give(self, job: bytes) -> int:
        """Have a job done; its number."""
        number, self._given = self._given, self._given + 1
        with self._lost_if_fails():
            if self._work is None or self._work.status in _OVER:
                self._work = self._client.submit(_unpacked, self._payload, pure=False)
            self._futures[number] = self._client.submit(_done, self._work, job, pure=False)
        self._listen(number)
        return number

    def ended(self, seconds: float) -> list[tuple[int, bytes | None]]:
        """Numbers and answers of the jobs that have ended, after waiting so long for one; None for one that failed."""
        numbers = []
        with suppress(queue.Empty):
            numbers.append(self._ended.get(timeout=max(0.0, seconds)))
            while True:
                numbers.append(self._ended.get_nowait())
        known = [number for number in dict.fromkeys(numbers) if number in self._futures]
        if not known:
            _ = self.places  # asks whether somebody is there
            return []
        good = [number for number in known if self._futures[number].status == "finished"]
        found: dict[int, bytes | None] = {number: None for number in known if number not in good}
        if len(found) == len(known):
            self._count()  # all of them may have failed because nobody is there
        found |= self._fetched(good)
        for number in found:
            del self._futures[number]
        self.failed += sum(answer is None for answer in found.values())
        return list(found.items())

    def refuse(self) -> None:
        """Take note that an answer was refused."""
        self.refused += 1

    def forget(self, numbers: Iterable[int]) -> None:
        """Do without the answers to these jobs."""
        for number in numbers:
            if number in self._futures:
                self._futures.pop(number).release()  # a worker that holds nothing any more is told so later

    def close(self) -> None:
        """Forget all jobs, and the work."""
        self.forget(list(self._futures))
        self._work = None

    def _listen(self, number: int) -> None:
        self._futures[number].add_done_callback(lambda _: self._ended.put(number))

    def _count(self) -> None:
        with self._lost_if_fails():
            self._places = sum(self._client.nthreads(callback_timeout=_DEAF).values())
        self._counted = time.monotonic()

    def _fetched(self, numbers: list[int]) -> dict[int, bytes | None]:
        """The answers to jobs that are done; not of those whose answer was lost with its worker, which are done again.

        An answer that cannot be read spoils the message that it comes in: each is fetched for itself then.
        """
        if not numbers:
            return {}
        gather = partial(self._client.gather, [self._futures[n] for n in numbers], errors="skip", asynchronous=True)
        late = False
        try:
            answers = self._client.sync(gather, callback_timeout=_FETCH)
            if len(answers) == len(numbers):
                return {
                    n: bytes(a) if type(a) in (bytes, bytearray) else None
                    for n, a in zip(numbers, answers, strict=True)
                }
        except Exception as error:  # whatever is in a message
            late = isinstance(error, TimeoutError)
        self._count()
        again = [number for number in numbers if self._futures[number].status == "pending"]
        for number in again:
            self._listen(number)
        rest = [number for number in numbers if number not in again]
        if late or len(numbers) == 1:
            return dict.fromkeys(rest)
        return {n: answer for number in rest for n, answer in self._fetched([number]).items()}

    @contextmanager
    def _lost_if_fails(self) -> Iterator[None]:
        try:
            if self._client.status != "running":
                raise ConnectionError("the connection to it broke")
            yield
        except (OSError, RuntimeError, ValueError) as error:
            self.lost = f"the scheduler at {self._address} is gone: {str(error).rstrip('.') or type(error).__name__}."
            raise BackendError(self.lost) from error


def _unpacked(payload: bytes) -> Work:
    """The work, on a worker."""
    work: Work = pickle.loads(payload)
    return work


def _done(work: Work, job: bytes) -> bytes:
    """The answer to a job, on a worker."""
    return work(job)
