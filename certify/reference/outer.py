"""Rules `faces`, `outer` and `inputs` of a claim that goes beyond {V <= c2} by a set {N <= n2} of another function.

N is above n2 all over the boundary of the domain, so that no trajectory gets out where N is at most n2. On the leaves
of a tree over all of the domain N falls along F wherever it is at most n2 and V at least c2: there is no other way out
of the one set than into the other.
"""

from __future__ import annotations

import math
from fractions import Fraction

from flint import arb, arb_mat, fmpq, fmpq_mat

from .balls import ZERO, total
from .batches import in_batches
from .document import Certificate
from .evidence import Covering, Tree
from .fields import exact
from .function import Models
from .keep import kept
from .leaves import Box, Leaf, Leaves, boxes, cut, structure
from .refusal import Refused, require, under
from .taylor import Taylor, is_negative

RULE, FACES = "outer", "faces"


def outer(c: Certificate, evidence: Tree, jobs: int) -> None:
    """Faces in their order, then T and the root, then the whole tree, then its leaves."""
    covering = evidence.covering
    if covering is None:
        raise Refused("format", "evidence.outer", "the claim needs a tree over the domain")
    check_leaves(c, covered(c, covering), covering, jobs)


def covered(c: Certificate, covering: Covering) -> Models:
    """The rules before those for leaves; returns the function."""
    if c.beyond is None:
        raise Refused("format", "claim.outer", "the claim needs a second function")
    models = Models(c.beyond, c.plant.states)
    for k, tree in enumerate(covering.faces):
        face(c, models, k, tree)
    covers_domain(c, covering)
    structure(covering.tree, range(c.n), RULE)
    return models


# ------------------------------------------------------------------------------------------------------------ the faces


def face(c: Certificate, models: Models, k: int, tree: bytes) -> None:
    """N is above its level on the k-th face, where a state is at one end of its domain, and the others anywhere."""
    axis, upper = divmod(k, 2)
    at = f"face {k}"
    axes = [i for i in range(c.n) if i != axis]
    structure(tree, axes, FACES, f"{at} ")
    least, most = [0.0] * c.n, [0.0] * c.n
    for i in axes:
        lo, hi = c.plant.domain[i]
        least[i], most[i] = -binary64_above(-lo, at), binary64_above(hi, at)
    fixed = Taylor(arb(c.plant.domain[axis][upper]))
    for box in cut(least, most, tree):
        centre, radius = middles(box)
        x = [
            Taylor(v, arb_mat(1, c.n, [r if j == i else ZERO for j in range(c.n)]))
            for i, (v, r) in enumerate(zip(centre, radius, strict=True))
        ]
        x[axis] = fixed
        place = f"{at} leaf {box.number}"
        with under(FACES, place):
            above = models.is_above(x)
        require(above, FACES, place, "N is not certain to be above its level")


def binary64_above(value: fmpq, at: str) -> float:
    """The least number of binary64 at or above a rational, or a refusal if there is none."""
    try:
        nearest = float(Fraction(int(value.p), int(value.q)))
    except OverflowError:
        nearest = math.inf
    above = nearest if not math.isfinite(nearest) or exact(nearest) >= value else math.nextafter(nearest, math.inf)
    require(math.isfinite(above), FACES, at, "the domain has an end that no binary64 number is beyond")
    return above


def middles(box: Box) -> tuple[list[arb], list[arb]]:
    """Centre and radius along each axis."""
    ends = [(arb(a), arb(b)) for a, b in zip(box.lo, box.hi, strict=True)]
    return [(a + b) / 2 for a, b in ends], [(b - a) / 2 for a, b in ends]


# ----------------------------------------------------------------------------------------------------------- the leaves


def covers_domain(c: Certificate, covering: Covering) -> None:
    """The root box holds every z with x = T z in the domain: |z_i| is at most the sum of |(T^-1)_ij| max|x_j|."""
    try:
        inverse = covering.T.inv()
    except ZeroDivisionError:
        raise Refused(RULE, "T", "it has no inverse") from None
    far = [max(-lo, hi) for lo, hi in c.plant.domain]
    for i, (row, b) in enumerate(zip(inverse.tolist(), covering.root, strict=True)):
        reach = sum((abs(v) * x for v, x in zip(row, far, strict=True)), fmpq(0))
        require(bool(reach <= exact(b)), RULE, f"axis {i}", "the root box does not contain the domain")


class OverDomain:
    """Data shared by the leaves of a covering."""

    def __init__(self, c: Certificate, models: Models, covering: Covering) -> None:
        self.c, self.models = c, models
        self.T = arb_mat(covering.T).tolist()
        self.domain = [(arb(lo), arb(hi)) for lo, hi in c.plant.domain]

    def is_free(self, box: Box) -> bool:
        """True if certainly the box lies outside the domain, or N is above n2 on all of it."""
        x = self.states(box)
        if any(v.c - v.first > hi or v.c + v.first < lo for v, (lo, hi) in zip(x, self.domain, strict=True)):
            return True
        try:
            return self.models.is_above(x)
        except Refused:
            return False  # N may be undefined somewhere on the box

    def states(self, box: Box) -> list[Taylor]:
        """x = T z in the symbols of the box."""
        centre, radius = middles(box)
        return [
            Taylor(
                total(t * v for t, v in zip(row, centre, strict=True)),
                arb_mat([[t * r for t, r in zip(row, radius, strict=True)]]),
            )
            for row in self.T
        ]


class Region(OverDomain):
    """The same beside {V <= c2}; `leaves` has V and the policy in the covering's coordinates."""

    def __init__(self, c: Certificate, models: Models, covering: Covering) -> None:
        super().__init__(c, models, covering)
        T = covering.T
        self.leaves = Leaves(c, T, fmpq_mat(T.transpose() * c.P * T))

    def is_free(self, box: Box) -> bool:
        """True if moreover V is certainly below c2 on all of it."""
        return self.leaves.is_below(self.leaves.outer, box) or super().is_free(box)

    def falls(self, leaf: Leaf) -> bool:
        """True if N'F, N'F + k (n2 - N) or N'F + k (V - c2) is certainly negative, for some k >= 0."""
        leaves, F = self.leaves, self.leaves.F(leaf)
        N, rate = self.models.moving([leaves.affine(row) for row in leaf.x], F)
        known = N.is_finite() and rate.is_finite()
        return known and is_negative(rate, [Taylor(self.models.level) + -N, self.beyond(leaf)])

    def beyond(self, leaf: Leaf) -> Taylor:
        """V - c2, which is not negative where N is asked to fall."""
        return self.leaves.V(leaf) + Taylor(-self.leaves.outer)

    def slacks(self, leaf: Leaf) -> list[Taylor]:
        """V - c2 and n2 - N; the first alone where N may be undefined."""
        try:
            N = self.models.value([self.leaves.affine(row) for row in leaf.x])
        except Refused:
            return [self.beyond(leaf)]
        return [self.beyond(leaf), Taylor(self.models.level) + -N]


def check_leaves(c: Certificate, models: Models, covering: Covering, jobs: int) -> None:
    """In each batch of leaves on which something is asked rule `inputs` comes first."""
    region = Region(c, models, covering)

    def check(some: list[Box]) -> None:
        enclosed = region.leaves.enclose(some, "outer leaf")
        for leaf in enclosed:
            region.leaves.keep_bounds(leaf)
        if c.keep is not None:
            for leaf in enclosed:
                kept(region.leaves, leaf, None, region.slacks(leaf))
        for leaf in enclosed:
            with under(RULE, leaf.place):
                falls = region.falls(leaf)
            require(falls, RULE, leaf.place, "no bound of what N changes by is certainly negative")

    in_batches(c, c.n, (box for box in boxes(covering) if not region.is_free(box)), check, jobs)
