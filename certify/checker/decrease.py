"""The matrix inequality of rules `local` and `tube`: that d'J'RJ d + 2 d'J'P F(J d) < 0 for 0 < ||d|| <= 1.

The models of F come with their rounding errors bounded (ball.py); all that follows from them is in rationals, so that
no rounding has to be thought of here. FORMAT.md has the inequality, its three sums, and why each of them is a bound.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from flint import fmpq, fmpq_mat

from .document import Multipliers
from .exact import exactly, is_definite, root_above
from .float64 import Array
from .jets import Jet


class Models:
    """F on a ball, in rationals: `a_i.d + d'Q_i d + r_i`, a_i (n,) within s_i, |r_i| <= d'E_i d."""

    def __init__(self, J: Array, F: Sequence[Jet]) -> None:
        """Parameters are finite; see `are_finite`."""
        self.J = exactly(J)
        self.A = exactly(np.array([f.a for f in F]))
        self.slack = [fmpq(*float(f.slack).as_integer_ratio()) for f in F]
        self.Q = [exactly(f.Q) for f in F]
        self.E = [exactly(f.E) for f in F]


def are_usable(by: Multipliers) -> bool:
    """None is negative, and g is positive where it is used."""
    signs = all(v >= 0 for row in (by.rest, by.apart, by.joint) for v in row)
    return signs and (all(beta > 0 for beta in by.apart) or all(g > 0 for g in by.joint))


def are_finite(F: Sequence[Jet]) -> bool:
    """Whether every component has a finite model."""
    return all(np.all(np.isfinite(part)) for f in F for part in (f.a, f.slack, f.Q, f.E))


def shows(models: Models, P: fmpq_mat, R: fmpq_mat, by: Multipliers) -> bool:
    """Whether the inequality is shown for symmetric P and R (n, n), by these multipliers."""
    decay, rest = sides(models, P, R, by)
    return is_definite(decay - rest)


def sides(models: Models, P: fmpq_mat, R: fmpq_mat, by: Multipliers) -> tuple[fmpq_mat, fmpq_mat]:
    """-(J'RJ + B + B') and the sum of all bounds of the rest, both symmetric (n, n)."""
    n, J = P.nrows(), models.J
    b = P * J  # b_i is row i
    rows = [fmpq_mat(1, n, [b[i, j] for j in range(n)]) for i in range(n)]
    squares = [row.transpose() * row for row in rows]
    lengths = [root_above((row * row.transpose())[0, 0]) for row in rows]
    B = b.transpose() * models.A
    decay = -(J.transpose() * R * J + B + B.transpose())
    rest = fmpq_mat(n, n)
    joint = [fmpq_mat(n, n) for _ in range(n)]
    wrong = fmpq(0)
    for i, (alpha, beta) in enumerate(zip(by.rest, by.apart, strict=True)):
        E, Q = models.E[i], models.Q[i]
        if alpha > 0:
            rest += alpha * squares[i] + E.transpose() * E / alpha
        else:
            rest += lengths[i] * (E + E.transpose())
        if beta > 0:
            rest += beta * squares[i] + Q.transpose() * Q / beta
        else:
            joint = [C + b[i, j] * Q for j, C in enumerate(joint)]
        wrong += 2 * lengths[i] * models.slack[i]
    if not all(beta > 0 for beta in by.apart):
        inverse = diagonal([1 / g for g in by.joint])
        rest += diagonal(by.joint) + sum((C.transpose() * inverse * C for C in joint), fmpq_mat(n, n))
    return decay, rest + diagonal([wrong] * n)


def diagonal(entries: Sequence[fmpq]) -> fmpq_mat:
    n = len(entries)
    return fmpq_mat([[entries[i] if i == j else fmpq(0) for j in range(n)] for i in range(n)])
