"""N of a claim that goes beyond {V <= c2}, and how it changes along F, in models on a box.

A network is taken step by step with a model for every entry: an affine step is a product of matrices with a row for
each model, its coefficients behind each other, its remainder by the magnitudes of the weights. How fast its value
changes is found with the models of the value, of which `map` and `observe` are kept. Where a box is wide, the
functions of a network are far from their tangents, and lie better between two lines.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from flint import arb, arb_mat

from . import affine
from .balls import SPREAD, ZERO
from .document import Certificate, Function
from .expressions import Call
from .networks import Affine, Clip, Map, Network, Observe, OnLists, Product
from .refusal import Refused
from .series import Coefficient, Term, along
from .taylor import Taylor, constant

Vector = list[Taylor]


class InRows(OnLists):
    """Networks of models. `seen` has what `map`, `product` and `observe` steps have read, in their order."""

    def __init__(self) -> None:
        self.seen = list[Vector]()

    def affine(self, step: Affine, v: Vector) -> Vector:
        return [x + Taylor(b) for x, b in zip(mapped(step.W, step.magnitudes, v), step.b, strict=True)]

    def map(self, step: Map, v: Vector) -> Vector:
        self.seen.append(v)
        return super().map(step, v)

    def clip(self, step: Clip, v: Vector) -> Vector:
        """Numbers alone, for a clip has no model."""
        if any(x.g is not None for x in v):
            raise Refused("ring", "leaf", "a clip has no model")
        return [Taylor(whole(x).max(arb(lo)).min(arb(hi))) for x, lo, hi in zip(v, step.lo, step.hi, strict=True)]

    def product(self, step: Product, v: Vector, w: Vector) -> Vector:
        self.seen += [v, w]
        return super().product(step, v, w)

    def observe(self, step: Observe, v: Vector) -> Vector:
        self.seen.append(v)
        return step.expressions.evaluate(dict(zip(step.names, v, strict=True)), constant)


class Rates(OnLists):
    """The derivatives of the entries where those of a network's first vector are given, in the models of its values."""

    def __init__(self, seen: Sequence[Vector]) -> None:
        self.seen = iter(seen)

    def affine(self, step: Affine, v: Vector) -> Vector:
        return mapped(step.W, step.magnitudes, v)

    def map(self, step: Map, v: Vector) -> Vector:
        return [x.slope_of(step.function) * rate for x, rate in zip(next(self.seen), v, strict=True)]

    def clip(self, step: Clip, v: Vector) -> Vector:
        raise Refused("ring", "leaf", "a clip may have no derivative")

    def product(self, step: Product, v: Vector, w: Vector) -> Vector:
        """(x y)' = x y' + y x'."""
        x, y = next(self.seen), next(self.seen)
        one, other = (super(Rates, self).product(step, *pair) for pair in ((x, w), (y, v)))
        return [a + b for a, b in zip(one, other, strict=True)]

    def observe(self, step: Observe, v: Vector) -> Vector:
        values, rates = (dict(zip(step.names, each, strict=True)) for each in (next(self.seen), v))
        return [number(rate) for _, rate in along(step.expressions, values, rates, constant)]


def number(v: Coefficient) -> Taylor:
    return Taylor(ZERO) if v is None else v


def net_at_0(c: Certificate) -> list[arb]:
    """The value of the policy's network at x = 0; no numbers where it may be undefined."""
    try:
        value: Vector = c.policy.network.run(InRows(), [Taylor(arb(v)) for v in c.policy.origin])
    except Refused:
        return [arb("nan")] * c.m
    return [whole(y) for y in value]


def whole(v: Taylor) -> arb:
    """A model without symbols as one ball."""
    return v.c + v.r * SPREAD


def called(call: Call, given: Sequence[Taylor]) -> Vector:
    value = call.network.run(InRows(), list(given))
    return [value[i] for i in call.entries]


def called_along(call: Call, given: Sequence[Term]) -> list[Term]:
    """A call of series, of which two coefficients are known."""
    moving = MovingCall(call.network, given)

    def rule(i: int) -> Callable[[int], Coefficient]:
        return lambda k: moving.coefficient(k)[i]

    return [Term(given[0].tape, rule(i)) for i in call.entries]


class MovingCall:
    """The value of a network along series, once for all entries that are used."""

    def __init__(self, network: Network, given: Sequence[Term]) -> None:
        self.network, self.given, self.algebra = network, given, InRows()
        self.found = list[Vector]()

    def coefficient(self, k: int) -> Vector:
        if k == len(self.found):
            at = [number(term.c[k]) for term in self.given]
            algebra: Any = Rates(self.algebra.seen) if k else self.algebra
            self.found.append(self.network.run(algebra, at))
        return self.found[k]


class Models:
    """The function of a claim on as many boxes as are asked for, given the models of the states there."""

    def __init__(self, N: Function, states: tuple[str, ...]) -> None:
        self.N, self.states, self.level = N.expression, states, arb(N.level)

    def value(self, x: Sequence[Taylor]) -> Taylor:
        """N, or a refusal where it may be undefined."""
        value: Taylor = self.N.evaluate(dict(zip(self.states, x, strict=True)), constant, called)[0]
        return value

    def is_above(self, x: Sequence[Taylor]) -> bool:
        """True if N is certainly defined, and above its level, on all of the box; x without remainders."""
        return self.certainly(x, lambda N: bool(-(-N).bound() > self.level))

    def is_below(self, x: Sequence[Taylor]) -> bool:
        """The same with N below its level."""
        return self.certainly(x, lambda N: bool(N.bound() < self.level))

    def certainly(self, x: Sequence[Taylor], test: Callable[[Taylor], bool]) -> bool:
        """True if one of the models of N is finite and passes."""
        ways = (self.value, self.by_forms) if self.N.calls else (self.value,)
        refused = None
        for way in ways:
            try:
                N = way(x)
            except Refused as no:
                refused = no
                continue
            if N.is_finite() and test(N):
                return True
        if refused is not None and len(ways) == 1:
            raise refused
        return False

    def by_forms(self, x: Sequence[Taylor]) -> Taylor:
        """N with the affine forms of its calls' values, each entry with a symbol for its error."""
        before = max(v.symbols for v in x)
        symbols = before + self.N.entries

        def of_call(call: Call, given: Sequence[Taylor]) -> Vector:
            return affine.called(call, given, symbols, before)

        wide = [Taylor(v.c, arb_mat(1, symbols, wider(v, symbols)), None, v.second + v.r) for v in x]
        value: Taylor = self.N.evaluate(dict(zip(self.states, wide, strict=True)), constant, of_call)[0]
        return value

    def moving(self, x: Sequence[Taylor], F: Sequence[Taylor]) -> tuple[Taylor, Taylor]:
        """N and N'F, or a refusal where N may be undefined."""
        states, rates = (dict(zip(self.states, each, strict=True)) for each in (x, F))
        ((value, rate),) = along(self.N, states, rates, constant, called_along)
        return value, number(rate)


def wider(v: Taylor, symbols: int) -> list[arb]:
    return [*v.slopes(v.symbols), *([ZERO] * (symbols - v.symbols))]


def mapped(W: arb_mat, magnitudes: arb_mat, x: Sequence[Taylor]) -> Vector:
    """W times a column of models."""
    symbols = max(v.symbols for v in x)
    square = symbols**2 if any(v.Q is not None for v in x) else 0
    rows = (W * arb_mat([[v.c, *v.slopes(symbols), *squares(v, square)] for v in x])).tolist()
    rest, end = (magnitudes * arb_mat([[v.r] for v in x])).entries(), 1 + symbols
    return [
        Taylor(
            row[0],
            arb_mat(1, symbols, row[1:end]) if symbols else None,
            arb_mat(symbols, symbols, row[end:]) if square else None,
            r,
        )
        for row, r in zip(rows, rest, strict=True)
    ]


def squares(v: Taylor, count: int) -> list[arb]:
    return [ZERO] * count if v.Q is None else list(v.Q.entries())
