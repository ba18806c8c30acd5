"""Rule `tube`: ellipsoids {(x - c(t))'P(t)(x - c(t)) <= 1} that no trajectory leaves, from `start` into {V <= c2}.

On a slab P(s) = (1 - s)^2 A + 2 s (1 - s) M + s^2 B runs from node A to node B by the middle M. Under `enlarged` c is
0, and x'P(t)x falls along every trajectory inside. Under `reached` c runs in a straight line from the centre of one
node to that of the next, and e'P(t)e, e = x - c(t), falls where it is 1. For each e, at each place of the path, the
derivative is such a polynomial in s too, with three coefficients that are seen to be negative. Along a path they are
those of the derivative plus edge (e'P(s)e - 1), with the same edge in all three: that a single e'Ae, e'Me or e'Be is 1
is not asked. e'P(s)e <= 1 puts e into the ellipsoid of A, M or B. So these three stand for all that lies between.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise

from flint import arb, fmpq, fmpq_mat

from .decrease import contains, decreases, decreases_along, sound_multipliers, whatever_y
from .document import Certificate, Interval
from .evidence import Path, Slab, Tree
from .fields import exact
from .flow import Steps
from .keep import kept_on_ball
from .local import cells
from .loop import Field, Known, Loop
from .rational import beyond_domain, identity, inverse_diagonal, positive_definite, root_above
from .refusal import require

Cells = Sequence[Sequence[Interval]]
Ends = tuple[fmpq_mat, fmpq_mat]  # of a slab: what belongs to the node before, and to the node after


def tube(loop: Loop, start: fmpq_mat, centre: fmpq_mat | None, evidence: Tree) -> None:
    """Nodes first, numbered from 0, and middles, numbered as slabs are, from 1; then the slabs."""
    slabs = evidence.tube
    c, nodes, origin = loop.c, [start, *(slab.end for slab in slabs)], fmpq_mat(loop.c.n, 1)
    centres = [origin if centre is None else centre]
    centres += [origin if slab.path is None else slab.path.centre for slab in slabs]
    for k, P in enumerate(nodes):
        node(c, P, centres[max(k - 1, 0) : k + 2], f"node {k}")
    for k, slab in enumerate(slabs, 1):
        node(c, slab.middle, centres[k - 1 : k + 1], f"middle {k}")
    inside = ends_inside(c, nodes[-1], centres[-1])
    require(inside, "tube", f"node {len(slabs)}", "the last node does not lie in {V <= c2}")
    for k, (slab, ends, path) in enumerate(zip(slabs, pairwise(nodes), pairwise(centres), strict=True), 1):
        passes(loop, slab, ends, path, f"slab {k}", evidence.cells)


def node(c: Certificate, P: fmpq_mat, centres: Sequence[fmpq_mat], at: str) -> None:
    """P is symmetric and positive definite, and {e'Pe <= 1} lies in the interior of the domain around each centre.

    The centres are those of the slabs that P belongs to: their ellipsoids may be as wide as this one all along.
    """
    largest = inverse_diagonal(P, "tube", at)
    for centre in centres:
        left = beyond_domain(c, largest, centre)
        require(left is None, "tube", at, f"the ellipsoid leaves the interior of the domain along {left}")


def ends_inside(c: Certificate, P: fmpq_mat, centre: fmpq_mat) -> bool:
    """True if {(x - centre)'P(x - centre) <= 1} lies in {V <= c2}, by the triangle inequality for the root of V.

    r bounds that of V(centre) / c2, and 1 - r that of V(x - centre) / c2, where P - c.P / (c2 (1 - r)^2) is definite.
    """
    c2 = exact(c.outer)
    r = root_above((centre.transpose() * c.P * centre)[0, 0] / c2)
    return bool(r < 1) and positive_definite(P - c.P / (c2 * (1 - r) ** 2))


def passes(loop: Loop, slab: Slab, nodes: Ends, centres: Ends, at: str, parts: Sequence[int]) -> None:
    """e'P(s)e falls on the ellipsoids of a slab, whose inputs are within their bounds, whatever is uncertain does."""
    require(slab.duration > 0, "tube", at, f"the duration {slab.duration!r} is not positive")
    h, middle, (before, after) = exact(slab.duration), slab.middle, nodes
    pieces = (
        ("first", before, 2 * (middle - before) / h),
        ("middle", middle, (after - before) / h),
        ("last", after, 2 * (after - middle) / h),
    )
    level = fmpq(1) if slab.path is None else 1 / (1 - share_of(slab.path, at) ** 2)
    form = "J'PJ - I" if slab.path is None else "J'PJ - I / (1 - share^2)"
    for name, P, _ in pieces:
        holds = contains(slab.ball, P, level * identity(loop.c.n))
        require(holds, "tube", at, f"its ball does not contain its {name} ellipsoid: {form} is not positive definite")
    sound_multipliers(slab.ball, "tube", at)
    boxes = [*cells(loop.c.plant.ranges, parts)]
    if slab.path is not None:
        none_negative = slab.path.edge >= 0 and slab.path.motion >= 0
        require(none_negative, "tube", at, "a multiplier of the path is negative")
        F = relative(loop, slab, slab.path, centres, at)
        for name, P, rate in pieces:
            falls = decreases_along(slab.ball, slab.path, P, rate, F)
            require(falls, "tube", at, f"e'P(t)e does not certainly fall: the {name} coefficient")
        return
    known = kept(loop, slab.ball.J, at, boxes)
    for cell in boxes:
        F = loop.within(known, cell, "tube", at)
        for name, P, rate in pieces:
            falls = whatever_y(F, partial(decreases, slab.ball, P, rate), loop.c.P)
            require(falls, "tube", at, f"x'P(t)x does not certainly fall: the {name} coefficient")


def share_of(path: Path, at: str) -> fmpq:
    """rho: |sigma| <= rho on the path, so that what is left of the ball for the ellipsoids is ||z||^2 <= 1 - rho^2."""
    require(0 < path.share < 1, "tube", at, f"the share {path.share!r} does not lie between 0 and 1")
    return exact(path.share)


def kept(loop: Loop, J: fmpq_mat, at: str, boxes: Cells, centre: fmpq_mat | None = None) -> Known:
    """States and inputs on the ball of a slab, after rules `inputs` and `keep`."""
    known = loop.known(J, "tube", at, centre)
    kept_on_ball(Steps(loop, known), boxes, at)
    return known


def relative(loop: Loop, slab: Slab, path: Path, centres: Ends, at: str) -> Field:
    """F less the velocity of the path, where x = m + J z + w sigma; m is half-way, and m +- share w are the centres."""
    before, after = centres
    step = after - before
    J = [[*row, w] for row, w in zip(slab.ball.J.tolist(), (step / (2 * exact(path.share))).entries(), strict=True)]
    known = kept(loop, fmpq_mat(J), at, [()], (before + after) / 2)
    F = loop.within(known, (), "tube", at)
    velocity = (step / exact(slab.duration)).entries()
    return replace(F, components=[f.shifted(arb(-v)) for f, v in zip(F.components, velocity, strict=True)])
