"""The local proof where quantities are uncertain: cell by cell of the box of their ranges, in floats.

A cell is small enough for one linearisation, whose distance from that of any other point of the cell is charged to the
decay as a norm. So the number of cells buys the size of the set; how many there are is chosen where the remainder is
nothing, at the origin.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import sympy
from numpy.typing import NDArray

from certify.engines.decrease import NOT_SHOWN, Shown, best_multipliers, decay_of, rest_of
from certify.engines.models import Models, Paths

Array = NDArray[np.float64]
_CAUTION = 2.0  # on what the corners of a cell differ by: a checker adds norms where these cancel
_MOST = 64  # cells
_ENOUGH = 0.5  # of the decay at the origin that the cells' extent may leave at least


@dataclass(frozen=True, slots=True)
class _Cell:
    """Which of the plants is the one in the middle of a cell, and which those at its corners."""

    middle: int
    corners: tuple[int, ...]

    def enclosed(self, models: Sequence[Models]) -> tuple[Models, Array]:
        """The models in the middle, wide enough for the corners, and the distance (n,) of the gradients."""
        middle, n = models[self.middle], len(models[0].A)
        slack, bend, wider = np.zeros(n), np.zeros(n), 1.0
        for corner in (models[number] for number in self.corners):
            slack = np.maximum(slack, np.linalg.norm(corner.A - middle.A, axis=1))
            bends = np.linalg.norm(corner.Q - middle.Q, axis=(1, 2))
            bends += np.linalg.norm((corner.K - middle.K).reshape(n, -1), axis=1)
            bends += np.abs(corner.shares - middle.shares) @ np.linalg.norm(middle.R, axis=(1, 2))
            bend = np.maximum(bend, bends)
            sizes = [float(np.einsum("iaa->", one.E)) for one in (corner, middle)]
            wider = max(wider, sizes[0] / sizes[1] if sizes[1] > 0 else 1.0)
        E = middle.E * (1 + _CAUTION * (wider - 1)) + _CAUTION * bend[:, None, None] * np.eye(middle.E.shape[1])
        return replace(middle, E=E), _CAUTION * slack


@dataclass(frozen=True, slots=True)
class Cells:
    """The local models in each cell; `cuts` says how many parts each range is cut into."""

    known: Paths
    cuts: tuple[int, ...]
    plants: tuple[tuple[sympy.Expr, ...], ...]
    cells: tuple[_Cell, ...]

    def shown(self, J: Array, P: Array) -> Shown:
        """One choice of multipliers for all cells on the ball of J, and the least margin that it leaves in any."""
        each = self._enclosed(J)
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
        return max(float(sizes @ slack) for _, slack in self._enclosed(J))

    def _enclosed(self, J: Array) -> list[tuple[Models, Array]]:
        models = self.known.models_of(J, self.plants)
        return [cell.enclosed(models) for cell in self.cells]


def _cut(known: Paths, cuts: tuple[int, ...]) -> Cells:
    ranges, loop = known.loop.system.ranges, known.loop
    cut = [
        [(lo + (hi - lo) * Fraction(i, count), lo + (hi - lo) * Fraction(i + 1, count)) for i in range(count)]
        for (lo, hi), count in zip(ranges.values(), cuts, strict=True)
    ]

    places: dict[tuple[Fraction, ...], int] = {}

    def at(values: tuple[Fraction, ...]) -> int:
        return places.setdefault(values, len(places))

    cells = tuple(
        _Cell(at(tuple((lo + hi) / 2 for lo, hi in cell)), tuple(at(corner) for corner in itertools.product(*cell)))
        for cell in itertools.product(*cut)
    )
    uncertain, dynamics = [s for s, _ in loop.system.uncertain], loop.system.uncertain_dynamics()
    held = ({s: sympy.Rational(*q.as_integer_ratio()) for s, q in zip(uncertain, v, strict=True)} for v in places)
    return Cells(known, cuts, tuple(tuple(e.subs(values) for e in dynamics) for values in held), cells)


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
