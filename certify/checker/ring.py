"""The rules for the leaves of the partition tree: Vdot < 0 wherever a leaf meets c1 <= V <= c2."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add

import numpy as np
from numpy.typing import NDArray

from .case import Failures
from .document import Certificate
from .exact import Matrix
from .expression import evaluate
from .float64 import EPS, Array, float_with_error, gamma, norm, total, up, within
from .network import Folded, enclose_on_boxes
from .taylor import Taylor, affine, constant, upper_bound

LEAF = 255
MAX_DEPTH = 4096
_BATCH_NUMBERS = 4_000_000  # in the largest array of a batch


class Ring:
    """The bounds on boxes, lo and hi (n, B) in the coordinates z, that the rules for a leaf ask for."""

    def __init__(self, c: Certificate, T: Array, net: Folded, S: Matrix) -> None:
        self.c, self.T, self.net = c, T, net
        self.n, self.m = len(c.states), len(c.inputs)
        value, error = np.moveaxis(np.array([[float_with_error(v) for v in row] for row in S]), 2, 0)
        self.S, self.S_error = np.diag(value)[:, None], np.diag(error)[:, None]  # of the diagonal, (n, 1)
        self.S_cross = up((np.abs(value) + error) * (1 - np.eye(self.n)))

    @property
    def batch(self) -> int:
        """How many leaves are looked at together."""
        width = max(max(layer.W.shape) for layer in self.net.layers)
        symbols = self.n + self.m
        numbers = max(width * (symbols + 4), symbols * symbols * (len(self.c.dynamics.operations) + 4))
        return int(max(1, min(4096, _BATCH_NUMBERS // numbers)))

    def misses(self, lo: Array, hi: Array) -> tuple[Array, Array]:
        """Where the box certainly has V > c2 everywhere, and where it certainly has V < c1 everywhere.

        A lower bound that has overflowed is none.
        """
        far = np.maximum(np.abs(lo), np.abs(hi))
        near = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))  # corners are exact
        cross = up(self.cross(far) + total(self.S_error * far * far, 0))
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

    def dynamics(
        self, x: Array, error: Array, mid: Array, slopes: Array, wide: Array
    ) -> tuple[list[Taylor], list[Taylor]]:
        """The states and F on the boxes; symbols: n box coordinates, m input errors."""
        n, m, batch = self.n, self.m, x.shape[2]
        plain = [affine(x[i, 0], np.concatenate([x[i, 1:], np.zeros((m, batch))])) for i in range(n)]
        states = [Taylor(model.c, model.g, model.Q, error[i]) for i, model in enumerate(plain)]
        unit = np.eye(m)[:, :, None]
        inputs = [affine(mid[j], np.concatenate([slopes[j], unit[j] * wide[j]])) for j in range(m)]
        return states, evaluate(self.c.dynamics, lambda q: constant(q, n + m, batch), [*states, *inputs])

    def vdot(self, states: list[Taylor], F: list[Taylor]) -> Taylor:
        """(2 P x)'F."""
        rows = [[x.scaled(2 * p, 0.0) for p, x in zip(row, states, strict=True)] for row in self.c.P.tolist()]
        return reduce(add, [reduce(add, row) * f for row, f in zip(rows, F, strict=True)])

    def bound(self, vdot: Taylor, centre: Array, radius: Array) -> Array:
        """Upper bound of Vdot on the part of each box that lies in the ring.

        There c2 - V and V - c1 are not negative, so Vdot is at most Vdot + k (c2 - V), and at most Vdot + k (V - c1),
        for any k >= 0.
        """
        bound = upper_bound(vdot)
        for level, sign in ((self.c.c2, 1.0), (self.c.c1, -1.0)):
            left = np.flatnonzero(np.logical_not(bound < 0))
            gap, part = self.gap(centre[:, left], radius[:, left], level, sign), vdot.at(left)
            k = multiplier(part.g[: self.n], gap.g[: self.n], gap.c)
            other = upper_bound(part + gap.scaled(k, 0.0))
            bound[left] = np.where(other < bound[left], other, bound[left])
        return bound

    def gap(self, centre: Array, radius: Array, level: float, sign: float) -> Taylor:
        """sign (level - V) on the boxes, which is not negative on the part of a leaf that lies in the ring."""
        far = up(np.abs(centre) + radius)
        size = up(level + total(self.S * far * far, 0))
        zeros = np.zeros((self.m, centre.shape[1]))
        g = np.concatenate([-2 * sign * self.S * centre * radius, zeros])
        q = np.concatenate([-sign * self.S * radius * radius, zeros])
        c = sign * (level - np.sum(self.S * centre * centre, axis=0))
        r = up(self.cross(far) + total(self.S_error * far * far, 0) + gamma(self.n + 8) * size)
        return Taylor(c, g, np.eye(len(q))[:, :, None] * q, r)

    def cross(self, far: Array) -> Array:
        """Upper bound of what the off-diagonal part of S adds to V in magnitude where |z| <= far."""
        return total(far * total(self.S_cross[:, :, None] * far[None, :], 1), 0)


def multiplier(a: Array, b: Array, c: Array) -> Array:
    """The k >= 0 that minimises `c k + sum_i |a_i + k b_i|`, shape (B,): it is 0 or lies where a term vanishes.

    Any number k >= 0 would do for the proof; an infinite one or NaN makes the bound NaN.
    """
    k = np.maximum(np.where(b != 0, -a / b, 0.0), 0.0)
    value = c * k + np.sum(np.abs(a[:, None] + k * b[:, None]), axis=0)
    best = np.argmin(value, axis=0)
    return np.asarray(np.take_along_axis(k, best[None], 0)[0])


@dataclass(frozen=True)
class Leaves:
    """A batch of leaves: the number of the first one, their corners (n, B), and in what the tree breaks after them."""

    ring: Ring
    first: int
    lo: Array
    hi: Array
    broken: tuple[str, str] | None

    @cached_property
    def misses(self) -> tuple[Array, Array]:
        """Which lie outside of the ring, and which inside of it."""
        return self.ring.misses(self.lo, self.hi)

    @cached_property
    def met(self) -> NDArray[np.intp]:
        """The leaves of which something is asked: those that may meet the ring and, under a practical claim, those
        inside of it as well, which no other rule covers then."""
        outside, inside = self.misses
        return np.flatnonzero(np.logical_not(outside if self.ring.c.claim == "practical" else outside | inside))

    @property
    def met_ring(self) -> Array:
        """Which of these may meet the ring."""
        return np.logical_not(self.misses[1][self.met])

    @cached_property
    def boxes(self) -> tuple[Array, Array]:
        """Their centres and radii."""
        lo, hi = self.lo[:, self.met], self.hi[:, self.met]
        centre = 0.5 * lo + 0.5 * hi
        return centre, up(np.maximum(hi - centre, centre - lo))

    @cached_property
    def policy(self) -> tuple[Array, Array, Array, Array, Array]:
        """States and their error, the policy's enclosure and its error, on these."""
        x, error = self.ring.states(*self.boxes)
        return (x, error, *enclose_on_boxes(self.ring.net, x, error))

    @cached_property
    def dynamics(self) -> tuple[list[Taylor], list[Taylor]]:
        """The states and F, on these."""
        return self.ring.dynamics(*self.policy)

    @cached_property
    def bound(self) -> Array:
        """Of Vdot, on these."""
        return self.ring.bound(self.ring.vdot(*self.dynamics), *self.boxes)

    @property
    def defined(self) -> Array:
        """On which of these every component of F has a finite model; what divides by a range that holds 0 has none."""
        return np.logical_and.reduce([np.isfinite(f.size + f.r) for f in self.dynamics[1]])

    def place(self, holds: Array) -> str:
        """The first of these for which something does not hold."""
        return f"leaf {self.first + int(self.met[np.argmin(holds)])}"


def is_whole(leaves: Leaves) -> Failures:
    """`tree`: the bytes are a tree of leaves and splits, and nothing else."""
    if leaves.broken:
        yield leaves.broken
    return int(leaves.lo.shape[1])


def keeps_inputs(leaves: Leaves) -> Failures:
    """`inputs`: the policy's enclosure lies in the bounds."""
    _, _, mid, slopes, wide = leaves.policy
    for j, (name, bounds) in enumerate(zip(leaves.ring.c.inputs, leaves.ring.c.input_bounds, strict=True)):
        holds = within(bounds, mid[j], up(total(np.abs(slopes[j]), 0) + wide[j]))
        if not np.all(holds):
            yield leaves.place(holds), f"{name} may leave its bounds"
    return int(mid.size)


def decreases(leaves: Leaves) -> Failures:
    """`ring`: Vdot < 0 on leaves that may meet the ring; on others of which anything is asked, F is smooth."""
    holds = leaves.bound < 0
    if not np.all(leaves.met_ring):
        holds = np.where(leaves.met_ring, holds, leaves.defined)
    if not np.all(holds):
        worst = np.argmin(holds)
        smooth = f"Vdot < 0 is not shown: {leaves.bound[worst]:.3g}"
        yield leaves.place(holds), smooth if leaves.met_ring[worst] else "F may be undefined"
    return int(np.sum(leaves.met_ring))


def batches(ring: Ring, tree: bytes, root: Array) -> Iterator[Leaves]:
    """The leaves of the partition tree in preorder.

    A byte below n splits the current box at the middle of that axis, lower half first; 255 is a leaf. Both children
    share the same binary64 midpoint, so the leaves cover the root box.
    """
    count, lows, highs = 0, [], []
    for low, high, broken in _walk(tree, root.tolist()):
        if broken is None:
            lows.append(low)
            highs.append(high)
        if broken or len(lows) == ring.batch:
            lo, hi = (np.array(corners).reshape(-1, len(root)).T for corners in (lows, highs))
            yield Leaves(ring, count, lo, hi, broken)
            count, lows, highs = count + len(lows), [], []
    if lows:
        yield Leaves(ring, count, np.array(lows).T, np.array(highs).T, None)


def _walk(tree: bytes, half: list[float]) -> Iterator[tuple[list[float], list[float], tuple[str, str] | None]]:
    """Corner by corner the leaves, and at the end what is wrong with the tree, if anything is."""
    n, stack = len(half), [([-b for b in half], half)]
    for position, axis in enumerate(tree):
        if not stack:
            return (yield [], [], (f"byte {position}", "the tree goes on after its last leaf"))
        lo, hi = stack.pop()
        if axis == LEAF:
            yield lo, hi, None
        elif axis >= n:
            return (yield [], [], (f"byte {position}", f"must be an axis below {n} or {LEAF}"))
        elif len(stack) >= MAX_DEPTH:
            return (yield [], [], (f"byte {position}", f"deeper than {MAX_DEPTH}"))
        else:
            middle = 0.5 * lo[axis] + 0.5 * hi[axis]
            left, right = hi.copy(), lo.copy()
            left[axis] = right[axis] = middle
            stack.append((right, hi))
            stack.append((lo, left))
    if stack:
        yield [], [], ("end", f"the tree ends with {len(stack)} boxes open")
