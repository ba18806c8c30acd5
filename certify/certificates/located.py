"""Answers to the question whether a box of states lies in a proved set."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

from certify.certificates.verdict import Answer


class Containment(Answer):
    """The answer to: do all states of a box lie in a proved set?

    CONTAINED: all do. NOT_CONTAINED: some state does not. UNDECIDED: neither was shown.
    """

    CONTAINED = "contained"
    NOT_CONTAINED = "not contained"
    UNDECIDED = "undecided"

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 0 contained, 1 not contained, 3 undecided."""
        return {Containment.CONTAINED: 0, Containment.NOT_CONTAINED: 1}.get(self, 3)


@dataclass(frozen=True, slots=True)
class Located:
    """The location of a box: `within` names the set that contains it, or the sets that do so together; `outside` is a
    state of the box in none of them, (n,)."""

    answer: Containment
    within: str | None = None
    outside: tuple[Fraction, ...] | None = None
