"""How an attempt to prove a claim ends: the verdict, and what stopped the level from being higher.

A verdict is never a bool: a program that writes `if verdict:` has merged REFUTED with UNKNOWN, or worse, so
`bool(verdict)` raises.
"""

from __future__ import annotations

from enum import Enum
from typing import NoReturn


class Verdict(Enum):
    """Outcome of an attempt to prove a claim.

    PROVED: an independent checker accepted the written certificate.
    TRUSTED: a solver says so, and nobody can replay its word.
    REFUTED: a condition of the claim fails for this V and level, shown in rigorous arithmetic; trajectories may behave
        all the same, and another V may show it.
    UNKNOWN: none of these; the accompanying reason says what ran out.
    """

    PROVED = "PROVED"
    TRUSTED = "TRUSTED"
    REFUTED = "REFUTED"
    UNKNOWN = "UNKNOWN"

    def __bool__(self) -> NoReturn:
        raise TypeError("a Verdict has four values; compare it with `is`, do not use it as a bool.")

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 0 proved, 1 refuted, 3 unknown or trusted."""
        return {Verdict.PROVED: 0, Verdict.REFUTED: 1}.get(self, 3)


class Stop(Enum):
    """What limits a level, or why there is none; the value is the message, and details may follow it."""

    REQUESTED = "requested"
    DOMAIN = "domain"
    MARGIN = "margin to the domain"
    WITNESS = "witness"
    INPUTS = "inputs"
    TIME = "time"
    STALLED = "nothing gained"
    REFUSED = "refused by the checker"
    BOXES = "boxes"
    CLUSTER = "the cluster went away"
    LOCAL = "local"
    FLOOR = "floor"
    SMOOTH = "smooth"
    PATH = "no tube from that state"
    BEYOND = "the level of the function"
    SOLVER = "solver"
    SPECTRUM = "spectrum"
    UNSTABLE = "unstable linearisation"

    def explain(self, detail: str = "") -> str:
        """The message with its detail."""
        return f"{self.value}: {detail}" if detail else self.value
