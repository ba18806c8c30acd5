"""The local proof where quantities are uncertain: cell by cell of the box of their ranges, in floats.

A cell is small enough for one linearisation, whose distance from that of any other point of the cell is charged to the
decay as a norm. So the number of cells buys the size of the set; how many there are is chosen where the remainder is
nothing, at the origin.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache

import numpy as np
from numpy.typing import NDArray

from certify.closed_loop import ClosedLoop
from certify.engines.decrease import NOT_SHOWN, Shown, best_multipliers, decay_of, rest_of
from certify.engines.models import Models, Paths

Array = NDArray[np.float64]
_CAUTION = 2.0  # on what the corners of a cell differ by: a checker adds norms where these cancel
_MOST = 256  # cells
_ENOUGH = 0.5  # of the decay at the origin that the cells' extent may leave at least


@dataclass(frozen=True, slots=True)
class _Cell:
    """The loop in the middle of a cell, and at its corners."""

    middle: Paths
    corners: tuple[Paths, ...]

    def enclosed(self, J: Array) -> tuple[Models, Array]:
        """The models in the middle, wide enough for the corners, and the distance (n,) of the gradients."""
        middle = self.middle.models(J)
        slack, bend, wider = np.zeros(len(J)), np.zeros(len(J)), 1.0
        for corner in (paths.models(J) for paths in self.corners):
            slack = np.maximum(slack, np.linalg.norm(corner.A - middle.A, axis=1))
            bends = np.linalg.norm(corner.Q - middle.Q, axis=(1, 2))
            bends += np.linalg.norm((corner.K - middle.K).reshape(len(J), -1), axis=1)
            bends += np.abs(corner.shares - middle.shares) @ np.linalg.norm(middle.R, axis=(1, 2))
            bend = np.maximum(bend, bends)
            sizes = [float(np.einsum("iaa->", models.E)) for models in (corner, middle)]
            wider = max(wider, sizes[0] / sizes[1] if sizes[1] > 0 else 1.0)
        E = middle.E * (1 + _CAUTION * (wider - 1)) + _CAUTION * bend[:, None, None] * np.eye(J.shape[1])
        return replace(middle, E=E), _CAUTION * slack


@dataclass(frozen=True, slots=True)
class Cells:
    """The local models in each cell; `cuts` says how many parts each range is cut into."""

    cuts: tuple[int, ...]
    cells: tuple[_Cell, ...]

    def shown(self, J: Array, P: Array) -> Shown:
        """One choice of multipliers for all cells on the ball of J, and the least margin that it leaves in any."""
        each = [cell.enclosed(J) for cell in self.cells]
        if not all(models.finite and models.admitted for models, _ in each):
            return NOT_SHOWN
        inverse, b = np.linalg.inv(J), P @ J
        sizes = np.linalg.norm(b, axis=1)
        charged = [2 * float(sizes @ slack) * np.eye(len(J)) for _, slack in each]
        worst = int(np.argmax([np.trace(c) for c in charged]))
        found = best_multipliers(each[worst][0], J, P, inverse.T @ charged[worst] @ inverse)
        if not found.margin > 0:
            return NOT_SHOWN
        margins = []
        for (models, _), extra in zip(each, charged, strict=True):
            decay = decay_of(models, J, b) - extra
            try:
                root = np.linalg.inv(np.linalg.cholesky(decay))
            except np.linalg.LinAlgError:
                return NOT_SHOWN
            margins.append(1 - np.linalg.eigvalsh(root @ rest_of(models, b, found.multipliers) @ root.T)[-1])
        return Shown(found.multipliers, float(min(margins)))

    def extent(self, J: Array, P: Array) -> float:
        """What is charged to the decay in the worst cell."""
        sizes = np.linalg.norm(P @ J, axis=1)
        return max(float(sizes @ slack) for _, slack in (cell.enclosed(J) for cell in self.cells))


def _cut(known: Paths, cuts: tuple[int, ...]) -> Cells:
    ranges, loop = known.loop.system.ranges, known.loop
    cut = [
        [(lo + (hi - lo) * Fraction(i, count), lo + (hi - lo) * Fraction(i + 1, count)) for i in range(count)]
        for (lo, hi), count in zip(ranges.values(), cuts, strict=True)
    ]

    @cache
    def at(values: tuple[Fraction, ...]) -> Paths:
        system = loop.system.at(dict(zip(ranges, values, strict=True)))
        return replace(known, loop=ClosedLoop(system, loop.network))

    cells = []
    for cell in itertools.product(*cut):
        middle = at(tuple((lo + hi) / 2 for lo, hi in cell))
        cells.append(_Cell(middle, tuple(at(corner) for corner in itertools.product(*cell))))
    return Cells(cuts, tuple(cells))


def cells_for(known: Paths, J: Array, P: Array) -> Cells:
    """As few cells as leave enough of the decay near the origin; J (n, n) is of a ball, whose size does not matter."""
    ranges = known.loop.system.ranges
    cells, tiny = _cut(known, (1,) * len(ranges)), J * 1e-6
    while True:
        shown = cells.shown(tiny, P)
        if shown.margin > _ENOUGH or 2 * int(np.prod(cells.cuts)) > _MOST:
            return cells
        finer = [
            _cut(known, tuple(2 * c if i == j else c for j, c in enumerate(cells.cuts))) for i in range(len(ranges))
        ]
        cells = min(finer, key=lambda one: one.extent(tiny, P))
