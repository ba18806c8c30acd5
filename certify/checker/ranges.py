"""Uncertain quantities on a ball: jets that are affine in numbers y_j in [-1, 1], each the same in all jets of a ball,
and the inequality at all y, by its corners."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import product

import numpy as np
from flint import fmpq, fmpq_mat

from .case import AT_CORNERS
from .decrease import OF_ONE, Models
from .exact import exactly, fraction, rational, root_above
from .functions import FUNCTIONS
from .jets import Jet, Units, aligned, constant
from .near import ZERO, Above, Array, Near, Vector, near

_SHORT = 6  # bits of a number that is chosen here


@dataclass(frozen=True)
class Swayed(Jet):
    """v(0) is near c + sum_j y_j c_j, the gradient near a + sum_j y_j a_j; `c_y` (N,) and `a_y` (k, N). All else holds
    whatever y is. A sum or product with a jet that knows nothing of y is one of these."""

    c_y: Near
    a_y: Vector

    @classmethod
    def of(cls, x: Jet, c_y: Near, a_y: Vector) -> Swayed:
        """A jet and what y does to it."""
        return cls(x.c, x.a, x.Q, x.K, x.E, x.B, x.units, x.lip, c_y, a_y)

    @cached_property
    def sway(self) -> Above:
        """Upper bound of y's effect on v(0)."""
        return self.c_y.size.sum()

    @cached_property
    def tilt(self) -> Above:
        """Upper bound of the effect on the gradient of y, and of errors of first order, which are those of some
        gradient at each d."""
        return self.a_y.size.sum() + self.units.tilt(self.B.size)

    @cached_property
    def v0(self) -> Near:
        return self.c.wider(self.sway)

    @cached_property
    def gradient(self) -> Vector:
        return self.a.wider(self.tilt)

    @property
    def error(self) -> Above:
        return super().error + self.c_y.error.sum()

    @property
    def slack(self) -> Above:
        return self.a.error + self.a_y.error.sum() + self.units.tilt(self.B.error)

    def __add__(self, other: Jet) -> Swayed:
        x, y = self._beside(other)
        return Swayed.of(Jet.__add__(x, y), x.c_y + y.c_y, x.a_y + y.a_y)

    def __neg__(self) -> Swayed:
        return Swayed.of(super().__neg__(), -self.c_y, -self.a_y)

    def __mul__(self, other: Jet) -> Swayed:
        """The product; terms of second order in y are lost."""
        x, y = self._beside(other)
        v = Jet.__mul__(x, y)
        c, a = v.c.wider(x.sway * y.sway), v.a.wider(x.sway * y.tilt + y.sway * x.tilt)
        a_y = x.a_y * y.c + y.a_y * x.c + _each(x.c_y, y.a) + _each(y.c_y, x.a)
        return Swayed.of(replaced(v, c, a), x.c_y * y.c + y.c_y * x.c, a_y)

    def __radd__(self, other: Jet) -> Swayed:
        return self._lifted(other) + self

    def __rmul__(self, other: Jet) -> Swayed:
        return self._lifted(other) * self

    def _beside(self, other: Jet) -> tuple[Swayed, Swayed]:
        x, y = aligned(self, other)
        return self._lifted(x), self._lifted(y)

    def _lifted(self, other: Jet) -> Swayed:
        return in_y(other, len(self.c_y.value))

    def function(self, name: str) -> Swayed:
        """phi(v).

        With delta = v(0) - c, phi(v(0)) is phi(c) + phi'(c) delta within sup|phi''|/2 delta^2, and phi'(v(0)) is
        phi'(c) + phi''(c) delta within sup|phi'''|/2 delta^2, the suprema over all that v(0) may be; NaN where phi'
        has no derivative among these.
        """
        if name == "abs" and self.may_vanish:
            return self.magnitude()
        f0, f1, half, _ = FUNCTIONS[name].expansion(Near(self.c.value), ZERO).f
        _, bent, twisted = (f.size for f in FUNCTIONS[name].expansion(self.v0, ZERO).derivative.stored)
        off, twice = self.v0.error, half * 2
        c = f0.wider(f1.size * self.c.error + bent * (off * off) * 0.5)
        moved = f1.wider(twice.size * self.c.error + twisted * (off * off))  # phi' at y = 0
        by_y = twice.size * self.sway
        a = (self.a * moved).wider(by_y * (self.a.error + self.tilt))
        v = replaced(super().function(name), c, a)
        return Swayed.of(v, self.c_y * f1, self.a_y * moved + _each(self.c_y * twice, self.a))

    def magnitude(self) -> Swayed:
        """|v(0)| is within as much of |c| as v(0) of c."""
        v = super().magnitude()
        return in_y(replaced(v, v.c.wider(self.v0.error), v.a), len(self.c_y.value))


def replaced(v: Jet, c: Near, a: Vector) -> Jet:
    """A jet with another value and gradient."""
    return Jet(c, a, v.Q, v.K, v.E, v.B, v.units, v.lip)


def in_y(v: Jet, count: int) -> Swayed:
    """A jet among those that know of so many numbers y."""
    if isinstance(v, Swayed):
        return v
    return Swayed.of(v, Near(np.zeros(count)), Vector(np.zeros((len(v.a.value), count))))


def _each(y: Near, a: Vector) -> Vector:
    """The vectors y_j a, (k, N, ...), of numbers y (N, ...) and vectors a (k, ...)."""
    return Vector(a.value[:, None], a.error[None]) * y


def uncertain(lo: Fraction, hi: Fraction, units: Units, number: int, count: int) -> Swayed:
    """A number of [lo, hi], lo + hi + (hi - lo) y over 2, y being the one of this number of `count`."""
    reach, here = near((hi - lo) / 2), np.arange(count) == number
    c_y = Near(np.where(here, reach.value, 0.0), reach.error * np.where(here, 1.0, 0.0))
    return Swayed.of(constant((lo + hi) / 2, units), c_y, Vector(np.zeros((len(units.R), count))))


def between(lo: Fraction, hi: Fraction, units: Units) -> Jet:
    """A number of [lo, hi] of which nothing else is known, maybe another one wherever it is used."""
    middle = constant((lo + hi) / 2, units)
    return replaced(middle, middle.c.wider(near((hi - lo) / 2).size), middle.a)


@dataclass(frozen=True)
class Others:
    """Numbers y that have no corners, by what they add: to Y = (f, A), or at rest to A, (n, 1 + k) or (n, k) each."""

    parts: list[fmpq_mat]

    def bound(self, models: Models, b: fmpq_mat, weight: Array) -> fmpq_mat:
        """S_ranges over d, or (1, d): 2 |b_i.y| |Y_i.y| <= tau (b_i.y)^2 + (Y_i.y)^2 / tau for each row of each part,
        whatever tau > 0 is."""
        k = b.ncols()
        S, W = fmpq_mat(k, k), np.zeros((k, k))
        W[k - len(weight) :, k - len(weight) :] = weight
        if k > len(weight):
            W[0, 0] = OF_ONE * np.trace(weight)
        for p, *steps in zip(b.tolist(), *(Y.tolist() for Y in self.parts), strict=True):
            row = fmpq_mat(1, k, p)
            size = _size(p, W)
            for q in steps:
                if any(q) and any(p):
                    tau, other = _short_root(_size(q, W), size), fmpq_mat(1, k, q)
                    S += tau * (row.transpose() * row) + other.transpose() * other / tau
        return S

    def lengths(self, models: Models, P: fmpq_mat) -> tuple[fmpq, fmpq]:
        first, found = int(bool(models.f)), (fmpq(0), fmpq(0))
        for Y in self.parts:
            squares = [(Y.transpose() * P * Y)[j, j] for j in range(Y.ncols())]
            ends = root_above(sum(squares[:first], fmpq(0))), root_above(sum(squares[first:], fmpq(0)))
            found = found[0] + ends[0], found[1] + ends[1]
        return found


def corners(models: Models, P: Array | None) -> Iterator[Models]:
    """The models at each y of which all entries are 1 or -1; the one there is where nothing moves f or A.

    If P is given, only the AT_CORNERS that move these most have corners; see `Others`."""
    count = max(len(g.c_y.value) for g in models.G if isinstance(g, Swayed))
    G, rest = [in_y(g, count) for g in models.G], not models.f
    moves = [
        (
            np.array([0 * g.c_y.value[j] if rest else g.c_y.value[j] for g in G]),
            np.array([g.a_y.value[:, j] for g in G]),
        )
        for j in range(len(G[0].c_y.value))
    ]
    moves = [(c_y, a_y) for c_y, a_y in moves if np.any(c_y) or np.any(a_y)]  # what else y does is in the errors
    others = list[tuple[Array, Array]]()
    if P is not None and len(moves) > AT_CORNERS:
        roots = np.sqrt(np.diag(P))
        moves = sorted(moves, key=lambda y: (bool(np.any(y[0])), float(roots @ np.sqrt((y[1] ** 2).sum(1)))))[::-1]
        moves, others = moves[:AT_CORNERS], moves[AT_CORNERS:]
    whole = [exactly(np.column_stack([*([] if rest else [c_y]), a_y])) for c_y, a_y in others]
    known = [([rational(c) for c in c_y.tolist()], exactly(a_y)) for c_y, a_y in moves]
    for signs in product((1, -1), repeat=len(known)):
        corner = copy(models)
        corner.more = [*models.more, *([Others(whole)] if whole else [])]
        for sign, (c_y, a_y) in zip(signs, known, strict=True):
            corner.A = corner.A + sign * a_y
            corner.f = [f + sign * c for f, c in zip(corner.f, c_y, strict=True)] if corner.f else []
        yield corner


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
