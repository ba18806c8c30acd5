"""The rules for {N <= n2} beyond {V <= c2}: N is above n2 on the domain's faces, and falls where V >= c2 and N <= n2.
Those for a set that is never left, without V, are in invariant.py.

They take models of N, and of its derivative along F, on boxes. Networks go through them step by step, the entries of a
vector on an axis of their own.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial, reduce
from math import nextafter
from operator import add
from typing import TYPE_CHECKING

import numpy as np
from flint import fmpq_mat

from .boxes import LEAF, Batch, Boxes, Leaves, batches, in_order, is_whole, keeps_inputs, middle
from .calls import entries
from .case import Case, Failures, given, only_where
from .exact import exactly, inverse, quotient, rational
from .expression import Call, Tape, evaluate
from .functions import FUNCTIONS
from .near import Above, Array, Form, Near, near
from .network import enclose_on_boxes, prepare
from .networks import Affine, Algebra, Map
from .taylor import Taylor, constant, constants, models, upper_bound
from .wiring import Clip, Concat, Observe, Product, Sum

if TYPE_CHECKING:
    from .rules import Tally

_BATCH_NUMBERS = 1_000_000  # in the largest array of a batch


@dataclass(frozen=True)
class Dual:
    """A model of v, or models in rows, on the symbols of the box, and one of its derivative along F, on all symbols;
    None where that is 0, or not asked."""

    value: Taylor
    rate: Taylor | None = None

    def __add__(self, other: Dual) -> Dual:
        x, y = self.rate, other.rate
        return Dual(self.value + other.value, x + y if x is not None and y is not None else x if y is None else y)

    def __neg__(self) -> Dual:
        return Dual(-self.value, None if self.rate is None else -self.rate)

    def __mul__(self, other: Dual) -> Dual:
        terms = [
            v.value.widened(w.rate.symbols) * w.rate for v, w in ((self, other), (other, self)) if w.rate is not None
        ]
        return Dual(self.value * other.value, reduce(add, terms) if terms else None)

    def function(self, name: str) -> Dual:
        """phi(v) for a function phi of the table; its derivative is phi'(v) times that of v."""
        v, rate = self.value, self.rate
        if rate is not None:
            slope = v.composed(FUNCTIONS[name].expansion(Near(v.c), v.moved).derivative)
            rate = slope.widened(rate.symbols) * rate
        return Dual(v.function(name), rate)

    def through(self, W: Array, b: Array) -> Dual:
        """`W v + b` of models in rows."""
        return Dual(_through(W, self.value, b), None if self.rate is None else _through(W, self.rate))


class InRows(Algebra[Dual]):
    """Networks of such models, each vector in rows (width, B)."""

    def affine(self, step: Affine, v: Dual) -> Dual:
        return v.through(step.weight, step.bias)

    def map(self, step: Map, v: Dual) -> Dual:
        return v.function(step.function)

    def clip(self, step: Clip, v: Dual) -> Dual:
        """Nothing: N has to have a derivative."""
        return Dual(v.value.scaled(np.nan))

    def sum(self, step: Sum, *vectors: Dual) -> Dual:
        return reduce(add, vectors)

    def concat(self, step: Concat, *vectors: Dual) -> Dual:
        return _stacked([row for v in vectors for row in _rows(v)])

    def product(self, step: Product, v: Dual, w: Dual) -> Dual:
        return _repeated(v, step.size) * _repeated(w, step.size)

    def observe(self, step: Observe, v: Dual) -> Dual:
        """Also what no expression reads must exist."""
        made = _stacked(evaluate(step.tape, _numbers(v.value), _rows(v)))
        N, exists = made.value, np.all(np.isfinite(v.value.size.top), axis=0)
        return replace(made, value=Taylor(N.c, N.p, N.r.where(exists, Above(np.nan))))

    def entries(self, call: Call, arguments: list[Dual]) -> list[Dual]:
        """A call in equations."""
        value = _rows(self.run(call.network, _stacked(arguments)))
        return [value[i] for i in call.entries]


class Function:
    """N on boxes, and its derivative along F."""

    def __init__(self, tape: Tape) -> None:
        self.tape, networks = tape, tape.called
        self.values = max(2 * tape.size, *(network.widest for network in networks), 0)
        prepare(*networks)

    def along(self, states: Sequence[Taylor], F: Sequence[Taylor | None]) -> Dual:
        """N, and its derivative where F is given."""
        variables = [Dual(x, f) for x, f in zip(states, F, strict=True)]
        N: Dual = evaluate(self.tape, _numbers(states[0]), variables, InRows().entries)[0]
        return N

    def is_above(self, x: Form, level: float) -> Array:
        """True on boxes on which N is certainly above the level; nowhere if that is infinite."""
        if not np.isfinite(level):
            return np.zeros(x.value.shape[2], dtype=bool)
        return self._has(x, lambda N: upper_bound(constants(N)(Fraction(level)) + -N) < 0)

    def is_below(self, x: Form, level: float) -> Array:
        """True on boxes on which N is certainly below the level."""
        return self._has(x, lambda N: upper_bound(N + constants(N)(-Fraction(level))) < 0)

    def _has(self, x: Form, shown: Callable[[Taylor], Array]) -> Array:
        found = np.zeros(x.value.shape[2], dtype=bool)
        if self.tape.calls:  # forms are good where boxes are large
            found = self._by(self._by_forms, x, shown)
        left = np.flatnonzero(np.logical_not(found))
        found[left] = self._by(lambda states: self.along(states, [None] * len(states)).value, x[:, left], shown)
        return found

    def _by(self, value: Callable[[list[Taylor]], Taylor], x: Form, shown: Callable[[Taylor], Array]) -> Array:
        N = value(models(Form(x.value), x.error))
        found: Array = np.isfinite(N.size.top) & shown(N)
        return found

    def _by_forms(self, states: list[Taylor]) -> Taylor:
        """N by the forms of the networks' values, each with a symbol for its error."""
        first = states[0].symbols
        wide = [x.widened(first + self.tape.entries) for x in states]
        N: Taylor = evaluate(self.tape, constants(wide[0]), wide, lambda call, given: entries(call, given, first))[0]
        return N


def is_above_on_faces(case: Case) -> Failures:
    """`faces`: N > n2 on every leaf of every face of the domain."""
    outer = given(case.c.outer)
    function, n, count = _function(case), len(case.c.states), 0
    widest = [(_below(lo), _above(hi)) for lo, hi in case.c.domain]
    for k, tree in enumerate(outer.faces):
        i, side = divmod(k, 2)
        where = f"face {k} "
        others = [j for j in range(n) if j != i]
        yield from is_whole(tree, others, where)
        if not all(np.all(np.isfinite(widest[j])) for j in others):
            yield f"{where}root", "no binary64 numbers enclose the domain"
        end = near(case.c.domain[i][side])
        lo, hi = np.array([(end.value, end.value) if j == i else pair for j, pair in enumerate(widest)]).T
        doubt = end.error * np.where(np.arange(n) == i, 1.0, 0.0)[:, None]
        left_over, leaves = partial(_below_on_face, function, outer.level, doubt), tree.count(LEAF)
        for left in in_order(left_over, batches(tree, lo, hi, _batch(n * n * function.values)), leaves, case.jobs):
            if len(left):
                yield f"{where}leaf {left[0]}", "N must be above its level"
        count += leaves
    return count


def _below_on_face(function: Function, level: float, doubt: Above, first: int, lo: Array, hi: Array) -> Array:
    """The leaves of a face, by their numbers, on which N is not certainly above the level."""
    centre, radius = middle(lo, hi)
    x = np.concatenate([centre[None], np.eye(len(lo))[:, :, None] * radius])
    below = np.logical_not(function.is_above(Form(x, doubt * np.ones_like(centre)), level))
    return first + np.flatnonzero(below)


def contains_domain(case: Case) -> Failures:
    """`outer`: |z_i| <= sum_j |(T^-1)_ij| max |x_j| in rationals."""
    outer = given(case.c.outer)
    to_z = inverse(exactly(outer.T))
    if to_z is None:
        yield "evidence.outer.T", "T must be invertible"
        return 0
    far = [max(-lo, hi) for lo, hi in case.c.domain]
    sizes = fmpq_mat([[abs(v) for v in row] for row in to_z.tolist()])
    reach = sizes * fmpq_mat([[quotient(x)] for x in far])
    for i, b in enumerate(outer.root.tolist()):
        if not reach[i, 0] <= rational(b):
            yield f"evidence.outer.root, axis {i}", "the root box must contain the domain"
    return len(far)


def is_partition(case: Case) -> Failures:
    """`outer`: the bytes are a partition of the root box."""
    return (yield from is_whole(given(case.c.outer).tree, range(len(case.c.states))))


def falls(leaves: Leaves) -> Failures:
    """`outer`: N'F < 0 on leaves that may have a state of the domain with V >= c2 and N <= n2."""
    if not np.all(leaves.hold):
        first = np.argmin(leaves.hold)
        yield f"{leaves.place}{leaves.numbers[first]}", f"that N falls is not shown: {leaves.bound[first]:.3g}"
    return int(leaves.hold.size)


@dataclass(frozen=True)
class Course:
    """N on boxes whose states are x, in forms, and how it changes: N'F and n2 - N; True where they and F are finite;
    where inputs keep their bounds, and the models of what equations read."""

    x: Form
    rise: Taylor
    below: Taylor
    finite: Array
    inputs: Array
    states: list[Taylor]
    held: list[Taylor]


class Beyond(Boxes):
    """The bounds that rule `outer` asks for, on boxes lo and hi (n, B) in the coordinates z of its tree."""

    def __init__(self, case: Case) -> None:
        self.outer = given(case.c.outer)
        none = fmpq_mat(len(case.c.states), len(case.c.states))
        super().__init__(case, self.outer.T, none if case.c.without_V else case.seen_from(self.outer.T))
        self.function, self.level = _function(case), self.outer.level
        ends_of = [[near(end).ends[side] for side, end in enumerate(pair)] for pair in self.c.domain]
        self.least, self.largest = np.array(ends_of).T[:, :, None]  # at or beyond the domain's ends, (n, 1)

    def leaves(self) -> Iterator[Batch]:
        """The tree's leaves in batches."""
        values = max(self.function.values, self.c.dynamics.size) + self.c.comparisons
        size = _batch(max(self.symbols**2 * values, (self.symbols + 4) * self.width))
        return batches(self.outer.tree, -self.outer.root, self.outer.root, size)

    def examine(self, first: int, lo: Array, hi: Array) -> Leaves:
        """The leaves with these corners, numbered from `first`, on which N'F and the constraints must be negative where
        N <= n2 and V >= c2."""
        centre, radius = middle(lo, hi)
        x = self.states(centre, radius)
        left = self.close(x, self.levels(lo, hi)[1] < self.c.c2)
        course = self.course(x[:, left])
        centre, radius = centre[:, left], radius[:, left]
        gaps = [course.below.at, lambda few: self.gap(centre[:, few], radius[:, few], self.c.c2, -1.0)]
        bound = self.least_bound(course.rise, gaps)
        hold = (bound < 0) & course.finite
        kept = self.kept([course.states], course.held, gaps)
        return Leaves(self, first + left, "outer leaf ", course.inputs, bound, hold, kept)

    def close(self, x: Form, free: Array) -> Array:
        """The numbers of boxes that are not free, may meet the domain, and have N at its level or below somewhere."""
        found = np.flatnonzero(np.logical_not(self.is_outside(x) | free))
        some: Array = found[np.logical_not(self.function.is_above(x[:, found], self.level))]
        return some

    def course(self, x: Form) -> Course:
        """N, the loop and N'F on boxes."""
        u = enclose_on_boxes(self.net, x)
        batch = x.value.shape[2]
        states, inputs = self.models(x, u)
        held = [*inputs, *self.quantities(batch)]
        F = self.f(states, held)
        both = self.function.along(models(Form(x.value), x.error), F)
        N, none = both.value.widened(self.symbols), constant(Fraction(0), self.symbols, batch)
        below = constant(Fraction(self.level), self.symbols, batch) + -N
        finite = np.all([np.isfinite(v.size.top) for v in (N, *F)], axis=0)
        return Course(x, none if both.rate is None else both.rate, below, finite, self.inputs_kept(x, u), states, held)

    def is_outside(self, x: Form) -> Array:
        """True on each box that certainly lies outside the domain, along one of the states."""
        lo, hi = x.range.ends
        outside: Array = np.any((lo > self.largest) | (hi < self.least), axis=0)
        return outside


def examine(tally: Tally, case: Case) -> None:
    """The rules about a second function."""
    for table in (ON_FACES, OF_OUTER_TREE):
        tally.hold(table, case)
    bounds = Beyond(case)
    if case.c.without_V:
        from . import invariant

        bounds = invariant.Staying(case)
    tree = bounds.outer.tree
    tally.margins["outer"] = tally.hold_on_leaves(ON_OUTER_LEAVES, bounds, tree, lambda leaves: leaves.bound)


ON_FACES = (("faces", is_above_on_faces),)
OF_OUTER_TREE = (("outer", contains_domain), ("outer", is_partition))
ON_OUTER_LEAVES = (
    ("inputs", keeps_inputs),
    ("keep", only_where(lambda c: c.keep, "keep", "on_leaves")),
    ("outer", falls),
)


def _function(case: Case) -> Function:
    return Function(given(case.c.outer).function)


def _batch(numbers: int) -> int:
    """The number of boxes per batch, each of which takes so many numbers."""
    return max(1, min(4096, _BATCH_NUMBERS // numbers))


def _numbers(like: Taylor) -> Callable[[Fraction], Dual]:
    """The function that gives a rational's model."""
    number = constants(like)
    return lambda q: Dual(number(q))


def _stacked(duals: Sequence[Dual]) -> Dual:
    """Models as rows of one."""
    rates = [v.rate for v in duals]
    some = next((rate for rate in rates if rate is not None), None)
    if some is None:
        return Dual(_in_rows([v.value for v in duals]))
    none = constants(some)(Fraction(0))
    return Dual(_in_rows([v.value for v in duals]), _in_rows([none if rate is None else rate for rate in rates]))


def _in_rows(models: Sequence[Taylor]) -> Taylor:
    c, p = np.stack([v.c for v in models]), np.stack([v.p for v in models], 1)
    return Taylor(c, p, Above(np.stack([v.r.top + np.zeros_like(v.c) for v in models])))


def _repeated(v: Dual, size: int) -> Dual:
    """So many rows, all of them the same if v has a single one."""
    return v if len(v.value.c) == size else _stacked(_rows(v) * size)


def _rows(v: Dual) -> list[Dual]:
    """The rows of such models."""
    rate = v.rate
    return [Dual(_row(v.value, i), None if rate is None else _row(rate, i)) for i in range(len(v.value.c))]


def _row(models: Taylor, i: int) -> Taylor:
    return Taylor(models.c[i], models.p[:, i], models.r[i])


def _through(W: Array, v: Taylor, b: Array | None = None) -> Taylor:
    """`W v + b` of models in rows (width, B)."""
    c, p = Near(v.c, v.r).through(W), v.beyond.through(W)
    if b is not None:
        c = c + Near(b[:, None])
    return Taylor(c.value, p.value, c.error + p.error)


def _below(q: Fraction) -> float:
    """The greatest binary64 number that is not above q."""
    try:
        value = float(q)
    except OverflowError:
        return sys.float_info.max if q > 0 else -np.inf
    return value if Fraction(value) <= q else nextafter(value, -np.inf)


def _above(q: Fraction) -> float:
    return -_below(-q)
