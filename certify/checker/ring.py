"""The rules for the leaves of the partition tree: D + 2 lambda V < 0 wherever a leaf meets c1 <= V <= c2."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from operator import add

import numpy as np
from flint import fmpq

from .boxes import Boxes, Leaves, batches, is_whole, middle, multipliers
from .case import Case, Failures
from .exact import fraction, root_above
from .near import Array, near
from .network import enclose_on_boxes
from .processes import Batch
from .taylor import Taylor, combination, upper_bound

_BATCH_NUMBERS = 800_000  # in the largest array of a batch: more would not stay in a cache


@dataclass(frozen=True)
class RingLeaves(Leaves):
    """The leaves that may meet the ring and, if there is no ball, those inside of it too, which no other rule covers
    then. An inside leaf holds if every component of F has a finite model, or if a step does not leave the set."""

    meet: Array  # which of them may meet the ring
    ends: Array  # (2, n, B): the state lies between these during a period; none if nothing is held


@dataclass(frozen=True)
class Motion:
    """A step on boxes: G; states and what else f reads, as they may be at any time of the step; between what a state
    lies during a period, (2, n, B), of no entries if nothing is held."""

    G: list[Taylor]
    states: list[Taylor]
    held: list[Taylor]
    ends: Array


class Moving(Boxes):
    """Boxes from which the state moves, in steps or continuously."""

    order: int  # of the series in time
    widest: list[float]  # the largest |x_i| that matters at the beginning of a period

    @property
    def batch(self) -> int:
        """The number of leaves per batch."""
        values = self.c.dynamics.size * (self.order + 1)
        numbers = max(self.width * (self.symbols + 4), self.symbols * self.symbols * (values + 4))
        return int(max(1, min(4096, _BATCH_NUMBERS // numbers)))

    def motion(self, states: list[Taylor], inputs: list[Taylor]) -> Motion:
        """G, and where the state may be until the step is done."""
        batch, nothing = len(inputs[0].c), np.zeros((2, 0, 0))
        ranges = self.quantities(batch)
        if not self.c.sample:
            F = self.f(states, [*inputs, *ranges])
            G = [f + -x for f, x in zip(F, states, strict=True)] if self.c.discrete else F
            return Motion(G, states, [*inputs, *ranges], nothing)
        from .flow import motion

        return motion(self, self.c.sample, states, inputs, ranges)


class Ring(Moving):
    """The bounds on boxes, lo and hi (n, B) in the coordinates z, that the rules for a leaf ask for."""

    def __init__(self, case: Case) -> None:
        lo, hi = case.c.sample or (0, 0)
        super().__init__(case, case.partition.T, case.S, lo < hi)
        c2, self.order = fmpq(*self.c.c2.as_integer_ratio()), case.partition.order
        roots = (root_above(c2 * fmpq(p.numerator, p.denominator)) for p in case.P_inverse)
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
        if self.case.covered or not self.c.step:
            bound = self.bound(rise, centre, radius)
        else:
            bound = np.where(beyond, self.bound(rise, centre, radius), self.bound_of_steps(rise, centre, radius))
        hold = bound < 0
        if not (self.case.covered or self.c.step or np.all(meet)):
            # a division by a range that contains 0 has no finite model
            hold = np.where(meet, hold, np.all([np.isfinite(g.size.top) for g in motion.G], axis=0))
        gaps = [lambda left: self.gap(centre[:, left], radius[:, left], self.c.c2, 1.0)]
        kept = [self.least_bound(g, gaps) < 0 for g in self.constraints(motion.states, motion.held)]
        held_back = np.array(kept, dtype=bool).reshape(len(kept), len(met))
        return RingLeaves(self, first + met, "leaf ", u.range, bound, hold, held_back, meet, motion.ends)

    def misses(self, lo: Array, hi: Array) -> tuple[Array, Array, Array]:
        """True on boxes with certainly V > c2 everywhere; with certainly V < c1; with certainly V >= c1."""
        least, most = self.levels(lo, hi)
        return least > self.c.c2, most < self.c.c1, least >= self.c.c1

    def rise(self, states: list[Taylor], G: list[Taylor]) -> Taylor:
        """D = sum_i G_i (2 P x + h P G)_i."""
        along = [v.scaled(2.0) for v in states]
        if self.c.step:
            step = self.number(self.c.sample or (self.c.step,) * 2, self.symbols - 1, len(states[0].c))
            along = [v + step * g for v, g in zip(along, G, strict=True)]
        rows = [combination(*zip(row, along, strict=True)) for row in self.c.P.tolist()]
        return reduce(add, [row * g for row, g in zip(rows, G, strict=True)])

    def bound_of_steps(self, rise: Taylor, centre: Array, radius: Array) -> Array:
        """Upper bound of D' + k (V - c0) on boxes for the best of some k between 0 and 1/h: where V >= c0 it bounds D',
        and where V < c0, a step does not lead out of {V <= c0}."""
        most = float(1 / self.c.step)
        most = most if Fraction(most) * self.c.step <= 1 else float(np.nextafter(most, 0.0))
        gap = self.gap(centre, radius, self.c.c0, -1.0)
        tried = multipliers(rise.g[: self.n], gap.g[: self.n], gap.c)
        bound = upper_bound(rise)
        for k in [*np.minimum(tried, most), np.full_like(bound, most)]:
            bound = np.fmin(bound, upper_bound(combination((1.0, rise), (k, gap))))
        return bound

    def bound(self, rise: Taylor, centre: Array, radius: Array) -> Array:
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


def stays(leaves: RingLeaves) -> Failures:
    """`flow`: during a period the state stays in the interior of the domain."""
    c = leaves.boxes.c
    if not c.sample:
        return 0
    for i, (name, (lo, hi)) in enumerate(zip(c.states, c.domain, strict=True)):
        (_, least), (most, _) = near(lo).ends, near(hi).ends
        hold = (leaves.ends[0, i] > least) & (leaves.ends[1, i] < most)
        if not np.all(hold):
            yield f"leaf {leaves.numbers[np.argmin(hold)]}", f"{name} may leave the domain during a period"
    return int(leaves.ends[0].size)


def decreases(leaves: RingLeaves) -> Failures:
    """`ring`: D + 2 lambda V < 0 on leaves that may meet the ring; on others of which anything is asked, F is smooth,
    or a step does not lead out."""
    if not np.all(leaves.hold):
        first = np.argmin(leaves.hold)
        smooth = f"the decrease is not shown: {leaves.bound[first]:.3g}"
        steps = leaves.boxes.c.step > 0
        yield f"leaf {leaves.numbers[first]}", smooth if leaves.meet[first] or steps else "F may be undefined"
    return int(np.sum(leaves.meet))
