"""Samples of which no function with the declared bounds can be found: differences of samples on a grid show it, in
rationals, or weights of scattered ones."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from itertools import combinations, product

import numpy as np

from certify.analysis.fitting.grid import Grid
from certify.analysis.fitting.linear import Contradicted, Sampling
from certify.analysis.fitting.polynomial import Polynomial
from certify.loop.plants.samples import Point, Unknown

_ASKED = 200  # scattered samples


def require_possible(one: Unknown, grid: Grid, noise: Fraction) -> None:
    """Reject samples that bend more along axes than a function with these bounds, or that are not 0 at 0.

    For a < b < c the slope of g from b to c is that from a to b within M_jj (c - a)/2, by the mean value theorem. Over
    a rectangle along two axes the rise of g on one side differs from that on the opposite side by the integral of g_ij,
    at most M_ij times the area.

    Raises
    ------
    Contradicted : no function with these bounds has such samples.
    """
    at_0 = abs(grid.middles.get((Fraction(0),) * len(grid.axes), Fraction(0)))
    if at_0 > noise:
        raise Contradicted(f"{one.state} is {float(at_0):.6g} away from 0 at the origin")
    for j, axis in enumerate(grid.axes):
        for a, b, c in zip(axis, axis[1:], axis[2:], strict=False):
            left, right = b - a, c - b
            most = one.curvature[j][j] * (c - a) / 2 + 2 * noise * (1 / left + 1 / right)
            for z in product(*grid.axes[:j], (b,), *grid.axes[j + 1 :]):
                p, q, r = (grid.middles[*z[:j], v, *z[j + 1 :]] for v in (a, b, c))
                if abs((r - q) / right - (q - p) / left) > most:
                    raise Contradicted(f"{one.state} bends more along {one.variables[j]} around {_words(one, z)}")
    values = np.array([float(grid.middles[z]) for z in product(*grid.axes)]).reshape([len(axis) for axis in grid.axes])
    for i, j in combinations(range(len(grid.axes)), 2):
        for steps in product(_steps(grid.axes[i]), _steps(grid.axes[j])):
            low, high = _twisted_most(one, grid, values, dict(zip((i, j), steps, strict=True)))
            corners = low, high, _with(low, i, high[i]), _with(high, i, low[i])
            p, q, r, s = (grid.middles[z] for z in corners)
            if abs(p + q - r - s) > one.curvature[i][j] * (high[i] - low[i]) * (high[j] - low[j]) + 4 * noise:
                both, where = f"{one.variables[i]} and {one.variables[j]}", f"{_words(one, low)} to {_words(one, high)}"
                raise Contradicted(f"{one.state} bends more along {both} from {where}")


def require_consistent(sampling: Sampling, p: Polynomial) -> None:
    """Reject scattered samples of which one contradicts those around it; those farthest from the polynomial are asked.

    Raises
    ------
    Contradicted : no function with these bounds has such samples.
    """
    taken = sampling.taken
    off = [abs(y - p.at(z)) for z, y in zip(taken.points, taken.values, strict=True)]
    for k in sorted(range(len(off)), key=lambda k: off[k], reverse=True)[:_ASKED]:
        sampling.at(taken.points[k])


def _twisted_most(one: Unknown, grid: Grid, values: np.ndarray, steps: Mapping[int, int]) -> tuple[Point, Point]:
    """The lower and the upper corner of the rectangle along two axes, so many samples wide, that is twisted most beyond
    what is declared: found in floats."""
    twist, area = values, np.ones([1] * values.ndim)
    for k, step in steps.items():
        axis = np.array([float(v) for v in grid.axes[k]])
        low, high = np.arange(len(axis) - step), np.arange(step, len(axis))
        twist = twist.take(high, k) - twist.take(low, k)
        area = area * np.expand_dims(axis[high] - axis[low], [n for n in range(values.ndim) if n != k])
    i, j = steps
    at = np.unravel_index(np.argmax(np.abs(twist) - float(one.curvature[i][j]) * area), twist.shape)
    each = list(zip(grid.axes, at, strict=True))
    return tuple(axis[k] for axis, k in each), tuple(axis[k + steps.get(n, 0)] for n, (axis, k) in enumerate(each))


def _steps(axis: Point) -> list[int]:
    """Widths of rectangles in samples: each twice the last, up to the whole axis."""
    return sorted({min(2**k, len(axis) - 1) for k in range(len(axis).bit_length())})


def _with(z: Point, k: int, value: Fraction) -> Point:
    return (*z[:k], value, *z[k + 1 :])


def _words(one: Unknown, z: Point) -> str:
    return ", ".join(f"{v} = {float(w):g}" for v, w in zip(one.variables, z, strict=True))
