"""The work that a pass has taken, and an estimate of the rest."""

from __future__ import annotations

import math

from certify.provers.base import Progress


class Account:
    """The operations of a pass, and an extrapolation of how many are left: they grow about as a power of the volume
    that is done."""

    def __init__(self) -> None:
        self.spent = 0.0
        self.left: float | None = None
        self.history: list[tuple[float, float]] = []

    def read(self, level: float, target: float, share: float, boxes: int, open_: int) -> Progress:
        self.history.append((self.spent, share))
        earlier = next((s for t, s in reversed(self.history) if t <= self.spent / 2), share)
        self.left = None
        if 0 < earlier < share:
            growth = math.log(2) / math.log(share / earlier)
            self.left = self.spent * math.expm1(min(700.0, -growth * math.log(share)))
        return Progress(level, target, boxes, open_, share, self.left)
