"""Pieces of work that know nothing of each other: each in a process of its own here, or on a cluster's workers.

A sweep's cases and a comparison's training runs are such pieces. The place must not show in the results: so a piece is
a function of a module with its arguments, its result is bytes, and a place gives results as they come, in no order. A
piece whose process died, or that raised, is lost, and the others continue: the caller decides what that means. A
process does one piece at a time, because BLAS's threads, flint's precision and numpy's generator are the process's.
"""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import queue
import signal
import threading
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass
from itertools import islice
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import TYPE_CHECKING, Any, Protocol

from certify.errors import BackendError, InputError, OptionError
from certify.provers.execution.cluster import connect
from certify.provers.execution.threads import cores

if TYPE_CHECKING:
    from distributed import Future

_IN_FLIGHT = 256  # pieces that a scheduler holds at a time: arguments stay here until their turn is near
_PULSE = 1.0  # seconds
_DESERTED = 60.0  # seconds without a worker, after which none is expected that was not to join from elsewhere
_DONE, _RAISED = b"\0", b"\1"
_ALONE = threading.Lock()


@dataclass(frozen=True, slots=True)
class Piece:
    """A piece of work: `work(*arguments)` gives bytes; `key` is its name among the pieces of a run.

    `work` is a function of a module, and the arguments are plain values: both may travel.
    """

    key: str
    work: Callable[..., bytes]
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Outcome:
    """A piece's outcome: its `result`, or None and the `reason` why it is lost."""

    key: str
    result: bytes | None
    reason: str = ""


class Place(Protocol):
    """Does pieces of work."""

    def run(self, pieces: Iterable[Piece]) -> Generator[Outcome | None, None, None]:
        """The outcomes, as they come, and None about once a second where none comes; closing it ends unfinished pieces.

        Raises
        ------
        BackendError : the place itself is gone.
        """


class Processes:
    """At most so many processes of this machine at a time, a new one for each piece.

    They are forked from a server that has loaded the pieces' module once, and end with the process that asked.

    Raises
    ------
    InputError : `jobs` is less than 1.
    """

    def __init__(self, jobs: int) -> None:
        if jobs < 1:
            raise OptionError(f"`jobs` must be at least 1; found {jobs}.")
        self.jobs = jobs

    def run(self, pieces: Iterable[Piece]) -> Generator[Outcome | None, None, None]:
        """The outcomes, as they come."""
        context = multiprocessing.get_context("forkserver")
        waiting, running = iter(pieces), dict[Connection, tuple[str, BaseProcess]]()

        def start() -> None:
            for piece in islice(waiting, self.jobs - len(running)):
                context.set_forkserver_preload([__name__, piece.work.__module__])  # heeded by the first process alone
                mine, theirs = context.Pipe(duplex=False)
                process = context.Process(target=_in_a_process, args=(theirs, self.jobs, piece.work, piece.arguments))
                process.start()
                theirs.close()  # so that the end of the process ends the pipe
                running[mine] = piece.key, process

        try:
            start()
            while running:
                ended = [end for end in wait(list(running), timeout=_PULSE) if isinstance(end, Connection)]
                outcomes = [_received(end, *running.pop(end)) for end in ended]
                start()
                yield from outcomes
                if not outcomes:
                    yield None
        finally:
            for end, (_, process) in running.items():
                _end(process)
                end.close()


class Cluster:
    """The workers of a Dask cluster, also those that join while the work is under way.

    A worker that dies takes nothing with it: the scheduler gives its pieces to others. Pieces that have been with four
    workers that died come back; whichever of them is to blame is not known, and each is tried once more, alone.

    Parameters
    ----------
    address : see `connect`.
    """

    def __init__(self, address: str) -> None:
        self.address = address

    def run(self, pieces: Iterable[Piece]) -> Generator[Outcome | None, None, None]:
        """The outcomes, as they come.

        Raises
        ------
        InputError, BackendError : those of `connect`; the scheduler is gone.
        """
        waiting, flying = iter(pieces), dict["Future", Piece]()
        ended: queue.SimpleQueue[Future] = queue.SimpleQueue()
        suspects, alone, deserted = list[Piece](), set[str](), 0
        with _quiet(), connect(self.address) as client:

            def submit(piece: Piece) -> None:
                future = client.submit(_on_a_worker, piece.work, piece.arguments, pure=False)
                flying[future] = piece
                future.add_done_callback(ended.put)

            while True:
                for piece in islice(waiting, _IN_FLIGHT - len(flying)):
                    submit(piece)
                if not flying and suspects:
                    alone.add(suspects[-1].key)
                    submit(suspects.pop())
                if not flying:
                    return
                try:
                    future = ended.get(timeout=_PULSE)
                except queue.Empty:
                    deserted = deserted + 1 if self.address.startswith("local:") and not client.nthreads() else 0
                    if deserted * _PULSE > _DESERTED:
                        raise BackendError(
                            f"no worker is left of {self.address}, and none came back. What was done is kept; give the "
                            "same command again."
                        ) from None
                    yield None
                    continue
                piece = flying.pop(future)
                if _killed(future) and piece.key not in alone:
                    suspects.append(piece)
                else:
                    yield self._outcome(piece.key, future)

    def _outcome(self, key: str, future: Future) -> Outcome:
        if future.status == "finished":
            return _unpacked(key, future.result())
        if future.status != "error":  # cancelled or lost: the client has no scheduler any more, or another one
            raise self._gone()
        return Outcome(key, None, f"the cluster could not do it: {_one_line(future.exception())}")

    def _gone(self) -> BackendError:
        return BackendError(
            f"the scheduler at {self.address} is gone, or has forgotten what it was asked for. What was done is kept; "
            "give the same command again when it is back."
        )


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Dask's client logs tracebacks about a scheduler that has gone; whoever asked gets one sentence."""
    log = logging.getLogger("distributed.client")

    def nothing(_: logging.LogRecord) -> bool:
        return False

    log.addFilter(nothing)  # its level would be set again when Dask is imported
    try:
        yield
    finally:
        log.removeFilter(nothing)


def place_for(jobs: int | None, cluster: str | None) -> Place:
    """The place that somebody named: a number of processes, or the address of a cluster; one process by default.

    Raises
    ------
    InputError : both are given, or the number is less than 1.
    """
    if cluster is None:
        return Processes(1 if jobs is None else jobs)
    if jobs is not None:
        raise InputError(f"--jobs must stand without --cluster; found both. A cluster of {jobs} here is local:{jobs}.")
    return Cluster(cluster)


def _in_a_process(end: Connection, jobs: int, work: Callable[..., bytes], arguments: tuple[Any, ...]) -> None:
    """A child's life: a group of its own, which ends with the process that asked, and one piece of work."""
    os.setpgid(0, 0)  # Ctrl-C is for the process that asked, and the children's own children end with them
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent.sentinel,), daemon=True).start()
    os.environ["OMP_NUM_THREADS"] = str(max(1, cores() // jobs))
    end.send_bytes(_done(work, arguments))


def _end_after(sentinel: int) -> None:
    wait([sentinel])
    os.killpg(0, signal.SIGKILL)


def _on_a_worker(work: Callable[..., bytes], arguments: tuple[Any, ...]) -> bytes:
    """A worker may have several threads, and may not have children of multiprocessing."""
    with _ALONE:
        return _done(work, arguments)


def _done(work: Callable[..., bytes], arguments: tuple[Any, ...]) -> bytes:
    """The result, or what was raised: an exception itself must not travel, reading one runs code."""
    try:
        return _DONE + work(*arguments)
    except Exception as error:
        return _RAISED + _one_line(error).encode("utf-8", "replace")


def _killed(future: Future) -> bool:
    """True if the workers that had a piece died."""
    return future.status == "error" and type(future.exception()).__name__ == "KilledWorker"


def _unpacked(key: str, sent: Any) -> Outcome:
    if not isinstance(sent, bytes) or sent[:1] not in (_DONE, _RAISED):
        return Outcome(key, None, f"what came back is no result: {type(sent).__name__}")
    if sent[:1] == _RAISED:
        return Outcome(key, None, sent[1:].decode("utf-8", "replace"))
    return Outcome(key, sent[1:])


def _received(end: Connection, key: str, process: BaseProcess) -> Outcome:
    """The result that a child sent, or how it ended."""
    with end:
        try:
            sent = end.recv_bytes()
        except (EOFError, OSError):
            process.join()
            return Outcome(key, None, _death(process.exitcode))
    process.join()
    return _unpacked(key, sent)


def _death(status: int | None) -> str:
    if status is not None and status < 0:
        name = signal.Signals(-status).name if -status in set(signal.Signals) else str(-status)
        return f"its process was ended by {name}" + (": was memory short?" if name == "SIGKILL" else "")
    return f"its process ended with status {status} and no result"


def _end(process: BaseProcess) -> None:
    """End a child and what it has started; its group may not be there yet."""
    if process.pid is not None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.join()


def _one_line(error: BaseException | None) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:2000]
