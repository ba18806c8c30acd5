"""Expressions in rationals: what can be decided exactly is decided exactly, by the rule of the certificate's format."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction

import sympy

from certify.errors import InputError
from certify.expressions.evaluate import Algebra, evaluate
from certify.expressions.tree import AT_ZERO

_MOST_BITS = 2**14  # of a number on the way: powers of powers grow without end


class _Rational(Algebra[Fraction]):
    """Functions have a rational value at exact 0 only, square roots at squares of rationals; only these are used."""

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
        if name == "sqrt":
            root = Fraction(math.isqrt(max(value.numerator, 0)), math.isqrt(value.denominator))
            if not (value > 0 and root * root == value):
                raise InputError(f"sqrt of {value}, which is not the square of a positive rational, has no exact value")
            return root
        if value != 0:
            raise InputError(f"{name} of {value} has no exact value")
        return Fraction(AT_ZERO[name])


def evaluate_exactly(expression: sympy.Expr, values: Mapping[sympy.Symbol, Fraction]) -> Fraction:
    """The rational value of an expression.

    Raises
    ------
    InputError : it divides by 0, a function stands at another point than 0 (a square root at a number that is not the
        square of a positive rational), or a number grows too long.
    """
    return evaluate(expression, values, _Rational())


def _small(q: Fraction) -> Fraction:
    if max(q.numerator.bit_length(), q.denominator.bit_length()) > _MOST_BITS:
        raise InputError(f"a number on the way has more than {_MOST_BITS} bits")
    return q
