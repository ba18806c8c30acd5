"""The claim that has no V: from the leaves of a tree of boxes a region is reached, and nothing is said of later."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from certify.certificates.claims.claim import Ranks, require_few
from certify.errors import InputError
from certify.loop.expressions import Expression

MOST_TARGETS = 64


@dataclass(frozen=True, slots=True)
class Reaches:
    """Every trajectory from a leaf of finite rank is in the target after as many steps as the rank is, at the latest.

    In the target every expression of `target`, over the states, is at most 0. Until then g < 0 for each g of `keep`,
    expressions in states, inputs and uncertain quantities, inputs keep their bounds, and states but for angles are in
    the interior of the domain.

    Raises
    ------
    InputError : `target` or `keep` has too many expressions, or `target` none.
    """

    kind: ClassVar[str] = "reaches"
    levels: ClassVar[Mapping[str, float]] = {}
    target: tuple[Expression, ...]
    ranks: Ranks
    keep: tuple[Expression, ...] = ()

    def __post_init__(self) -> None:
        if not 1 <= len(self.target) <= MOST_TARGETS:
            raise InputError(f"`target` must have 1 to {MOST_TARGETS} expressions; found {len(self.target)}.")
        require_few(self.keep)
