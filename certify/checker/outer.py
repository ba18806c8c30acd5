"""The rules for {N <= n2} beyond {V <= c2}: N is above n2 on the domain's faces, and falls where V >= c2 and N <= n2.

They take models of N, and of its derivative along F, on boxes. A network goes through them layer by layer, its units on
an axis of their own; an expression as a power series in time.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import cached_property, partial
from math import nextafter

import numpy as np
from flint import fmpq, fmpq_mat

from .boxes import LEAF, Boxes, Leaves, batches, is_whole, keeps_inputs, middle
from .case import Case, Failures
from .document import Network
from .exact import exactly, inverse
from .expression import Tape, evaluate
from .flow import Series
from .functions import FUNCTIONS
from .near import Above, Array, Form, Near, near
from .network import Folded, enclose_on_boxes, layer
from .processes import Batch, in_order
from .taylor import Taylor, affine, constant, upper_bound

_BATCH_NUMBERS = 1_000_000  # in the largest array of a batch
_MOST_NUMBERS, _MOST_VALUES = 2**22, 2**26  # of a box: in the models of a network, and of all of an expression's values


class Layers:
    """A network's models: each layer's values before the next tanh, one row per unit, (width, B) and more behind."""

    def __init__(self, net: Network) -> None:
        self.net, self.values = net, max(len(W) for W in net.weights)

    @cached_property
    def as_policy(self) -> Folded:
        """The same network as a policy, for the enclosure of rule `ring`."""
        layers = tuple(layer(W, b) for W, b in zip(self.net.weights, self.net.biases, strict=True))
        return Folded(layers, False, np.ones(1), Near(np.zeros(1)))

    def least(self, x: Form) -> Array:
        """A lower bound of N (B,), affine on the boxes: good where these are large."""
        least: Array = enclose_on_boxes(self.as_policy, x).range.ends[0][0]
        return least

    def is_small(self, symbols: int) -> bool:
        """True if the models in so many symbols fit in memory."""
        numbers: int = sum(len(W) * (W.shape[1] + symbols**2) for W in self.net.weights)
        return numbers <= _MOST_NUMBERS

    def models(self, states: Sequence[Taylor]) -> list[Taylor]:
        """The models of each layer; the last is N, in one row."""
        found = [_stacked(states)]
        for k, (W, b) in enumerate(zip(self.net.weights, self.net.biases, strict=True)):
            found.append(_through(W, found[-1].function("tanh") if k else found[0], b))
        return found[1:]

    def value(self, models: Sequence[Taylor]) -> Taylor:
        """N."""
        return _row(models[-1])

    def along(self, models: Sequence[Taylor], F: Sequence[Taylor]) -> Taylor:
        """N'F: y_1 = W_1 F, y_(k+1) = W_(k+1) (tanh'(a_k) y_k)."""
        first, *later = self.net.weights
        y = _through(first, _stacked(F))
        for W, a in zip(later, models, strict=False):
            slope = a.composed(FUNCTIONS["tanh"].expansion(Near(a.c), a.moved).derivative)
            y = _through(W, slope.widened(y.symbols) * y)
        return _row(y)


class Formula:
    """An expression's models are those of the states; N and N'F are the first two coefficients of a series in time."""

    def __init__(self, tape: Tape) -> None:
        self.tape, self.values = tape, 2 * len(tape.operations)

    def is_small(self, symbols: int) -> bool:
        """True if the models in so many symbols take acceptable time."""
        return len(self.tape.operations) * symbols**2 <= _MOST_VALUES

    def least(self, x: Form) -> Array:
        """No bound before there are models."""
        return np.full(x.value.shape[2], -np.inf)

    def models(self, states: Sequence[Taylor]) -> list[Taylor]:
        """The states."""
        return list(states)

    def value(self, models: Sequence[Taylor]) -> Taylor:
        """N."""
        N: Taylor = evaluate(self.tape, _numbers(models[0]), models)[0]
        return N

    def along(self, models: Sequence[Taylor], F: Sequence[Taylor]) -> Taylor:
        """N'F."""
        number = _numbers(F[0])
        series = [Series([x.widened(f.symbols), f], 2, number) for x, f in zip(models, F, strict=True)]
        N: Series = evaluate(self.tape, lambda q: Series([number(q)], 2, number), series)[0]
        rise: Taylor = N.parts[1] if len(N.parts) > 1 else number(Fraction(0))
        return rise


def is_small(case: Case) -> Failures:
    """`outer`: N is small enough."""
    if not _function(case).is_small(len(case.c.states) + len(case.c.inputs) + len(case.c.uncertain)):
        yield "claim.outer", "too many numbers or operations for so many symbols"
    return 0


def is_above_on_faces(case: Case) -> Failures:
    """`faces`: N > n2 on every leaf of every face of the domain."""
    claim, evidence = case.outer
    function, n, count = _function(case), len(case.c.states), 0
    widest = [(_below(lo), _above(hi)) for lo, hi in case.c.domain]
    for k, tree in enumerate(evidence.faces):
        i, side = divmod(k, 2)
        where = f"face {k} "
        others = [j for j in range(n) if j != i]
        yield from is_whole(tree, others, where)
        if not all(np.all(np.isfinite(widest[j])) for j in others):
            yield f"{where}root", "no binary64 numbers enclose the domain"
        end = near(case.c.domain[i][side])
        lo, hi = np.array([(end.value, end.value) if j == i else pair for j, pair in enumerate(widest)]).T
        doubt = end.error * np.where(np.arange(n) == i, 1.0, 0.0)[:, None]
        left_over, leaves = partial(_below_on_face, function, claim.level, doubt), tree.count(LEAF)
        for left in in_order(left_over, batches(tree, lo, hi, _batch(n * n * function.values)), leaves, case.jobs):
            if len(left):
                yield f"{where}leaf {left[0]}", "N must be above its level"
        count += leaves
    return count


def _below_on_face(function: Layers | Formula, level: float, doubt: Above, first: int, lo: Array, hi: Array) -> Array:
    """The leaves of a face, by their numbers, on which N is not certainly above the level."""
    centre, radius = middle(lo, hi)
    x = np.concatenate([centre[None], np.eye(len(lo))[:, :, None] * radius])
    return first + _below_level(function, Form(x, doubt * np.ones_like(centre)), level)[0]


def contains_domain(case: Case) -> Failures:
    """`outer`: |z_i| <= sum_j |(T^-1)_ij| max |x_j| in rationals."""
    _, evidence = case.outer
    to_z = inverse(exactly(evidence.T))
    if to_z is None:
        yield "evidence.outer.T", "T must be invertible"
        return 0
    far = [max(-lo, hi) for lo, hi in case.c.domain]
    sizes = fmpq_mat([[abs(v) for v in row] for row in to_z.tolist()])
    reach = sizes * fmpq_mat([[fmpq(x.numerator, x.denominator)] for x in far])
    for i, b in enumerate(evidence.root.tolist()):
        if not reach[i, 0] <= fmpq(*b.as_integer_ratio()):
            yield f"evidence.outer.root, axis {i}", "the root box must contain the domain"
    return len(far)


def is_partition(case: Case) -> Failures:
    """`outer`: the bytes are a partition of the root box."""
    return (yield from is_whole(case.outer[1].tree, range(len(case.c.states))))


def falls(leaves: Leaves) -> Failures:
    """`outer`: N'F < 0 on leaves that may have a state of the domain with V >= c2 and N <= n2."""
    if not np.all(leaves.hold):
        first = np.argmin(leaves.hold)
        yield f"{leaves.place}{leaves.numbers[first]}", f"that N falls is not shown: {leaves.bound[first]:.3g}"
    return int(leaves.hold.size)


class Beyond(Boxes):
    """The bounds that rule `outer` asks for, on boxes lo and hi (n, B) in the coordinates z of its tree."""

    def __init__(self, case: Case) -> None:
        claim, evidence = case.outer
        super().__init__(case, evidence.T, case.seen_from(evidence.T))
        self.function, self.level, self.evidence = _function(case), claim.level, evidence
        ends_of = [[near(end).ends[side] for side, end in enumerate(pair)] for pair in self.c.domain]
        self.least, self.largest = np.array(ends_of).T[:, :, None]  # at or beyond the domain's ends, (n, 1)

    def leaves(self) -> Iterator[Batch]:
        """The tree's leaves in batches."""
        width = max(max(layer.W.shape) for layer in self.net.layers)
        values = max(self.function.values, len(self.c.dynamics.operations))
        size = _batch(max(self.symbols**2 * values, (self.symbols + 4) * width))
        return batches(self.evidence.tree, -self.evidence.root, self.evidence.root, size)

    def examine(self, first: int, lo: Array, hi: Array) -> Leaves:
        """The leaves with these corners, numbered from `first`, of which N'F is asked."""
        centre, radius = middle(lo, hi)
        x = self.states(centre, radius)
        close = np.flatnonzero(np.logical_not(self.is_outside(x) | (self.levels(lo, hi)[1] < self.c.c2)))
        left, models = _below_level(self.function, x[:, close], self.level)
        left, N = close[left], self.function.value(models).widened(self.symbols)
        x, centre, radius = x[:, left], centre[:, left], radius[:, left]
        u = enclose_on_boxes(self.net, x)
        states, held = self.models(x, u)
        F = self.f(states, [*held, *self.quantities(len(left))])
        rise = self.function.along(models, F)
        below = constant(Fraction(self.level), self.symbols, len(left)) + -N
        bound = self.least_bound(
            rise, [below.at, lambda few: self.gap(centre[:, few], radius[:, few], self.c.c2, -1.0)]
        )
        finite = np.all([np.isfinite(v.size.top) for v in (N, *F)], axis=0)
        return Leaves(self, first + left, "outer leaf ", u.range, bound, (bound < 0) & finite)

    def is_outside(self, x: Form) -> Array:
        """True on each box that certainly lies outside the domain, along one of the states."""
        lo, hi = x.range.ends
        outside: Array = np.any((lo > self.largest) | (hi < self.least), axis=0)
        return outside


OF_OUTER = (("outer", is_small),)
ON_FACES = (("faces", is_above_on_faces),)
OF_OUTER_TREE = (("outer", contains_domain), ("outer", is_partition))
ON_OUTER_LEAVES = (("inputs", keeps_inputs), ("outer", falls))


def _function(case: Case) -> Layers | Formula:
    function = case.outer[0].function
    return Layers(function) if isinstance(function, Network) else Formula(function)


def _batch(numbers: int) -> int:
    """The number of boxes per batch, each of which takes so many numbers."""
    return max(1, min(4096, _BATCH_NUMBERS // numbers))


def _below_level(function: Layers | Formula, x: Form, level: float) -> tuple[Array, list[Taylor]]:
    """The boxes, by their indices, on which N is not certainly above the level, and the function's models on these."""
    left = np.flatnonzero(np.logical_not(function.least(x) > level))
    x = x[:, left]
    models = function.models([affine(x.value[0, i], x.value[1:, i], x.error[i]) for i in range(x.value.shape[1])])
    N = function.value(models)
    above = np.isfinite(N.size.top) & (upper_bound(-N) < -level)
    still = np.flatnonzero(np.logical_not(above))
    return left[still], [v.at(still) for v in models]


def _numbers(like: Taylor) -> Callable[[Fraction], Taylor]:
    """The function that gives a rational's model."""
    return lambda q: constant(q, like.symbols, len(like.c))


def _stacked(models: Sequence[Taylor]) -> Taylor:
    """Models as rows of one."""
    c, p = np.stack([v.c for v in models]), np.stack([v.p for v in models], 1)
    return Taylor(c, p, Above(np.stack([v.r.top + np.zeros_like(v.c) for v in models])))


def _row(models: Taylor) -> Taylor:
    """The first of such models."""
    return Taylor(models.c[0], models.p[:, 0], models.r[0])


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
