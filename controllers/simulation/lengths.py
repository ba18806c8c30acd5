"""Lengths of simulated runs, and of the window at their end in which they are measured."""

from __future__ import annotations

import math
from dataclasses import dataclass

from certify.errors import OptionError
from certify.loop.plants import System


@dataclass(frozen=True, slots=True, kw_only=True)
class Lengths:
    """Seconds that are simulated, and the last seconds, in which runs are measured; the same in steps of discrete time.

    Raises
    ------
    OptionError : a length is not positive and finite, or a window is longer than its run.
    """

    duration: float = 60.0
    window: float = 1.0
    duration_steps: int = 3000
    window_steps: int = 50

    def __post_init__(self) -> None:
        self.require_positive("duration", "window", "duration_steps", "window_steps")
        for length, window, unit in (("duration", "window", "s"), ("duration_steps", "window_steps", "steps")):
            if getattr(self, length) < getattr(self, window):
                raise OptionError(f"`{length}` must be at least the window, {getattr(self, window):g} {unit}.")

    def require_positive(self, *names: str) -> None:
        """Refuse options that are not positive and finite."""
        for name in names:
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"`{name}` must be positive and finite; found {getattr(self, name)}.")

    def span(self, system: System) -> tuple[float, float]:
        """Duration and window in the plant's unit of time: seconds, or steps."""
        if system.time == "discrete":
            return self.duration_steps, self.window_steps
        return self.duration, self.window
