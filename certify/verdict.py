"""The four answers to a proof question.

A verdict is never a bool: a program that writes `if verdict:` has merged
REFUTED with UNKNOWN, or worse, so `bool(verdict)` raises.
"""

from __future__ import annotations

from enum import Enum
from typing import NoReturn


class Verdict(Enum):
    """Outcome of an attempt to prove a claim.

    PROVED: an independent checker accepted the written certificate.
    REFUTED: the claim is false for this V and level, shown in rigorous arithmetic.
    TRUSTED: a solver says so whose word nobody can replay; the checker checked the rest.
    UNKNOWN: none of these; the accompanying reason says what ran out.
    """

    PROVED = "PROVED"
    REFUTED = "REFUTED"
    TRUSTED = "TRUSTED"
    UNKNOWN = "UNKNOWN"

    def __bool__(self) -> NoReturn:
        raise TypeError("a Verdict has four values; compare it with `is`, do not use it as a bool.")

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 0 proved, 1 refuted, 3 unknown or trusted."""
        return {Verdict.PROVED: 0, Verdict.REFUTED: 1, Verdict.TRUSTED: 3, Verdict.UNKNOWN: 3}[self]
