"""Lyapunov functions as expressions of the states: energies, polynomials, whatever the grammar of plants can say.

This is the form in which a certificate states a function that is no network. Its exact numbers are rationals.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.expressions import Expression, Number, Symbol, cornered, differentiate, numerical, symbols_of, total
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
    InputError : the expression has another symbol; or abs, min, max or clip, with which it has no derivative somewhere.

    Examples
    --------
    >>> from certify.loop.expressions import cos, symbols
    >>> x, y = symbols(["x", "y"])
    >>> N = Symbolic(1 - cos(x) + y**2 / 2, (x, y))
    >>> float(N(np.array([0.0, 2.0]))), N.gradient(np.array([0.0, 2.0])).tolist()
    (2.0, [0.0, 2.0])
    """

    expression: Expression
    states: tuple[Symbol, ...]

    def __post_init__(self) -> None:
        others = sorted(s.name for s in symbols_of(self.expression) - set(self.states))
        if others:
            raise InputError(f"a Lyapunov function must be one of the states {self.states}; found {', '.join(others)}.")

        for term in cornered(self.expression):
            raise InputError(
                f"a Lyapunov function must be continuously differentiable; {term} has a corner. Round it off, as "
                "sqrt(x**2 + 1e-6) does with abs(x)."
            )

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.states)

    def __call__(self, x: Array) -> Array:
        """N in float64, shape (..., n) to (...)."""
        return np.broadcast_to(_compiled(self)(*np.moveaxis(x, -1, 0))[0], x.shape[:-1]).astype(np.float64)

    def gradient(self, x: Array) -> Array:
        """dN/dx in float64, shape (..., n) to (..., n)."""
        columns = [np.broadcast_to(one, x.shape[:-1]) for one in _compiled(self)(*np.moveaxis(x, -1, 0))[1:]]
        return np.stack(columns, axis=-1).astype(np.float64)


def of_polynomial(function: Polynomial, states: Sequence[Symbol]) -> Symbolic:
    """A polynomial as an expression, its coefficients as the rationals that they are."""
    terms = []
    for row, c in zip(function.exponents.tolist(), function.coefficients.tolist(), strict=True):
        powers: list[Expression] = [s**a for s, a in zip(states, row, strict=True) if a]
        terms.append(reduce(operator.mul, powers if c == 1 and powers else [Number(Fraction(c)), *powers]))
    return Symbolic(total(terms), tuple(states))


@cache
def _compiled(function: Symbolic) -> Callable[..., tuple[Any, ...]]:
    """N and its derivatives as one function of numpy's arrays."""
    parts = [function.expression, *(differentiate(function.expression, s) for s in function.states)]
    return numerical(parts, function.states)
