"""Examine the leaves of a tree in several processes, with the results in the order of the file.

Each leaf is decided on its own. So each process is a copy of this one, and examines every so many-th batch of leaves.
The results are taken in the order of the leaves and without a gap, or not at all, and there must be as many leaves as
the tree has: a process that ends early, or leaves something out, makes an error, and neither yes nor no.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import chain, cycle, islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeVar

from .near import Array

Batch = tuple[int, Array, Array]  # the number of the first leaf, and their corners (n, B)
Result = TypeVar("Result")
Work = Callable[[int, Array, Array], Result]
Answers = Iterator[tuple[int, int, Result]]  # the number of the first leaf, how many there are, and their result


def in_order(work: Work[Result], batches: Iterator[Batch], leaves: int, jobs: int) -> Iterator[Result]:
    """Yield `work(*batch)` of each batch of a tree's leaves, made in up to so many processes, as if in one.

    Raises
    ------
    ArithmeticError : the results are not those of all leaves.
    """
    first, examined = list(islice(batches, jobs)), 0
    batches = chain(first, batches)
    answers = _answers(work, batches) if len(first) < 2 else _by_processes(work, batches, len(first))
    for number, size, result in answers:
        if number != examined:
            break
        examined += size
        yield result
    if examined != leaves:
        raise ArithmeticError(f"leaves have been passed over: after {examined} of {leaves}")


def _answers(work: Work[Result], batches: Iterator[Batch]) -> Answers[Result]:
    for first, lo, hi in batches:
        yield first, lo.shape[1], work(first, lo, hi)


def _by_processes(work: Work[Result], batches: Iterator[Batch], count: int) -> Answers[Result]:
    """Yield the answers in the order of the batches until a process has none left. Each process continues with a copy
    of the iterator, which nobody has begun."""
    context, running = get_context("fork"), []
    try:
        for k in range(count):
            reading, writing = context.Pipe(duplex=False)
            own = _answers(work, islice(batches, k, None, count))
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
