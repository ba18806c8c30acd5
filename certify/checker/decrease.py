"""The matrix inequality of rules `local` and `tube`: that d'J'RJ d + 2 d'J'P F(J d) < 0 for 0 < ||d|| <= 1, or, along a
path, z'J'RJ z + 2 z'J'P (F - v) < 0 where z'J'PJ z = 1.

The models of F come with their rounding errors bounded (ball.py); what follows from them is in rationals, so that no
rounding has to be thought of, but for the two sums of many terms (pairs.py). FORMAT.md has the inequality, its five
sums, and why each of them is a bound.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from flint import fmpq, fmpq_mat

from .ball import Units
from .document import Multipliers, Path
from .exact import exactly, is_definite, root_above
from .float64 import EPS, Array, gamma, norm, total, up
from .jets import Jet, unpacked
from .pairs import bound_of_pairs, in_binary64


class Models:
    """F - v on a ball: `f_i + a_i.d + d'Q_i d + K_i[d] + sum_jq B_ij L_jq e_q + r_i`, (f_i, a_i) within s_i,
    |r_i| <= d'E_i d; d has k entries. At rest v = 0 and f_i is exactly 0, so that s_i is about a_i alone."""

    def __init__(self, J: Array, F: Sequence[Jet], units: Units, velocity: Sequence[fmpq] | None = None) -> None:
        """J is (n, n), v the velocity of a path. Parameters are finite; see `are_finite`."""
        self.J, self.units = exactly(J), units
        self.K, self.twists = np.array([f.K for f in F]), np.array([f.twist for f in F])
        self.B = exactly(np.array([f.B for f in F]))
        self.A = exactly(np.array([f.a for f in F]))
        self.slack = [rational(f.slack) for f in F]
        self.Q = [exactly(f.Q) for f in F]
        self.E = [exactly(f.E) for f in F]
        self.f: list[fmpq] = []
        if velocity is not None:
            self.f = [rational(f.c) - v for f, v in zip(F, velocity, strict=True)]
            self.slack = [s + rational(f.error) for s, f in zip(self.slack, F, strict=True)]


def are_usable(by: Multipliers, path: Path | None = None) -> bool:
    """None is negative, and g is positive where it is used."""
    edges = () if path is None else (path.edge, path.motion, path.joint)
    signs = all(v >= 0 for row in (by.rest, by.apart, by.joint, edges) for v in row)
    joint = by.joint if path is None else (*by.joint, path.joint)
    return signs and (all(beta > 0 for beta in by.apart) or all(g > 0 for g in joint))


def are_finite(F: Sequence[Jet], units: Units) -> bool:
    """Whether every component has a finite model, and what is summed in binary64 has finite sums of squares."""
    parts = [part for f in F for part in (f.c, f.error, f.a, f.slack, f.Q, f.E, f.B, f.twist)]
    return all(np.all(np.isfinite(part)) for part in (*parts, norm(units.L.ravel(), 0), norm(units.R.ravel(), 0)))


def shows(models: Models, P: fmpq_mat, R: fmpq_mat, by: Multipliers, path: Path | None = None) -> bool:
    """Whether the inequality is shown for symmetric P and R (n, n), by these multipliers and those of the path."""
    decay, rest = sides(models, P, R, by, path)
    return is_definite(decay - rest)


def sides(
    models: Models, P: fmpq_mat, R: fmpq_mat, by: Multipliers, path: Path | None = None
) -> tuple[fmpq_mat, fmpq_mat]:
    """What is negative to first order, with its sign changed, and the sum of all bounds of the rest, both symmetric.

    At rest they are -(J'RJ + B + B') and S over d, (n, n); along a path -M and S over (1, d), (n + 2, n + 2).
    """
    J, k = models.J, models.A.ncols()
    b = padded(P * J, 0, k - J.ncols())  # b_i is row i, 0 for the motion
    rows = [fmpq_mat(1, k, [b[i, j] for j in range(k)]) for i in range(b.nrows())]
    squares = [row.transpose() * row for row in rows]
    lengths = [root_above((row * row.transpose())[0, 0]) for row in rows]
    B = b.transpose() * models.A
    form = padded(J.transpose() * R * J, k - J.ncols(), k - J.ncols()) + B + B.transpose()
    shares = by.joint if path is None else (*by.joint, rational(path.joint))
    rest = fmpq_mat(k, k)
    joint = [fmpq_mat(k, k) for _ in range(k)]
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
    rest += cubic(models, b, by) + of_units(models, b, by.weight)
    if not all(beta > 0 for beta in by.apart):
        inverse = diagonal([1 / g for g in shares])
        rest += diagonal(shares) + sum((C.transpose() * inverse * C for C in joint), fmpq_mat(k, k))
    if path is not None:
        form = with_edge(form, models, P, b, path)
        rest = fmpq_mat([[0] * (k + 1), *([0, *row] for row in rest.tolist())])
    return -form, rest + diagonal([wrong] * rest.nrows())


def cubic(models: Models, b: fmpq_mat, by: Multipliers) -> fmpq_mat:
    """S_cubic: where beta_i > 0 each 2 (b_i.d) K_i[d] by itself, and the sum of all others as 2 sum_l d_l N_l[d, d, d],
    N being symmetric in all of its indices."""
    k = b.ncols()
    if not np.any(models.K):
        return fmpq_mat(k, k)
    row, power = in_binary64(b)
    K, apart = unpacked(models.K, k), np.array([beta > 0 for beta in by.apart])
    each, others = row[apart], row[~apart]
    T = K[apart].reshape(-1, k * k, k)
    S = bound_of_pairs(each, up(EPS * norm(each, 1)), T, np.zeros(len(T)), by.weight)
    N = np.tensordot(others.T, K[~apart], 1)
    N = (N + N.transpose(1, 0, 2, 3) + N.transpose(1, 2, 0, 3) + N.transpose(1, 2, 3, 0)) / 4
    wrong = np.full(k, up((gamma(len(row)) + EPS) * total(norm(others, 1) * models.twists[~apart], 0)))
    S += bound_of_pairs(np.eye(k), np.zeros(k), N.reshape(k, k * k, k), wrong, by.weight)
    return S * fmpq(2) ** power


def of_units(models: Models, b: fmpq_mat, weight: Array) -> fmpq_mat:
    """S_units: 2 sum_q (p_q.d) e_q, p_q = sum_i b_i sum_j B_ij L_jq."""
    L, R = models.units.L, models.units.R
    if not np.any(L):
        return fmpq_mat(b.ncols(), b.ncols())
    row, by = in_binary64(models.B.transpose() * b)
    p, wrong = L.T @ row, (gamma(len(L)) + EPS) * total(np.abs(L) * norm(row, 1)[:, None], 0)
    return bound_of_pairs(p, up(wrong), R, np.zeros(len(R)), weight) * fmpq(2) ** by


def with_edge(form: fmpq_mat, models: Models, P: fmpq_mat, b: fmpq_mat, path: Path) -> fmpq_mat:
    """M: the form over (1, d) with the linear part that F - v has at d = 0, and the multipliers of edge and motion."""
    n, k = P.nrows(), form.nrows()
    share, edge, motion = rational(path.share), rational(path.edge), rational(path.motion)
    inner = form + edge * padded(models.J.transpose() * P * models.J, k - n, k - n)
    inner[k - 1, k - 1] -= motion
    linear = (fmpq_mat(1, n, models.f) * b).entries()
    first = [motion * share * share - edge, *linear]
    return fmpq_mat([first, *([v, *row] for v, row in zip(linear, inner.tolist(), strict=True))])


def padded(A: fmpq_mat, rows: int, columns: int) -> fmpq_mat:
    """A with that many rows and columns of zeros more."""
    wider = [[*row, *[0] * columns] for row in A.tolist()]
    return fmpq_mat([*wider, *([0] * (A.ncols() + columns) for _ in range(rows))])


def diagonal(entries: Sequence[fmpq]) -> fmpq_mat:
    n = len(entries)
    return fmpq_mat([[entries[i] if i == j else fmpq(0) for j in range(n)] for i in range(n)])


def rational(value: float) -> fmpq:
    """A finite binary64 number as it is."""
    return fmpq(*float(value).as_integer_ratio())
