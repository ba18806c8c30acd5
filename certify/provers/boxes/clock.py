"""How long a pass has worked, and how long it probably still will."""

from __future__ import annotations

import math
import time

from certify.provers.base import Progress


class Clock:
    """The seconds of a pass while it runs, and an extrapolation of how many are left: they grow about as a power of the
    volume that is done."""

    def __init__(self) -> None:
        self.before = self.start = 0.0
        self.left: float | None = None
        self.history: list[tuple[float, float]] = []

    def __enter__(self) -> None:
        self.start = time.monotonic()

    def __exit__(self, *_: object) -> None:
        self.before += self.spent

    @property
    def spent(self) -> float:
        """Seconds since the pass was last set going."""
        return time.monotonic() - self.start

    def read(self, level: float, target: float, share: float, boxes: int, open_: int) -> Progress:
        seconds = self.before + self.spent
        self.history.append((seconds, share))
        earlier = next((s for t, s in reversed(self.history) if t <= seconds / 2), share)
        self.left = None
        if 0 < earlier < share:
            growth = math.log(2) / math.log(share / earlier)
            self.left = seconds * math.expm1(min(700.0, -growth * math.log(share)))
        return Progress(level, target, boxes, open_, share, self.left)
