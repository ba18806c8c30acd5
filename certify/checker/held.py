"""The ball of `contraction` where inputs are held: G of two states, which come closer with every period.

Beside where a state is during a period it takes how fast that changes with the state at its beginning: phi - x has a
Lipschitz constant over d, shown as the a-priori enclosure is. With it the last coefficient of the series has one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from .contraction import Contracted
from .document import Intervals
from .flow import Held, Way
from .jets import Jet
from .near import Above


@dataclass(frozen=True)
class HeldClose(Contracted, Held):  # type: ignore[misc]  # it is made by `of` of the first
    """Quantities are constant, and so may be any numbers of their ranges in all coefficients but the first."""

    @property
    def order(self) -> int:
        return self.by.order

    def during(self, way: Way) -> list[Jet]:
        """The way along d bounds the Lipschitz constant of what moves, and so its size over ||d|| beyond d = 0."""
        return [replace(x, lip=Above(along)) for x, along in zip(super().during(way), way[1], strict=True)]

    def steepness(self, f: Jet) -> Above:
        """A Lipschitz constant over d."""
        return f.gradient.size + f.beyond[1]

    def change(self, cell: Intervals = ()) -> list[Jet]:
        """G; nothing where no enclosure is found."""
        return self.G(cell) or []
