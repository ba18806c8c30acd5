"""The options of flattening."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from certify.errors import OptionError

Gain = Literal["kept", "lqr"]
Curvature = Literal["removed", "kept"]


@dataclass(frozen=True, slots=True, kw_only=True)
class FlattenOptions:
    """The options of a run of `flatten`.

    Parameters
    ----------
    weight : of the departure beside the fit; 1 says that hidden units which could add as much as the linear part count
        like an input that is off by as much as it is large.
    curvature : `removed` lowers the departure; `kept` lowers the cost of runs and the boxes that the proof of a set is
        forecast to take, and counts four of the steps as one.
    volume : of that set; None means that of the ellipsoid whose half-axes are twice those of the box.
    distance : from the saturated linear feedback of the policy's own gain, root mean square on the plant's box of
        initial states, relative to that feedback's own change, which curvature that is kept must have at least.
    box : half-widths (n,) of the box on which the departure is taken; None means the plant's box of initial states.
    steps, batch, rate : gradient steps, states in each, and the first step of Adam relative to a layer's weights.
    time_limit : seconds after which no more gradient steps are taken, those before them included.
    max_cost_change : bound on the relative rise of the median cost; a fall is no harm.
    states : initial states of the runs that judge a policy.
    gain : the Jacobian at 0 that is aimed at: `kept` is the policy's own, `lqr` that of the LQR at the time step of the
        runs that judge, in discrete time the plant's own.
    Q, R : diagonals (n,) and (m,) of the LQR's weights, for `gain` "lqr"; None means those of the runs that judge.
    seed, threads : of everything random; of torch.

    Raises
    ------
    InputError : a number is out of its range; the message names it.
    """

    weight: float = 1.0
    curvature: Curvature = "removed"
    volume: float | None = None
    distance: float = 0.0
    box: tuple[float, ...] | None = None
    steps: int = 2000
    batch: int = 512
    rate: float = 0.01
    time_limit: float = 600.0
    max_cost_change: float = 0.05
    states: int = 200
    gain: Gain = "kept"
    Q: tuple[float, ...] | None = None
    R: tuple[float, ...] | None = None
    seed: int = 0
    threads: int = 1

    def __post_init__(self) -> None:
        for name in ("weight", "batch", "rate", "time_limit", "states", "threads"):
            self._require(name, 0 < getattr(self, name) < math.inf, "positive and finite")
        for name in ("steps", "max_cost_change", "distance"):
            self._require(name, 0 <= getattr(self, name) < math.inf, "at least 0 and finite")
        self._require("seed", 0 <= self.seed < 2**63, "at least 0 and below 2^63")
        self._require("gain", self.gain in get_args(Gain), f"one of {get_args(Gain)}")
        self._require("curvature", self.curvature in get_args(Curvature), f"one of {get_args(Curvature)}")
        if self.volume is not None:
            self._require("volume", 0 < self.volume < math.inf, "positive and finite")
            self._require("volume", self.curvature == "kept", 'left out unless `curvature` is "kept"')
        self._require(
            "distance", not self.distance or self.curvature == "kept", 'left out unless `curvature` is "kept"'
        )
        if self.box is not None:
            self._require("box", all(0 < width < math.inf for width in self.box), "positive and finite half-widths")
        for name, weights in (("Q", self.Q), ("R", self.R)):
            if weights is not None:
                self._require(name, all(0 < weight < math.inf for weight in weights), "positive and finite weights")
                self._require(name, self.gain == "lqr", 'left out unless `gain` is "lqr", whose weights these are')

    def _require(self, name: str, holds: bool, requirement: str) -> None:
        if not holds:
            raise OptionError(f"`{name}` must be {requirement}; found {getattr(self, name)!r}.")
