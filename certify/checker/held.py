"""The ball of `contraction` where inputs are held: G of two states, which come closer with every period.

The rule needs two bounds for a period: where the state is, as rule `flow` has it, and how fast that changes with the
state at the beginning. The second is a Lipschitz constant of phi - x over d, which the same iteration shows; with it
the last coefficient of the series has one too.
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
