"""Rule `local`: V falls on a ball that contains {V <= c1}, without a hole at the origin, for all that is uncertain.

Where the claim has a floor there is a hole: V falls where it is at least c0, and from below c0 it does not rise beyond.

What is uncertain has symbols in the values and gradients of the models, whose corners count; all else that it does to
them is taken in by their balls. These are wide where its range is wide, and so the ranges are cut into cells.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise, product

from flint import fmpq

from .decrease import contains, decreases, decreases_around, sound_multipliers, whatever_y
from .document import Certificate, Interval
from .evidence import Ball
from .fields import exact
from .flow import steps_on
from .keep import kept_on_ball
from .kinks import ALL, Cone
from .leaves import cut, structure
from .loop import Field, Loop
from .rational import identity
from .refusal import require


def local(loop: Loop, ball: Ball, parts: Sequence[int]) -> None:
    """Check the file's ball first, then rules `inputs`, `flow` and `keep`, then the decrease in each cell."""
    c: Certificate = loop.c
    sides = cones(ball.directions, c.n, "local")
    holds = contains(ball, c.P, exact(c.inner) * identity(c.n))
    require(holds, "local", "ball", "it does not contain {V <= c1}: J'PJ - c1 I is not positive definite")
    sound_multipliers(ball, "local", "ball")
    h, R, level = c.step, 2 * c.rate * c.P, c.floor
    short = h == 0 or exact(ball.edge) * h <= 1
    require(bool(short), "local", "ball", "the edge is beyond 1/h: V could rise above c0 from below")
    known = loop.known(ball.J, "local", "ball", cone=None if sides[0] is None else ALL)
    steps = steps_on(loop, known, ball, "ball")

    def falls(G: Field) -> bool:
        if level is None:
            return decreases(ball, c.P, R, G, h)
        return decreases_around(ball, c.P, R, G, h, exact(level))

    if c.keep is not None:
        kept_on_ball(steps, cells(c.plant.ranges, parts), "ball")
    words = "that V falls does not follow: the matrix that is left is not positive definite"
    for side, cone in enumerate(sides):
        where = f" cone {side}" if ball.directions else ""
        here = steps
        if cone not in (None, ALL):
            known = loop.on_cone(ball.J, cone, "local", f"ball{where}")
            here = steps_on(loop, known, ball, f"ball{where}", steps.within)
        for number, cell in enumerate(cells(c.plant.ranges, parts)):
            at = (f"cell {number}" if parts else "ball") + where
            require(whatever_y(here.change(cell, "local", at), falls, c.P), "local", at, words)


def cells(ranges: Sequence[Interval], parts: Sequence[int]) -> Iterator[tuple[Interval, ...]]:
    """The boxes that arise when each range is cut into its number of equal parts; without ranges one of no extent."""
    each = []
    for (lo, hi), count in zip(ranges, parts, strict=True):
        each.append(list(pairwise([lo + (hi - lo) * i / count for i in range(count + 1)])))  # exact: the last is hi
    yield from product(*each)


def cones(directions: Sequence[bytes] | None, n: int, rule: str) -> list[Cone | None]:
    """The cones of d that stand in the file, together all d; one of all d without trees, None without `directions`.

    A tree is over a face of the box |d_i| <= 1, and each of its boxes lies in its cone.
    """
    if not directions:
        return [None if directions is None else ALL]
    found = list[Cone | None]()
    for k, tree in enumerate(directions):
        axis, end = k // 2, 1.0 if k % 2 else -1.0
        structure(tree, [i for i in range(n) if i != axis], rule, f"directions {k} ")
        least, most = ([end if i == axis else v for i in range(n)] for v in (-1.0, 1.0))
        for box in cut(least, most, tree):
            centre = tuple((exact(a) + exact(b)) / 2 for a, b in zip(box.lo, box.hi, strict=True))
            known = all(exact(0.5 * a + 0.5 * b) == v for a, b, v in zip(box.lo, box.hi, centre, strict=True))
            require(known, rule, f"directions {k} leaf {box.number}", "its centre is not of binary64 numbers")
            square = sum((((exact(b) - exact(a)) / 2) ** 2 for a, b in zip(box.lo, box.hi, strict=True)), fmpq(0))
            found.append(Cone(centre, square))
    return found
