"""Constants that a file's program computes from its numbers, such as sqrt(var + epsilon) of a normaliser.

They are rationals, elementwise, and exact; a square root that is no rational has 300 bits, and each number that is
folded from it is rounded to 53.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np

from certify.errors import InputError
from certify.loop.files.arrays import Numbers

_BITS = 300
_MOST_BITS = 1 << 13
_MOST_NUMBERS = 1 << 16
_POWERS = (Fraction(1, 2), Fraction(-1, 2), Fraction(-1), Fraction(2), Fraction(3))


def is_constant(value: Any) -> bool:
    """True for a number, or an array of numbers."""
    return isinstance(value, np.ndarray | np.number | Fraction | int | float) and not isinstance(value, bool)


def is_computed(array: Numbers) -> bool:
    """True for an array of rationals, as `computed` makes them."""
    return array.dtype == object and all(isinstance(v, Fraction) for v in array.ravel())


def computed(name: str, given: tuple[Any, ...], what: str) -> Numbers | None:
    """The exact value of an operation on constants, an array of rationals; None if it is no such operation.

    Raises
    ------
    InputError : a number is not finite, the root of a negative number is taken, or the shapes do not fit.
    """
    if name not in _OPERATIONS or len(given) != _COUNTS.get(name, 2):
        return None
    try:
        values = [_exact(value, what) for value in given]
        if max(value.size for value in values) > _MOST_NUMBERS:
            raise InputError(f"{what} must compute with at most {_MOST_NUMBERS} constants.")
        result = np.asarray(np.frompyfunc(_OPERATIONS[name], len(values), 1)(*values), dtype=object)
    except (ValueError, ZeroDivisionError) as error:
        raise InputError(f"{what} cannot be computed of its constants: {error}.") from error
    if any(max(abs(v.numerator), v.denominator).bit_length() > _MOST_BITS for v in result.ravel()):
        raise InputError(f"{what} makes constants that are too long.")
    return result


def _exact(value: Any, what: str) -> Numbers:
    """A constant as an array of rationals."""
    array = np.asarray(value, dtype=object if isinstance(value, Fraction) else None)
    if is_computed(array):
        return array
    if array.dtype.kind not in "fiu" or not np.all(np.isfinite(array)):
        raise InputError(f"the constants of {what} must be finite real numbers; found {array.dtype}.")
    made = np.empty(array.shape, dtype=object)
    made[...] = np.array([Fraction(v) for v in array.ravel().tolist()], dtype=object).reshape(array.shape)
    return made


def _root(q: Fraction) -> Fraction:
    """The square root, exact where it is rational."""
    if q < 0:
        raise ValueError("the root of a negative number is taken")
    up, down = math.isqrt(q.numerator), math.isqrt(q.denominator)
    if up * up == q.numerator and down * down == q.denominator:
        return Fraction(up, down)
    bits = 2 * (_BITS + max(0, q.denominator.bit_length() - q.numerator.bit_length()))
    return Fraction(math.isqrt((q.numerator << bits) // q.denominator), 1 << bits // 2)


def _power(q: Fraction, exponent: Fraction) -> Fraction:
    if exponent not in _POWERS:
        raise ValueError(f"the exponent must be {', '.join(map(str, map(float, _POWERS)))}; found {float(exponent)}")
    return Fraction(_root(q)) ** int(2 * exponent) if exponent.denominator == 2 else Fraction(q ** int(exponent))


_OPERATIONS: dict[str, Callable[..., Fraction]] = {
    "add": operator.add,
    "sub": operator.sub,
    "rsub": lambda a, b: b - a,
    "mul": operator.mul,
    "div": operator.truediv,
    "maximum": max,
    "minimum": min,
    "pow": _power,
    "neg": operator.neg,
    "abs": abs,
    "sqrt": _root,
    "rsqrt": lambda q: 1 / _root(q),
    "reciprocal": lambda q: 1 / q,
}
_COUNTS = dict.fromkeys(("neg", "abs", "sqrt", "rsqrt", "reciprocal"), 1)
