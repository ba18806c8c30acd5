"""The rules for the leaves of the partition tree: D + 2 lambda V < 0 wherever a leaf meets c1 <= V <= c2."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import reduce
from itertools import islice
from operator import add

import numpy as np
from flint import fmpq

from .case import Case, Failures
from .exact import fraction, root_above
from .expression import evaluate
from .float64 import EPS, Array, ends, float_with_error, gamma, norm, total, up, within
from .flow import later
from .network import enclose_on_boxes
from .taylor import Taylor, affine, constant, upper_bound

LEAF = 255
MAX_DEPTH = 4096
_BATCH_NUMBERS = 4_000_000  # in the largest array of a batch
_ATTEMPTS = 4  # at the a-priori enclosure


@dataclass(frozen=True)
class Leaves:
    """The leaves of a batch of which something is asked: those that may meet the ring and, where there is no ball,
    those inside of it as well, which no other rule covers then."""

    ring: Ring
    numbers: Array  # in the tree
    meet: Array  # which of them may meet the ring
    mid: Array  # (m, B): the inputs lie within `reach` of this
    reach: Array
    ends: Array  # (2, n, B): the state lies between these during a period; none if nothing is held
    bound: Array  # of D + 2 lambda V
    hold: Array  # where that is negative, or inside of the ring where every component of F has a finite model


class Ring:
    """The bounds on boxes, lo and hi (n, B) in the coordinates z, that the rules for a leaf ask for."""

    def __init__(self, case: Case) -> None:
        self.case, self.c, self.T, self.net = case, case.c, case.partition.T, case.net
        self.n, self.m, self.k = len(case.c.states), len(case.c.inputs), len(case.c.uncertain)
        lo, hi = case.c.sample or (0, 0)
        self.c2 = fmpq(*self.c.c2.as_integer_ratio())
        self.symbols = self.n + self.m + self.k + (lo < hi)
        value, error = np.moveaxis(
            np.array([[float_with_error(fraction(v)) for v in row] for row in case.S.tolist()]), 2, 0
        )
        self.S = np.diag(value)[:, None]  # the diagonal, (n, 1)
        self.S_rest = up(np.abs(value - np.diag(self.S[:, 0])) + error)  # bounds what S is beside it

    @property
    def batch(self) -> int:
        """How many leaves are looked at together."""
        width = max(max(layer.W.shape) for layer in self.net.layers)
        values = len(self.c.dynamics.operations) * (self.case.partition.order + 1)
        numbers = max(width * (self.symbols + 4), self.symbols * self.symbols * (values + 4))
        return int(max(1, min(4096, _BATCH_NUMBERS // numbers)))

    def examine(self, first: int, lo: Array, hi: Array) -> Leaves:
        """The leaves with these corners, numbered from `first`."""
        outside, inside, beyond = self.misses(lo, hi)
        met = np.flatnonzero(np.logical_not(outside | inside if self.case.covered else outside))
        lo, hi, meet, beyond = lo[:, met], hi[:, met], np.logical_not(inside[met]), beyond[met]
        centre = 0.5 * lo + 0.5 * hi
        radius = up(np.maximum(hi - centre, centre - lo))
        x, error = self.states(centre, radius)
        mid, slopes, wide = enclose_on_boxes(self.net, x, error)
        states, held = self.affine(x, error, mid, slopes, wide)
        G, ends = self.increment(states, held)
        rise = self.rise(states, G)
        if self.c.rate:
            rise = rise + self.gap(centre, radius, 0.0, -1.0).scaled(2 * self.c.rate)
        if self.case.covered or not self.c.step:
            bound = self.bound(rise, centre, radius)
        else:
            bound = np.where(beyond, self.bound(rise, centre, radius), self.bound_of_steps(rise, centre, radius))
        hold = bound < 0
        if not (self.case.covered or self.c.step or np.all(meet)):
            # what divides by a range that holds 0 has no finite model
            hold = np.where(meet, hold, np.all([np.isfinite(g.size + g.r) for g in G], axis=0))
        return Leaves(self, first + met, meet, mid, up(total(np.abs(slopes), 1) + wide), ends, bound, hold)

    def misses(self, lo: Array, hi: Array) -> tuple[Array, Array, Array]:
        """Where the box certainly has V > c2 everywhere, where it certainly has V < c1, and where V >= c1.

        A lower bound that has overflowed is none.
        """
        far = np.maximum(np.abs(lo), np.abs(hi))
        near = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))  # corners are exact
        cross = self.cross(far)
        least = np.sum(self.S * near * near, axis=0) * (1 - gamma(self.n + 4)) - cross - 2.0**-960
        most = up(total(self.S * far * far, 0) + cross)
        least = least - EPS * np.abs(least) - EPS * cross
        finite = least < np.inf
        return (least > self.c.c2) & finite, most < self.c.c1, (least >= self.c.c1) & finite

    def states(self, centre: Array, radius: Array) -> tuple[Array, Array]:
        """x = T z on the boxes as affine forms (n, n + 1, B), and a bound of their rounding errors (n, B)."""
        slopes = self.T[:, :, None] * radius[None]
        x = np.concatenate([np.matmul(self.T, centre)[:, None], slopes], axis=1)
        error = gamma(self.n) * (norm(self.T, 1)[:, None] * norm(centre, 0)) + EPS * total(np.abs(slopes), 1)
        return x, up(error)

    def affine(
        self, x: Array, error: Array, mid: Array, slopes: Array, wide: Array
    ) -> tuple[list[Taylor], list[Taylor]]:
        """States and inputs on the boxes; symbols: n box coordinates, m input errors, k uncertain quantities, and the
        period if it has a range."""
        batch = wide.shape[1]
        zeros, errors = np.zeros((self.symbols - self.n, batch)), np.eye(self.m)[:, :, None] * wide[:, None]
        states = [affine(v[0], np.concatenate([v[1:], zeros]), e) for v, e in zip(x, error, strict=True)]
        parts = zip(mid, slopes, errors, strict=True)
        inputs = [affine(v, np.concatenate([slope, own, zeros[self.m :]])) for v, slope, own in parts]
        return states, inputs

    def increment(self, states: list[Taylor], inputs: list[Taylor]) -> tuple[list[Taylor], Array]:
        """G, and between what a state lies during a period."""
        batch, nothing = len(inputs[0].c), np.zeros((2, 0, 0))
        ranges = [self.number(pair, self.n + self.m + j, batch) for j, pair in enumerate(self.c.ranges)]
        if not self.c.sample:
            F = self.f(states, [*inputs, *ranges])
            return [f + -x for f, x in zip(F, states, strict=True)] if self.c.discrete else F, nothing
        loose = [*inputs, *(_between(v) for v in ranges)]
        during, F = self.way(states, loose)
        order, h = self.case.partition.order, self.number(self.c.sample, self.symbols - 1, batch)
        G = [self.of_mean(f) for f in self.f(during if order == 1 else states, [*inputs, *ranges])]
        if order > 1:
            rising = later(self.c.dynamics, self.constant(batch), states, during, loose, h, order, _itself)
            G = [x + h * more for x, more in zip(G, rising, strict=True)]
        return G, self.hull(states, F)

    def constant(self, batch: int) -> Callable[[Fraction], Taylor]:
        """Of rationals, the models."""
        return lambda q: constant(q, self.symbols, batch)

    def f(self, states: list[Taylor], held: list[Taylor]) -> list[Taylor]:
        """f of states, and of inputs and uncertain quantities."""
        return evaluate(self.c.dynamics, self.constant(len(held[0].c)), [*states, *held])

    def way(self, states: list[Taylor], held: list[Taylor]) -> tuple[list[Taylor], list[Taylor]]:
        """Where states may be during a period, and f of them; NaN where none of a few attempts to say so holds."""
        h, way = self.case.longest, np.zeros((self.n, len(held[0].c)))
        for attempt in range(1 + _ATTEMPTS):
            during = [replace(x, r=up(x.r + own)) for x, own in zip(states, way, strict=True)]
            F = self.f(during, held)
            most = up(h * np.array([up(f.size + f.r) for f in F]))
            good = np.all(most < way, axis=0)
            if np.all(good):
                break
            way = np.where(good, way, 1.25 * most if attempt < _ATTEMPTS else np.nan)
        else:
            during = [replace(x, r=up(x.r + own)) for x, own in zip(states, way, strict=True)]
            F = self.f(during, held)
        return during, F

    def hull(self, states: list[Taylor], F: list[Taylor]) -> Array:
        """Between what the states lie that start in {V <= c2} and move as fast as F for a period at most."""
        h, found = self.case.longest, []
        for x, f, p in zip(states, F, self.case.P_inverse, strict=True):
            value, error = float_with_error(fraction(root_above(self.c2 * fmpq(p.numerator, p.denominator))))
            widest = up(value + error)
            (lo, hi), (slowest, fastest) = (ends(v.c, up(v.linear + v.quadratic + v.r)) for v in (x, f))
            lo, hi = np.maximum(lo, -widest), np.minimum(hi, widest)
            away = up(h * np.maximum(-slowest, 0.0)), up(h * np.maximum(fastest, 0.0))
            found.append((ends(lo, away[0])[0], ends(hi, away[1])[1]))
        return np.moveaxis(np.array(found), 1, 0)

    def of_mean(self, f: Taylor) -> Taylor:
        """A model with the symbols of uncertain quantities, as their means: what is of second order in them, whose mean
        is another, becomes part of the remainder."""
        own = slice(self.n + self.m, self.n + self.m + self.k)
        Q = f.Q.copy()
        Q[own, own] = 0.0
        return replace(f, Q=Q, r=up(f.r + total(total(np.abs(f.Q[own, own]), 0), 0)))

    def rise(self, states: list[Taylor], G: list[Taylor]) -> Taylor:
        """D = sum_i G_i (2 P x + h P G)_i."""
        along = [v.scaled(2.0) for v in states]
        if self.c.step:
            step = self.number(self.c.sample or (self.c.step,) * 2, self.symbols - 1, len(states[0].c))
            along = [v + step * g for v, g in zip(along, G, strict=True)]
        rows = [reduce(add, [v.scaled(p) for p, v in zip(row, along, strict=True)]) for row in self.c.P.tolist()]
        return reduce(add, [row * g for row, g in zip(rows, G, strict=True)])

    def number(self, pair: tuple[Fraction, Fraction], symbol: int, batch: int) -> Taylor:
        """A number of a range, by its symbol."""
        (lo, hi), g = pair, np.zeros((self.symbols, batch))
        (middle, error), (reach, doubt) = float_with_error((lo + hi) / 2), float_with_error((hi - lo) / 2)
        g[symbol] = reach
        return affine(np.full(batch, middle), g, up(error + doubt))

    def bound_of_steps(self, rise: Taylor, centre: Array, radius: Array) -> Array:
        """Upper bound of D' + k (V - c0) on boxes for the best of some k between 0 and 1/h: where V >= c0 it bounds D',
        and where V < c0, a step does not lead out of {V <= c0}."""
        most = float(1 / self.c.step)
        most = most if Fraction(most) * self.c.step <= 1 else float(np.nextafter(most, 0.0))
        gap = self.gap(centre, radius, self.c.c0, -1.0)
        tried = multipliers(rise.g[: self.n], gap.g[: self.n], gap.c)
        bound = upper_bound(rise)
        for k in [*np.minimum(tried, most), np.full_like(bound, most)]:
            bound = np.fmin(bound, upper_bound(rise + gap.scaled(k)))
        return bound

    def bound(self, rise: Taylor, centre: Array, radius: Array) -> Array:
        """Upper bound of D' on the part of each box that lies in the ring.

        There c2 - V and V - c1 are not negative, so D' is at most D' + k (c2 - V), and at most D' + k (V - c1),
        for any k >= 0. A k that proves a leaf proves it for a lower c2 and a higher c1 too, and is tried again then.
        """
        bound = upper_bound(rise)
        for level, sign in ((self.c.c2, 1.0), (self.c.c1, -1.0)):
            left = np.flatnonzero(np.logical_not(bound < 0))
            gap, part = self.gap(centre[:, left], radius[:, left], level, sign), rise.at(left)
            for k in multipliers(part.g[: self.n], gap.g[: self.n], gap.c):
                still = np.flatnonzero(np.logical_not(bound[left] < 0))
                other = upper_bound(part.at(still) + gap.at(still).scaled(k[still]))
                bound[left[still]] = np.fmin(bound[left[still]], other)
        return bound

    def gap(self, centre: Array, radius: Array, level: float, sign: float) -> Taylor:
        """sign (level - V) on the boxes, which is not negative on the part of a leaf that lies in the ring."""
        far = up(np.abs(centre) + radius)
        size = up(level + total(self.S * far * far, 0))
        zeros = np.zeros((self.symbols - self.n, centre.shape[1]))
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


def stays(leaves: Leaves) -> Failures:
    """`flow`: during a period the state stays in the interior of the domain."""
    c = leaves.ring.c
    if not c.sample:
        return 0
    for i, (name, (lo, hi)) in enumerate(zip(c.states, c.domain, strict=True)):
        (_, least), (most, _) = (ends(*float_with_error(q)) for q in (lo, hi))
        hold = (leaves.ends[0, i] > least) & (leaves.ends[1, i] < most)
        if not np.all(hold):
            yield f"leaf {leaves.numbers[np.argmin(hold)]}", f"{name} may leave the domain during a period"
    return int(leaves.ends[0].size)


def decreases(leaves: Leaves) -> Failures:
    """`ring`: D + 2 lambda V < 0 on leaves that may meet the ring; on others of which anything is asked, F is smooth,
    or a step does not lead out."""
    if not np.all(leaves.hold):
        first = np.argmin(leaves.hold)
        smooth = f"the decrease is not shown: {leaves.bound[first]:.3g}"
        steps = leaves.ring.c.step > 0
        yield f"leaf {leaves.numbers[first]}", smooth if leaves.meet[first] or steps else "F may be undefined"
    return int(np.sum(leaves.meet))


def _between(v: Taylor) -> Taylor:
    """What has a symbol, as a number of which only the range is known."""
    return affine(v.c, np.zeros_like(v.g), up(v.linear + v.r))


def _itself(v: Taylor) -> Taylor:
    return v


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
