"""Examine batches of leaves in several processes.

Each leaf is decided on its own. So each process is a copy of this one, and examines every so many-th batch of leaves.
A process that ends early ends the answers; who asks sees that some are missing.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import cycle, islice
from multiprocessing import get_context
from multiprocessing.connection import Connection

from .boxes import Answers, Batch, Result, Work, answers


def by_processes(work: Work[Result], batches: Iterator[Batch], count: int) -> Answers[Result]:
    """Yield the answers in the order of the batches until a process has none left. Each process continues with a copy
    of the iterator, which nobody has begun."""
    context, running = get_context("fork"), []
    try:
        for k in range(count):
            reading, writing = context.Pipe(duplex=False)
            own = answers(work, islice(batches, k, None, count))
            process = context.Process(target=_send, args=(own, writing, reading), daemon=True)
            process.start()
            writing.close()
            running.append((process, reading))
        for _, reading in cycle(running):
            answer = reading.recv()
            if isinstance(answer, Exception):
                raise answer
            yield answer
    except EOFError:
        return
    finally:
        for process, _ in running:
            process.kill()
            process.join()


def _send(answers: Answers[Result], pipe: Connection, other_end: Connection) -> None:
    """Send the answers, and the first refusal or error in place of one."""
    other_end.close()  # so that what is sent to nobody is an error, and this process ends
    try:
        for answer in answers:
            pipe.send(answer)
    except Exception as error:
        pipe.send(error)
