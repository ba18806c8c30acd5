"""Bounds of an unknown function at a point, or of its slopes at the origin, from samples around it.

With |g_ab| <= M_ab on a convex box that holds p and the samples z_k, g(z_k) = g(p) + grad g(p).(z_k - p) + r_k with
|r_k| <= 1/2 sum M_ab |z_k - p|_a |z_k - p|_b. For samples and weights v with sum_k v_k = 1, sum_k v_k z_k = p

    g(p) lies within sum_k |v_k| (noise + |r_k|) of sum_k v_k y_k,

and at the origin, where g is 0, its slope a_j does if sum_k v_k z_k = e_j, the unit vector. The samples are the active
ones of a linear program, whose optimum is the least bound; the weights are solved for in rationals, so that nothing
rests on its solver.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from typing import NamedTuple

import numpy as np
from flint import fmpq, fmpq_mat
from scipy.optimize import linprog

from certify.certificates.samples import Weights
from certify.errors import CertifyError, InputError
from certify.loop.plants.samples import Point, Sampled, Unknown


class Contradicted(CertifyError):
    """The samples are of no function with these bounds of second derivatives, this noise and the value 0 at 0."""


_MOST = 100  # samples, those of the least bounds, that the programs see


def beyond(one: Unknown, z: Point) -> Fraction:
    """The bound of |r| at a distance z."""
    pairs = ((row, v) for row, v in zip(one.curvature, z, strict=True))
    return sum((m * abs(v * w) for row, v in pairs for m, w in zip(row, z, strict=True)), Fraction(0)) / 2


class Bounds(NamedTuple):
    """An interval that holds a value of g, or a slope at the origin, and the weights of samples that show each end."""

    lo: Fraction
    hi: Fraction
    lower: Weights
    upper: Weights


class Row(NamedTuple):
    """A sample's inequality |a.q - y| <= e for q, the value and the slopes of g at a point, or the slopes alone."""

    a: Point
    y: Fraction
    e: Fraction


class Sampling:
    """Samples of a function in its box, of which linear programs ask.

    Raises
    ------
    InputError : there are none.
    """

    def __init__(self, one: Unknown, taken: Sampled, noise: Fraction) -> None:
        if not taken.points:
            raise InputError(f"no sample of {one.state} lies in the domain and the input bounds: take some there.")
        self.one, self.taken, self.noise = one, taken, noise
        self.points = np.array([[float(v) for v in z] for z in taken.points])
        self.values, self.M = np.array([float(y) for y in taken.values]), np.array(one.curvature, dtype=float)
        self.size = np.array([float(hi - lo) for lo, hi in one.box])

    def at(self, p: Point) -> Bounds:
        """An interval that holds g(p).

        Raises
        ------
        InputError : the samples do not span the variables.
        Contradicted : no function with these bounds has such samples.
        """
        return _Around(self, p, True).bounds(0)

    def slopes(self) -> tuple[Bounds, ...]:
        """Intervals that hold the first derivatives of g at the origin, where it is 0; raises like `at`."""
        around = _Around(self, (Fraction(0),) * len(self.size), False)
        return tuple(around.bounds(j) for j in range(len(self.size)))


class _Around:
    """Samples around a point p, those of the least errors, and their linear programs; `valued` where g(p) is unknown.

    The programs see floats, in which each variable is scaled by its box, and values by the largest error.
    """

    def __init__(self, sampling: Sampling, p: Point, valued: bool) -> None:
        self.sampling, self.p, self.valued = sampling, p, valued
        away = sampling.points - np.array([float(v) for v in p])
        e = float(sampling.noise) + 0.5 * np.einsum("ki,ij,kj->k", np.abs(away), sampling.M, np.abs(away))
        telling = np.flatnonzero(away.any(axis=1) | valued)
        order = telling[np.argsort(e[telling], kind="stable")]
        alone = order[_MOST:][np.count_nonzero(away[order[_MOST:]], axis=1) == 1]
        self.numbers = np.concatenate([order[:_MOST], alone[:_MOST]])
        Z = away[self.numbers] / sampling.size
        self.A = np.column_stack([np.ones(len(Z)), Z]) if valued else Z
        unit = float(e[self.numbers].max()) or 1.0  # of values, for the programs' tolerances are absolute
        self.y, self.e = sampling.values[self.numbers] / unit, e[self.numbers] / unit

    def row(self, k: int) -> Row:
        """The inequality of sample k, exactly."""
        s = self.sampling
        away = tuple(v - w for v, w in zip(s.taken.points[k], self.p, strict=True))
        a = (Fraction(1), *away) if self.valued else away
        return Row(a, s.taken.values[k], s.noise + beyond(s.one, away))

    def bounds(self, j: int) -> Bounds:
        """An interval of the j-th entry of q."""
        (lo, lower), (hi, upper) = (self._end(j, sign) for sign in (1, -1))
        if lo > hi:
            raise self._contradicted([k for k, _ in (*lower, *upper)])
        return Bounds(lo, hi, lower, upper)

    def _end(self, j: int, sign: int) -> tuple[Fraction, Weights]:
        """The lower (sign 1) or upper end, from samples that a linear program chooses, and their weights."""
        cost = np.zeros(self.A.shape[1])
        cost[j] = sign
        left, right = np.vstack([self.A, -self.A]), np.concatenate([self.y + self.e, self.e - self.y])
        solved = linprog(cost, A_ub=left, b_ub=right, bounds=(None, None))
        if solved.status == 2:
            raise self._contradiction()
        if solved.status != 0:
            what = f"do not bound {self.sampling.one.state} or its slopes at {self._where()}"
            raise InputError(f"the samples {what}: take some near it along each variable.")
        order = np.argsort(-np.abs(solved.ineqlin.marginals), kind="stable") % len(self.A)
        unit = [Fraction(int(i == j)) for i in range(len(cost))]
        weights = self._weights(list(dict.fromkeys(self.numbers[order].tolist())), unit)
        rows = [(v, self.row(k)) for k, v in weights]
        middle = sum((v * row.y for v, row in rows), Fraction(0))
        return middle - sign * sum((abs(v) * row.e for v, row in rows), Fraction(0)), weights

    def _weights(self, order: Sequence[int], unit: Sequence[Fraction]) -> Weights:
        """v with sum_k v_k a_k = unit, for the first samples in an order that span the space."""
        basis: list[int] = []
        columns: list[list[fmpq]] = []
        for k in order:
            more = [*columns, list(map(_exact, self.row(k).a))]
            if fmpq_mat(more).rank() == len(more):
                basis, columns = [*basis, k], more
            if len(basis) == len(unit):
                break
        else:
            raise InputError(f"the samples of {self.sampling.one.state} must differ in each variable.")
        solved = fmpq_mat(columns).transpose().solve(fmpq_mat([[_exact(v)] for v in unit])).entries()
        return tuple((k, Fraction(int(v.p), int(v.q))) for k, v in zip(basis, solved, strict=True) if v)

    def _contradiction(self) -> CertifyError:
        """The finding that samples contradict one another, if rationals show it: v with sum_k v_k a_k = 0 for which
        |sum_k v_k y_k| is larger than the errors allow."""
        ones = np.ones((len(self.A), 1))
        cost = np.append(np.zeros(self.A.shape[1]), 1.0)
        left = np.vstack([np.hstack([self.A, -ones]), np.hstack([-self.A, -ones])])
        right = np.concatenate([self.y + self.e, self.e - self.y])
        solved = linprog(cost, A_ub=left, b_ub=right, bounds=(None, None))
        if solved.status == 0:
            order = np.argsort(-np.abs(solved.ineqlin.marginals), kind="stable") % len(self.A)
            chosen = list(dict.fromkeys(self.numbers[order].tolist()))[: self.A.shape[1] + 1]
            rows = [self.row(k) for k in chosen]
            null, rank = fmpq_mat([list(map(_exact, row.a)) for row in rows]).transpose().numer_denom()[0].nullspace()
            for column in range(rank):
                v = [Fraction(int(null[i, column])) for i in range(len(rows))]
                off = abs(sum((w * row.y for w, row in zip(v, rows, strict=True)), Fraction(0)))
                if off > sum((abs(w) * row.e for w, row in zip(v, rows, strict=True)), Fraction(0)):
                    return self._contradicted([k for k, w in zip(chosen, v, strict=True) if w])
        return InputError(
            f"{self.sampling.one.state} cannot be bounded at {self._where()}: the samples are nearly a contradiction."
        )

    def _contradicted(self, numbers: Sequence[int]) -> Contradicted:
        taken = self.sampling.taken
        each = [f"{float(taken.values[k]):.6g} at {_words(taken.points[k])}" for k in sorted({*numbers})]
        what = "no value and slopes" if self.valued else "no slopes"
        return Contradicted(
            f"{what} of {self.sampling.one.state} at {self._where()} are consistent with the samples {'; '.join(each)}"
        )

    def _where(self) -> str:
        return f"({_words(self.p)})" if any(self.p) else "the origin"


def _words(z: Point) -> str:
    return ", ".join(f"{float(v):g}" for v in z)


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
