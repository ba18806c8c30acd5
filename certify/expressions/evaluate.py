"""One walk over an expression for every arithmetic: rationals, Arb balls, Taylor models, jets.

An arithmetic says what a constant is and how constants enter sums and products; everything else follows from its
values' own `+`, `*`, `inverse` and functions. What the walk does not know it refuses: a node that slipped through
as something else would be a proof about another plant.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import reduce
from typing import Any, Generic, TypeVar

import sympy

from certify.errors import InputError
from certify.expressions.tree import CONSTANTS, GRAMMAR, as_function, as_power

V = TypeVar("V")


class Algebra(ABC, Generic[V]):
    """What an arithmetic does with the nodes of an expression.

    `total` and `product` get the constant of a sum or product apart from its other operands, which come in the
    expression's order. A power is the square of the power of half the exponent, times the base if it is odd.
    """

    @abstractmethod
    def constant(self, q: Fraction) -> V:
        """The value of an exact number."""

    def total(self, constant: Fraction | None, terms: Sequence[V]) -> V:
        """Sum of one or more values."""
        first = [] if constant is None else [self.constant(constant)]
        return reduce(lambda a, b: a + b, [*first, *terms])  # type: ignore[operator]

    def product(self, constant: Fraction | None, factors: Sequence[V]) -> V:
        """Product of one or more values."""
        first = [] if constant is None else [self.constant(constant)]
        return reduce(lambda a, b: a * b, [*first, *factors])  # type: ignore[operator]

    def inverse(self, value: V) -> V:
        """1 / value."""
        return value.inverse()  # type: ignore[attr-defined, no-any-return]

    def function(self, name: str, value: V) -> V:
        """One of `FUNCTIONS` by its name."""
        if name == "tan":
            return self.product(None, [self.function("sin", value), self.inverse(self.function("cos", value))])
        return getattr(value, name)()  # type: ignore[no-any-return]

    def power(self, base: V, exponent: int) -> V:
        """`base ** exponent`, exponent >= 1."""
        result = base
        for bit in bin(exponent)[3:]:
            result = self.product(None, [result, result])
            if bit == "1":
                result = self.product(None, [result, base])
        return result


def evaluate(
    expression: sympy.Expr,
    variables: Mapping[sympy.Symbol, V],
    algebra: Algebra[V],
    known: dict[Any, V] | None = None,
) -> V:
    """The value of an expression of a plant.

    Parameters
    ----------
    variables : the values of its symbols.
    known : subexpressions that are there already; filled on the way, so that calls can share them.

    Raises
    ------
    InputError : a symbol without a value, or a node outside the grammar.
    """
    known = {} if known is None else known
    if expression not in known:
        known[expression] = _evaluate(expression, variables, algebra, known)
    return known[expression]


def _evaluate(
    expression: sympy.Expr, variables: Mapping[sympy.Symbol, V], algebra: Algebra[V], known: dict[Any, V]
) -> V:
    if expression.is_Symbol:
        if expression not in variables:
            raise InputError(f"the expression uses {expression}, which has no value here.")
        return variables[expression]
    if expression.is_Rational:
        return algebra.constant(_fraction(expression))
    if expression in CONSTANTS:
        multiple, name = CONSTANTS[expression]
        return algebra.product(Fraction(multiple), [algebra.function(name, algebra.constant(Fraction(1)))])
    if (power := as_power(expression)) is not None:
        base, roots, exponent = power
        result = evaluate(base, variables, algebra, known)
        for _ in range(roots):
            result = algebra.function("sqrt", result)
        result = algebra.power(result, abs(exponent))
        return result if exponent > 0 else algebra.inverse(result)
    if expression.is_Add or expression.is_Mul:
        numbers = [_fraction(a) for a in expression.args if a.is_Rational]
        others = [evaluate(a, variables, algebra, known) for a in expression.args if not a.is_Rational]
        if expression.is_Add:
            return algebra.total(sum(numbers, Fraction(0)) if numbers else None, others)
        return algebra.product(reduce(lambda a, b: a * b, numbers) if numbers else None, others)
    if (function := as_function(expression)) is not None:
        name, argument = function
        return algebra.function(name, evaluate(argument, variables, algebra, known))
    raise InputError(f"{expression} is outside the grammar; allowed are {GRAMMAR}.")


def _fraction(q: sympy.Rational) -> Fraction:
    return Fraction(int(q.p), int(q.q))
