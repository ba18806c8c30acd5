"""The plant near its operating point: A, B, and its controllability.

The rank is exact if A and B are rational: a rank computed in floats depends on a tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction

import flint
import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.expressions import (
    AT_CORNER,
    Expression,
    Number,
    Operation,
    Symbol,
    cornered,
    differentiate,
    in_absolute_values,
    nodes,
    numerical,
    substitute,
    value_if_rational,
)
from certify.loop.plants.system import System

Matrix = tuple[tuple[Expression, ...], ...]
"""Rows of constants: a `Number` where the entry is rational, else an expression without symbols."""


def linearise(system: System) -> tuple[Matrix, Matrix]:
    """(df/dx, df/du) of the nominal plant at x = 0 and u_eq, exact; shapes (n, n) and (n, m).

    Raises
    ------
    InputError : a derivative divides by 0 there, or takes the root of a number that is not positive; or it depends on
        the slope of abs, min, max or clip at a corner. That of v*abs(v) at 0 is 0, whatever the slope of abs is.
    """
    at = _at_rest(system)
    try:
        A, B = (
            tuple(tuple(_constant(differentiate(e, s), at) for s in by) for e in system.exact_dynamics())
            for by in (system.states, system.inputs)
        )
    except InputError as error:
        if str(error) != AT_CORNER:
            raise InputError(f"the equations of {system.name} have no derivative at the origin: {error}.") from error
        raise InputError(
            f"the equations of {system.name} must be differentiable at the operating point; "
            f"{corners_at_rest(system)[0]} has a corner there. Move the operating point or the corner, multiply it by "
            "what is 0 there, as in x*abs(x), or round it off, as sqrt(x**2 + 1e-6) does with abs(x), and "
            "(x + sqrt(x**2 + 1e-6))/2 with max(x, 0)."
        ) from error
    return A, B


def corners_at_rest(system: System) -> list[Expression]:
    """The terms of the nominal plant with a corner at x = 0 and u_eq, as they were written."""
    values = {Symbol(name): q for name, q in system.parameters.items()}
    values |= dict.fromkeys(system.disturbances, Fraction(0)) | _at_rest(system)
    return [
        term
        for term in cornered(*system.dynamics)
        if any(
            isinstance(v, Operation) and v.operator == "abs" and _is_zero(v.operands[0], values)
            for v in nodes(in_absolute_values(term))
        )
    ]


def _at_rest(system: System) -> dict[Symbol, Fraction]:
    return dict.fromkeys(system.states, Fraction(0)) | dict(zip(system.inputs, system.exact_u_eq(), strict=True))


def _is_zero(expression: Expression, values: Mapping[Symbol, Fraction]) -> bool:
    try:
        return value_if_rational(expression, values) == 0
    except InputError:  # it has no value, which is refused as well
        return False


def in_floats(matrix: Matrix) -> NDArray[np.float64]:
    """The matrix rounded to binary64."""
    return np.array([numerical(row, [])() for row in matrix], dtype=np.float64)


def _constant(slope: Expression, at: dict[Symbol, Fraction]) -> Expression:
    value = value_if_rational(slope, at)
    if value == AT_CORNER:
        raise InputError(AT_CORNER)
    return substitute(slope, {s: Number(q) for s, q in at.items()}) if isinstance(value, str) else Number(value)


_NOISE = 1e-11  # of singular values over the largest: below it they are rounding


@dataclass(frozen=True, slots=True)
class Controllability:
    """Rank of [B, AB, ..., A^(n-1) B].

    Parameters
    ----------
    rank : dimension of the controllable subspace.
    exact : True if it was computed in rationals.
    smallest : otherwise the smallest singular value over the largest, of the matrix with A divided by its norm.
    """

    rank: int
    exact: bool
    smallest: float | None

    def __post_init__(self) -> None:
        if self.exact != (self.smallest is None):
            raise InputError("a rank is either exact or comes with the smallest singular value that it rests on.")


def _rationals(rows: list[list[Fraction]]) -> flint.fmpq_mat:
    return flint.fmpq_mat([[flint.fmpq(q.numerator, q.denominator) for q in row] for row in rows])


def controllability(A: Matrix, B: Matrix) -> Controllability:
    """The dimension of the controllable subspace (Kalman's rank condition).

    >>> zero, one = Number(0), Number(1)
    >>> controllability(((zero, one), (zero, zero)), ((zero,), (one,)))
    Controllability(rank=2, exact=True, smallest=None)
    """
    n, m = len(A), len(B[0])
    entries = [[[e.value for e in row if isinstance(e, Number)] for row in M] for M in (A, B)]
    if all(len(row) == width for M, width in zip(entries, (n, m), strict=True) for row in M):
        step, columns = map(_rationals, entries)
        blocks = [columns]
        for _ in range(n - 1):
            blocks.append(step * blocks[-1])
        whole = flint.fmpq_mat([[v for M in blocks for v in M.tolist()[i]] for i in range(n)])
        return Controllability(int(whole.rank()), True, None)
    a, b = in_floats(A), in_floats(B)
    size = float(np.linalg.norm(a, 2)) or 1.0
    terms = [b]
    for _ in range(n - 1):
        terms.append(a @ terms[-1] / size)  # columns are not scaled: one that is rounding alone must stay small
    values = np.linalg.svd(np.hstack(terms), compute_uv=False)
    values = values / (values[0] or 1.0)
    return Controllability(int((values > _NOISE).sum()), False, float(values[-1]))
