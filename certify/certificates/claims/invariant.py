"""The claims about sets that are never left; nothing is said of where in one trajectories go, and no V is needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from certify.certificates.claims.claim import Outer, Ranks, require_few
from certify.loop.expressions import Expression


@dataclass(frozen=True, slots=True)
class Invariant:
    """Every trajectory from a state of the domain with N <= n2, N and n2 those of `outer`, is in such a state at all
    times.

    Along it g < 0 for each g of `keep`, expressions in states, inputs and uncertain quantities, inputs keep their
    bounds, and the state is in the interior of the domain.

    Raises
    ------
    InputError : `keep` has too many expressions.
    """

    kind: ClassVar[str] = "invariant"
    levels: ClassVar[Mapping[str, float]] = {}
    ranks: ClassVar[Ranks | None] = None
    outer: Outer
    keep: tuple[Expression, ...] = ()

    def __post_init__(self) -> None:
        require_few(self.keep)


@dataclass(frozen=True, slots=True)
class Remains:
    """Every trajectory from a leaf of finite rank is in such a leaf again after `ranks.steps` steps at most, and so on
    for ever.

    Along it g < 0 for each g of `keep`, expressions in states, inputs and uncertain quantities, inputs keep their
    bounds, and states but for angles are in the interior of the domain.

    Raises
    ------
    InputError : `keep` has too many expressions.
    """

    kind: ClassVar[str] = "remains"
    levels: ClassVar[Mapping[str, float]] = {}
    outer: ClassVar[Outer | None] = None
    ranks: Ranks
    keep: tuple[Expression, ...] = ()

    def __post_init__(self) -> None:
        require_few(self.keep)
