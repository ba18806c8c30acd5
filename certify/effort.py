"""Effort: counted work, so that the same command gives the same answer, however fast or busy the machine is.

A search is limited by the elementary operations that it asks for, counted from sizes, and never by a clock. The counts
are calibrated on two quiet cores, where `UNIT` operations take about a second; elsewhere they take longer or shorter
and do the same.
"""

from __future__ import annotations

import math
import time

UNIT = 1e9
"""Operations that two quiet cores do in about a second of a search."""
WHOLE = 50 * UNIT
"""Operations of a run with `--effort 1`."""


class Effort:
    """Operations that may still be done; every part of an effort is charged to the whole as well.

    Parameters
    ----------
    granted : operations.
    seconds : a limit on the wall clock as well: no more operations are left than the rest of the time is worth, at the
        pace so far.
    """

    def __init__(self, granted: float = math.inf, seconds: float | None = None) -> None:
        self.granted, self.spent = granted, 0.0
        self._start = time.monotonic()
        self._end = None if seconds is None else self._start + seconds
        self._whole: Effort | None = None
        self._alone = False

    def charge(self, operations: float) -> None:
        """Count work that is done, or about to be done."""
        self.spent += operations
        if self._whole is not None:
            self._whole.charge(operations)

    def part(self, operations: float, even_if_over: bool = False) -> Effort:
        """At most so many of these operations; with `even_if_over` so many even where fewer are left."""
        found = Effort(operations)
        found._whole, found._alone = self, even_if_over
        return found

    def share(self, of_what_is_left: float) -> Effort:
        """A share of the operations that are left."""
        left = self.left
        return self.part(of_what_is_left * left if left < math.inf else left)

    @property
    def left(self) -> float:
        """Operations that may still be done, 0 at least."""
        left = min(self.granted - self.spent, self._worth)
        if self._whole is not None and not self._alone:
            left = min(left, self._whole.left)
        return max(0.0, left)

    @property
    def is_short_of_time(self) -> bool:
        """True if the clock leaves less than the count does."""
        if self._whole is not None:
            return self._whole.is_short_of_time
        return self._worth < self.granted - self.spent

    @property
    def over(self) -> bool:
        """True if nothing is left."""
        return self.left <= 0

    def seconds_for(self, operations: float) -> float:
        """Seconds that so many operations take at the pace so far."""
        return self._whole.seconds_for(operations) if self._whole is not None else operations / self._pace

    @property
    def _pace(self) -> float:
        """Operations a second so far; that of quiet cores at first."""
        elapsed = time.monotonic() - self._start
        return (self.spent + UNIT) / (elapsed + 1.0)

    @property
    def _worth(self) -> float:
        """Operations that the rest of the time is worth at that pace; infinite without a limit on the clock."""
        return math.inf if self._end is None else (self._end - time.monotonic()) * self._pace


class _Unlimited(Effort):
    """An effort without an end, which keeps no account."""

    def charge(self, operations: float) -> None:
        pass


UNLIMITED: Effort = _Unlimited()
