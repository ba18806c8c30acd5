"""Divide the leaves among processes, and run several processes at once.

Each leaf is decided on its own. So the batches of leaves are dealt out like cards: every process walks all of the
certificate's batches in the order of the file, and examines those of its own part. If a process does not answer, or
answers about another part, the whole examination fails, with neither yes nor no.
"""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NoReturn

from .near import Array

Batch = tuple[int, Array, Array]  # the number of the first leaf, and their corners (n, B)


@dataclass
class Part:
    """A process's share of the batches: those whose number, counted from 0 through the whole examination, leaves
    `number - 1` when divided by `of`."""

    number: int = 1
    of: int = 1
    passed: int = 0  # batches before the one in hand, of whatever part
    leaves: int = 0  # in the batches of this part
    all_leaves: int = 0  # in all of them
    spans: list[list[int]] = field(default_factory=list)  # [first, beyond] of this part's, counted through them all

    def own(self, batches: Iterable[Batch]) -> Iterator[Batch]:
        """Yield the batches of this part."""
        for batch in batches:
            first, size = self.all_leaves, batch[1].shape[1]
            self.all_leaves += size
            if self.passed % self.of == self.number - 1:
                self.leaves += size
                self.spans.append([first, first + size])
                yield batch
            self.passed += 1

    def split(self, index: int, count: int) -> tuple[int, int]:
        """Number and `of` of one of the parts, counted from 0, that this one falls into."""
        return self.number + index * self.of, count * self.of


def in_processes(count: int, work: Callable[[int], Any]) -> list[Any]:
    """`work(0)` to `work(count - 1)`, what JSON can say of them, each made in a process that is a copy of this one.

    Raises
    ------
    ChildProcessError : a process did not come to its end, or could not answer.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)  # a caller may have had it ignored, and then no status is kept
    children: list[tuple[int, int]] = []
    said: list[tuple[str, int]] = []
    try:
        for index in range(count):
            reading, writing = os.pipe()
            child = os.fork()
            if child == 0:
                _answer(work, index, reading, writing)
            os.close(writing)
            children.append((child, reading))
        while children:
            with open(children[0][1], encoding="ascii") as pipe:
                text = pipe.read()
            said.append((text, os.waitpid(children[0][0], 0)[1]))
            del children[0]
    finally:
        for child, _ in children:  # of an examination that has failed
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
    if any(status != 0 for _, status in said):
        raise ChildProcessError(f"of {count} processes, not all came to their end: {[status for _, status in said]}")
    return [json.loads(text) for text, _ in said]


def _answer(work: Callable[[int], Any], index: int, reading: int, writing: int) -> NoReturn:
    """Run in the copied process: work, and write the answer to the pipe."""
    status = 1
    try:
        os.close(reading)
        with open(writing, "w", encoding="ascii") as pipe:
            json.dump(work(index), pipe)
        status = 0
    finally:
        os._exit(status)
