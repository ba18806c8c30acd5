"""One walk over an expression for every arithmetic: rationals, Arb balls, Taylor models, jets.

An arithmetic defines constants and the way they enter sums and products; everything else follows from its values' own
`+`, `*`, `inverse` and functions. The walk rejects unknown nodes: a node evaluated as something else would give a proof
about another plant.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from fractions import Fraction
from functools import partial, reduce
from typing import Generic, TypeVar

from certify.errors import InputError
from certify.loop.expressions.gathering import gathered
from certify.loop.expressions.tree import FUNCTIONS, GRAMMAR, JUMP, Expression, Number, Operation, Symbol, nodes

OF_ONE = (*FUNCTIONS, "abs", JUMP, "sign")

V = TypeVar("V")


class Algebra(ABC, Generic[V]):
    """An arithmetic's operations on the nodes of an expression.

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
        """One of `FUNCTIONS`, abs or sign, by its name; a sign that is not certain is no number. An arithmetic that
        takes equations that jump says so itself."""
        if name == JUMP:
            raise InputError("equations that jump, with heaviside, are no part of this proof.")
        if name == "tan":
            return self.product(None, [self.function("sin", value), self.inverse(self.function("cos", value))])
        return getattr(value, name)()  # type: ignore[no-any-return]

    def extreme(self, name: str, a: V | Fraction, b: V | Fraction) -> V | Fraction:
        """The larger of two, `(a + b + abs(a - b))/2`, or the lesser one (`min`), with `-abs`; of exact numbers the
        exact one."""
        if isinstance(a, Fraction) and isinstance(b, Fraction):
            return max(a, b) if name == "max" else min(a, b)
        q = next((v for v in (a, b) if isinstance(v, Fraction)), Fraction(0))
        values = [v for v in (a, b) if not isinstance(v, Fraction)]
        other = [self.product(Fraction(-1), [v]) for v in values[1:]]
        apart = self.function("abs", self.total(-q or None, [values[0], *other]))
        apart = apart if name == "max" else self.product(Fraction(-1), [apart])
        return self.product(Fraction(1, 2), [self.total(q or None, [*values, apart])])

    def power(self, base: V, exponent: int) -> V:
        """`base ** exponent`, exponent >= 1."""
        result = base
        for bit in bin(exponent)[3:]:
            result = self.product(None, [result, result])
            if bit == "1":
                result = self.product(None, [result, base])
        return result


def evaluate(
    expression: Expression,
    variables: Mapping[Symbol, V],
    algebra: Algebra[V],
    known: dict[Expression, V] | None = None,
) -> V:
    """Evaluate an expression of a plant, with every operand, also one that is multiplied by 0.

    Parameters
    ----------
    variables : the values of its symbols.
    known : values of subexpressions that are computed already; the walk adds to it, so that calls can share them.

    Raises
    ------
    InputError : a symbol without a value, a node outside the grammar, a division by a number that is 0.
    """
    known = {} if known is None else known
    plain = gathered(expression)
    for node in nodes(plain):
        if node not in known and (node is plain or not isinstance(node, Number)):
            known[node] = _value(node, variables, algebra, known)
    return known[plain]


def _value(node: Expression, variables: Mapping[Symbol, V], algebra: Algebra[V], known: Mapping[Expression, V]) -> V:
    if isinstance(node, Symbol):
        if node not in variables:
            raise InputError(f"the expression uses {node}, which has no value here.")
        return variables[node]
    if isinstance(node, Number):
        return algebra.constant(node.value)
    if isinstance(node, Operation):
        values = [known[e] for e in node.operands if not isinstance(e, Number)]
        if node.operator in ("+", "*"):
            constant = next((e.value for e in node.operands if isinstance(e, Number)), None)
            return (algebra.total if node.operator == "+" else algebra.product)(constant, values)
        if node.operator == "**":
            result = algebra.power(values[0], abs(node.exponent))
            return result if node.exponent > 0 else algebra.inverse(result)
        if node.operator in OF_ONE:
            (at,) = node.operands
            return algebra.function(node.operator, algebra.constant(at.value) if isinstance(at, Number) else values[0])
        if node.operator in ("min", "max", "clip"):
            given = [e.value if isinstance(e, Number) else known[e] for e in node.operands]
            value = _extreme(node.operator, given, algebra)
            return algebra.constant(value) if isinstance(value, Fraction) else value
    raise InputError(f"{node!r} is outside the grammar; allowed are {GRAMMAR}.")


def _extreme(name: str, given: Sequence[V | Fraction], algebra: Algebra[V]) -> V | Fraction:
    """min, max or clip, of two after the other."""
    if name == "clip":
        v, lo, hi = given
        return algebra.extreme("min", algebra.extreme("max", v, lo), hi)
    return reduce(partial(algebra.extreme, name), given)
