"""The options of a comparison."""

from __future__ import annotations

from dataclasses import dataclass

from certify.errors import OptionError
from controllers.comparison.methods import BASELINES, Method
from controllers.simulation.lengths import Lengths


@dataclass(frozen=True, slots=True, kw_only=True)
class CompareOptions(Lengths):
    """The options of a comparison; the floor of ||x|| is measured in the window.

    Parameters
    ----------
    methods : ways to act, with the runs that they need.
    seeds : trained runs of each kind, with the seeds 0, 1, ...
    states, start_seed : number and seed of the initial states, which all methods share.
    tolerance : bound on ||x|| in the window for a trajectory that has settled.
    to_floor : baselines learn until they no longer improve, not for as many steps as ours.
    budget, patience : of that rule, where they are not `controllers.comparison.runs.RULES`'s.
    """

    methods: tuple[Method, ...] = BASELINES
    seeds: int = 5
    states: int = 50
    start_seed: int = 0
    duration: float = 20.0
    duration_steps: int = 1000
    tolerance: float = 1e-6
    to_floor: bool = False
    budget: int | None = None
    patience: int | None = None

    def __post_init__(self) -> None:
        Lengths.__post_init__(self)
        self.require_positive("seeds", "states", "tolerance")
        if self.start_seed < 0:
            raise OptionError(f"`start_seed` must be at least 0; found {self.start_seed}.")
