"""Rule `tube`: ellipsoids {x'P(t)x <= 1} that no trajectory leaves, from `start` into {V <= c2}.

On a slab P(s) = (1 - s)^2 A + 2 s (1 - s) M + s^2 B runs from node A to node B by the middle M, and x'P(t)x falls along
every trajectory inside. What falls is for each x such a polynomial too, with three coefficients that are seen to be
negative; x'P(s)x <= 1 puts x into the ellipsoid of A, M or B. So these three stand for all that lies between.
"""

from __future__ import annotations

from itertools import pairwise

from flint import fmpq_mat

from .decrease import contains, decreases, sound_multipliers
from .document import Certificate
from .evidence import Slab
from .fields import exact
from .loop import Loop
from .rational import beyond_domain, identity, inverse_diagonal, positive_definite
from .refusal import require


def tube(loop: Loop, start: fmpq_mat, slabs: tuple[Slab, ...]) -> None:
    """Nodes first, numbered from 0, and middles, numbered as slabs are, from 1; then the slabs."""
    nodes = [start, *(slab.end for slab in slabs)]
    for k, P in enumerate(nodes):
        node(loop.c, P, f"node {k}")
    for k, slab in enumerate(slabs, 1):
        node(loop.c, slab.middle, f"middle {k}")
    inside = positive_definite(nodes[-1] - loop.c.P / exact(loop.c.outer))
    require(inside, "tube", f"node {len(slabs)}", "the last node does not lie in {V <= c2}")
    for k, (slab, (before, after)) in enumerate(zip(slabs, pairwise(nodes), strict=True), 1):
        passes(loop, before, after, slab, f"slab {k}")


def node(c: Certificate, P: fmpq_mat, at: str) -> None:
    """P is symmetric and positive definite, and {x'Px <= 1} lies in the interior of the domain."""
    left = beyond_domain(c, inverse_diagonal(P, "tube", at))
    require(left is None, "tube", at, f"the ellipsoid leaves the interior of the domain along {left}")


def passes(loop: Loop, before: fmpq_mat, after: fmpq_mat, slab: Slab, at: str) -> None:
    """x'P(s)x falls on the ellipsoids of a slab, whose inputs are within their bounds."""
    require(slab.duration > 0, "tube", at, f"the duration {slab.duration!r} is not positive")
    h, middle = exact(slab.duration), slab.middle
    pieces = (
        ("first", before, 2 * (middle - before) / h),
        ("middle", middle, (after - before) / h),
        ("last", after, 2 * (after - middle) / h),
    )
    for name, P, _ in pieces:
        holds = contains(slab.ball, P, identity(loop.c.n))
        require(holds, "tube", at, f"its ball does not contain its {name} ellipsoid: J'PJ - I is not positive definite")
    sound_multipliers(slab.ball, "tube", at)
    F = loop.on(slab.ball.J, "tube", at)
    for name, P, rate in pieces:
        falls = decreases(slab.ball, P, rate, F)
        require(falls, "tube", at, f"x'P(t)x does not certainly fall: the {name} coefficient")
