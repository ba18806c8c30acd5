"""The box of ranges cut into cells, in each of which the models are affine in the uncertain quantities.

One cell is enough, whatever its extent, if the gradients of F move in a straight line with the uncertain quantities.
Their departure from that line is charged to the decay as a norm, and cells make it small. Their number is chosen at the
origin, where the terms of higher order vanish.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants.system import Interval
from certify.provers.ball.decrease import corners_of
from certify.provers.ball.models import meets_corner
from certify.provers.ball.steps import Cell, Steps

Array = NDArray[np.float64]
_MOST = 64  # cells
_FEW = 8  # cells that do not show anything at the origin: then more will not
_ENOUGH = 0.9  # share of the decay at the origin that the gradients' departures have to leave
_NO_SLACK = 1e-12  # share of the decay
_WORTH = 0.01  # share of the decay that twice the cells have to gain


def cut(ranges: list[Interval], cuts: tuple[int, ...]) -> list[Cell]:
    """The cells, each range being cut into so many equal parts; one without extent where there is no range."""
    parts = [
        [(lo + (hi - lo) * Fraction(i, count), lo + (hi - lo) * Fraction(i + 1, count)) for i in range(count)]
        for (lo, hi), count in zip(ranges, cuts, strict=True)
    ]
    return list(itertools.product(*parts))


def cuts_for(steps: Steps, J: Array, P: Array, R: Array | None) -> tuple[int, ...] | None:
    """As few as leave enough of the decay near the origin; None if no ball can show anything, however small.

    J (n, n) is of a ball, whose size does not matter.
    """
    ranges = list(steps.known.loop.system.ranges.values())
    cuts, tiny = (1,) * len(ranges), J * 1e-6
    if steps.is_plain or meets_corner(steps.known):  # a look at the origin saves less than it takes
        return cuts
    left = _left(steps, tiny, P, R, cuts)
    if left is None:
        return None
    while ranges and left < _ENOUGH and 2 * int(np.prod(cuts)) <= _MOST:
        finer = [tuple(2 * c if i == j else c for j, c in enumerate(cuts)) for i in range(len(ranges))]
        found, best = max((_left(steps, tiny, P, R, one) or -np.inf, one) for one in finer)
        hopeless = int(np.prod(cuts)) >= _FEW if found == -np.inf else left > 0 and not found > left + _WORTH
        if hopeless:
            break
        left, cuts = found, best
    return cuts if left > 0 else None


def _left(steps: Steps, J: Array, P: Array, R: Array | None, cuts: tuple[int, ...]) -> float | None:
    """The least share of the decay, in any cell and direction, that the gradients' slack leaves; what the values at the
    origin are does not count. None if a corner has no decay, and no slack that cells could make smaller."""
    least = 1.0
    for models in steps.models(J, cut(list(steps.known.loop.system.ranges.values()), cuts), np.zeros(len(J))):
        if not models.finite:
            return -np.inf
        nothing, spread = np.zeros_like(models.f), models.spread
        if spread is not None:
            spread = replace(spread, moves=np.zeros_like(spread.moves), error=nothing)
        for corner in corners_of(replace(models, f=nothing, spread=spread), J, P, R, steps.longest):
            slack = nothing if spread is None else spread.slack
            charge = 2 * float(np.linalg.norm(corner.b, axis=1) @ slack)
            values = np.linalg.eigvalsh(corner.decay + charge * np.eye(len(J)))
            if values[0] <= 0 and charge <= _NO_SLACK * float(np.max(np.abs(values))):
                return None
            least = min(least, 1 - charge / float(values[0]) if values[0] > 0 else -np.inf)
    return least
