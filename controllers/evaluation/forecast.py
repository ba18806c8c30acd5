"""A forecast of the set that `certify roa` proves with a policy at effort 1, beside its box of initial states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from certify.analysis.candidates.economical import FEW_STATES, Forecast
from certify.analysis.stages.acceptance import operations_of_check
from certify.effort import WHOLE
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import SOLVED, ball_volume, choose_candidate, volume
from certify.provers.boxes.rule import operations_of_box

_MANY = 6  # states, beyond which boxes hardly count
_LOST = 0.5  # share of the effort for candidates and for boxes that are divided


@dataclass(frozen=True, slots=True)
class Forecasted:
    """The volume of that set, and its size: its mean half-axis relative to the box of initial states."""

    volume: float
    size: float


def forecast_of(network: PolicyNetwork, system: System, box: Sequence[float]) -> Forecasted | None:
    """The forecast for the best P that solves a Lyapunov equation; None in over six states, or if it is not stable.

    Parameters
    ----------
    box : half-widths (n,) of the box of initial states.

    Notes
    -----
    Only the policy's curvature is forecast: where it bends little, the plant decides, and less may be proved.
    """
    loop, n = ClosedLoop(system, network), system.n
    if n > _MANY:
        return None
    forecast = Forecast(loop, states=FEW_STATES)
    boxes = (1 - _LOST) * WHOLE / (operations_of_box(loop) + operations_of_check(loop))
    try:
        found = [choose_candidate(loop, name).P for name in SOLVED]
    except InputError:  # it is not stable
        return None
    largest = max(volume(P, forecast.level(P, boxes)) for P in found)
    return Forecasted(largest, float((largest / (ball_volume(n) * np.prod(box))) ** (1 / n)))
