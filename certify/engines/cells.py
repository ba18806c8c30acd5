"""The local proof where quantities are uncertain: cell by cell of the box of their ranges, in floats.

A cell is small enough for one linearisation, whose distance from that of any other point of the cell is charged to the
decay as a norm. So the number of cells buys the size of the set; how many there are is chosen where the remainder is
nothing, at the origin.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.closed_loop import ClosedLoop
from certify.engines.decrease import NOT_SHOWN, Shown, best_multipliers, decay_of, rest_of
from certify.engines.models import Models, Paths
from certify.systems.system import Interval

Array = NDArray[np.float64]
_CAUTION = 2.0  # on what the corners of a cell differ by: a checker adds norms where these cancel
_MOST = 256  # cells
_ENOUGH = 0.5  # of the decay at the origin that the cells' extent may leave at least


@dataclass(frozen=True, slots=True)
class Cells:
    """The local models in each cell; `cuts` says how many parts each range is cut into."""

    known: Paths
    cuts: tuple[int, ...]

    def shown(self, J: Array, P: Array) -> Shown:
        """One choice of multipliers for all cells on the ball of J, and the least margin that it leaves in any."""
        each = [self._enclosed(J, cell) for cell in self._cells()]
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
        return max(float(sizes @ slack) for _, slack in (self._enclosed(J, cell) for cell in self._cells()))

    def _cells(self) -> Iterator[dict[str, Interval]]:
        ranges = self.known.loop.system.ranges
        cut = [
            [(lo + (hi - lo) * Fraction(i, count), lo + (hi - lo) * Fraction(i + 1, count)) for i in range(count)]
            for (lo, hi), count in zip(ranges.values(), self.cuts, strict=True)
        ]
        return (dict(zip(ranges, cell, strict=True)) for cell in itertools.product(*cut))

    def _enclosed(self, J: Array, cell: dict[str, Interval]) -> tuple[Models, Array]:
        """The models in the middle of a cell, wide enough for its corners, and the distance (n,) of the gradients."""
        middle = self._models(J, {name: (lo + hi) / 2 for name, (lo, hi) in cell.items()})
        slack, bend, wider = np.zeros(len(J)), np.zeros(len(J)), 1.0
        for sides in itertools.product((0, 1), repeat=len(cell)):
            corner = self._models(J, {name: ends[side] for (name, ends), side in zip(cell.items(), sides, strict=True)})
            slack = np.maximum(slack, np.linalg.norm(corner.A - middle.A, axis=1))
            bend = np.maximum(bend, np.linalg.norm(corner.Q - middle.Q, axis=(1, 2)))
            sizes = [float(np.einsum("iaa->", models.E)) for models in (corner, middle)]
            wider = max(wider, sizes[0] / sizes[1] if sizes[1] > 0 else 1.0)
        E = middle.E * (1 + _CAUTION * (wider - 1)) + _CAUTION * bend[:, None, None] * np.eye(J.shape[1])
        return replace(middle, E=E), _CAUTION * slack

    def _models(self, J: Array, values: dict[str, Fraction]) -> Models:
        loop = self.known.loop
        return replace(self.known, loop=ClosedLoop(loop.system.at(values), loop.network)).models(J)


def cells_for(known: Paths, J: Array, P: Array) -> Cells:
    """As few cells as leave enough of the decay near the origin; J (n, n) is of a ball, whose size does not matter."""
    ranges = known.loop.system.ranges
    cells, tiny = Cells(known, (1,) * len(ranges)), J * 1e-6
    while True:
        shown = cells.shown(tiny, P)
        if shown.margin > _ENOUGH or 2 * int(np.prod(cells.cuts)) > _MOST:
            return cells
        finer = [
            Cells(known, tuple(2 * c if i == j else c for j, c in enumerate(cells.cuts))) for i in range(len(ranges))
        ]
        cells = min(finer, key=lambda one: one.extent(tiny, P))
