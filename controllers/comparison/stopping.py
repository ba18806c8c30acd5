"""The plan of a run: when it is evaluated, and when it ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from certify.errors import OptionError
from controllers.comparison.learning_curve import CurvePoint

Why = Literal["no improvement", "budget", "steps"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Stopping:
    """The rule by which a run has reached its floor.

    Parameters
    ----------
    budget : steps after which it ends in any case, before the closing phase.
    every : steps between evaluations.
    patience : evaluations in a row without an improvement that end it, those not counted that are lost.
    share : by which floor or cost has to fall below its smallest value so far to count as an improvement.
    closing : share of the steps made so far that the closing phase takes.
    """

    budget: int
    every: int
    patience: int = 8
    share: float = 0.05
    closing: float = 0.2

    def __post_init__(self) -> None:
        for name in ("budget", "every", "patience"):
            if getattr(self, name) < 1:
                raise OptionError(f"`{name}` must be at least 1; found {getattr(self, name)}.")
        for name in ("share", "closing"):
            if not 0 <= getattr(self, name) < 1:
                raise OptionError(f"`{name}` must be in [0, 1); found {getattr(self, name)}.")

    def turn(self, rows: Sequence[CurvePoint]) -> tuple[int, Why] | None:
        """The step after which learning ends, and why; None as long as it continues."""
        floor = cost = math.inf
        since, first = 0, True
        for row in rows:
            if not row.lost:
                better = first or row.floor < (1 - self.share) * floor or row.cost < (1 - self.share) * cost
                since, first = 0 if better else since + 1, False
                floor, cost = min(floor, row.floor), min(cost, row.cost)
            if row.step >= self.budget:
                return row.step, "budget"
            if since >= self.patience:
                return row.step, "no improvement"
        return None

    def end(self, rows: Sequence[CurvePoint]) -> tuple[int, int] | None:
        """First and last step of the closing phase; None while the run learns."""
        turn = self.turn(rows)
        return None if turn is None else (turn[0], turn[0] + round(self.closing * turn[0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fixed:
    """A run of a fixed number of steps, evaluated every so many."""

    steps: int
    every: int

    def __post_init__(self) -> None:
        for name in ("steps", "every"):
            if getattr(self, name) < 1:
                raise OptionError(f"`{name}` must be at least 1; found {getattr(self, name)}.")


Plan = Stopping | Fixed
