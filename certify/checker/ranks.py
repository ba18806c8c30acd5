"""The rules for ranks: from each leaf of a finite rank a few steps lead to the target, or to leaves of lower ranks;
where there is no target, to leaves of any finite rank.

A leaf is followed step by step: its image is affine in the symbols of the leaf and of the errors of the last steps, n
of each. New errors are bounded in coordinates N x, and so are the oldest ones, which have no symbols any more. Where
equations jump, a leaf has an image for each choice of heavisides that may occur. `Cover` decides which leaves the last
images meet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property, reduce
from itertools import product
from operator import add
from typing import TYPE_CHECKING

import numpy as np
from flint import arb, fmpq_mat

from .boxes import LEAF, Batch, batches, is_whole, middle
from .case import Case, Failures, given
from .exact import exactly, inverse, near_matrix
from .expression import evaluate
from .near import Above, Array, Form, Near, near, near_ball
from .network import enclose_on_boxes
from .periodic import is_periodic
from .ring import Motion, Moving
from .sections import MAX_RANK
from .taylor import Taylor, affine, combination, constants, upper_bound

if TYPE_CHECKING:
    from .rules import Tally

TURN = near_ball(2 * arb.pi())
_MOST_NODES = 2**14  # of the tree that an image may meet
_APART = 2.0**-20  # of a column's size, by which columns are kept from being dependent
_MOST_IMAGES = 64  # of a leaf, at once
Failing = tuple[str, str]  # a place, and what fails there


@dataclass
class Course:
    """The first failure of each rule on a batch of leaves, and how often each was decided."""

    failed: dict[str, Failing] = field(default_factory=dict)
    counts: dict[str, int] = field(default_factory=dict)

    def note(self, rule: str, hold: Array, numbers: Array, detail: str) -> None:
        """Take in what a rule says of leaves."""
        self.counts[rule] = self.counts.get(rule, 0) + len(numbers)
        if rule not in self.failed and not np.all(hold):
            self.failed[rule] = f"rank leaf {numbers[np.argmin(hold)]}", detail


class Cover:
    """The tree as arrays: which boxes meet only leaves of low ranks."""

    def __init__(self, case: Case) -> None:
        ranks = given(case.c.ranks)
        self.lo, self.hi, self.angles = ranks.lo, ranks.hi, ranks.angles
        count = len(ranks.tree)
        self.axis = np.frombuffer(ranks.tree, dtype=np.uint8).astype(np.int64)
        self.split, self.right = np.zeros(count), np.zeros(count, dtype=np.int64)
        self.most, self.least = np.full(count, MAX_RANK), np.zeros(count, dtype=np.int64)
        self._fill(ranks.tree, ranks.lo.tolist(), ranks.hi.tolist(), ranks.numbers[0].tolist())

    def _fill(self, tree: bytes, lo: list[float], hi: list[float], ranks: list[int]) -> None:
        """Splits, upper halves, and the highest and the lowest rank below each node, in preorder."""
        waiting, leaf = [(lo, hi, -1)], 0
        for node, axis in enumerate(tree):
            lo, hi, parent = waiting.pop()
            if parent >= 0:
                self.right[parent] = node
            if axis == LEAF:
                self.most[node] = self.least[node] = ranks[leaf]
                leaf += 1
                continue
            left, right = hi.copy(), lo.copy()
            left[axis] = right[axis] = self.split[node] = 0.5 * lo[axis] + 0.5 * hi[axis]
            waiting += [(right, hi, node), (lo, left, -1)]
        for node in range(len(tree) - 1, -1, -1):
            if tree[node] != LEAF:
                below = [node + 1, self.right[node]]
                self.most[node], self.least[node] = max(self.most[below]), min(self.least[below])

    def meets_low(self, lo: Array, hi: Array, bound: Array) -> Array:
        """True on boxes (n, B), as places, that lie in the root box and meet no leaf of a rank above a bound (B,)."""
        good, seen = np.ones(len(bound), dtype=bool), np.zeros(len(bound), dtype=np.int64)
        for low, high, some in self.places(lo, hi):
            left = some[good[some]]
            if not len(left):  # as of all that follow
                break
            good[left], seen[left] = self._descend(low[:, left], high[:, left], bound[left], seen[left])
        return good

    def places(self, lo: Array, hi: Array) -> Iterator[tuple[Array, Array, Array]]:
        """Boxes in the root box whose union has all places of these, where there is nothing to move the boxes; and the
        indices of those that are not done yet: where k angles are cut in two there are 2^k, one after the other."""
        turned = list(self.angles)
        first, second, cut = self._turned(lo[turned], hi[turned])
        digit, count = np.cumsum(cut, axis=0) - cut, np.sum(cut, axis=0)
        for number in range(2 ** int(np.max(count, initial=0))):
            other = cut & ((number >> digit) & 1 == 1)  # a digit of the box's number says what it has of an angle
            low, high = lo.copy(), hi.copy()
            low[turned], high[turned] = (np.where(other, b, a) for a, b in zip(first, second, strict=True))
            yield low, high, np.flatnonzero(number < 2.0**count)

    def _turned(self, lo: Array, hi: Array) -> tuple[tuple[Array, Array], tuple[Array, Array], Array]:
        """Two intervals in the root's that have all places of one in an angle, where it is cut in two; elsewhere the
        first has them, and may be all of the root's."""
        least, most = (end[list(self.angles)][:, None] for end in (self.lo, self.hi))
        turns = np.rint((0.5 * lo + 0.5 * hi - (0.5 * least + 0.5 * most)) / TURN.value)
        a, b = moved(lo, -turns)[0], moved(hi, -turns)[1]
        one = np.ones_like(a)
        after, before = moved(a, one)[0], moved(b, -one)[1]
        low, high = a < least, b > most
        known = np.where(
            low, ~high & (b >= least) & (after >= least), np.where(high, (a <= most) & (before <= most), a <= b)
        )
        whole = np.isfinite(a) & np.isfinite(b) & ~known
        first = np.where(whole, least, np.maximum(a, least)), np.where(whole, most, np.minimum(b, most))
        second = np.where(low, after, least), np.where(low, most, before)
        return first, second, known & (low | high)

    def _descend(self, lo: Array, hi: Array, bound: Array, seen: Array) -> tuple[Array, Array]:
        """Descend with all boxes at once, which have met so many nodes; one that has met too many fails."""
        inside = np.all((lo >= self.lo[:, None]) & (hi <= self.hi[:, None]), axis=0)
        good = inside.copy()
        box, node = np.flatnonzero(inside), np.zeros(int(np.sum(inside)), dtype=np.int64)
        while len(box):
            seen = seen + np.bincount(box, minlength=len(bound))
            good[box[(self.least[node] > bound[box]) | (seen[box] > _MOST_NODES)]] = False
            further = (self.most[node] > bound[box]) & good[box]
            box, node = box[further], node[further]
            axis, split = self.axis[node], self.split[node]
            below, above = lo[axis, box] <= split, hi[axis, box] >= split
            box, node = np.append(box[below], box[above]), np.append(node[below] + 1, self.right[node[above]])
        return good, seen


class Steps(Moving):
    """Leaves and their images."""

    def __init__(self, case: Case) -> None:
        n, (lo, hi) = len(case.c.states), case.c.sample or (0, 0)
        identity = fmpq_mat([[int(i == j) for j in range(n)] for i in range(n)])
        self.ranks = given(case.c.ranks)
        super().__init__(case, np.eye(n), identity, lo < hi, self.ranks.memory * n)
        self.widest = [np.inf] * n
        self.order = self.ranks.order
        self.frame = np.eye(n) if self.ranks.frame is None else self.ranks.frame
        self.back = near_matrix(given(inverse(exactly(self.frame))).transpose())
        self.rank, self.count = self.ranks.numbers
        self.straight = [i for i in range(n) if i not in self.ranks.angles]  # states that are no angles

    @cached_property
    def cover(self) -> Cover:
        return Cover(self.case)

    def leaves(self) -> Iterator[Batch]:
        """The tree's leaves in batches; the cover is made before there are several processes."""
        self.cover  # noqa: B018
        return batches(self.ranks.tree, self.ranks.lo, self.ranks.hi, self.batch)

    def examine(self, first: int, lo: Array, hi: Array) -> Course:
        """The leaves with these corners, numbered from `first`, and all steps from them."""
        course, numbers = Course(), first + np.arange(lo.shape[1])
        x = self.start(lo, hi)
        rank, count = self.rank[numbers], self.count[numbers]
        there = np.flatnonzero(rank == 0)
        course.note("ranks", self.is_in_target(x[:, there]), numbers[there], "the leaf must lie in the target")
        moving = np.flatnonzero((rank > 0) & (rank < MAX_RANK))
        x = x[:, moving]
        for k in range(1, int(np.max(count[moving], initial=0)) + 1):
            left = np.flatnonzero(count[moving] >= k)
            if not len(left):
                break
            x, of = self.step(x[:, left], numbers[moving[left]], course)
            moving = moving[left[of]]
            done = np.flatnonzero(count[moving] == k)
            arrived = moving[done]
            bound = np.full(len(arrived), MAX_RANK - 1) if self.c.claim == "remains" else rank[arrived] - k
            hold = self.arrives(x[:, done], bound)
            course.note("ranks", hold, numbers[arrived], "the steps may lead neither to the target nor to such ranks")
        return course

    def start(self, lo: Array, hi: Array) -> Form:
        """The boxes with these corners, in their symbols."""
        centre, radius = middle(lo, hi)
        slopes = np.eye(self.n)[:, :, None] * radius
        errors = np.zeros((self.ranks.memory * self.n, *centre.shape))
        return Form(np.concatenate([centre[None], slopes, errors]), Above(np.zeros_like(centre)))

    def step(self, x: Form, numbers: Array, course: Course) -> tuple[Form, Array]:
        """The images of forms, of leaves with these numbers, after a step, and which form each is of; and what the
        rules say of it.

        Of a form (1 + n + p n, n, B) the first n coefficients are those of the leaf's symbols, then come those of
        errors, n for each step, the last step first. With jumps images in the target are left out, and those of leaves
        that have too many. Before that a leaf may have thousands, so none of them waits for the others.
        """
        images, of, jumps = list[Form](), list[Array](), self.c.dynamics.jumps > 0
        leaves, leaf = np.unique(numbers, return_inverse=True)
        leads, met = np.zeros(len(numbers), dtype=bool), np.zeros(len(leaves), dtype=np.int64)
        for some in np.array_split(np.arange(len(numbers)), -(-len(numbers) // self.batch)):
            for later, which in self.images(x[:, some], numbers[some], course):
                form, left = some[which], np.arange(len(which))
                leads[form] = True
                if jumps:
                    left = np.flatnonzero(np.logical_not(self.is_in_target(later)))
                    met += np.bincount(leaf[form[left]], minlength=len(met))
                    left = left[met[leaf[form[left]]] <= _MOST_IMAGES]
                images.append(later[:, left])
                of.append(form[left])
        course.note("ranks", leads, numbers, "every step is excluded")
        few = met <= _MOST_IMAGES
        if jumps:
            course.note("ranks", few, leaves, f"a leaf may have no more than {_MOST_IMAGES} images at once")
        form = np.concatenate(of)
        error = Above(np.concatenate([v.error.top + 0 * v.value[0] for v in images], -1))
        every, left = Form(np.concatenate([v.value for v in images], -1), error), np.flatnonzero(few[leaf[form]])
        return every[:, left], form[left]

    def images(self, x: Form, numbers: Array, course: Course) -> Iterator[tuple[Form, Array]]:
        """The images of forms, of leaves with these numbers, some at a time, and which form each is of."""
        c = self.c
        u = enclose_on_boxes(self.net, x)
        hold = np.all(self.inputs_kept(x, u), axis=0)
        course.note("inputs", hold, numbers, "an input may leave its bounds, or have no value")
        states, inputs = self.models(x, u)
        held = [*inputs, *self.quantities(len(numbers))]
        motion = Motion([], [states], held) if c.dynamics.jumps else self.motion(states, inputs)
        if c.sample:
            hold = self.in_domain(*motion.ends)
            course.note("flow", hold, numbers, "the state may leave the domain during a period")
        if c.keep is not None:
            hold = self.kept(motion.courses, motion.held, ())
            course.note("keep", np.all(hold, axis=0), numbers, "a constraint may be violated")
        hold = self.in_domain(*x.range.ends)
        course.note("ranks", hold, numbers, "the state may leave the domain")
        every = (
            self.jumped(states, held) if c.dynamics.jumps else [(self.after(states, motion.G), np.arange(len(hold)))]
        )
        for models, some in filter(lambda each: len(each[1]), every):
            later = self.form(models)
            exist = np.isfinite(np.concatenate([later.size.top, u.size.top[:, some]]))
            course.note("ranks", np.all(exist, axis=0), numbers[some], "F may be undefined")
            yield later, some

    def jumped(self, states: list[Taylor], held: list[Taylor]) -> Iterator[tuple[list[Taylor], Array]]:
        """F on the forms where the signs of all arguments of heavisides are certain; for each choice of values, on
        those others where none of them certainly is the other number."""
        certain = np.ones(len(states[0].c), dtype=bool)

        def choose(a: Taylor) -> Taylor:
            above = upper_bound(-a) < 0
            certain[np.logical_not(above | (upper_bound(a) < 0))] = False
            return existing(a, above)

        F, some = self.f(states, held, choose), np.flatnonzero(certain)
        yield [v.at(some) for v in F], some
        some = np.flatnonzero(np.logical_not(certain))
        states, held = [v.at(some) for v in states], [v.at(some) for v in held]
        for choice in product((0, 1), repeat=self.c.dynamics.jumps) if len(some) else ():
            F, possible = self.chosen(states, held, choice)
            yield [v.at(possible) for v in F], some[possible]

    def chosen(self, states: list[Taylor], held: list[Taylor], choice: Sequence[int]) -> tuple[list[Taylor], Array]:
        """F with these values of heavisides, and the forms where each may have its value."""
        values, possible = iter(choice), np.ones(len(states[0].c), dtype=bool)

        def choose(a: Taylor) -> Taylor:
            value = next(values)
            possible[upper_bound(a if value else -a) < 0] = False
            return existing(a, np.full_like(possible, value))

        return self.f(states, held, choose), np.flatnonzero(possible)

    def form(self, models: list[Taylor]) -> Form:
        """Models in the symbols that they keep, and in new ones of errors that have all else."""
        n, kept, batch = self.n, self.ranks.memory * self.n, models[0].c.shape[-1]
        first = np.stack([np.concatenate([v.c[None], v.g[:kept]]) for v in models], 1)
        others = Near(np.stack([v.p[kept:] for v in models]).reshape(n, -1)).through(self.frame)
        others = Near(others.value.reshape(n, -1, batch), others.error.shaped(n, -1, batch))
        more = Above(np.stack([v.r.top + 0 * v.c for v in models])).through(self.frame)
        back = self.back[:, :, None]
        if self.ranks.moving:
            bound, back = turned(others, more, back)
        else:
            bound = others.size.sum(1) + more
        errors = Near(bound.top[:, None]) * back
        return Form(np.concatenate([first[: n + 1], errors.value, first[n + 1 :]]), errors.error.sum(0))

    def after(self, states: list[Taylor], G: list[Taylor]) -> list[Taylor]:
        """x + h G."""
        if self.c.sample is None:
            return [x + g for x, g in zip(states, G, strict=True)]
        h = self.number(self.c.sample, self.symbols - 1, len(states[0].c))
        return [x + h * g for x, g in zip(states, G, strict=True)]

    def in_domain(self, lo: Array, hi: Array) -> Array:
        """True on boxes with states strictly inside the domain, but for angles."""
        inside = np.ones(lo.shape[1], dtype=bool)
        for i in self.straight:
            (_, least), (most, _) = (near(end).ends for end in self.c.domain[i])
            inside &= (lo[i] > least) & (hi[i] < most)
        return inside

    def arrives(self, x: Form, bound: Array) -> Array:
        """True where forms lie in the target, or meet leaves of ranks up to a bound (B,) alone."""
        good = self.is_in_target(x)
        left = np.flatnonzero(np.logical_not(good))
        lo, hi = x[:, left].range.ends
        good[left] = self.cover.meets_low(lo, hi, bound[left])
        return good

    def is_in_target(self, x: Form) -> Array:
        """True where forms certainly lie in the target, as places."""
        if self.c.claim == "remains":
            return np.zeros(x.value.shape[2], dtype=bool)
        value, error = x.value.copy(), x.error
        if self.c.target is None:
            for i in self.ranks.angles:
                turned = Near(value[0, i]) + TURN * Near(-np.rint(value[0, i] / TURN.value))
                value[0, i], error = turned.value, error + Above(np.eye(self.n)[i][:, None] * turned.error.top)
        states = [affine(value[0, i], value[1:, i], error[i]) for i in range(self.n)]
        hold: Array = np.all([upper_bound(v) <= 0 for v in self.beyond(states)], axis=0)
        return hold

    def beyond(self, states: list[Taylor]) -> list[Taylor]:
        """V - c2, or the expressions, which are at most 0 in the target."""
        number = constants(states[0])
        if self.c.target is not None:
            return evaluate(self.c.target, number, states)
        rows = [combination(*zip(row, states, strict=True)) for row in self.c.P.tolist()]
        V = [x * row for x, row in zip(states, rows, strict=True)]
        return [reduce(add, [*V, number(Fraction(-self.c.c2))])]


def turned(others: Near, more: Above, back: Near) -> tuple[Above, Near]:
    """Bounds b (n, B) of the numbers y = Q^-1 v, where v are sums of columns `others` (n, K, B), the oldest errors'
    first, with symbols in [-1, 1], and of numbers up to `more` (n, B); and (N^-1 Q)' (n, n, B), of (N^-1)' (n, n, B).

    Nothing is believed of the Q that numpy finds: E = I - Q'Q is bounded; unless it is below 1/2 in the norm of row
    sums nothing is known. So Q has an inverse, and y = Q'v + E y gives |y_i| <= |Q'v|_i + |E| |y|, and |y| <= 2 |Q'v|.
    """
    n = len(others.value)
    columns = others.value[:, :n] / np.sum(np.abs(others.value[:, :n]), axis=0)
    columns = np.where(np.isfinite(columns), columns, 0.0) + _APART * np.eye(n)[:, :, None]
    Q, R = (np.moveaxis(M, 0, -1) for M in np.linalg.qr(np.moveaxis(columns, -1, 0)))
    Q = Q * np.where(R[range(n), range(n)] < 0, -1.0, 1.0)
    away = ((Near(Q[:, :, None]) * Near(Q[:, None])).sum() - Near(np.eye(n)[:, :, None])).size.sum(1).max()
    rows = [(Near(Q[:, i, None]) * others).sum().size.sum() + (more * np.abs(Q[:, i])).sum() for i in range(n)]
    b = Above(np.stack([row.top for row in rows]))
    b = b + b.max() * away.over(np.where(away.top < 0.5, 0.5, np.nan))
    return b, (Near(back.value[:, None], back.error.shaped(n, 1, n, -1)) * Near(Q[:, :, None])).sum()


def existing(a: Taylor, values: Array) -> Taylor:
    """0 or 1 on each form, and nothing where a may not exist."""
    zero = constants(a)(Fraction(0))
    return Taylor(np.where(values, 1.0, 0.0), zero.p, Above(0 * a.size.top))


def moved(x: Array, turns: Array) -> tuple[Array, Array]:
    """Numbers moved by so many turns, rounded down and up."""
    below, above = (Near(x) + TURN * Near(turns)).ends
    return np.where(turns == 0, x, below), np.where(turns == 0, x, above)


def is_stated(case: Case) -> Failures:
    """`ranks`: a root box with its tree, that has all places of an angle, and for each leaf a rank and its steps."""
    ranks, n = given(case.c.ranks), len(case.c.states)
    for i, (lo, hi) in enumerate(zip(ranks.lo.tolist(), ranks.hi.tolist(), strict=True)):
        least = Fraction(TURN.ends[1]) if i in ranks.angles else Fraction(0)
        if not Fraction(hi) - Fraction(lo) > least:
            yield f"evidence.ranks, axis {i}", "lo must be below hi, in an angle by more than 2 pi"
    if ranks.frame is not None and inverse(exactly(ranks.frame)) is None:
        yield "evidence.ranks.frame", "it must have an inverse"
    leaves = yield from is_whole(ranks.tree, range(n), "ranks, ")
    if len(ranks.ranks) != 2 * leaves or len(ranks.steps) not in (leaves, 2 * leaves):
        yield "evidence.ranks", f"there must be two bytes of ranks and one or two of steps for each of {leaves} leaves"
    rank, count = ranks.numbers
    resting = (rank == 0) | (rank == MAX_RANK)
    hold = np.where(resting, count == 0, (count > 0) & (count <= rank) & (rank <= ranks.most))
    if not np.all(hold):
        yield f"rank leaf {np.argmin(hold)}", "its steps must be 0 at rank 0 and 65535, else 0 < steps <= rank <= most"
    return leaves


def _holds(rule: str) -> Callable[[Course], Failures]:
    """The rule on a batch of leaves."""

    def holds(course: Course) -> Failures:
        if rule in course.failed:
            yield course.failed[rule]
        return course.counts.get(rule, 0)

    return holds


def examine(tally: Tally, case: Case) -> None:
    tally.hold(OF_RANKS, case)
    tally.hold_on_leaves(ON_RANK_LEAVES, Steps(case), given(case.c.ranks).tree, lambda _: np.zeros(0))


OF_RANKS = (("angles", is_periodic), ("ranks", is_stated))
ON_RANK_LEAVES = tuple((rule, _holds(rule)) for rule in ("inputs", "flow", "keep", "ranks"))
