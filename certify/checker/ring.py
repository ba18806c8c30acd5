"""The rules for the leaves of the partition tree: D + 2 lambda V < 0 wherever a leaf meets c1 <= V <= c2."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from .boxes import Batch, Boxes, Leaves, batches, is_whole, middle
from .case import Case, Failures
from .exact import fraction, quotient, rational, root_above
from .near import Array, near
from .network import enclose_on_boxes
from .taylor import Taylor, combination, inner_product

_BATCH_NUMBERS = 800_000  # in the largest array of a batch: more would not stay in a cache


@dataclass(frozen=True)
class RingLeaves(Leaves):
    """The leaves that may meet the ring and, if there is no ball, those inside of it too, which no other rule covers
    then. An inside leaf holds if every component of F has a finite model, or if a step does not leave the set."""

    meet: Array  # which of them may meet the ring
    motion: Motion


@dataclass(frozen=True)
class Motion:
    """On boxes G, which is F, or the increment in a step over its length; states and what else f reads, as constraints
    take them, where inputs are held for each quarter of a period at any time of it, which is a symbol more; and between
    what a state lies during a period, (2, n, B)."""

    G: list[Taylor]
    courses: list[list[Taylor]]
    held: list[Taylor]
    ends: Array = None


class Moving(Boxes):
    """Boxes from which the state moves, in steps or continuously."""

    order: int  # of the series in time
    widest: list[float]  # the largest |x_i| that matters at the beginning of a period

    @property
    def batch(self) -> int:
        """The number of leaves per batch."""
        values = self.c.dynamics.size * (self.order + 1) + self.c.comparisons
        numbers = max(self.width * (self.symbols + 4), self.symbols * self.symbols * (values + 4))
        return int(max(1, min(4096, _BATCH_NUMBERS // numbers)))

    def motion(self, states: list[Taylor], inputs: list[Taylor]) -> Motion:
        """G, and where the state may be until a step is done."""
        if self.c.step:
            from .stepping import motion

            return motion(self, states, inputs)
        held = [*inputs, *self.quantities(len(inputs[0].c))]
        return Motion(self.f(states, held), [states], held)


class Ring(Moving):
    """The bounds on boxes, lo and hi (n, B) in the coordinates z, that the rules for a leaf ask for."""

    @staticmethod
    def of(case: Case) -> Ring:
        """The bounds of a certificate."""
        if not case.c.step:
            return Ring(case)
        from .stepping import StepRing

        return StepRing(case)

    def __init__(self, case: Case) -> None:
        lo, hi = case.c.sample or (0, 0)
        super().__init__(case, case.partition.T, case.S, lo < hi)
        c2, self.order = rational(self.c.c2), case.partition.order
        roots = (root_above(c2 * quotient(p)) for p in case.P_inverse)
        self.widest = [near(fraction(root)).ends[1] for root in roots]

    def leaves(self) -> Iterator[Batch]:
        """The tree's leaves in batches."""
        root = self.case.partition.root
        return batches(self.case.partition.tree, -root, root, self.batch)

    def examine(self, first: int, lo: Array, hi: Array) -> RingLeaves:
        """The leaves with these corners, numbered from `first`."""
        outside, inside, beyond = self.misses(lo, hi)
        met = np.flatnonzero(np.logical_not(outside | inside if self.case.covered else outside))
        lo, hi, meet, beyond = lo[:, met], hi[:, met], np.logical_not(inside[met]), beyond[met]
        centre, radius = middle(lo, hi)
        x = self.states(centre, radius)
        u = enclose_on_boxes(self.net, x)
        states, held = self.models(x, u)
        motion = self.motion(states, held)
        rise = self.rise(states, motion.G)
        if self.c.rate:
            rise = combination((1.0, rise), (2 * self.c.rate, self.gap(centre, radius, 0.0, -1.0)))
        bound = self.bound(rise, centre, radius, beyond)
        gaps = [lambda left: self.gap(centre[:, left], radius[:, left], self.c.c2, 1.0)]
        kept = self.kept(motion.courses, motion.held, gaps)
        hold = self.hold(bound, meet, motion.G)
        return RingLeaves(self, first + met, "leaf ", self.inputs_kept(x, u), bound, hold, kept, meet, motion)

    def hold(self, bound: Array, meet: Array, G: list[Taylor]) -> Array:
        """True where the bound is negative or, on leaves that cannot meet the ring, all of G has a finite model: a
        division by a range that contains 0 has none."""
        if self.case.covered or np.all(meet):
            return bound < 0
        return np.where(meet, bound < 0, np.all([np.isfinite(g.size.top) for g in G], axis=0))

    def misses(self, lo: Array, hi: Array) -> tuple[Array, Array, Array]:
        """True on boxes with certainly V > c2 everywhere; with certainly V < c1; with certainly V >= c1."""
        least, most = self.levels(lo, hi)
        return least > self.c.c2, most < self.c.c1, least >= self.c.c1

    def rise(self, states: list[Taylor], G: list[Taylor]) -> Taylor:
        """D = 2 sum_i G_i (P x)_i, from above."""
        return self.product(G, [v.scaled(2.0) for v in states])

    def product(self, x: list[Taylor], y: list[Taylor]) -> Taylor:
        """x'P y, from above."""
        return inner_product([combination(*zip(row, y, strict=True)) for row in self.c.P.tolist()], x)

    def bound(self, rise: Taylor, centre: Array, radius: Array, beyond: Array = None) -> Array:
        """Upper bound of D' on the part of each box that lies in the ring.

        There c2 - V and V - c1 are not negative, so D' is at most D' + k (c2 - V), and at most D' + k (V - c1),
        for any k >= 0. A k that proves a leaf proves it for a lower c2 and a higher c1 too, and is tried again then.
        """
        edges = ((self.c.c2, 1.0), (self.c.c1, -1.0))
        gaps = [lambda left, e=edge: self.gap(centre[:, left], radius[:, left], *e) for edge in edges]
        return self.least_bound(rise, gaps)


def is_partition(case: Case) -> Failures:
    """`tree`: the bytes are a partition of the root box."""
    return (yield from is_whole(case.partition.tree, range(len(case.c.states))))


def decreases(leaves: RingLeaves) -> Failures:
    """`ring`: D + 2 lambda V < 0 on leaves that may meet the ring; on others of which anything is asked, F is smooth,
    or a step does not lead out."""
    for k in np.flatnonzero(np.logical_not(leaves.hold)):
        smooth = f"the decrease is not shown: {leaves.bound[k]:.3g}"
        steps = leaves.boxes.c.step > 0
        yield f"leaf {leaves.numbers[k]}", smooth if leaves.meet[k] or steps else "F may be undefined"
    return int(np.sum(leaves.meet))
