"""The linear part of an unknown function at the origin, and a bound of all beyond it, from samples near by.

With g(0) = 0 and |g_ab| <= M_ab on a convex set around the origin, g(z) = a.z + r(z), |r(z)| <= 1/2 sum M_ab |z_a z_b|.
For samples z_k that span the space and weights w with sum_k w_k z_k = e_j, the unit vector,

    a_j = sum_k w_k a.z_k,  which lies within sum_k |w_k| (noise + |r|(z_k)) of sum_k w_k y_k.

The samples are the active ones of a linear program, whose optimum is the least bound; the weights are solved for in
rationals, so that nothing rests on its solver.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from flint import fmpq, fmpq_mat
from scipy.optimize import linprog

from certify.errors import CertifyError, InputError
from certify.loop.plants.samples import Grid, Point, Unknown


class Contradicted(CertifyError):
    """The samples are of no function with these bounds of second derivatives, this noise and the value 0 at 0."""


_MOST = 400  # samples, those of the least bounds, that the programs see


def beyond(one: Unknown, z: Point) -> Fraction:
    """The bound of |r| at a point."""
    pairs = ((row, v) for row, v in zip(one.curvature, z, strict=True))
    return sum((m * abs(v * w) for row, v in pairs for m, w in zip(row, z, strict=True)), Fraction(0)) / 2


class Slope(NamedTuple):
    """An interval that holds a first derivative of g at the origin, and the weights of samples that show each end."""

    lo: Fraction
    hi: Fraction
    lower: Mapping[Point, Fraction]
    upper: Mapping[Point, Fraction]


def slopes(one: Unknown, grid: Grid, noise: Fraction) -> tuple[Slope, ...]:
    """Intervals that hold the first derivatives of g at the origin.

    Raises
    ------
    InputError : the samples do not span the variables.
    Contradicted : no function with these bounds has such samples.
    """
    near = sorted(((noise + beyond(one, z), z, y) for z, y in grid.values.items() if any(z)), key=lambda row: row[0])
    near = _widest(near)
    size = [max(abs(axis[0]), abs(axis[-1])) for axis in grid.axes]
    Z = np.array([[float(v / s) for v, s in zip(z, size, strict=True)] for _, z, _ in near])
    y, e = np.array([float(row[2]) for row in near]), np.array([float(row[0]) for row in near])
    found = []
    for j in range(len(size)):
        unit = [Fraction(int(i == j)) for i in range(len(size))]
        (lo, lower), (hi, upper) = (_end(Z, y, e, near, j, sign, unit) for sign in (1, -1))
        if not lo <= hi:
            raise Contradicted(
                f"{one.state} would have a slope along {one.variables[j]} from {float(lo):.6g} to {float(hi):.6g}"
            )
        found.append(Slope(lo, hi, lower, upper))
    return tuple(found)


Row = tuple[Fraction, Point, Fraction]  # the bound of a sample's distance from the linear part, the point, the value


def _widest(near: Sequence[Row]) -> list[Row]:
    """Rows that tell of slopes: the least error by the length of z, and those of the axes."""
    alone = [row for row in near if sum(map(bool, row[1])) == 1]
    return (list(near[:_MOST]) + [row for row in alone if row not in near[:_MOST]])[: 2 * _MOST]


def _end(
    Z: np.ndarray, y: np.ndarray, e: np.ndarray, rows: Sequence[Row], j: int, sign: int, unit: Sequence[Fraction]
) -> tuple[Fraction, Mapping[Point, Fraction]]:
    """The lower (sign 1) or upper end of a_j, from samples that a linear program chooses, and their weights."""
    cost = np.zeros(Z.shape[1])
    cost[j] = sign
    solved = linprog(cost, A_ub=np.vstack([Z, -Z]), b_ub=np.concatenate([y + e, e - y]), bounds=(None, None))
    if solved.status == 2:
        raise _contradiction(Z, y, e, rows)
    if solved.status != 0:
        raise InputError("the samples do not bound the slopes at the origin: take some near it along each variable.")
    active = np.argsort(-np.abs(solved.ineqlin.marginals), kind="stable") % len(rows)
    chosen = list(dict.fromkeys(active.tolist()))
    weights = _weights(rows, chosen, unit)
    middle = sum((w * rows[k][2] for k, w in weights.items()), Fraction(0))
    doubt = sum((abs(w) * rows[k][0] for k, w in weights.items()), Fraction(0))
    return middle - sign * doubt, {rows[k][1]: w for k, w in weights.items()}


def _contradiction(Z: np.ndarray, y: np.ndarray, e: np.ndarray, rows: Sequence[Row]) -> CertifyError:
    """The finding that samples contradict one another, if rationals show it: w with sum_k w_k z_k = 0 for which
    |sum_k w_k y_k| is larger than the errors allow."""
    ones = np.ones((len(Z), 1))
    cost = np.append(np.zeros(Z.shape[1]), 1.0)
    left = np.vstack([np.hstack([Z, -ones]), np.hstack([-Z, -ones])])
    solved = linprog(cost, A_ub=left, b_ub=np.concatenate([y + e, e - y]), bounds=(None, None))
    if solved.status == 0:
        active = np.argsort(-np.abs(solved.ineqlin.marginals), kind="stable") % len(rows)
        chosen = list(dict.fromkeys(active.tolist()))[: Z.shape[1] + 1]
        null, rank = (
            fmpq_mat([[_exact(rows[k][1][i]) for k in chosen] for i in range(Z.shape[1])]).numer_denom()[0].nullspace()
        )
        for column in range(rank):
            w = [Fraction(int(null[i, column])) for i in range(len(chosen))]
            off = abs(sum((v * rows[k][2] for v, k in zip(w, chosen, strict=True)), Fraction(0)))
            if off > sum((abs(v) * rows[k][0] for v, k in zip(w, chosen, strict=True)), Fraction(0)):
                return Contradicted(f"no slopes at the origin are consistent with {len(chosen)} of the samples")
    return InputError("the slopes at the origin cannot be bounded: the samples are nearly a contradiction.")


def _weights(rows: Sequence[Row], order: Sequence[int], unit: Sequence[Fraction]) -> dict[int, Fraction]:
    """w with sum_k w_k z_k = unit, for the first samples in an order that span the space."""
    basis: list[int] = []
    for k in order:
        columns = [rows[i][1] for i in (*basis, k)]
        if fmpq_mat([[_exact(v) for v in z] for z in columns]).rank() == len(columns):
            basis.append(k)
        if len(basis) == len(unit):
            break
    else:
        raise InputError("the samples near the origin must differ in each variable.")
    matrix = fmpq_mat([[_exact(rows[k][1][i]) for k in basis] for i in range(len(unit))])
    solved = matrix.solve(fmpq_mat([[_exact(v)] for v in unit]))
    return {k: Fraction(int(w.p), int(w.q)) for k, w in zip(basis, solved.entries(), strict=True)}


def _exact(q: Fraction) -> fmpq:
    return fmpq(q.numerator, q.denominator)


def residual_text(one: Unknown, size: Sequence[Fraction]) -> str:
    """A smooth bound of |r| as an equation: |z_a z_b| is at most (s z_a^2 + z_b^2/s)/2 for any s, here by the sizes."""
    shares = zip(one.variables, least_square(one, size), strict=True)
    return " + ".join(f"{_upwards(share)}*{v}**2" for v, share in shares if share) or "0"


def least_square(one: Unknown, size: Sequence[Fraction]) -> list[Fraction]:
    """The factors of the squares of variables in such a bound."""
    return [
        sum((m * size[b] for b, m in enumerate(row)), Fraction(0)) / 2 / size[a] for a, row in enumerate(one.curvature)
    ]


def _upwards(q: Fraction) -> str:
    return f"({Fraction(-(-q * 10**9 // 1), 10**9)})"
