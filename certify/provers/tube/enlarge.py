"""The largest ellipsoid of a shape, or of several shapes, from which a tube leads into the certified set: around the
origin, or around a state."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov import domain_limit, volume
from certify.provers.tube.path import find_path
from certify.provers.tube.tube import Around, Tube, find_tube

Array = NDArray[np.float64]
_FINE = 1.02  # ratio of sizes at which a search ends
_BELOW = 1 - 1e-9  # share of the domain's limit, which the start may not reach
_FIRST = 1.6  # growth of the size from one try to the next, as long as tubes are found
_NARROW = 1e-6  # share of the largest size in the domain below which no tube around a state is tried
_TRIED, _SHORTER = 0.1, 0.2  # shares: of that size, the first; of a refused size, the next as long as none is found
_WORTH = 1.02  # factor of the best volume that another shape must promise


@dataclass(frozen=True, slots=True)
class Found:
    """A tube, and the name of the shape that it starts from."""

    tube: Tube
    shape: str

    @property
    def volume(self) -> float:
        """The volume of its start."""
        return volume(self.tube.start, 1.0)


def enlarge(
    known: Around,
    goal: Array,
    shapes: Mapping[str, Array],
    effort: Effort,
    worth: float = 0.0,
    report: Callable[[Found], None] | None = None,
) -> Found | None:
    """The tube with the largest start that the effort allows; None if none starts outside the goal.

    Parameters
    ----------
    goal : (n, n), of {x'Px <= 1}, where tubes end.
    shapes : by name, each (n, n) up to a factor: of the ellipsoids that are tried.
    effort : of what is left of it half goes to each shape but the last.
    worth : the volume that a start must exceed.
    report : called with each that is better than those before.
    """
    best: Found | None = None
    for number, (name, shape) in enumerate(shapes.items(), start=1):
        share = effort.share(1.0 if number == len(shapes) else 0.5)
        for tube in _growing(known, goal, shape, worth if best is None else best.volume, share):
            best = Found(tube, name)
            if report is not None:
                report(best)
    return best


def _growing(known: Around, goal: Array, shape: Array, worth: float, effort: Effort) -> Iterator[Tube]:
    """Tubes from larger and larger multiples of a shape, each of more volume than `worth`."""
    unit = shape * float(
        np.max(np.linalg.eigvals(np.linalg.solve(shape, goal)).real)
    )  # it touches the goal from inside
    most = math.sqrt(domain_limit(unit, known.loop.system.domain) * _BELOW)
    least = max(1.0, (_WORTH * worth / volume(unit, 1.0)) ** (1 / len(shape)))
    proved, refused = 1.0, most * _FINE
    size = least if worth > 0 else min(_FIRST, most)
    while not effort.over and proved < size <= most:
        tube = find_tube(known, unit / size**2, goal, effort)
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


def surround(
    loop: ClosedLoop, centre: Array, goal: Array, shapes: Mapping[str, Array], effort: Effort
) -> tuple[Found | None, str]:
    """The tube with the largest start around a state that the effort allows; None, and why, if there is none.

    Parameters
    ----------
    centre : (n,), in the interior of the domain.
    goal, shapes, effort : see `enlarge`.
    """
    best: Found | None = None
    why = ""
    each = zip(centre, loop.system.domain, strict=True)
    around = [(lo - Fraction(float(c)), hi - Fraction(float(c))) for c, (lo, hi) in each]
    for number, (name, shape) in enumerate(shapes.items(), start=1):
        share = effort.share(1.0 if number == len(shapes) else 0.5)
        unit = shape / (domain_limit(shape, around) * _BELOW)  # the largest in the domain
        proved, refused, size = 0.0, 1.0, _TRIED
        if best is not None:
            size = (_WORTH * best.volume / volume(unit, 1.0)) ** (1 / len(shape))
        while not share.over and _NARROW < size < 1 and refused > _FINE * proved:
            tube, said = find_path(loop, centre, unit / size**2, goal, share)
            if tube is not None:
                best, proved = Found(tube, name), size
            elif proved or best is None:
                refused, why = size, why if why and share.over else said  # what ended the search says little
            else:
                break
            size = min(_FIRST * proved, math.sqrt(proved * refused)) if proved else _SHORTER * size
    return best, why
