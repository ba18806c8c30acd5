"""Convert sympy's expressions as sympy shows them.

sympy simplifies an expression as it is built: `x*(x - 1)/(x - 1)` is `x` before anybody can see the quotient. So such a
plant is about sympy's simplified expression, and only on request.
"""

from __future__ import annotations

from fractions import Fraction
from functools import reduce
from typing import Any

from certify.errors import InputError
from certify.loop.expressions.tree import (
    FUNCTIONS,
    GRAMMAR,
    JUMP,
    Expression,
    Number,
    Operation,
    Symbol,
    atan,
    exp,
    function,
    sqrt,
)

_CORNERS = {"Abs": "abs", "Min": "min", "Max": "max"}
_JUMP = "Heaviside"  # its second argument is its value at 0, and here it may be any of two


def from_sympy(expression: Any) -> Expression:
    """The tree of a sympy expression, after sympy's own simplifications.

    Raises
    ------
    InputError : it is outside the grammar of plants, or holds a rounded number.

    Examples
    --------
    >>> import sympy
    >>> x = sympy.Symbol("x")
    >>> from_sympy(sympy.sqrt(x) * x / 2 + sympy.sin(x) ** 2)
    sin(x)**2 + 0.5*sqrt(x)**3
    """
    import sympy

    e = sympy.sympify(expression)
    if e.is_Symbol:
        return Symbol(e.name)
    if e.is_Rational:
        return Number(Fraction(int(e.p), int(e.q)))
    if e is sympy.E or e is sympy.pi:
        return exp(1) if e is sympy.E else 4 * atan(1)
    if e.is_Add or e.is_Mul:
        parts = [from_sympy(a) for a in e.args]
        return reduce(lambda a, b: a + b if e.is_Add else a * b, parts)
    if e.is_Pow and e.exp.is_Rational and int(e.exp.q).bit_count() == 1:
        roots = reduce(lambda a, _: sqrt(a), range(int(e.exp.q).bit_length() - 1), from_sympy(e.base))
        return roots if e.exp.p == 1 else roots ** int(e.exp.p)
    name = type(e).__name__
    if name in _CORNERS:
        return function(_CORNERS[name], *map(from_sympy, e.args))
    if name == _JUMP:
        return function(JUMP, from_sympy(e.args[0]))
    if e.is_Function and name in FUNCTIONS:
        return Operation(name, from_sympy(e.args[0]))
    if e.is_Float:
        raise InputError(f"an equation holds the rounded number {e}; write it as a fraction.")
    raise InputError(f"an equation uses {e}; allowed are {GRAMMAR} and exact numbers.")
