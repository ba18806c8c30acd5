"""The closed loop and V on boxes of coordinates z, x = T z, for the rules about leaves of a partition tree, and the
leaves themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import islice

import numpy as np
from flint import fmpq_mat

from .case import Case, Failures
from .exact import fraction
from .expression import evaluate
from .float64 import EPS, Array, float_with_error, gamma, norm, total, up, within
from .processes import Batch
from .taylor import Taylor, affine, constant, upper_bound

LEAF = 255
MAX_DEPTH = 4096


@dataclass(frozen=True)
class Leaves:
    """The leaves of a batch that a rule examines."""

    boxes: Boxes
    numbers: Array  # in the tree
    place: str  # of one, before its number
    mid: Array  # (m, B): the inputs lie within `reach` of this
    reach: Array
    bound: Array  # an upper bound of the margin
    hold: Array  # where what is asked holds


class Boxes:
    """Boxes with corners lo and hi (n, B) in z, batched; S = T'PT."""

    def __init__(self, case: Case, T: Array, S: fmpq_mat, more: int = 0) -> None:
        """`more` symbols come after those of the box, the inputs and the uncertain quantities."""
        self.case, self.c, self.T, self.net = case, case.c, T, case.net
        self.n, self.m, self.k = len(case.c.states), len(case.c.inputs), len(case.c.uncertain)
        self.symbols = self.n + self.m + self.k + more
        value, error = np.moveaxis(np.array([[float_with_error(fraction(v)) for v in row] for row in S.tolist()]), 2, 0)
        self.S = np.diag(value)[:, None]  # the diagonal, (n, 1)
        self.S_rest = up(np.abs(value - np.diag(self.S[:, 0])) + error)  # bounds what S is beside it

    def levels(self, lo: Array, hi: Array) -> tuple[Array, Array]:
        """Bounds of V from below and above on the boxes; a lower bound that has overflowed is -infinity."""
        far = np.maximum(np.abs(lo), np.abs(hi))
        near = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))  # corners are exact
        cross = self.cross(far)
        least = np.sum(self.S * near * near, axis=0) * (1 - gamma(self.n + 4)) - cross - 2.0**-960
        most = up(total(self.S * far * far, 0) + cross)
        least = least - EPS * np.abs(least) - EPS * cross
        return np.where(least < np.inf, least, -np.inf), most

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

    def quantities(self, batch: int) -> list[Taylor]:
        """The uncertain quantities, each with its symbol."""
        return [self.number(pair, self.n + self.m + j, batch) for j, pair in enumerate(self.c.ranges)]

    def constant(self, batch: int) -> Callable[[Fraction], Taylor]:
        """The function that gives a rational's model."""
        return lambda q: constant(q, self.symbols, batch)

    def f(self, states: list[Taylor], held: list[Taylor]) -> list[Taylor]:
        """f of states, and of inputs and uncertain quantities."""
        return evaluate(self.c.dynamics, self.constant(len(held[0].c)), [*states, *held])

    def number(self, pair: tuple[Fraction, Fraction], symbol: int, batch: int) -> Taylor:
        """A number of a range, by its symbol."""
        (lo, hi), g = pair, np.zeros((self.symbols, batch))
        (middle, error), (reach, doubt) = float_with_error((lo + hi) / 2), float_with_error((hi - lo) / 2)
        g[symbol] = reach
        return affine(np.full(batch, middle), g, up(error + doubt))

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
        """Upper bound of the off-diagonal part of V in magnitude where |z| <= far."""
        return total(far * total(self.S_rest[:, :, None] * far[None, :], 1), 0)

    def least_bound(self, rise: Taylor, gaps: Sequence[Callable[[Array], Taylor]]) -> Array:
        """An upper bound of `rise` where no gap is negative: that of `rise` or of `rise + k gap` for one gap and some
        k >= 0, whichever is least. A gap is a function of the indices of the boxes that it is wanted on."""
        bound = upper_bound(rise)
        for gap_on in gaps:
            left = np.flatnonzero(np.logical_not(bound < 0))
            gap, part = gap_on(left), rise.at(left)
            for k in multipliers(part.g[: self.n], gap.g[: self.n], gap.c):
                still = np.flatnonzero(np.logical_not(bound[left] < 0))
                other = upper_bound(part.at(still) + gap.at(still).scaled(k[still]))
                bound[left[still]] = np.fmin(bound[left[still]], other)
        return bound


def multipliers(a: Array, b: Array, c: Array) -> Array:
    """The k at which a term of `c k + sum_i |a_i + k b_i|` vanishes, or 0 if that is negative: (n, B), the best first.

    Any number k >= 0 is valid for the proof; an infinite one or NaN makes the bound NaN.
    """
    k = np.maximum(np.where(b != 0, -a / b, 0.0), 0.0)
    value = c * k + np.sum(np.abs(a[:, None] + k * b[:, None]), axis=0)
    return np.take_along_axis(k, np.argsort(value, axis=0, kind="stable"), 0)


def middle(lo: Array, hi: Array) -> tuple[Array, Array]:
    """Centre and radius of boxes."""
    centre = 0.5 * lo + 0.5 * hi
    return centre, up(np.maximum(hi - centre, centre - lo))


def keeps_inputs(leaves: Leaves) -> Failures:
    """`inputs`: by form, or the policy's enclosure lies in the bounds."""
    c = leaves.boxes.c
    if leaves.boxes.case.bounded:
        return 0
    for name, bounds, mid, reach in zip(c.inputs, c.input_bounds, leaves.mid, leaves.reach, strict=True):
        hold = within(bounds, mid, reach)
        if not np.all(hold):
            yield f"{leaves.place}{leaves.numbers[np.argmin(hold)]}", f"{name} may leave its bounds"
    return int(leaves.mid.size)


def is_whole(tree: bytes, axes: Sequence[int], where: str = "") -> Failures:
    """The bytes are a tree of leaves and of splits of these axes in preorder, and nothing else."""
    boxes, allowed = 1, {*axes, LEAF}
    for position, axis in enumerate(tree):
        if not boxes:
            yield f"{where}byte {position}", "the tree goes on after its last leaf"
        if axis not in allowed:
            yield f"{where}byte {position}", f"must be one of {', '.join(map(str, (*axes, LEAF)))}"
        boxes += -1 if axis == LEAF else 1
        if boxes > MAX_DEPTH + 1:
            yield f"{where}byte {position}", f"deeper than {MAX_DEPTH}"
    if boxes:
        yield f"{where}end", f"the tree ends with {boxes} boxes open"
    return tree.count(LEAF)


def batches(tree: bytes, lo: Array, hi: Array, size: int) -> Iterator[Batch]:
    """The leaves of a tree over the box lo, hi (n,), in preorder: the number of the first of each batch, and their
    corners (n, B)."""
    first, leaves = 0, _walk(tree, lo.tolist(), hi.tolist())
    while corners := list(islice(leaves, size)):
        lower, upper = np.array(corners).transpose(1, 2, 0)
        yield first, lower, upper
        first += len(corners)


def _walk(tree: bytes, lo: list[float], hi: list[float]) -> Iterator[tuple[list[float], list[float]]]:
    """A byte splits the current box at the middle of that axis, lower half first, or says that it is a leaf. Both
    halves share the same binary64 midpoint, so the leaves cover the root box."""
    stack = [(lo, hi)]
    for axis in tree:
        lo, hi = stack.pop()
        if axis == LEAF:
            yield lo, hi
            continue
        left, right = hi.copy(), lo.copy()
        left[axis] = right[axis] = 0.5 * lo[axis] + 0.5 * hi[axis]
        stack += [(right, hi), (lo, left)]
