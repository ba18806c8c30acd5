"""Leaves in batches that meet the weights together, by several processes if asked: each leaf is decided on its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import islice
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import TypeVar

from .document import Certificate
from .refusal import Refused

COLUMNS, WIDE = 48, 64  # of a product; networks from this width on take more of them at once without loss
T = TypeVar("T")
Check = Callable[[list[T]], None]


def in_batches(c: Certificate, symbols: int, asked: Iterator[T], check: Check[T], jobs: int) -> None:
    """Check batches of leaves with so many symbols in their order; the first refusal is raised.

    Each of several processes is a copy of this one with all the batches, of which it checks every so many-th.
    """
    columns = COLUMNS if max(c.policy.network.sizes) < WIDE else 8 * COLUMNS
    size = max(1, columns // (symbols + 1))
    batches = iter(lambda: list(islice(asked, size)), [])
    for some in batches:
        check(some)
        if jobs > 1:  # what all batches need of the weights is known before there are copies of it
            break
    if jobs == 1:
        return
    fork, pipes = get_context("fork"), list[Connection]()
    for k in range(jobs):
        mine, its = fork.Pipe(duplex=False)
        fork.Process(target=share, args=(batches, check, k, jobs, its), daemon=True).start()
        its.close()
        pipes.append(mine)
    found = [pipe.recv() for pipe in pipes]  # an error if a process has ended without an answer
    refusals = [answer for answer in found if answer is not None]
    if refusals:
        raise Refused(*min(refusals)[1:])


def share(batches: Iterator[list[T]], check: Check[T], k: int, jobs: int, pipe: Connection) -> None:
    """Check batch k and every one that many further; send the first refusal with its batch's number, else None."""
    number = 0
    try:
        for number, some in enumerate(batches):
            if number % jobs == k:
                check(some)
    except Refused as no:
        pipe.send((number, no.rule, no.at, no.detail))
    else:
        pipe.send(None)
