"""A polynomial near an unknown function, and a bound of how far the function may be from it.

Let an interval hold g at each point of a grid, |g_jj| <= H_j, p a polynomial and r = g - p. On a cell of the
grid with the widths s the multilinear interpolation I r of r at the cell's corners has

    |r - I r| <= sum_j s_j^2/8 sup|r_jj| <= sum_j s_j^2/8 (H_j + sup|p_jj|),

for interpolation along one axis errs by at most s^2/8 sup|r_jj| (Davis, *Interpolation and Approximation*, theorem
3.1.1), and interpolation along the others takes means. |I r| is at most the largest |r| at the corners, which
the intervals bound. p is any polynomial: how it is found decides how small the bound is, not whether it is true.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import pairwise, product
from math import comb, frexp, prod

import numpy as np
from scipy.optimize import linprog

from certify.analysis.fitting.grid import Grid, nearness
from certify.errors import InputError
from certify.loop.plants.samples import Point, Unknown

_DIGITS = 12  # of a coefficient after the point, as a share of the largest sampled value
_HELD = 10**12  # denominators of bounds that stand in files
_TERMS, _PARTS = 2**7, 2**9  # terms z^k of a polynomial that the checkers expand, and their sum of prod (k_j + 1)
Cell = tuple[tuple[Fraction, Fraction], ...]
"""The interval of each variable."""


@dataclass(frozen=True, slots=True)
class Polynomial:
    """sum_k c_k prod_j (z_j/scale_j)^(powers_kj), by exact numbers."""

    variables: tuple[str, ...]
    scale: Point
    powers: tuple[tuple[int, ...], ...]
    coefficients: Point

    def at(self, z: Point) -> Fraction:
        """The value at a point."""
        t = [v / s for v, s in zip(z, self.scale, strict=True)]
        return sum((c * _power(t, p) for c, p in zip(self.coefficients, self.powers, strict=True)), Fraction(0))

    def bent(self, j: int, cell: Sequence[tuple[Fraction, Fraction]]) -> Fraction:
        """A bound of the absolute second derivative along axis j on a cell: its terms around the cell's middle, whose
        sizes are added."""
        terms = dict[tuple[int, ...], Fraction]()
        for c, p in zip(self.coefficients, self.powers, strict=True):
            if p[j] >= 2:
                lower = tuple(k - 2 * (i == j) for i, k in enumerate(p))
                terms[lower] = terms.get(lower, Fraction(0)) + c * p[j] * (p[j] - 1)
        halves = []
        for i, ((lo, hi), s) in enumerate(zip(cell, self.scale, strict=True)):
            terms = _moved(terms, i, (lo + hi) / 2 / s)
            halves.append((hi - lo) / 2 / s)
        return sum((abs(c) * _power(halves, p) for p, c in terms.items()), Fraction(0)) / self.scale[j] ** 2

    def text(self) -> str:
        """The polynomial as an equation of a plant's file."""
        terms = []
        for c, p in zip(self.coefficients, self.powers, strict=True):
            factors = [
                f"({v}/({_shown(s)}))" + (f"**{k}" if k > 1 else "")
                for v, s, k in zip(self.variables, self.scale, p, strict=True)
                if k
            ]
            if c:
                terms.append("*".join([f"({_shown(c)})", *factors]))
        return " + ".join(terms) or "0"


def _power(t: Sequence[Fraction], p: Sequence[int]) -> Fraction:
    found = Fraction(1)
    for v, k in zip(t, p, strict=True):
        found *= v**k
    return found


def _moved(terms: Mapping[tuple[int, ...], Fraction], i: int, by: Fraction) -> dict[tuple[int, ...], Fraction]:
    """The polynomial of t with t_i + by instead of t_i."""
    found = dict[tuple[int, ...], Fraction]()
    for p, c in terms.items():
        for k in range(p[i] + 1):
            lower = (*p[:i], k, *p[i + 1 :])
            found[lower] = found.get(lower, Fraction(0)) + c * comb(p[i], k) * by ** (p[i] - k)
    return found


def _shown(q: Fraction) -> str:
    """A decimal or a quotient that is exactly this number."""
    return str(q)


def fitted(one: Unknown, grid: Grid, degree: int) -> Polynomial:
    """The polynomial without a constant term, of least squares at the intervals' middles; its degree in a variable of
    bounded second derivative 0 is 1, and terms of several variables are of degree 3 at most."""
    curved = [max(row) > 0 for row in one.curvature]
    most = [min(degree if bent else 1, len(axis) - 1) for bent, axis in zip(curved, grid.axes, strict=True)]
    powers = [
        p for p in product(*(range(k + 1) for k in most)) if 0 < sum(p) <= (3 if sum(map(bool, p)) > 1 else degree)
    ]
    if len(powers) > _TERMS or sum(prod(k + 1 for k in p) for p in powers) > _PARTS:
        raise InputError(f"`degree` {degree} makes a larger polynomial than the checkers expand: try a lower one.")
    # powers of 2, whose own powers are short numbers
    scale = tuple(Fraction(2) ** frexp(max(abs(axis[0]), abs(axis[-1])))[1] for axis in grid.axes)
    points = np.array([[float(v / s) for v, s in zip(z, scale, strict=True)] for z in grid.middles])
    values = np.array([float(y) for y in grid.middles.values()])
    columns = np.stack([np.prod(points ** np.array(p), axis=1) for p in powers], axis=1)
    found = np.linalg.lstsq(columns, values, rcond=None)[0]
    unit = Fraction(10) ** (len(str(int(max(1.0, float(np.abs(values).max()))))) - _DIGITS)
    return Polynomial(
        one.variables, scale, tuple(powers), tuple(round(Fraction(float(c)) / unit) * unit for c in found)
    )


def cells(grid: Grid) -> Iterator[Cell]:
    """The cells of a grid, each by its interval along each axis."""
    return product(*(tuple(pairwise(axis)) for axis in grid.axes))


def errors(p: Polynomial, one: Unknown, grid: Grid) -> dict[Cell, Fraction]:
    """A bound of |g - p| on each cell of the grid."""
    off = {}
    for z, (lo, hi, *_) in grid.bounds.items():
        y = p.at(z)
        off[z] = max(hi - y, y - lo)
    found = {}
    for cell in cells(grid):
        each = max(off[corner] for corner in product(*cell))
        for j, (lo, hi) in enumerate(cell):
            each += (hi - lo) ** 2 / 8 * (one.curvature[j][j] + p.bent(j, cell))
        found[cell] = each
    return found


@dataclass(frozen=True, slots=True)
class Bound:
    """constant + sum_j slope_j z_j^2, a bound of |g - p| everywhere on the grid."""

    variables: tuple[str, ...]
    constant: Fraction
    rise: Point

    def least(self, cell: Cell) -> Fraction:
        """The least value on a cell."""
        each = zip(self.rise, cell, strict=True)
        return self.constant + sum((k * (0 if a <= 0 <= b else min(a * a, b * b)) for k, (a, b) in each), Fraction(0))

    def text(self) -> str:
        """The bound as an equation of a plant's file."""
        each = zip(self.variables, self.rise, strict=True)
        constant = [f"({self.constant})"] if self.constant else []
        return " + ".join([*constant, *(f"({k})*{v}**2" for v, k in each if k)]) or "0"


def bounded(one: Unknown, each: Mapping[Cell, Fraction], near_origin: float = 0.0) -> Bound:
    """A bound of so simple a form of what is known cell by cell: by a linear program that asks for the least mean of
    its ratios to these, with weights of `nearness` to the power `near_origin`, then raised by as much as it misses in
    rationals. A constant if some of these are 0."""
    variables, rise = one.variables, [Fraction(0)] * len(one.variables)
    least = {cell: [Fraction(0) if lo <= 0 <= hi else min(lo * lo, hi * hi) for lo, hi in cell] for cell in each}
    if all(each.values()):
        rows = np.array([[1.0, *map(float, squares)] for squares in least.values()])
        sizes = np.array([float(e) for e in each.values()])
        weights = (
            nearness(one, np.array([[float(lo + hi) / 2 for lo, hi in cell] for cell in each])) ** near_origin / sizes
        )
        solved = linprog(weights @ rows / weights.sum(), A_ub=-rows, b_ub=-sizes)
        if solved.status == 0:
            rise = [max(Fraction(0), round(Fraction(float(k)) * _HELD) / Fraction(_HELD)) for k in solved.x[1:]]
    missed = max(
        e - sum((k * q for k, q in zip(rise, least[cell], strict=True)), Fraction(0)) for cell, e in each.items()
    )
    return Bound(variables, Fraction(-(-max(missed, Fraction(0)) * _HELD // 1), _HELD), tuple(rise))


@dataclass(frozen=True, slots=True)
class Missing:
    """Points of a grid at which samples are missing, those first where the interval is widest; with samples there the
    largest error on a cell would be at most `largest`, half of what it is, if their values are the intervals' middles.
    Where no number of points does that, the first alone and no bound."""

    points: tuple[Point, ...] = ()
    largest: float | None = None


def missing(p: Polynomial, grid: Grid, each: Mapping[Cell, Fraction], noise: Fraction) -> Missing:
    """The fewest of the widest points of a chosen grid that halve the largest error, in floats."""
    points = sorted(grid.bounds, key=lambda z: grid.bounds[z].hi - grid.bounds[z].lo, reverse=True)
    away = {z: float(abs(grid.middles[z] - p.at(z))) for z in points}
    half = {z: float(grid.bounds[z].hi - grid.bounds[z].lo) / 2 for z in points}
    bend = {cell: float(e) - max(away[z] + half[z] for z in product(*cell)) for cell, e in each.items()}

    def largest(count: int) -> float:
        off = {z: away[z] + (float(noise) if k < count else half[z]) for k, z in enumerate(points)}
        return max(b + max(off[z] for z in product(*cell)) for cell, b in bend.items())

    goal = float(max(each.values())) / 2
    count = bisect_left(range(len(points) + 1), -goal, key=lambda k: -largest(k))
    return Missing(tuple(points[:count]), largest(count)) if count <= len(points) else Missing(tuple(points[:1]))
