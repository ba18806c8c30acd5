"""The options of a comparison."""

from __future__ import annotations

import math
from dataclasses import dataclass

from certify.errors import OptionError
from certify.loop.plants import System
from controllers.comparison.methods import BASELINES, Method


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareOptions:
    """The options of a comparison.

    Parameters
    ----------
    methods : ways to act, with the runs that they need.
    seeds : trained runs of each kind, with the seeds 0, 1, ...
    states, start_seed : number and seed of the initial states, which all methods share.
    duration, window : seconds simulated, and the last seconds in which the floor of ||x|| is measured.
    duration_steps, window_steps : the same of a plant in discrete time, in steps.
    tolerance : bound on ||x|| in the window for a trajectory that has settled.
    to_floor : baselines learn until they no longer improve, not for as many steps as ours.
    budget, patience : of that rule, where they are not `controllers.comparison.runs.RULES`'s.
    """

    methods: tuple[Method, ...] = BASELINES
    seeds: int = 5
    states: int = 50
    start_seed: int = 0
    duration: float = 20.0
    window: float = 1.0
    duration_steps: int = 1000
    window_steps: int = 50
    tolerance: float = 1e-6
    to_floor: bool = False
    budget: int | None = None
    patience: int | None = None

    def __post_init__(self) -> None:
        for name in ("seeds", "states", "duration", "window", "duration_steps", "window_steps", "tolerance"):
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"`{name}` must be positive and finite; found {getattr(self, name)}.")
        if self.start_seed < 0 or self.window > self.duration or self.window_steps > self.duration_steps:
            raise OptionError(
                "`start_seed` must be at least 0, and `window` at most `duration`, in seconds and in steps."
            )

    def span(self, system: System) -> tuple[float, float]:
        """Duration and window in the plant's unit of time: seconds, or steps."""
        if system.time == "discrete":
            return self.duration_steps, self.window_steps
        return self.duration, self.window
