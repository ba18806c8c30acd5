"""The claim about a set that is never left; nothing is said of where in it trajectories go, and no V is needed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from certify.certificates.claims.claim import MOST_KEPT, Outer, Ranks
from certify.errors import InputError
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
    outer: Outer
    keep: tuple[Expression, ...] = ()

    def __post_init__(self) -> None:
        if len(self.keep) > MOST_KEPT:
            raise InputError(f"`keep` must have at most {MOST_KEPT} expressions; found {len(self.keep)}.")

    @property
    def levels(self) -> Mapping[str, float]:
        """The section `levels` of the certificate: there are none."""
        return {}

    @property
    def ranks(self) -> Ranks | None:
        """None: nothing is said of boxes."""
        return None
