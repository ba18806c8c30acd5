"""Rule `local`: V falls on a ball that contains {V <= c1}, without a hole at the origin, for all that is uncertain.

Where the claim has a floor there is a hole: V falls where it is at least c0, and from below c0 it does not rise beyond.

What is uncertain has symbols in the values and gradients of the models, whose corners count; all else that it does to
them is taken in by their balls. These are wide where its range is wide, and so the ranges are cut into cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, product

from .decrease import contains, decreases, decreases_around, sound_multipliers, whatever_y
from .document import Certificate, Interval
from .evidence import Ball
from .fields import exact
from .flow import steps_on
from .keep import kept_on_ball
from .loop import Field, Loop
from .rational import identity
from .refusal import require


def local(loop: Loop, ball: Ball, parts: Sequence[int]) -> None:
    """Check the file's ball first, then rules `inputs`, `flow` and `keep`, then the decrease in each cell."""
    c: Certificate = loop.c
    holds = contains(ball, c.P, exact(c.inner) * identity(c.n))
    require(holds, "local", "ball", "it does not contain {V <= c1}: J'PJ - c1 I is not positive definite")
    sound_multipliers(ball, "local", "ball")
    h, R, level = c.step, 2 * c.rate * c.P, c.floor
    short = h == 0 or exact(ball.edge) * h <= 1
    require(bool(short), "local", "ball", "the edge is beyond 1/h: V could rise above c0 from below")
    steps = steps_on(loop, loop.known(ball.J, "local", "ball"), ball, "ball")

    def falls(G: Field) -> bool:
        if level is None:
            return decreases(ball, c.P, R, G, h)
        return decreases_around(ball, c.P, R, G, h, exact(level))

    if c.keep is not None:
        kept_on_ball(steps, cells(c.plant.ranges, parts), "ball")
    for number, cell in enumerate(cells(c.plant.ranges, parts)):
        at = f"cell {number}" if parts else "ball"
        everywhere = whatever_y(steps.change(cell, "local", at), falls, c.P)
        require(
            everywhere, "local", at, "that V falls does not follow: the matrix that is left is not positive definite"
        )


def cells(ranges: Sequence[Interval], parts: Sequence[int]) -> Iterator[tuple[Interval, ...]]:
    """The boxes that arise when each range is cut into its number of equal parts; without ranges one of no extent."""
    each = []
    for (lo, hi), count in zip(ranges, parts, strict=True):
        each.append(list(pairwise([lo + (hi - lo) * i / count for i in range(count + 1)])))  # exact: the last is hi
    yield from product(*each)
