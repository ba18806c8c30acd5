"""Evaluate expressions in rationals, by the rule of the certificate's format."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

from certify.errors import InputError
from certify.loop.expressions.evaluate import Algebra, evaluate
from certify.loop.expressions.gathering import MOST_BITS
from certify.loop.expressions.tree import JUMP, Expression, Symbol

AT_CORNER = "the slope of abs at 0"
_AT_ZERO: Mapping[str, int] = {"sin": 0, "cos": 1, "tan": 0, "tanh": 0, "exp": 1, "atan": 0}


@dataclass(frozen=True, slots=True)
class _Unnamed:
    """An unknown number, with a description in words."""

    words: str


_Number = Fraction | _Unnamed


class _Rational(Algebra[_Number]):
    """Functions have a rational value at exact 0 only, square roots at squares of rationals, abs everywhere.

    Exact 0 times an unknown number is 0: the checkers' rule `local` shows that the number exists.
    """

    def constant(self, q: Fraction) -> _Number:
        return q

    def total(self, constant: Fraction | None, terms: Sequence[_Number]) -> _Number:
        result = constant or Fraction(0)
        for term in sorted(terms, key=_is_slope, reverse=True):
            if isinstance(term, _Unnamed):
                return term
            result = _small(result + term)
        return result

    def product(self, constant: Fraction | None, factors: Sequence[_Number]) -> _Number:
        factors = [Fraction(1) if constant is None else constant, *factors]
        if Fraction(0) in factors:
            return Fraction(0)
        result = Fraction(1)
        for factor in sorted(factors, key=_is_slope, reverse=True):
            if isinstance(factor, _Unnamed):
                return factor
            result = _small(result * factor)
        return result

    def inverse(self, value: _Number) -> _Number:
        if value == 0:
            raise InputError("it divides by 0")
        return value if isinstance(value, _Unnamed) else 1 / value

    def function(self, name: str, value: _Number) -> _Number:
        if isinstance(value, _Unnamed):
            return value
        if name == "abs":
            return abs(value)
        if name == JUMP:
            return Fraction(value > 0) if value != 0 else _Unnamed("heaviside of 0, either 0 or 1")
        if name == "sign":
            return Fraction(1 if value > 0 else -1) if value != 0 else _Unnamed(AT_CORNER)
        if name == "sqrt":
            if value <= 0:
                raise InputError(
                    f"it takes the square root of {value}, and the root is smooth at positive numbers only"
                )
            root = Fraction(math.isqrt(value.numerator), math.isqrt(value.denominator))
            return root if root * root == value else _Unnamed(f"sqrt of {value}, which is not the square of a rational")
        return _Unnamed(f"{name} of {value}") if value != 0 else Fraction(_AT_ZERO[name])


def value_if_rational(
    expression: Expression, values: Mapping[Symbol, Fraction], unknown: Iterable[Symbol] = ()
) -> Fraction | str:
    """The rational value of an expression for any values of the unknown symbols; else, in words, the part without one.

    Raises
    ------
    InputError : it divides by 0, takes the root of a number that is not positive, or a number grows too long.
    """
    numbers: dict[Symbol, _Number] = {**values, **{s: _Unnamed(f"{s}, which is uncertain,") for s in unknown}}
    value = evaluate(expression, numbers, _Rational())
    return value.words if isinstance(value, _Unnamed) else value


def evaluate_exactly(
    expression: Expression, values: Mapping[Symbol, Fraction], unknown: Iterable[Symbol] = ()
) -> Fraction:
    """`value_if_rational`, where that is a number.

    Raises
    ------
    InputError : it divides by 0, takes the root of a number that is not positive, or a number grows too long; or the
        value is that of a function at another point than 0 (of a square root at a number that is no square), or
        depends on what is unknown.
    """
    value = value_if_rational(expression, values, unknown)
    if isinstance(value, str):
        raise InputError(f"{value} has no exact value")
    return value


def _is_slope(value: _Number) -> bool:
    """True of a slope at a corner, which names a sum or product rather than other numbers without a value do."""
    return isinstance(value, _Unnamed) and value.words == AT_CORNER


def _small(q: Fraction) -> Fraction:
    if max(q.numerator.bit_length(), q.denominator.bit_length()) > MOST_BITS:
        raise InputError(f"a number on the way has more than {MOST_BITS} bits")
    return q
