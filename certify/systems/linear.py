"""The plant near its operating point: A, B, and whether its inputs reach every direction.

Exact where rationals allow it: a rank computed in floats is an opinion about a tolerance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import sympy

from certify.errors import InputError
from certify.systems.system import System


def linearise(system: System) -> tuple[sympy.Matrix, sympy.Matrix]:
    """(df/dx, df/du) of the plant at x = 0 and u_eq, exact; shapes (n, n) and (n, m).

    Raises
    ------
    InputError : a derivative divides by 0 there.
    """
    f = sympy.Matrix(system.exact_dynamics())
    at: dict[sympy.Symbol, sympy.Expr] = dict.fromkeys(system.states, sympy.Integer(0))
    u_eq = system.exact_u_eq()
    at |= {s: sympy.Rational(u.numerator, u.denominator) for s, u in zip(system.inputs, u_eq, strict=True)}
    found = f.jacobian(list(system.states)).subs(at), f.jacobian(list(system.inputs)).subs(at)
    if any(M.has(sympy.zoo, sympy.nan, sympy.oo) for M in found):
        raise InputError(f"the equations of {system.name} have no derivative at the origin: they divide by 0 there.")
    return found


_NOISE = 1e-11  # of singular values over the largest: below it they are rounding


@dataclass(frozen=True, slots=True)
class Controllability:
    """Rank of [B, AB, ..., A^(n-1) B].

    Parameters
    ----------
    rank : of n directions of the state space, how many the inputs reach.
    exact : whether it was computed in rationals.
    smallest : where it was not, the smallest singular value over the largest, of the matrix with A divided by its norm.
    """

    rank: int
    exact: bool
    smallest: float | None

    def __post_init__(self) -> None:
        if self.exact != (self.smallest is None):
            raise InputError("a rank is either exact or comes with the smallest singular value that it rests on.")


def controllability(A: sympy.Matrix, B: sympy.Matrix) -> Controllability:
    """How many directions of the state space the inputs reach (Kalman's rank condition).

    >>> controllability(sympy.Matrix([[0, 1], [0, 0]]), sympy.Matrix([0, 1]))
    Controllability(rank=2, exact=True, smallest=None)
    """
    n = A.shape[0]
    if all(entry.is_Rational for entry in (*A, *B)):
        blocks = [B]
        for _ in range(n - 1):
            blocks.append(A * blocks[-1])
        return Controllability(int(sympy.Matrix.hstack(*blocks).rank()), True, None)
    a, b = (np.array(M.evalf(17).tolist(), dtype=np.float64) for M in (A, B))
    size = float(np.linalg.norm(a, 2)) or 1.0
    columns = [b]
    for _ in range(n - 1):
        columns.append(a @ columns[-1] / size)  # columns are not scaled: one that is rounding alone must stay small
    values = np.linalg.svd(np.hstack(columns), compute_uv=False)
    values = values / (values[0] or 1.0)
    return Controllability(int((values > _NOISE).sum()), False, float(values[-1]))
