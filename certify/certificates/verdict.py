"""The end of an attempt to prove a claim: the verdict, and the reason why the level is not higher.

An answer is never a bool: `if verdict:` would merge REFUTED with UNKNOWN, so `bool(verdict)` raises. An answer equals
its name. Comparing it with text that names no answer of its kind raises too: a slip such as `verdict == "proved"` must
not pass for "not proved", nor `verdict != "refuted"` for a proof.
"""

from __future__ import annotations

from enum import Enum
from typing import NoReturn


class Answer(Enum):
    """An answer with several values, such as a verdict: no bool, equal to itself and to its value as text.

    It hashes as that text does, so that the two are the same key.
    """

    def __bool__(self) -> NoReturn:
        known = ", ".join(repr(one.value) for one in type(self))
        raise TypeError(f"a {type(self).__name__} is no bool; compare it with one of its values: {known}.")

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, str):
            return self is other
        known = [one.value for one in type(self)]
        if other not in known:
            raise ValueError(
                f"a {type(self).__name__} must be compared with one of {', '.join(map(repr, known))}; "
                f"found {other!r:.60}."
            )
        return bool(self.value == other)

    def __hash__(self) -> int:
        return hash(self.value)


class Verdict(Answer):
    """Outcome of an attempt to prove a claim.

    PROVED: an independent checker accepted the written certificate.
    TRUSTED: a solver says so, and nobody can replay its answer.
    REFUTED: a condition of the claim fails for this V and level, shown in rigorous arithmetic; trajectories may still
    converge, and another V may show it.
    UNKNOWN: none of these; the reason names the limit that was reached.

    Examples
    --------
    >>> Verdict.PROVED == "PROVED", Verdict.UNKNOWN == "PROVED"
    (True, False)
    >>> Verdict.PROVED == "proved"
    Traceback (most recent call last):
        ...
    ValueError: a Verdict must be compared with one of 'PROVED', 'TRUSTED', 'REFUTED', 'UNKNOWN'; found 'proved'.
    """

    PROVED = "PROVED"
    TRUSTED = "TRUSTED"
    REFUTED = "REFUTED"
    UNKNOWN = "UNKNOWN"

    @property
    def exit_status(self) -> int:
        """Exit status of the command line: 0 proved, 1 refuted, 3 unknown or trusted."""
        return {Verdict.PROVED: 0, Verdict.REFUTED: 1}.get(self, 3)


class Stop(Enum):
    """The reason why a level is not higher, or why there is none; its value is the message, and details may follow."""

    REQUESTED = "requested"
    DOMAIN = "domain"
    MARGIN = "margin to the domain"
    WITNESS = "witness"
    INPUTS = "inputs"
    KEEP = "constraint"
    EFFORT = "effort"
    TIME = "time"
    STALLED = "nothing gained"
    REFUSED = "refused by the checker"
    BOXES = "boxes"
    SMALL = "boxes too small"
    CLUSTER = "the cluster went away"
    LOCAL = "local"
    FLOOR = "floor"
    SMOOTH = "smooth"
    PATH = "no tube from there"
    BEYOND = "the level of the function"
    SOLVER = "solver"
    SPECTRUM = "spectrum"
    UNSTABLE = "unstable linearisation"

    @property
    def ran_out(self) -> bool:
        """True if what was granted ended the search: its effort, or its time."""
        return self in (Stop.EFFORT, Stop.TIME)

    def explain(self, detail: str = "") -> str:
        """The message with its detail."""
        return f"{self.value}: {detail}" if detail else self.value
