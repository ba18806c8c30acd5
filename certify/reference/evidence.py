"""Rule `format` for the section `evidence`: what the rules are given so that they need not search.

Nothing here is believed: a ball that is too small, a multiplier that is negative or a duration of 0 has the form of a
certificate, and is refused by the rule that uses it.
"""

from __future__ import annotations

import re
from array import array
from dataclasses import dataclass
from typing import Any

from flint import fmpq_mat

from .fields import binary64, decoded, entries, keys, numbers, square
from .refusal import require

MAX_SLABS = 10**4
WORD = re.compile(r"[A-Za-z0-9_.+-]{1,80}")


@dataclass(frozen=True)
class Ball:
    """All x = J d with ||d|| <= 1, and the rows of multipliers with which `decrease` is decided on it."""

    J: fmpq_mat
    alpha: array[float]
    beta: array[float]
    g: array[float]


@dataclass(frozen=True)
class Slab:
    """From one node of a tube by `middle` to the next, `end`, in the time `duration`."""

    middle: fmpq_mat
    end: fmpq_mat
    duration: float
    ball: Ball


@dataclass(frozen=True)
class Tree:
    """Evidence that can be replayed. `ball` belongs to claims about the origin, `tube` to an enlarged one."""

    T: fmpq_mat
    root: array[float]
    tree: bytes
    ball: Ball | None
    tube: tuple[Slab, ...]


@dataclass(frozen=True)
class Trusted:
    """Evidence that cannot."""

    solver: str
    version: str


def read_evidence(value: Any, n: int, claim: str) -> Tree | Trusted:
    if isinstance(value, dict) and value.get("kind") == "trusted-solver":
        require(claim != "enlarged", "format", "evidence.kind", "an enlarged claim must be replayed")
        return read_trusted(value)
    evidence = keys(value, "evidence", "kind", "T", "root", "tree", "local", "tube")
    require(evidence["kind"] == "partition-tree", "format", "evidence.kind", "an unknown kind")
    T, root = square(evidence["T"], "evidence.T", n), numbers(evidence["root"], "evidence.root", n)
    tree = decoded(evidence["tree"], "evidence.tree")
    ball = None
    if claim == "practical":
        require(evidence["local"] is None, "format", "evidence.local", "null was expected: the claim has no ball")
    else:
        ball = read_ball(keys(evidence["local"], "evidence.local", "J", "multipliers"), "evidence.local", n)
    tube = entries(evidence["tube"], "evidence.tube")
    least, most = (1, MAX_SLABS) if claim == "enlarged" else (0, 0)
    fits = least <= len(tube) <= most
    require(fits, "format", "evidence.tube", f"{least} to {most} slabs are allowed with claim '{claim}'")
    return Tree(T, root, tree, ball, tuple(read_slab(v, f"evidence.tube.{k}", n) for k, v in enumerate(tube)))


def read_ball(value: dict[str, Any], at: str, n: int) -> Ball:
    rows = numbers(value["multipliers"], f"{at}.multipliers", 3 * n)
    return Ball(square(value["J"], f"{at}.J", n), rows[:n], rows[n : 2 * n], rows[2 * n :])


def read_slab(value: Any, at: str, n: int) -> Slab:
    slab = keys(value, at, "middle", "end", "duration", "J", "multipliers")
    duration = binary64(slab["duration"], f"{at}.duration")
    middle, end = (square(slab[key], f"{at}.{key}", n) for key in ("middle", "end"))
    return Slab(middle, end, duration, read_ball(slab, at, n))


def read_trusted(value: dict[str, Any]) -> Trusted:
    evidence = keys(value, "evidence", "kind", "solver", "version", "precision", "queries")
    positive = binary64(evidence["precision"], "evidence.precision") > 0
    require(positive, "format", "evidence.precision", "must be positive")
    queries = entries(evidence["queries"], "evidence.queries")
    said = [word for pair in queries for word in entries(pair, "evidence.queries", 2)]
    for word in (evidence["solver"], evidence["version"], *said):
        good = isinstance(word, str) and WORD.fullmatch(word) is not None
        require(good, "format", "evidence", "a word was expected")
    return Trusted(evidence["solver"], evidence["version"])
