"""Rule `local`: Vdot < 0 on a ball that contains {V <= c1}, without a hole at the origin, for all that is uncertain.

The matrix inequality has no symbol for an uncertain quantity; the models' balls take in what it does to them, so that
one inequality holds for all of its values. They are wide where its range is wide, and so the ranges are cut into cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, product

from flint import fmpq_mat

from .decrease import contains, decreases, sound_multipliers
from .document import Certificate, Interval
from .evidence import Ball
from .fields import exact
from .loop import Loop
from .rational import identity
from .refusal import require


def local(loop: Loop, ball: Ball, parts: Sequence[int]) -> None:
    """What the file says of the ball comes first, then rule `inputs` on it, and then what decreases, in each cell."""
    c: Certificate = loop.c
    holds = contains(ball, c.P, exact(c.inner) * identity(c.n))
    require(holds, "local", "ball", "it does not contain {V <= c1}: J'PJ - c1 I is not positive definite")
    sound_multipliers(ball, "local", "ball")
    known, still = loop.known(ball.J, "local", "ball"), fmpq_mat(c.n, c.n)
    for number, cell in enumerate(cells(c.plant.ranges, parts)):
        at = f"cell {number}" if parts else "ball"
        falls = decreases(ball, c.P, still, loop.within(known, cell, "local", at))
        require(falls, "local", at, "Vdot < 0 does not follow: the matrix that is left is not positive definite")


def cells(ranges: Sequence[Interval], parts: Sequence[int]) -> Iterator[tuple[Interval, ...]]:
    """The boxes that arise when each range is cut into its number of equal parts; without ranges one of no extent."""
    each = []
    for (lo, hi), count in zip(ranges, parts, strict=True):
        each.append(list(pairwise([lo + (hi - lo) * i / count for i in range(count + 1)])))  # exact: the last is hi
    yield from product(*each)
