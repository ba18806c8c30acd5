"""Expressions in rationals: what can be decided exactly is decided exactly, by the rule of the certificate's format."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

import sympy

from certify.errors import InputError
from certify.expressions.evaluate import Algebra, evaluate
from certify.expressions.tree import AT_ZERO

_MOST_BITS = 2**14  # of a number on the way: powers of powers grow without end


class _Rational(Algebra[Fraction]):
    """sin, cos and tan have a rational value at exact 0 only, and only that is used."""

    def constant(self, q: Fraction) -> Fraction:
        return q

    def total(self, constant: Fraction | None, terms: object) -> Fraction:
        return _small(super().total(constant, terms))  # type: ignore[arg-type]

    def product(self, constant: Fraction | None, factors: object) -> Fraction:
        return _small(super().product(constant, factors))  # type: ignore[arg-type]

    def inverse(self, value: Fraction) -> Fraction:
        if value == 0:
            raise InputError("it divides by 0")
        return 1 / value

    def function(self, name: str, value: Fraction) -> Fraction:
        if value != 0:
            raise InputError(f"{name} of {value} has no exact value")
        return Fraction(AT_ZERO[name])


def evaluate_exactly(expression: sympy.Expr, values: Mapping[sympy.Symbol, Fraction]) -> Fraction:
    """The rational value of an expression.

    Raises
    ------
    InputError : it divides by 0, a function stands at another point than 0, or a number grows too long.
    """
    return evaluate(expression, values, _Rational())


def _small(q: Fraction) -> Fraction:
    if max(q.numerator.bit_length(), q.denominator.bit_length()) > _MOST_BITS:
        raise InputError(f"a number on the way has more than {_MOST_BITS} bits")
    return q
