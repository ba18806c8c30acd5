"""Power series in time over any arithmetic, for solutions of the plant's equations within a sampling period.

A value of this arithmetic is a row of coefficients of t^0, t^1, ..., each a value of the inner arithmetic. Because
x' = f(x, u), coefficient k of f gives coefficient k + 1 of x: the expressions are walked once, and then every node
takes its next coefficient in the order of creation, so that nothing is computed twice. A coefficient that is certainly
0 is not stored as a value, so that it costs nothing and adds no error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Generic, TypeVar

from certify.loop.expressions.evaluate import Algebra, evaluate
from certify.loop.expressions.tree import Expression, Symbol

V = TypeVar("V")


class Series(Generic[V]):
    """`coefficients` of t^0, t^1, ... as far as they are known; None stands for a certain 0."""

    __slots__ = ("coefficients",)

    def __init__(self, *coefficients: V | None) -> None:
        self.coefficients: list[V | None] = list(coefficients)


class PowerSeries(Algebra[Series[V]]):
    """Expressions of the plant on power series whose coefficients are values of `inner`.

    A new series has one coefficient. `advance` gives each series its next one from those of its operands, once the
    series from outside have theirs. No series is created after the first `advance`.
    """

    def __init__(self, inner: Algebra[V]) -> None:
        self.inner = inner
        self._known = 1  # coefficients of each series
        self._made: list[tuple[Series[V], Callable[[int], V | None]]] = []
        self._circles: dict[int, tuple[Series[V], Series[V], Series[V]]] = {}

    def advance(self) -> None:
        """Compute one more coefficient of every series."""
        for series, rule in self._made:
            series.coefficients.append(rule(self._known))
        self._known += 1

    def forget(self) -> None:
        """Let go of all rules. They know this object and it knows them, a circle that would keep large values until
        Python looks for circles."""
        self._made.clear()

    def held(self, value: V) -> Series[V]:
        """A constant in time."""
        return self._follow(lambda k: None if k else value)

    def constant(self, q: Fraction) -> Series[V]:
        return self.held(self.inner.constant(q))

    def total(self, constant: Fraction | None, terms: Sequence[Series[V]]) -> Series[V]:
        rows = [term.coefficients for term in terms]
        return self._follow(lambda k: self._sum(None if k else constant, [row[k] for row in rows]))

    def product(self, constant: Fraction | None, factors: Sequence[Series[V]]) -> Series[V]:
        result = factors[0]
        for factor in factors[1:]:
            result = self._times(result, factor)
        return result if constant is None else self._scaled(constant, result)

    def inverse(self, value: Series[V]) -> Series[V]:
        """1 / v by `v_0 y_k = -sum_(j>=1) v_j y_(k-j)`."""
        y: Series[V] = Series()
        v = value.coefficients

        def rule(k: int) -> V | None:
            if not k:
                return self.inner.inverse(self._first(v))
            terms = [self._product(None, v[j], y.coefficients[k - j]) for j in range(1, k + 1)]
            return self._product(Fraction(-1), self._sum(None, terms), y.coefficients[0])

        return self._follow(rule, y)

    def function(self, name: str, value: Series[V]) -> Series[V]:
        """One of `FUNCTIONS`, by `k w_k = sum_(j>=1) j v_j s_(k-j)`, s the series of the derivative phi'(v); or abs, or
        sign, which is constant where it is certain."""
        if name == "tan":
            return super().function(name, value)
        if name in ("sin", "cos"):
            return self._circle(value)[name == "cos"]
        if name == "sign":
            return self.held(self.inner.function(name, self._first(value.coefficients)))
        result: Series[V] = Series()
        if name == "abs":
            return self._follow(self._magnitude(value), result)
        if name == "sqrt":
            return self._follow(self._root(value, result), result)
        if name == "exp":
            slope = result
        elif name == "tanh":
            slope = Series()
        else:
            slope = self.inverse(self.total(Fraction(1), [self._times(value, value)]))
        self._follow(self._integral(name, Fraction(1), value, slope), result)
        if name == "tanh":  # 1 - t^2 of the coefficients that t has by then
            square = self._times(result, result)
            self._follow(lambda k: self._slope_of_tanh(k, square), slope)
        return result

    def _slope_of_tanh(self, k: int, square: Series[V]) -> V | None:
        return self._sum(None if k else Fraction(1), [self._product(Fraction(-1), square.coefficients[k])])

    def _circle(self, value: Series[V]) -> tuple[Series[V], Series[V]]:
        """(sin, cos), which are each other's derivatives; one pair per series."""
        if id(value) not in self._circles:
            sine: Series[V] = Series()
            cosine: Series[V] = Series()
            self._follow(self._integral("sin", Fraction(1), value, cosine), sine)
            self._follow(self._integral("cos", Fraction(-1), value, sine), cosine)
            self._circles[id(value)] = value, sine, cosine  # with the value, so that its id stays its own
        return self._circles[id(value)][1:]

    def _integral(self, name: str, sign: Fraction, value: Series[V], slope: Series[V]) -> Callable[[int], V | None]:
        def rule(k: int) -> V | None:
            v, s = value.coefficients, slope.coefficients
            if not k:
                return self.inner.function(name, self._first(v))
            return self._sum(None, [self._product(sign * Fraction(j, k), v[j], s[k - j]) for j in range(1, k + 1)])

        return rule

    def _root(self, value: Series[V], result: Series[V]) -> Callable[[int], V | None]:
        """The root w by `2 w_0 w_k = v_k - sum_(0<j<k) w_j w_(k-j)`."""
        inverse: list[V] = []

        def rule(k: int) -> V | None:
            v, w = value.coefficients, result.coefficients
            if not k:
                return self.inner.function("sqrt", self._first(v))
            if not inverse:
                inverse.append(self.inner.inverse(self._first(w)))
            terms = [self._product(Fraction(-1), w[j], w[k - j]) for j in range(1, k)]
            return self._product(Fraction(1, 2), self._sum(None, [v[k], *terms]), inverse[0])

        return rule

    def _magnitude(self, value: Series[V]) -> Callable[[int], V | None]:
        """Times the sign of v_0, which has to be certain unless v is constant in time: where v passes 0 there is no
        series, though all its later coefficients be 0."""
        v, sign = value.coefficients, list[V]()

        def rule(k: int) -> V | None:
            if not k:
                return self.inner.function("abs", self._first(v))
            if v[k] is not None and not sign:
                sign.append(self.inner.function("sign", self._first(v)))
            if v[k] is None and sign:
                return self.inner.product(Fraction(0), sign)
            return self._product(None, *sign, v[k])

        return rule

    def _times(self, a: Series[V], b: Series[V]) -> Series[V]:
        v, w = a.coefficients, b.coefficients
        return self._follow(lambda k: self._sum(None, [self._product(None, v[i], w[k - i]) for i in range(k + 1)]))

    def _scaled(self, factor: Fraction, value: Series[V]) -> Series[V]:
        return self._follow(lambda k: self._product(factor, value.coefficients[k]))

    def _follow(self, rule: Callable[[int], V | None], series: Series[V] | None = None) -> Series[V]:
        """A series whose coefficients come from a rule, which may ask for earlier ones of its own."""
        series = Series() if series is None else series
        series.coefficients.append(rule(0))
        self._made.append((series, rule))
        return series

    def _first(self, coefficients: Sequence[V | None]) -> V:
        first = coefficients[0]
        return self.inner.constant(Fraction(0)) if first is None else first

    def _sum(self, constant: Fraction | None, terms: Sequence[V | None]) -> V | None:
        there = [term for term in terms if term is not None]
        if not there:
            return None if constant is None else self.inner.constant(constant)
        return there[0] if len(there) == 1 and constant is None else self.inner.total(constant, there)

    def _product(self, constant: Fraction | None, *factors: V | None) -> V | None:
        there = [factor for factor in factors if factor is not None]
        if len(there) < len(factors):
            return None
        constant = None if constant == 1 else constant
        return there[0] if len(there) == 1 and constant is None else self.inner.product(constant, there)


def solution_series(
    dynamics: Sequence[Expression],
    states: Mapping[Symbol, V],
    held: Mapping[Symbol, V],
    algebra: Algebra[V],
    order: int,
) -> list[list[V]]:
    """Coefficients of the solution of `x' = f(x)` from the states, with all else constant.

    Parameters
    ----------
    dynamics : f, in the order of the states.
    states : their values at t = 0, the coefficients x_0.
    held : the values of all other symbols.
    order : number of coefficients after x_0, at least 1.

    Returns
    -------
    list : for each state x_1, ..., x_order: with f_k the k-th coefficient of f, `x_(k+1) = f_k / (k + 1)`.
    """
    series = PowerSeries(algebra)
    x: dict[Symbol, Series[V]] = {symbol: Series(value) for symbol, value in states.items()}
    values = {**x, **{symbol: series.held(value) for symbol, value in held.items()}}
    known: dict[Expression, Series[V]] = {}
    f = [evaluate(expression, values, series, known) for expression in dynamics]
    for k in range(order):
        if k:
            series.advance()
        for own, rate in zip(x.values(), f, strict=True):
            own.coefficients.append(_divided(rate.coefficients[k], k + 1, algebra))
    series.forget()
    zero = algebra.constant(Fraction(0))
    return [[zero if v is None else v for v in own.coefficients[1:]] for own in x.values()]


def _divided(value: V | None, count: int, algebra: Algebra[V]) -> V | None:
    return value if value is None or count == 1 else algebra.product(Fraction(1, count), [value])
