"""The rules for the leaves of the partition tree: Vdot < 0 wherever a leaf meets c1 <= V <= c2."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import reduce
from itertools import islice
from operator import add

import numpy as np

from .case import Case, Failures
from .exact import fraction
from .expression import evaluate
from .float64 import EPS, Array, float_with_error, gamma, norm, total, up, within
from .network import enclose_on_boxes
from .taylor import Taylor, affine, constant, upper_bound

LEAF = 255
MAX_DEPTH = 4096
_BATCH_NUMBERS = 4_000_000  # in the largest array of a batch


@dataclass(frozen=True)
class Leaves:
    """The leaves of a batch of which something is asked: those that may meet the ring and, under a practical claim,
    those inside of it as well, which no other rule covers then."""

    ring: Ring
    numbers: Array  # in the tree
    meet: Array  # which of them may meet the ring
    mid: Array  # (m, B): the inputs lie within `reach` of this
    reach: Array
    bound: Array  # of Vdot
    hold: Array  # where Vdot < 0, or inside of the ring where every component of F has a finite model


class Ring:
    """The bounds on boxes, lo and hi (n, B) in the coordinates z, that the rules for a leaf ask for."""

    def __init__(self, case: Case) -> None:
        self.case, self.c, self.T, self.net = case, case.c, case.partition.T, case.net
        self.n, self.m, self.k = len(case.c.states), len(case.c.inputs), len(case.c.uncertain)
        value, error = np.moveaxis(
            np.array([[float_with_error(fraction(v)) for v in row] for row in case.S.tolist()]), 2, 0
        )
        self.S = np.diag(value)[:, None]  # the diagonal, (n, 1)
        self.S_rest = up(np.abs(value - np.diag(self.S[:, 0])) + error)  # bounds what S is beside it

    @property
    def batch(self) -> int:
        """How many leaves are looked at together."""
        width = max(max(layer.W.shape) for layer in self.net.layers)
        symbols = self.n + self.m + self.k
        numbers = max(width * (symbols + 4), symbols * symbols * (len(self.c.dynamics.operations) + 4))
        return int(max(1, min(4096, _BATCH_NUMBERS // numbers)))

    def examine(self, first: int, lo: Array, hi: Array) -> Leaves:
        """The leaves with these corners, numbered from `first`."""
        outside, inside = self.misses(lo, hi)
        met = np.flatnonzero(np.logical_not(outside if self.c.practical else outside | inside))
        lo, hi, meet = lo[:, met], hi[:, met], np.logical_not(inside[met])
        centre = 0.5 * lo + 0.5 * hi
        radius = up(np.maximum(hi - centre, centre - lo))
        x, error = self.states(centre, radius)
        mid, slopes, wide = enclose_on_boxes(self.net, x, error)
        vdot, F = self.models(x, error, mid, slopes, wide)
        bound = self.bound(vdot, centre, radius)
        hold = bound < 0
        if not np.all(meet):  # what divides by a range that holds 0 has no finite model
            hold = np.where(meet, hold, np.all([np.isfinite(f.size + f.r) for f in F], axis=0))
        return Leaves(self, first + met, meet, mid, up(total(np.abs(slopes), 1) + wide), bound, hold)

    def misses(self, lo: Array, hi: Array) -> tuple[Array, Array]:
        """Where the box certainly has V > c2 everywhere, and where it certainly has V < c1 everywhere.

        A lower bound that has overflowed is none.
        """
        far = np.maximum(np.abs(lo), np.abs(hi))
        near = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))  # corners are exact
        cross = self.cross(far)
        least = np.sum(self.S * near * near, axis=0) * (1 - gamma(self.n + 4)) - cross - 2.0**-960
        most = up(total(self.S * far * far, 0) + cross)
        least = least - EPS * np.abs(least) - EPS * cross
        return (least > self.c.c2) & (least < np.inf), most < self.c.c1

    def states(self, centre: Array, radius: Array) -> tuple[Array, Array]:
        """x = T z on the boxes as affine forms (n, n + 1, B), and a bound of their rounding errors (n, B)."""
        slopes = self.T[:, :, None] * radius[None]
        x = np.concatenate([np.matmul(self.T, centre)[:, None], slopes], axis=1)
        error = gamma(self.n) * (norm(self.T, 1)[:, None] * norm(centre, 0)) + EPS * total(np.abs(slopes), 1)
        return x, up(error)

    def models(self, x: Array, error: Array, mid: Array, slopes: Array, wide: Array) -> tuple[Taylor, list[Taylor]]:
        """Vdot = (2 P x)'F, and F, on the boxes; symbols: n box coordinates, m input errors, k uncertain quantities."""
        batch = wide.shape[1]
        zeros, errors = np.zeros((self.m + self.k, batch)), np.eye(self.m)[:, :, None] * wide[:, None]
        states = [affine(v[0], np.concatenate([v[1:], zeros]), e) for v, e in zip(x, error, strict=True)]
        parts = zip(mid, slopes, errors, strict=True)
        inputs = [affine(v, np.concatenate([slope, own, zeros[self.m :]])) for v, slope, own in parts]
        quantities = [self.quantity(j, batch) for j in range(self.k)]
        symbols = self.n + self.m + self.k
        F = evaluate(self.c.dynamics, lambda q: constant(q, symbols, batch), [*states, *inputs, *quantities])
        rows = [[v.scaled(2 * p) for p, v in zip(row, states, strict=True)] for row in self.c.P.tolist()]
        return reduce(add, [reduce(add, row) * f for row, f in zip(rows, F, strict=True)]), F

    def quantity(self, j: int, batch: int) -> Taylor:
        """An uncertain quantity over its range."""
        (lo, hi), g = self.c.ranges[j], np.zeros((self.n + self.m + self.k, batch))
        (middle, error), (reach, doubt) = float_with_error((lo + hi) / 2), float_with_error((hi - lo) / 2)
        g[self.n + self.m + j] = reach
        return affine(np.full(batch, middle), g, up(error + doubt))

    def bound(self, vdot: Taylor, centre: Array, radius: Array) -> Array:
        """Upper bound of Vdot on the part of each box that lies in the ring.

        There c2 - V and V - c1 are not negative, so Vdot is at most Vdot + k (c2 - V), and at most Vdot + k (V - c1),
        for any k >= 0. A k that proves a leaf proves it for a lower c2 and a higher c1 too, and is tried again then.
        """
        bound = upper_bound(vdot)
        for level, sign in ((self.c.c2, 1.0), (self.c.c1, -1.0)):
            left = np.flatnonzero(np.logical_not(bound < 0))
            gap, part = self.gap(centre[:, left], radius[:, left], level, sign), vdot.at(left)
            for k in multipliers(part.g[: self.n], gap.g[: self.n], gap.c):
                still = np.flatnonzero(np.logical_not(bound[left] < 0))
                other = upper_bound(part.at(still) + gap.at(still).scaled(k[still]))
                bound[left[still]] = np.fmin(bound[left[still]], other)
        return bound

    def gap(self, centre: Array, radius: Array, level: float, sign: float) -> Taylor:
        """sign (level - V) on the boxes, which is not negative on the part of a leaf that lies in the ring."""
        far = up(np.abs(centre) + radius)
        size = up(level + total(self.S * far * far, 0))
        zeros = np.zeros((self.m + self.k, centre.shape[1]))
        g = np.concatenate([-2 * sign * self.S * centre * radius, zeros])
        q = np.concatenate([-sign * self.S * radius * radius, zeros])
        c = sign * (level - np.sum(self.S * centre * centre, axis=0))
        r = up(self.cross(far) + gamma(self.n + 8) * size)
        return Taylor(c, g, np.eye(len(q))[:, :, None] * q, r)

    def cross(self, far: Array) -> Array:
        """Upper bound of what S beside its diagonal adds to V in magnitude where |z| <= far."""
        return total(far * total(self.S_rest[:, :, None] * far[None, :], 1), 0)


def multipliers(a: Array, b: Array, c: Array) -> Array:
    """The k at which a term of `c k + sum_i |a_i + k b_i|` vanishes, or 0 if that is negative: (n, B), the best first.

    Any number k >= 0 would do for the proof; an infinite one or NaN makes the bound NaN.
    """
    k = np.maximum(np.where(b != 0, -a / b, 0.0), 0.0)
    value = c * k + np.sum(np.abs(a[:, None] + k * b[:, None]), axis=0)
    return np.take_along_axis(k, np.argsort(value, axis=0, kind="stable"), 0)


def is_whole(case: Case) -> Failures:
    """`tree`: the bytes are a tree of leaves and splits in preorder, and nothing else."""
    boxes, n, tree = 1, len(case.c.states), case.partition.tree
    for position, axis in enumerate(tree):
        if not boxes:
            yield f"byte {position}", "the tree goes on after its last leaf"
        if axis >= n and axis != LEAF:
            yield f"byte {position}", f"must be an axis below {n} or {LEAF}"
        boxes += -1 if axis == LEAF else 1
        if boxes > MAX_DEPTH + 1:
            yield f"byte {position}", f"deeper than {MAX_DEPTH}"
    if boxes:
        yield "end", f"the tree ends with {boxes} boxes open"
    return tree.count(LEAF)


def keeps_inputs(leaves: Leaves) -> Failures:
    """`inputs`: by form, or the policy's enclosure lies in the bounds."""
    c = leaves.ring.c
    if leaves.ring.case.bounded:
        return 0
    for name, bounds, mid, reach in zip(c.inputs, c.input_bounds, leaves.mid, leaves.reach, strict=True):
        hold = within(bounds, mid, reach)
        if not np.all(hold):
            yield f"leaf {leaves.numbers[np.argmin(hold)]}", f"{name} may leave its bounds"
    return int(leaves.mid.size)


def decreases(leaves: Leaves) -> Failures:
    """`ring`: Vdot < 0 on leaves that may meet the ring; on others of which anything is asked, F is smooth."""
    if not np.all(leaves.hold):
        first = np.argmin(leaves.hold)
        smooth = f"Vdot < 0 is not shown: {leaves.bound[first]:.3g}"
        yield f"leaf {leaves.numbers[first]}", smooth if leaves.meet[first] else "F may be undefined"
    return int(np.sum(leaves.meet))


def batches(tree: bytes, root: Array, size: int) -> Iterator[tuple[int, Array, Array]]:
    """The leaves of a whole tree in preorder: the number of the first of each batch, and their corners (n, B)."""
    first, leaves = 0, _walk(tree, root.tolist())
    while corners := list(islice(leaves, size)):
        lo, hi = np.array(corners).transpose(1, 2, 0)
        yield first, lo, hi
        first += len(corners)


def _walk(tree: bytes, half: list[float]) -> Iterator[tuple[list[float], list[float]]]:
    """A byte splits the current box at the middle of that axis, lower half first, or says that it is a leaf. Both
    halves share the same binary64 midpoint, so the leaves cover the root box."""
    stack = [([-b for b in half], half)]
    for axis in tree:
        lo, hi = stack.pop()
        if axis == LEAF:
            yield lo, hi
            continue
        left, right = hi.copy(), lo.copy()
        left[axis] = right[axis] = 0.5 * lo[axis] + 0.5 * hi[axis]
        stack += [(right, hi), (lo, left)]
