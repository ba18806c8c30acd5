"""The largest ellipsoid of a shape, or of several shapes, from which a tube leads into the certified set."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.engines.models import Paths
from certify.engines.tube import Tube, find_tube
from certify.lyapunov import domain_limit, volume

Array = NDArray[np.float64]
_FINE = 1.02  # ratio of sizes at which a search ends
_BELOW = 1 - 1e-9  # of the domain's limit, which the start may not reach
_FIRST = 1.6  # growth of the size from one try to the next, as long as tubes are found
_WORTH = 1.02  # of the best volume: what another shape must promise


@dataclass(frozen=True, slots=True)
class Enlarged:
    """A tube, and the name of the shape that it starts from."""

    tube: Tube
    shape: str

    @property
    def volume(self) -> float:
        """Of its start."""
        return volume(self.tube.start, 1.0)


def enlarge(
    known: Paths,
    goal: Array,
    shapes: Mapping[str, Array],
    left: Callable[[], float],
    worth: float = 0.0,
    report: Callable[[Enlarged], None] | None = None,
) -> Enlarged | None:
    """The tube with the largest start that the time allows; None if none starts outside the goal.

    Parameters
    ----------
    goal : (n, n), of {x'Px <= 1}, where tubes end.
    shapes : by name, each (n, n) up to a factor: of the ellipsoids that are tried.
    left : seconds that the search may still take; half of them go to each shape but the last.
    worth : the volume that a start must exceed.
    report : called with each that is better than those before.
    """
    best: Enlarged | None = None
    for number, (name, shape) in enumerate(shapes.items(), start=1):
        share = left() if number == len(shapes) else left() / 2
        end = time.perf_counter() + share
        for tube in _growing(known, goal, shape, worth if best is None else best.volume, end):
            best = Enlarged(tube, name)
            if report is not None:
                report(best)
    return best


def _growing(known: Paths, goal: Array, shape: Array, worth: float, end: float) -> Iterator[Tube]:
    """Tubes from larger and larger multiples of a shape, each of more volume than `worth`."""
    unit = shape * float(
        np.max(np.linalg.eigvals(np.linalg.solve(shape, goal)).real)
    )  # it touches the goal from inside
    most = math.sqrt(domain_limit(unit, known.loop.system.domain) * _BELOW)
    least = max(1.0, (_WORTH * worth / volume(unit, 1.0)) ** (1 / len(shape)))
    proved, refused = 1.0, most * _FINE
    size = least if worth > 0 else min(_FIRST, most)
    while time.perf_counter() < end and proved < size <= most:
        tube = find_tube(known, unit / size**2, goal, end - time.perf_counter())
        if tube is not None:
            proved = size
            yield tube
        elif worth > 0 and proved < least:
            return
        else:
            refused = size
        if refused <= _FINE * proved:
            return
        size = min(_FIRST * proved, most) if refused > most else math.sqrt(proved * refused)
