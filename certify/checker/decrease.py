"""The matrix inequality of rules `local` and `tube`: that d'J'RJ d + 2 d'J'P G + h G'P G < 0 for 0 < ||d|| <= 1 at
rest, that this and k (V - c0) is negative around a level c0, or, along a path, z'J'RJ z + 2 z'J'P (F - v) < 0 where
z'J'PJ z = 1.

The models of G come with their rounding errors bounded (ball.py). From there on everything is in rationals, without
rounding, except for the sums of many terms (pairs.py, `beyond`). FORMAT.md has the inequality and its six sums,
docs/mathematics/local.md the proof that each is a bound.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from flint import fmpq, fmpq_mat

from .case import AT_CORNERS
from .document import Multipliers
from .exact import exactly, fraction, is_definite, root_above
from .jets import Jet, unpacked
from .near import Above, Array, Near, Tensor, Vector, at_least_0, mixed, norm, size, symmetrised, triples
from .pairs import bound_of_pairs, in_binary64

if TYPE_CHECKING:
    from .kinks import Kinks
    from .sections import Path

_NOTHING = fmpq(0)
_SHARE = fmpq(1, 4)  # of 1 against d, around a level
_SHORT = 6  # bits of a number that is chosen here
OF_ONE = 16  # the weight of 1 over that of all of d: any positive number would do


@dataclass(frozen=True)
class Level:
    """c0, and the multiplier of V - c0."""

    c0: fmpq
    edge: fmpq


class Models:
    """G on a ball: `f_i + a_i.d + d'Q_i d + K_i[d] + sum_jq B_ij L_jq e_q + r_i`, f_i within `error`, a_i within
    `slack`, |r_i| <= d'E_i d; d has k entries. Along a path it is F - v. At rest f_i is exactly 0."""

    def __init__(self, J: Array, G: Sequence[Jet], rest: bool, velocity: Sequence[fmpq] = ()) -> None:
        """J is (n, n), v the velocity of a path, `rest` says whether G vanishes at d = 0. Parameters are finite; see
        `are_finite`. Where y is uncertain these are the models at y = 0; see `corners`."""
        self.J, self.units = exactly(J), G[0].units
        self.K = np.stack([g.K.value for g in G], -1)
        self.shares = np.array([g.B.value for g in G])
        self.B = exactly(self.shares)
        self.A = exactly(np.array([g.a.value for g in G]))
        self.slack = [rational(g.slack.top) for g in G]
        self.error = [fmpq(0) if rest else rational(g.error.top) for g in G]
        self.Qs, self.Es = np.array([g.Q.value.ravel() for g in G]), np.stack([g.remainder for g in G], -1)
        self.Q = [exactly(g.Q.value) for g in G]
        self.E = [exactly(g.remainder) for g in G]
        self.f = []
        if not rest:
            self.f = [rational(g.c.value) - v for g, v in zip(G, velocity or [fmpq(0)] * len(G), strict=True)]
        moves = [
            (
                np.array([0 * g.c_y.value[j] if rest else g.c_y.value[j] for g in G]),
                np.array([g.a_y.value[:, j] for g in G]),
            )
            for j in range(len(G[0].c_y.value))
        ]
        self.moves = [
            (c_y, a_y) for c_y, a_y in moves if np.any(c_y) or np.any(a_y)
        ]  # what else y does is in the errors
        self.others: list[fmpq_mat] = []
        self.kinks: Kinks | None = None

    def corners(self, P: Array | None = None) -> Iterator[Models]:
        """The models at each y of which all entries are 1 or -1; the one there is where nothing moves f or A.

        If P is given, only the AT_CORNERS that move these most have corners. What each of the others adds to
        Y = (f, A), or at rest to A, are then the `others` of every corner, (n, 1 + k) or (n, k)."""
        moves, others = self.moves, list[tuple[Array, Array]]()
        if P is not None and len(moves) > AT_CORNERS:
            roots = np.sqrt(np.diag(P))
            moves = sorted(moves, key=lambda y: (bool(np.any(y[0])), float(roots @ np.sqrt((y[1] ** 2).sum(1)))))[::-1]
            moves, others = moves[:AT_CORNERS], moves[AT_CORNERS:]
        whole = [exactly(np.column_stack([*([c_y] if self.f else []), a_y])) for c_y, a_y in others]
        known = [([rational(c) for c in c_y.tolist()], exactly(a_y)) for c_y, a_y in moves]
        for signs in product((1, -1), repeat=len(known)):
            corner = copy(self)
            corner.others = whole
            for sign, (c_y, a_y) in zip(signs, known, strict=True):
                corner.A = corner.A + sign * a_y
                corner.f = [f + sign * c for f, c in zip(corner.f, c_y, strict=True)] if self.f else []
            yield corner


def are_usable(by: Multipliers, path: Path | None = None) -> bool:
    """None is negative, and g is positive where it is used."""
    edges = () if path is None else (path.edge, path.motion, path.joint)
    signs = all(v >= 0 for row in (by.rest, by.apart, by.joint, edges) for v in row)
    joint = by.joint if path is None else (*by.joint, path.joint)
    return signs and (all(beta > 0 for beta in by.apart) or all(g > 0 for g in joint))


def are_finite(F: Sequence[Jet]) -> bool:
    """True if every component has a finite model, and the sums of squares in binary64 are finite."""
    units = F[0].units
    parts = [
        part
        for f in F
        for part in (f.c.value, f.error.top, f.a.value, f.slack.top, f.Q.value, f.remainder, f.B.value, f.twist.top)
    ]
    parts += [norm(units.reach, (0, 1)).top, norm(units.R, (0, 1, 2)).top]
    if units.first is not None:
        parts += [norm(units.first.alpha, (0, 1)).top, norm(units.first.beta).top, norm(units.first.rho).top]
    return all(np.all(np.isfinite(part)) for part in parts)


def shows(models: Models, P: fmpq_mat, R: fmpq_mat, by: Multipliers, path: Path | None = None) -> bool:
    """True if these multipliers, with those of the path, show the inequality for symmetric P and R (n, n)."""
    decay, rest = sides(models, P, R, by, path)
    return is_definite(decay - rest)


def sides(
    models: Models,
    P: fmpq_mat,
    R: fmpq_mat,
    by: Multipliers,
    path: Path | None = None,
    h: fmpq = _NOTHING,
    beyond: fmpq = _NOTHING,
    level: Level | None = None,
) -> tuple[fmpq_mat, fmpq_mat]:
    """The negated leading form, and the sum S of all bounds of the rest, both symmetric: over d at rest, (n, n), else
    over y = (1, d). `beyond` is Gamma, used where h > 0.

    In `rest` come one after the other S_rest and S_apart (in the loop, which gathers the C_j of `joint`), S_cubic and
    S_units, S_joint, the errors of f and a, S_step, as FORMAT.md has them; b_i is taken without its first entry, which
    meets f alone.
    """
    k, first = models.A.ncols(), int(bool(models.f))
    U = padded(models.J, 0, k - models.J.ncols())  # x as a function of y, or d
    Y = models.A
    if first:
        U, Y = (
            fmpq_mat([[c, *row] for c, row in zip(column, M.tolist(), strict=True)])
            for column, M in (([fmpq(0)] * U.nrows(), U), (models.f, Y))
        )
    b = P * (U + h * Y)  # b_i is row i
    rows = [fmpq_mat(1, k, row[first:]) for row in b.tolist()]
    squares = [row.transpose() * row for row in rows]
    lengths = [root_above((row * row.transpose())[0, 0]) for row in rows]
    crossed = U.transpose() * P * Y
    form = U.transpose() * R * U + crossed + crossed.transpose() + h * (Y.transpose() * P * Y)
    shares = by.joint if path is None else (*by.joint, rational(path.joint))
    rest = fmpq_mat(k, k)
    joint = [fmpq_mat(k, k) for _ in range(k)]
    for i, (alpha, beta) in enumerate(zip(by.rest, by.apart, strict=True)):
        E, Q = models.E[i], models.Q[i]
        if alpha > 0:
            rest += alpha * squares[i] + E.transpose() * E / alpha
        else:
            rest += lengths[i] * (E + E.transpose())
        if beta > 0:
            rest += beta * squares[i] + Q.transpose() * Q / beta
        else:
            joint = [C + rows[i][0, j] * Q for j, C in enumerate(joint)]
    bare = fmpq_mat([row.entries() for row in rows])
    rest += cubic(models, bare, by) + of_units(models, bare, by.weight)
    if not all(beta > 0 for beta in by.apart):
        inverse = diagonal([1 / g for g in shares])
        rest += diagonal(shares) + sum((C.transpose() * inverse * C for C in joint), fmpq_mat(k, k))
    share = _SHARE if path is None else fmpq(1)
    size = [abs(row[0]) if first else fmpq(0) for row in b.tolist()]
    at_0, along = doubts(models, P, h, beyond, size, lengths, share)
    of_others = of_quantities(models, b, by.weight)
    if h > 0:
        f = fmpq_mat(len(models.f), 1, models.f) if first else fmpq_mat(P.nrows(), 1)
        along += h * beyond * (beyond + 2 * root_above((f.transpose() * P * f)[0, 0]))
    rest += diagonal([along] * k)
    if first:
        rest = fmpq_mat([[at_0, *[0] * k], *([0, *row] for row in rest.tolist())])
    rest += of_others
    if models.kinks is not None:
        rest += models.kinks.bound(models, b, by.weight)
    if level is not None:
        form += level.edge * (U.transpose() * P * U)
        form[0, 0] -= level.edge * level.c0
    if path is not None:
        form = with_edge(form, models, P, path)
    return -form, rest


def doubts(
    models: Models, P: fmpq_mat, h: fmpq, beyond: fmpq, at_0: Sequence[fmpq], lengths: Sequence[fmpq], share: fmpq
) -> tuple[fmpq, fmpq]:
    """The contribution of f's errors and a's slacks to the entry of 1, and to each entry of d.

    `at_0` and `lengths` are the magnitudes of b_i's first entry, and of the rest of it. Twice a product of 1 and ||d||
    is at most share + ||d||^2 / share.
    """
    roots = [root_above(P[i, i]) if h > 0 else fmpq(0) for i in range(P.nrows())]  # of no step P may be any matrix
    e = sum((root * v for root, v in zip(roots, models.error, strict=True)), fmpq(0))
    s = sum((root * v for root, v in zip(roots, models.slack, strict=True)), fmpq(0))
    if h > 0:
        s += fmpq(0) if models.kinks is None else models.kinks.length
        for Y in models.others:  # its part with b_i is in `of_quantities`
            first = int(bool(models.f))
            lengths_of_1 = [(Y.transpose() * P * Y)[j, j] for j in range(Y.ncols())]
            e += root_above(sum(lengths_of_1[:first], fmpq(0)))
            s += root_above(sum(lengths_of_1[first:], fmpq(0)))
    pairs = list(zip(at_0, lengths, models.error, models.slack, strict=True))
    both = sum((length * wrong + p * slack for p, length, wrong, slack in pairs), h * e * s)
    start = 2 * sum((p * wrong for p, _, wrong, _ in pairs), fmpq(0)) + h * e * e
    along = 2 * sum((length * slack for _, length, _, slack in pairs), fmpq(0)) + h * s * s + 2 * h * beyond * (e + s)
    return start + share * both, along + both / share


def size_beyond(models: Models, P: Array) -> float:
    """Gamma: an upper bound of ||g||_P / ||d||^2, g the models less (f, A d); maybe infinite, or NaN."""
    R, E = (norm(M, (0, 1)) for M in (models.units.R, models.Es))
    c = Near(models.units.reach).through(models.shares)
    each = at_least_0((c * c.through(P)).sum())
    bent, twisted = lengths_of_forms(models, P)
    rest = (each.root * R).sum() + (size(np.diag(P)).root * E).sum()
    return float((bent + twisted + rest).top)


def lengths_of_forms(models: Models, P: Array) -> tuple[Above, Above]:
    """Upper bounds of ||(x'Q_i y)_i||_P and ||(K_i[x, y, z])_i||_P, where x, y and z are no longer than 1."""
    often = triples(models.A.ncols())[-1]
    bent = at_least_0(form_of(Near(models.Qs.T), models.Qs, P))
    twisted = at_least_0(form_of(Near(models.K) * Near(often[:, None]), models.K.T, P))
    return bent.root, twisted.root


def form_of(x: Near, y: Array, P: Array) -> Near:
    """sum_ij P_ij x_i.y_j, x (N, n) and y (n, N)."""
    return (x.through(y) * Near(P)).sum().sum()


def cubic(models: Models, b: fmpq_mat, by: Multipliers) -> fmpq_mat:
    """S_cubic: where beta_i > 0 each 2 (b_i.d) K_i[d] by itself, and the sum of all others as 2 sum_l d_l N_l[d, d, d],
    N being symmetric in all of its indices."""
    k = b.ncols()
    if not np.any(models.K):
        return fmpq_mat(k, k)
    row, power = in_binary64(b)
    apart = np.array([beta > 0 for beta in by.apart])
    K = np.moveaxis(unpacked(models.K.T, k), 0, -1)  # (k, k, k, n)
    S = bound_of_pairs(vectors(row[apart]), Tensor(K[..., apart].reshape(k, k * k, -1)), by.weight)
    N = symmetrised(mixed(Tensor(K[..., ~apart]), row[~apart]))
    S += bound_of_pairs(Vector(np.eye(k)), Tensor(N.value.reshape(k, k * k, k), N.error), by.weight)
    return S * fmpq(2) ** power


def of_units(models: Models, b: fmpq_mat, weight: Array) -> fmpq_mat:
    """S_units: 2 sum_q (p_q.d) e_q, p_q = sum_i b_i sum_j B_ij L_jq."""
    L, R = models.units.reach, models.units.R
    if not np.any(L):
        return fmpq_mat(b.ncols(), b.ncols())
    row, by = in_binary64(models.B.transpose() * b)
    return bound_of_pairs(vectors(row.through(L.T)), Tensor(R), weight) * fmpq(2) ** by


def of_quantities(models: Models, b: fmpq_mat, weight: Array) -> fmpq_mat:
    """S_ranges over d, or (1, d): 2 |b_i.y| |Y_i.y| <= tau (b_i.y)^2 + (Y_i.y)^2 / tau for each row of each of the
    models' others, whatever tau > 0 is."""
    k = b.ncols()
    S = fmpq_mat(k, k)
    if not models.others:
        return S
    W = np.zeros((k, k))
    W[k - len(weight) :, k - len(weight) :] = weight
    if k > len(weight):
        W[0, 0] = OF_ONE * np.trace(weight)
    for p, *steps in zip(b.tolist(), *(Y.tolist() for Y in models.others), strict=True):
        row = fmpq_mat(1, k, p)
        size = _size(p, W)
        for q in steps:
            if any(q) and any(p):
                tau, other = _short_root(_size(q, W), size), fmpq_mat(1, k, q)
                S += tau * (row.transpose() * row) + other.transpose() * other / tau
    return S


def _size(row: Sequence[fmpq], W: Array) -> float:
    """row W row', about; NaN where that is not near any number of binary64."""
    try:
        p = np.array([float(fraction(v)) for v in row])
    except OverflowError:
        return float("nan")
    with np.errstate(all="ignore"):
        return float(p @ W @ p)


def _short_root(above: float, below: float) -> fmpq:
    """About the root of a quotient, of few bits; 1 where that is no positive number."""
    with np.errstate(all="ignore"):
        m, e = np.frexp(np.sqrt(np.float64(above) / np.float64(below)))
    tau = float(np.ldexp(np.round(m * 2**_SHORT) / 2**_SHORT, e))
    return rational(tau) if 0 < tau < np.inf else fmpq(1)


def vectors(rows: Near) -> Vector:
    """Rows of numbers with an error each, (N, k), as vectors (k, N)."""
    return Vector(rows.value.T, rows.error.norm(1))


def with_edge(form: fmpq_mat, models: Models, P: fmpq_mat, path: Path) -> fmpq_mat:
    """The form over (1, d) and the multipliers of edge and motion."""
    n, k = P.nrows(), form.nrows() - 1
    share, edge, motion = rational(path.share), rational(path.edge), rational(path.motion)
    inner = padded(models.J.transpose() * P * models.J, k - n, k - n)
    ends = fmpq_mat([[0] * (k + 1), *([0, *row] for row in inner.tolist())])
    form = form + edge * ends
    form[k, k] -= motion
    form[0, 0] += motion * share * share - edge
    return form


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
