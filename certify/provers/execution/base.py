"""A place to run: it takes a bound of boxes and gives back one that does the same work there, or does whole jobs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bound = Callable[[Array, Array, float, float], Any]
Work = Callable[[bytes], bytes]


class Counted(Protocol):
    """A bound of boxes that says about how many operations one takes."""

    @property
    def operations(self) -> float:
        """Operations to bound a box, as an `Effort` counts them."""

    def __call__(self, lo: Array, hi: Array, inner: float, outer: float, /) -> Any: ...


class Jobs(Protocol):
    """Work that is done elsewhere, a job at a time at each of several places."""

    @property
    def places(self) -> int:
        """The number of jobs that are done at once now; 0 if nobody is there."""

    def give(self, job: bytes) -> int:
        """Have a job done; its number."""

    def ended(self, seconds: float) -> list[tuple[int, bytes | None]]:
        """Numbers and answers of the jobs that have ended, after waiting so long for one; None for one that failed.

        Raises
        ------
        BackendError : nobody will ever answer.
        """

    def refuse(self) -> None:
        """Take note that an answer was refused."""

    def forget(self, numbers: Iterable[int]) -> None:
        """Do without the answers to these jobs."""


class Runner(Protocol):
    """Bounds batches of boxes. The answer for a box must not depend on where or with which others it was bounded."""

    @property
    def remark(self) -> str | None:
        """A remark on the places for a person; None if there is nothing to say."""

    def start(self, bound: Bound) -> AbstractContextManager[Bound]:
        """`bound`, a function of corners (n, B) and two levels to a named tuple of arrays (..., B), as run here."""

    def jobs(self, work: Work) -> AbstractContextManager[Jobs | None]:
        """The jobs by which `work`, which can be pickled, is done elsewhere; None if all is done here."""
