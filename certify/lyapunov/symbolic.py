"""Lyapunov functions as expressions of the states: energies, polynomials, whatever the grammar of plants can say.

This is the form in which a certificate states a function that is no network. Its exact numbers are rationals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import numpy as np
import sympy
from numpy.typing import NDArray

from certify.errors import InputError
from certify.expressions import GRAMMAR, has_tree
from certify.lyapunov.polynomial import Polynomial

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Symbolic:
    """`N(x)` as an exact expression of the states, in deviations from the plant's operating point.

    Parameters
    ----------
    expression : in the grammar of plants, of no other symbols than the states.
    states : the n states, in the plant's order.

    Raises
    ------
    InputError : the expression has another symbol, or is outside the grammar.

    Examples
    --------
    >>> x, y = sympy.symbols("x y", real=True)
    >>> N = Symbolic(1 - sympy.cos(x) + y**2 / 2, (x, y))
    >>> float(N(np.array([0.0, 2.0]))), N.gradient(np.array([0.0, 2.0])).tolist()
    (2.0, [0.0, 2.0])
    """

    expression: sympy.Expr
    states: tuple[sympy.Symbol, ...]

    def __post_init__(self) -> None:
        others = sorted(str(s) for s in self.expression.free_symbols - set(self.states))
        if others:
            raise InputError(f"a Lyapunov function must be one of the states {self.states}; found {', '.join(others)}.")
        if not all(has_tree(node) for node in sympy.preorder_traversal(self.expression)):
            raise InputError(f"{self.expression} is outside the grammar; allowed are {GRAMMAR}.")

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    def __call__(self, x: Array) -> Array:
        """N in float64, shape (..., n) to (...)."""
        return np.broadcast_to(_compiled(self)[0](*np.moveaxis(x, -1, 0)), x.shape[:-1]).astype(np.float64)

    def gradient(self, x: Array) -> Array:
        """dN/dx in float64, shape (..., n) to (..., n)."""
        columns = [np.broadcast_to(one(*np.moveaxis(x, -1, 0)), x.shape[:-1]) for one in _compiled(self)[1:]]
        return np.stack(columns, axis=-1).astype(np.float64)


def of_polynomial(function: Polynomial, states: Sequence[sympy.Symbol]) -> Symbolic:
    """A polynomial as an expression, its coefficients as the rationals that they are."""
    terms = [
        sympy.Mul(sympy.Rational(*Fraction(c).as_integer_ratio()), *(s**a for s, a in zip(states, row, strict=True)))
        for row, c in zip(function.exponents.tolist(), function.coefficients.tolist(), strict=True)
    ]
    return Symbolic(sympy.Add(*terms), tuple(states))


@cache
def _compiled(function: Symbolic) -> tuple[sympy.Lambda, ...]:
    """N and its derivatives as functions of numpy's arrays."""
    parts = [function.expression, *(sympy.diff(function.expression, s) for s in function.states)]
    return tuple(sympy.lambdify(function.states, part, "numpy") for part in parts)
