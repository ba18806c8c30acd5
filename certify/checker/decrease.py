"""The matrix inequality of rule `local`: that d'J'RJ d + 2 d'J'P G < 0 for 0 < ||d|| <= 1 at rest, or that this and
k (V - c0) is negative around a level c0. stepping.py has it for steps, tube.py along a path.

The models of G come with their rounding errors bounded (ball.py). From there on everything is in rationals, without
rounding, except for the sums of many terms (pairs.py). FORMAT.md has the inequality and its six sums,
docs/mathematics/local.md the proof that each is a bound.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add
from typing import TYPE_CHECKING, Protocol

import numpy as np
from flint import fmpq, fmpq_mat

from .document import LocalBall
from .exact import diagonal, exactly, is_definite, rational, root_above
from .jets import Jet, unpacked
from .near import Array, Near, Tensor, Vector, mixed, symmetrised
from .pairs import bound_of_pairs, in_binary64

if TYPE_CHECKING:
    from .sections import Slab

OF_ONE = 16  # the weight of 1 over that of all of d: any positive number would do


class More(Protocol):
    """A part that only some models have beside the rest."""

    def bound(self, models: Models, b: fmpq_mat, weight: Array) -> fmpq_mat:
        """A bound of twice its sum with b_i, row i of b, over d or y = (1, d)."""

    def lengths(self, models: Models, P: fmpq_mat) -> tuple[fmpq, fmpq]:
        """Bounds of its length in the norm of P, of the part with 1, and of the part with d over ||d||."""


@dataclass(frozen=True)
class Multipliers:
    """alpha, beta and g, n of each, and `weight`, (k, k), from which the others follow."""

    rest: tuple[fmpq, ...]
    apart: tuple[fmpq, ...]
    joint: tuple[fmpq, ...]
    weight: Array

    @staticmethod
    def of(part: LocalBall | Slab) -> Multipliers:
        """The multipliers of a part of the evidence."""
        rest, apart, joint = (tuple(map(rational, row)) for row in part.multipliers.tolist())
        return Multipliers(rest, apart, joint, part.weight)


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
        self.J, self.G, self.units = exactly(J), G, G[0].units
        self.K = np.stack([g.K.value for g in G], -1)
        self.shares = np.array([g.B.value for g in G])
        self.B = exactly(self.shares)
        self.A = exactly(np.array([g.a.value for g in G]))
        self.slack = [rational(g.slack.top) for g in G]
        self.error = [fmpq(0) if rest else rational(g.error.top) for g in G]
        self.Q = [exactly(g.Q.value) for g in G]
        self.E = [exactly(g.remainder) for g in G]
        self.f = []
        if not rest:
            self.f = [rational(g.c.value) - v for g, v in zip(G, velocity or [fmpq(0)] * len(G), strict=True)]
        self.more = list[More]()
        self.beyond = fmpq(0)  # Gamma, of a step

    def corners(self, P: Array | None = None) -> Iterator[Models]:
        """The models at each y of which all entries are 1 or -1; these alone where nothing is uncertain. If P is given
        y may have fewer entries, those that move f and A most; what the others add is among `more`."""
        if not any(hasattr(g, "c_y") for g in self.G):
            yield self
            return
        from .ranges import corners

        yield from corners(self, P)


def are_usable(by: Multipliers) -> bool:
    """None is negative, and g is positive where it is used."""
    signs = all(v >= 0 for row in (by.rest, by.apart, by.joint) for v in row)
    return signs and (all(beta > 0 for beta in by.apart) or all(g > 0 for g in by.joint))


def are_finite(F: Sequence[Jet]) -> bool:
    """True if every component has a finite model, and the sums of squares in binary64 are finite."""
    parts = [
        part for f in F for part in (f.c.value, f.error.top, f.a.value, f.slack.top, f.Q.value, f.remainder, f.B.value)
    ]
    twist = reduce(add, [f.twist for f in F])  # bounds the norms of sums of the K_i, with factors up to 1
    norms = [(twist * twist).top, *(norm.top for norm in F[0].units.norms)]
    return all(np.all(np.isfinite(part)) for part in (*parts, *norms))


class Inequality:
    """The inequality with some multipliers, for symmetric P and R (n, n): over d at rest, (k, k), else over y = (1, d).
    b_i is taken without its first entry, which meets f alone."""

    share = fmpq(1, 4)  # of 1 against d, around a level

    def __init__(self, models: Models, P: fmpq_mat, R: fmpq_mat, by: Multipliers, level: Level | None = None) -> None:
        self.models, self.P, self.R, self.by, self.level = models, P, R, by, level
        self.k, self.first = models.A.ncols(), int(bool(models.f))
        self.U, self.Y = self.position(), models.A  # x and G as functions of d, or y
        if self.first:
            self.U, self.Y = (
                fmpq_mat([[c, *row] for c, row in zip(column, M.tolist(), strict=True)])
                for column, M in (([fmpq(0)] * self.U.nrows(), self.U), (models.f, self.Y))
            )

    def position(self) -> fmpq_mat:
        """x as a function of d."""
        return self.models.J

    @cached_property
    def b(self) -> fmpq_mat:
        """The b_i in rows."""
        return self.P * self.U

    @cached_property
    def rows(self) -> list[fmpq_mat]:
        """The b_i, each without the entry of 1."""
        return [fmpq_mat(1, self.k, row[self.first :]) for row in self.b.tolist()]

    @cached_property
    def lengths(self) -> list[fmpq]:
        """Their lengths, from above."""
        return [root_above((row * row.transpose())[0, 0]) for row in self.rows]

    @property
    def joint(self) -> Sequence[fmpq]:
        """The multipliers g."""
        return self.by.joint

    def form(self) -> fmpq_mat:
        """The terms of second order in d, or y."""
        U, crossed = self.U, self.U.transpose() * self.P * self.Y
        form = U.transpose() * self.R * U + crossed + crossed.transpose()
        if self.level is not None:
            form += self.level.edge * (U.transpose() * self.P * U)
            form[0, 0] -= self.level.edge * self.level.c0
        return form

    def rest(self) -> fmpq_mat:
        """The sum S of all bounds of the rest, symmetric: S_rest and S_apart, S_cubic and S_units, S_joint, those of
        the errors of f and a, and of what only some models have."""
        by, k = self.by, self.k
        rest, joint = fmpq_mat(k, k), [fmpq_mat(k, k) for _ in range(k)]  # the C_j
        for E, Q, row, length, alpha, beta in zip(
            self.models.E, self.models.Q, self.rows, self.lengths, by.rest, by.apart, strict=True
        ):
            square = row.transpose() * row
            rest += alpha * square + E.transpose() * E / alpha if alpha > 0 else length * (E + E.transpose())
            if beta > 0:
                rest += beta * square + Q.transpose() * Q / beta
            else:
                joint = [C + row[0, j] * Q for j, C in enumerate(joint)]
        bare = fmpq_mat([row.entries() for row in self.rows])
        rest += cubic(self.models, bare, by) + of_units(self.models, bare, by.weight)
        if not all(beta > 0 for beta in by.apart):
            inverse = diagonal([1 / g for g in self.joint])
            rest += diagonal(self.joint) + sum((C.transpose() * inverse * C for C in joint), fmpq_mat(k, k))
        at_0, along, both = self.doubts()
        rest += diagonal([along + both / self.share] * k)
        if self.first:
            rest = fmpq_mat([[at_0 + self.share * both, *[0] * k], *([0, *row] for row in rest.tolist())])
        for more in self.models.more:
            rest += more.bound(self.models, self.b, by.weight)
        return rest

    def doubts(self) -> tuple[fmpq, fmpq, fmpq]:
        """The contributions of f's errors and a's slacks to the entry of 1, and to each entry of d, and twice their
        products of 1 and ||d||, each of which is at most share + ||d||^2 / share."""
        ends = [abs(row[0]) if self.first else fmpq(0) for row in self.b.tolist()]  # of the b_i, what meets f
        of_each = list(zip(ends, self.lengths, self.models.error, self.models.slack, strict=True))
        at_0 = 2 * sum((end * wrong for end, _, wrong, _ in of_each), fmpq(0))
        along = 2 * sum((length * slack for _, length, _, slack in of_each), fmpq(0))
        return at_0, along, sum((length * wrong + end * slack for end, length, wrong, slack in of_each), fmpq(0))

    def sides(self) -> tuple[fmpq_mat, fmpq_mat]:
        """The negated form, and the rest, which must stay below it."""
        return -self.form(), self.rest()

    @property
    def holds(self) -> bool:
        """True if the multipliers show it."""
        decay, rest = self.sides()
        return is_definite(decay - rest)


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


def vectors(rows: Near) -> Vector:
    """Rows of numbers with an error each, (N, k), as vectors (k, N)."""
    return Vector(rows.value.T, rows.error.norm(1))
