"""Steps of networks that are neither affine nor a function of each entry, and clips, the policy's own among them.

What each means has a class for each algebra: numbers, boxes, balls. Algebras that only some certificates need have the
meaning of these steps beside that of the others.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import reduce
from operator import add
from typing import Any

import numpy as np

from .ball import OnBall, Rows
from .elementary import clip_of, lines_around_product
from .exact import Exact, Exactly, clipped
from .expression import Tape, evaluate, parse
from .jets import Jet, constant
from .near import ZERO, Above, Array, Form, Near, Uniform, Vector, norm, size
from .network import Enclosed, OnBoxes
from .networks import MAX_STEPS, MAX_WIDTH, Step, vectors_of
from .schema import Value
from .taylor import constants, forms, models
from .words import expression

MAX_NAMES = 64


@dataclass(frozen=True, eq=False)
class Clip(Step):
    """`min(max(h, lo), hi)`."""

    lo: Array
    hi: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        return self.lo, self.hi


class Sum(Step):
    """The sum of vectors, from left to right."""


class Concat(Step):
    """Vectors one behind the other."""


class Product(Step):
    """The product of two vectors, entry by entry; one of a single entry multiplies every entry of the other."""


@dataclass(frozen=True, eq=False)
class Observe(Step):
    """Expressions of the entries, by their names."""

    names: tuple[str, ...]
    tape: Tape

    @property
    def words(self) -> str:
        trees = json.dumps(self.tape.trees, separators=(",", ":"))
        return super().words + "".join(f"{name}\0" for name in self.names) + f"{trees}\0"

    def said(self, of: str) -> str:
        made = ", ".join(expression(tree) for tree in self.tape.trees)
        return f"({made}) of ({', '.join(self.names)}) = {of}"


def read(value: Value, sizes: Sequence[int]) -> Step:
    """A step of one of these kinds, after vectors of these sizes."""
    kind = value.raw["kind"]
    keys = {"clip": "lo hi", "observe": "names expressions"}.get(kind, "")
    _, of, *others = value.keys(f"kind of {keys}")
    least, most = {"product": (2, 2), "sum": (2, MAX_STEPS), "concat": (2, MAX_STEPS)}.get(kind, (1, 1))
    read = vectors_of(of, sizes, least, most)
    each, width = [sizes[i] for i in read], sizes[read[0]]
    match kind:
        case "clip":
            lo, hi = (end.array(width) for end in others)
            value.must(bool(np.all(lo < hi)), "lower, then upper ends")
            return Clip(read, width, lo, hi)
        case "sum":
            of.must(set(each) == {width}, "vectors of equal length")
            return Sum(read, width)
        case "concat":
            of.must(sum(each) <= MAX_WIDTH, f"vectors of at most {MAX_WIDTH} entries in all")
            return Concat(read, sum(each))
        case "product":
            of.must({*each} <= {1, max(each)}, "vectors of equal length, or one of a single entry")
            return Product(read, max(each))
    names, expressions = others
    named = names.listed(Value.name, width, min(width, MAX_NAMES))
    names.must(len(set(named)) == width, "different names")
    trees = expressions.listed(lambda tree: tree.raw, 1, MAX_NAMES)
    return Observe(read, len(trees), named, parse(trees, named, expressions.at))


class NumberSteps:
    """Numbers that add and multiply, in lists."""

    def sum(self, step: Sum, *vectors: list[Any]) -> list[Any]:
        return [reduce(add, entries) for entries in zip(*vectors, strict=True)]

    def concat(self, step: Concat, *vectors: list[Any]) -> list[Any]:
        return [x for v in vectors for x in v]

    def product(self, step: Product, v: list[Any], w: list[Any]) -> list[Any]:
        return [v[i % len(v)] * w[i % len(w)] for i in range(step.size)]


class ExactSteps(NumberSteps):
    """Rationals, and numbers without a value."""

    def clip(self, step: Clip, v: list[Exact]) -> list[Exact]:
        return [clipped(x, *ends) for x, *ends in zip(v, step.lo.tolist(), step.hi.tolist(), strict=True)]

    def observe(self, step: Observe, v: list[Exact]) -> list[Exact]:
        return evaluate(step.tape, Exact, v)


class BoxSteps:
    """Forms on boxes, with what each step adds to errors."""

    def __init__(self, boxes: OnBoxes) -> None:
        self.boxes, self.k = boxes, len(boxes.steps) - 1  # the step in hand

    def clip(self, step: Clip, v: Enclosed) -> Enclosed:
        h, slope, gap = clip_forms(v.plain, v.spread + v.error, step.lo, step.hi)
        return self.boxes.by_lines(v, h, slope, gap)

    def sum(self, step: Sum, *vectors: Enclosed) -> Enclosed:
        h, (first, *others) = vectors[0].h, vectors
        fresh, old, ball = first.fresh, first.old, first.ball
        for v in others:
            h, fresh, old, ball = h + v.h, fresh + v.fresh, old + v.old, ball + v.ball
        self.boxes.added[-1] = h.error
        return Enclosed(Form(h.value), fresh + h.error, old, ball, self.k)

    def concat(self, step: Concat, *vectors: Enclosed) -> Enclosed:
        h = Form(np.concatenate([v.h.value for v in vectors], 1))
        fresh, old = (
            Above(np.concatenate([part.top + 0 * v.spread.v for part, v in zip(parts, vectors, strict=True)]))
            for parts in ([v.fresh for v in vectors], [v.old for v in vectors])
        )
        squares = ZERO
        for v in vectors:
            squares = squares + v.ball * v.ball
        return Enclosed(h, fresh, old, squares.root, self.k)

    def product(self, step: Product, v: Enclosed, w: Enclosed) -> Enclosed:
        """With v = c + V and w = e + W it is c e + c W + e V + V W: errors of v and w pass times e and c, exact
        numbers, and V W is between bounds."""
        c, e = v.h.value[0], w.h.value[0]
        moved, other = _unmoved(v.h), _unmoved(w.h)
        shift, gap = lines_around_product(moved, v.error, other, w.error, v.step == w.step)
        h = (w.plain * Near(c) + moved * Near(e)).raised(Near(shift))
        passed, added = v.error * size(e) + w.error * size(c), gap + h.error
        self.boxes.added[-1], self.boxes.factors[self.k] = added, (e, c)
        ball = (_length(v, e) + _length(w, c)).least(passed.norm())
        return Enclosed(Form(h.value), added, passed, ball, self.k)

    def observe(self, step: Observe, v: Enclosed) -> Enclosed:
        """Also what no expression reads must exist."""
        x = models(v.h, v.error)
        y = evaluate(step.tape, constants(x[0]), x)
        h, exists = forms(y), np.all([np.isfinite(entry.size.top) for entry in x], axis=0)
        error = self.boxes.added[-1] = h.error.where(exists, Above(np.nan))
        return Enclosed(Form(h.value), error, ZERO, ZERO, self.k)

    def before(self, k: int, step: Step, weight: Uniform) -> list[tuple[int, Uniform]]:
        """The weights with which errors of the vectors that step k reads reach the value through it."""
        match step:
            case Clip():
                return [(step.of[0], weight.times(self.boxes.slopes[k][:, None]))]  # type: ignore[index]
            case Sum():
                return [(i, weight) for i in step.of]
            case Product():
                return [
                    (i, _gathered(weight.times(factor[:, None]), self.boxes.width(i)))
                    for i, factor in zip(step.of, self.boxes.factors[k], strict=True)
                ]
            case Concat():
                ends = np.cumsum([0, *(self.boxes.width(i) for i in step.of)])
                return [
                    (i, Uniform(weight.value[a:b], weight.error))
                    for i, a, b in zip(step.of, ends[:-1], ends[1:], strict=True)
                ]
        return []  # expressions keep no way back


def _unmoved(h: Form) -> Form:
    """The coefficients of the symbols alone, and 0 for that of 1."""
    return Form(np.concatenate([np.zeros_like(h.value[:1]), h.value[1:]]))


def _length(v: Enclosed, factor: Array) -> Above:
    """Upper bound of the 2-norm of the errors of v times factors, of an error for all of them if v has one entry."""
    steep = norm(factor) if v.h.value.shape[1] == 1 else size(factor).max()
    return steep * (v.ball + v.fresh.norm())


def _gathered(weight: Uniform, width: int) -> Uniform:
    """The weights of a vector of this width that is multiplied; of a single entry, those of all products together."""
    count = len(weight.value)
    return weight.through(np.ones((1, count))) if width == 1 < count else weight


def clip_forms(v: Form, error: Above, least: Array, most: Array) -> tuple[Form, Array, Above]:
    """Lines around `min(max(v, least), most)`, of numbers within `error` of the first coefficients of the forms v:
    these lines of the forms, their slopes, and how far from them it may be; least and most (m,).

    Nothing changes where v certainly stays between them.
    """
    numbers = Near(v.value[0], error)
    lo, hi = numbers.ends
    inside = (lo >= least[:, None]) & (hi <= most[:, None])
    slope, shift, gap = clip_of(numbers, least[:, None], most[:, None])
    cut = (v * Near(slope)).raised(Near(shift))
    kept = Form(np.where(inside, v.value, cut.value), Above(np.where(inside, 0.0, cut.error.top)))
    return kept, np.where(inside, 1.0, slope), Above(np.where(inside, 0.0, gap.top))


class BallSteps:
    """Vectors on a ball, whose units stand in the algebra."""

    def __init__(self, ball: OnBall) -> None:
        self.ball = ball

    def clip(self, step: Clip, v: Rows) -> Rows:
        """Entries that are certainly not clipped stay, those that certainly are become constant, others NaN."""
        value = self.ball.jets(v)
        lo, hi = value.range.ends
        free, low, high = (lo > step.lo) & (hi < step.hi), hi < step.lo, lo > step.hi
        slope = np.where(free, 1.0, np.where(low | high, 0.0, np.nan))
        y = Near(np.where(free, v.y.value, np.where(low, step.lo, step.hi)), v.y.error * slope)
        return Rows(y, self.ball.columns(v, value.units.count).times(Near(slope)))

    def sum(self, step: Sum, *vectors: Rows) -> Rows:
        units = self.ball.R.shape[2]
        y, X = vectors[0].y, self.ball.columns(vectors[0], units)
        for v in vectors[1:]:
            y, X = y + v.y, X + self.ball.columns(v, units)
        return Rows(y, X)

    def concat(self, step: Concat, *vectors: Rows) -> Rows:
        parts, error = [self.ball.columns(v, self.ball.R.shape[2]) for v in vectors], ZERO
        for X in parts:
            error = error + X.error * X.error
        y = np.concatenate([v.y.value for v in vectors])
        of_y = np.concatenate([v.y.error.top + 0 * v.y.value for v in vectors])
        return Rows(Near(y, Above(of_y)), Vector(np.concatenate([X.value for X in parts]), error.root))

    def product(self, step: Product, v: Rows, w: Rows) -> Rows:
        """The units are products of both without their values at d = 0, as of jets without constants."""
        units = self.ball.R.shape[2]
        x, y = (self.repeated(part, step.size, units) for part in (v, w))
        first, second = self.ball.jets(x), self.ball.jets(y)
        none = Near(np.zeros(step.size))
        made = replace(first, c=none) * replace(second, c=none, units=first.units)
        X = y.X.times(x.y) + x.X.times(y.y)
        of_units = self.ball.with_units(made.Q.value, made.K.value, made.remainder, made.lipschitz)
        return Rows(x.y * y.y, X, of_units)

    def repeated(self, v: Rows, width: int, units: int) -> Rows:
        """A vector of so many entries, all of them the same if it has a single one, with columns for all units."""
        X = self.ball.columns(v, units)
        if len(X.value) == width:
            return Rows(v.y, X)
        ones = np.ones((width, 1))
        return Rows(v.y.through(ones), X.mapped(ones, size(ones).norm((0, 1))))

    def observe(self, step: Observe, v: Rows) -> Rows:
        u = self.ball.jets(v)
        entries = [
            Jet(u.c[j], u.a[j], u.Q[j], u.K[j], u.E[j], Near(u.B.value[:, j]), u.units, u.lip[j])
            for j in range(len(v.y.value))
        ]
        return self.ball.entered(evaluate(step.tape, lambda q: constant(q, u.units), entries))


MEANINGS: dict[type, Callable[[Any], Any]] = {Exactly: lambda _: ExactSteps(), OnBoxes: BoxSteps, OnBall: BallSteps}
