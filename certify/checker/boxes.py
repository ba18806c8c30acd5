"""The closed loop and V on boxes of coordinates z, x = T z, for the rules about leaves of a partition tree, and the
leaves themselves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import chain, islice
from typing import Any, TypeVar

import numpy as np
from flint import fmpq_mat

from .case import Case, Failures
from .exact import near_matrix
from .expression import evaluate
from .near import Above, Array, Form, Near, near, size
from .network import keep_bounds, prepare
from .networks import Network
from .taylor import Taylor, affine, combination, constants, pairs, upper_bound

LEAF = 255
MAX_DEPTH = 4096


Batch = tuple[int, Array, Array]  # the number of the first leaf, and their corners (n, B)
Result = TypeVar("Result")
Work = Callable[[int, Array, Array], Result]
Answers = Iterator[tuple[int, int, Result]]  # the number of the first leaf, how many there are, and their result


@dataclass(frozen=True)
class Leaves:
    """The leaves of a batch that a rule examines."""

    boxes: Boxes
    numbers: Array  # in the tree
    place: str  # of one, before its number
    inputs: Array  # where each input keeps its bounds, (m, B)
    bound: Array  # an upper bound of the margin
    hold: Array  # where what is asked holds
    kept: Array  # where each constraint holds, (K, B)

    @property
    def case(self) -> Case:
        return self.boxes.case


class Boxes(ABC):
    """Boxes with corners lo and hi (n, B) in z, batched; S = T'PT."""

    def __init__(self, case: Case, T: Array, S: fmpq_mat, more: int = 0, doubts: int = 0) -> None:
        """`doubts` symbols come after those of the box; then those of the inputs, the uncertain quantities, and entries
        of calls; then `more`."""
        self.case, self.c, self.T, self.net = case, case.c, T, case.net
        self.n, self.m, self.k = len(case.c.states), len(case.c.inputs), len(case.c.uncertain)
        self.errors = self.n + doubts  # the first symbol of an input's error
        self.calls = self.errors + self.m + self.k  # the first symbol of an entry of a call
        self.symbols = self.calls + self.c.dynamics.entries + more
        prepare(*self.networks)
        whole = near_matrix(S)
        self.S = np.diag(whole.value)  # the diagonal
        self.S_rest = whole.error + size(whole.value - np.diag(self.S))  # bounds what S is beside it

    @property
    def width(self) -> int:
        """The most entries of a vector of the networks."""
        return max(network.widest for network in self.networks)

    @property
    def networks(self) -> list[Network]:
        """The policy's, and that of each call in the equations."""
        return [self.c.policy.network, *self.c.dynamics.called]

    @abstractmethod
    def leaves(self) -> Iterator[Batch]:
        """The tree's leaves in batches."""

    @abstractmethod
    def examine(self, first: int, lo: Array, hi: Array) -> Any:
        """The leaves with these corners, numbered from `first`, of which anything is asked."""

    def levels(self, lo: Array, hi: Array) -> tuple[Array, Array]:
        """Bounds of V from below and above on the boxes; NaN where they overflow."""
        far = np.maximum(np.abs(lo), np.abs(hi))
        close = np.where((lo <= 0) & (hi >= 0), 0.0, np.minimum(np.abs(lo), np.abs(hi)))  # corners are exact
        cross = self.cross(size(far))
        least, most = self.diagonal(close), self.diagonal(far)
        return Near(least.value, least.error + cross).ends[0], Near(most.value, most.error + cross).ends[1]

    def diagonal(self, z: Array) -> Near:
        """sum_i S_ii z_i^2 at exact z (n, B)."""
        return (Near(z) * Near(z)).through(self.S[None])[0]

    def cross(self, far: Above) -> Above:
        """Upper bound of the off-diagonal part of V in magnitude where |z| <= far."""
        return (far * (self.S_rest[:, :, None] * far).sum(1)).sum()

    def states(self, centre: Array, radius: Array) -> Form:
        """x = T z on the boxes, (n + 1, n, B)."""
        z = np.concatenate([centre[None], np.eye(self.n)[:, :, None] * radius])
        return Form(z).through(self.T)

    def models(self, x: Form, u: Form) -> tuple[list[Taylor], list[Taylor]]:
        """States and inputs on the boxes; symbols: n box coordinates and what else x has, m input errors, k uncertain
        quantities, entries of calls, and the period if it has a range."""
        batch = u.error.v.shape[1]
        zeros = np.zeros((self.symbols - self.errors, batch))
        errors = np.eye(self.m)[:, :, None] * u.error.top[:, None]
        states = [affine(x.value[0, i], np.concatenate([x.value[1:, i], zeros]), x.error[i]) for i in range(self.n)]
        inputs = [
            affine(u.value[0, j], np.concatenate([u.value[1:, j], errors[j], zeros[self.m :]])) for j in range(self.m)
        ]
        return states, inputs

    def inputs_kept(self, x: Form, u: Form) -> Array:
        """True for each input and box (m, B) on which it keeps its bounds: by form if it has a value, or as
        `keep_bounds` finds."""
        if self.case.bounded:
            return np.all(np.isfinite(u.range.ends), axis=0)
        return keep_bounds(self.net, self.c.input_bounds, x, u)

    def quantities(self, batch: int) -> list[Taylor]:
        """The uncertain quantities, each with its symbol."""
        return [self.number(pair, self.errors + self.m + j, batch) for j, pair in enumerate(self.c.ranges)]

    def f(self, states: list[Taylor], held: list[Taylor], choose: Any = None) -> list[Taylor]:
        """f of states, and of inputs and uncertain quantities; `choose` gives the value of a heaviside."""
        calling = None
        if self.c.dynamics.calls:
            from .calls import entries

            calling = partial(entries, first=self.calls)
        return evaluate(self.c.dynamics, constants(held[0]), [*states, *held], calling, choose)

    def kept(self, courses: list[list[Taylor]], held: list[Taylor], gaps: Sequence[Callable[[Array], Taylor]]) -> Array:
        """True for each constraint and box on which it is negative at all of these states where no gap is, (K, B)."""
        if self.c.keep is None:
            return np.zeros((0, len(held[0].c)), dtype=bool)
        from .keep import on_boxes

        return on_boxes(self, courses, held, gaps)

    def number(self, pair: tuple[Fraction, Fraction], symbol: int, batch: int) -> Taylor:
        """A number of a range, by its symbol, which may be one beyond all others."""
        (lo, hi), g = pair, np.zeros((max(self.symbols, symbol + 1), batch))
        middle, reach = near((lo + hi) / 2), near((hi - lo) / 2)
        g[symbol] = reach.value
        return affine(np.full(batch, middle.value), g, middle.error + reach.error)

    def gap(self, centre: Array, radius: Array, level: float, sign: float) -> Taylor:
        """sign (level - V) on the boxes, which is not negative on the part of a leaf that lies in the ring.

        V is `sum S_ii (centre_i + radius_i d_i)^2` within `cross`.
        """
        S, i_j = -sign * self.S[:, None], pairs(self.symbols)
        c = Near(sign * level) + self.diagonal(centre) * -sign
        g, q = _by(S, 2 * centre, radius), _by(S, radius, radius)
        p = np.zeros((self.symbols + len(i_j[0]), centre.shape[1]))
        p[: self.n] = g.value
        p[self.symbols :][np.flatnonzero(i_j[0] == i_j[1])[: self.n]] = q.value
        return Taylor(c.value, p, c.error + g.error.sum() + q.error.sum() + self.cross(size(centre) + radius))

    def least_bound(self, rise: Taylor, gaps: Sequence[Callable[[Array], Taylor]], least: float = 0.0) -> Array:
        """An upper bound of `rise` where no gap is negative: that of `rise` or of `rise + k gap` for one gap and some
        k >= 0, whichever is least. A gap is a function of the indices of the boxes that it is wanted on. With a `least`
        k of -inf it bounds `rise` where a gap is 0."""
        bound = upper_bound(rise)
        for gap_on in gaps:
            left = np.flatnonzero(np.logical_not(bound < 0))
            gap, part = gap_on(left), rise.at(left)
            for k in multipliers(part.g[: self.n], gap.g[: self.n], gap.c, least):
                still = np.flatnonzero(np.logical_not(bound[left] < 0))
                other = upper_bound(combination((1.0, part.at(still)), (k[still], gap.at(still))))
                bound[left[still]] = np.fmin(bound[left[still]], other)
        return bound


def _by(S: Array, x: Array, y: Array) -> Near:
    """S x y for exact numbers."""
    return Near(S) * Near(x) * Near(y)


def multipliers(a: Array, b: Array, c: Array, least: float = 0.0) -> Array:
    """The k at which a term of `c k + sum_i |a_i + k b_i|` vanishes, at `least` if it is less: (n, B), the best first.

    Any number k >= 0 is valid for the proof, and k < 0 where what it multiplies is 0; an infinite one or NaN makes the
    bound NaN.
    """
    k = np.maximum(np.where(b != 0, -a / b, 0.0), least)
    value = c * k + np.sum(np.abs(a[:, None] + k * b[:, None]), axis=0)
    return np.take_along_axis(k, np.argsort(value, axis=0, kind="stable"), 0)


def middle(lo: Array, hi: Array) -> tuple[Array, Array]:
    """Centre and radius of boxes."""
    centre = 0.5 * lo + 0.5 * hi
    ends = (Near(hi) - Near(centre)).ends[1], (Near(centre) - Near(lo)).ends[1]
    return centre, np.maximum(*ends)


def keeps_inputs(leaves: Leaves) -> Failures:
    """`inputs`: by form, or on each leaf."""
    c = leaves.boxes.c
    by_form = leaves.boxes.case.bounded
    for name, hold in zip(c.inputs, leaves.inputs, strict=True):
        if not np.all(hold):
            wrong = "have no value" if by_form else "leave its bounds"
            yield f"{leaves.place}{leaves.numbers[np.argmin(hold)]}", f"{name} may {wrong}"
    return 0 if by_form else int(leaves.inputs.size)


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


def in_order(work: Work[Result], batches: Iterator[Batch], leaves: int, jobs: int) -> Iterator[Result]:
    """Yield `work(*batch)` of each batch of a tree's leaves, made in up to so many processes, as if in one.

    The results are taken in the order of the leaves and without a gap, or not at all, and there must be as many leaves
    as the tree has: if one is left out, that makes an error, and neither yes nor no.

    Raises
    ------
    ArithmeticError : the results are not those of all leaves.
    """
    first, examined = list(islice(batches, jobs)), 0
    batches = chain(first, batches)
    if len(first) < 2:
        found = answers(work, batches)
    else:
        from .processes import by_processes

        found = by_processes(work, batches, len(first))
    for number, count, result in found:
        if number != examined:
            break
        examined += count
        yield result
    if examined != leaves:
        raise ArithmeticError(f"leaves have been passed over: after {examined} of {leaves}")


def answers(work: Work[Result], batches: Iterator[Batch]) -> Answers[Result]:
    for first, lo, hi in batches:
        yield first, lo.shape[1], work(first, lo, hi)
