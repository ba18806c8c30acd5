"""The options of distillation."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

from certify.errors import OptionError
from controllers.options import Activation, Centre


@dataclass(frozen=True, slots=True, kw_only=True)
class DistilOptions:
    """The options of a run of `distil`.

    Parameters
    ----------
    activation, hidden : the function between the new policy's layers, and its hidden widths.
    centre : its centring; None means `preactivation` for a policy that is squashed by tanh, else `output`.
    samples : states that are imitated.
    steps, batch, rate : gradient steps, states in each, and the first step of Adam relative to a layer's weights.
    states : initial states of the runs that compare the two policies.
    seed, threads : of everything random; of torch.

    Raises
    ------
    InputError : a value is out of its range; the message names it.
    """

    activation: Activation = "tanh"
    hidden: tuple[int, ...] = (32, 32)
    centre: Centre | None = None
    samples: int = 20_000
    steps: int = 3000
    batch: int = 512
    rate: float = 0.01
    states: int = 200
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("samples", "batch", "rate", "states", "threads"):
            self._require(name, 0 < getattr(self, name) < math.inf, "positive and finite")
        self._require("steps", self.steps >= 0, "at least 0")
        self._require("seed", 0 <= self.seed < 2**63, "at least 0 and below 2^63")
        self._require("hidden", bool(self.hidden) and all(w > 0 for w in self.hidden), "positive widths, at least one")
        self._require("activation", self.activation in get_args(Activation), f"one of {get_args(Activation)}")
        centres = get_args(Centre)
        self._require("centre", self.centre is None or self.centre in centres, f"one of {centres}")

    def _require(self, name: str, holds: bool, requirement: str) -> None:
        if not holds:
            raise OptionError(f"`{name}` must be {requirement}; found {getattr(self, name)!r}.")
