"""A grid over the box of an unknown function, with an interval at each point that holds the function there.

Samples on a grid are such a grid themselves. Among scattered ones it is chosen: an axis is halved between two values
where second derivatives add much, or where the intervals at one are much wider than at the other, for the error on a
cell is that of its worst corner. Cells near the origin may count more: there an error moves a plant most.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from itertools import pairwise, product
from math import floor, log10, prod

import numpy as np
from numpy.typing import NDArray

from certify.analysis.fitting.linear import Bounds, Sampling
from certify.loop.plants.samples import Box, Point, Sampled, Unknown

_FEW, _MOST = 1000, 2000  # points of a grid that is chosen; in between as many as there are samples
_SHARE = 0.5  # of the error between two values that second derivatives and differences of half widths may make
_NEAR = 0.05  # distance to the origin, in half widths of the box, below which all is as near
Interval = tuple[Fraction, Fraction]


@dataclass(frozen=True)
class Grid:
    """Intervals of g at the points of a grid.

    Parameters
    ----------
    axes : the values of each variable, ascending, from end to end of the box.
    bounds : an interval of g at each point, the last axis fastest, with the weights that show it.
    """

    axes: tuple[Point, ...]
    bounds: Mapping[Point, Bounds]

    @cached_property
    def middles(self) -> dict[Point, Fraction]:
        """The middle of each interval."""
        return {p: (each.lo + each.hi) / 2 for p, each in self.bounds.items()}


def axes_of(taken: Sampled) -> tuple[Point, ...] | None:
    """The axes of samples that are a grid, one at each of its points; None of others."""
    axes = tuple(tuple(sorted(set(column))) for column in zip(*taken.points, strict=True))
    whole = prod(map(len, axes)) == len(taken.points) == len(set(taken.points)) and min(map(len, axes)) > 1
    return axes if whole else None


def enclosed(sampling: Sampling, near_origin: float = 0.0) -> Grid:
    """A grid over the box: that of the samples, or one that is chosen, with weights of `nearness` to this power.

    Raises
    ------
    InputError : the samples do not span the variables.
    Contradicted : no function with the bounds has these samples.
    """
    one, taken, noise = sampling.one, sampling.taken, sampling.noise
    axes = axes_of(taken)
    if axes is not None and _reach(axes) == one.box:
        one_of = {z: ((k, Fraction(1)),) for k, z in enumerate(taken.points)}
        value = dict(zip(taken.points, taken.values, strict=True))
        return Grid(axes, {z: Bounds(value[z] - noise, value[z] + noise, one_of[z], one_of[z]) for z in product(*axes)})
    found = dict[Point, Bounds]()
    most = min(max(_FEW, len(taken.values)), _MOST)
    sides = zip(one.box, one.curvature, strict=True)
    with_0 = tuple((lo, Fraction(0), hi) if lo < 0 < hi and any(row) else (lo, hi) for (lo, hi), row in sides)
    finer: tuple[Point, ...] | None = with_0 if near_origin and prod(map(len, with_0)) <= most else one.box
    while finer is not None:
        axes = finer
        for p in product(*axes):
            if p not in found:
                found[p] = _outwards(sampling.at(p))
        finer = _finer(one, axes, found, most, near_origin)
    return Grid(axes or (), {p: found[p] for p in product(*(axes or ()))})


def _reach(axes: tuple[Point, ...]) -> Box:
    return tuple((axis[0], axis[-1]) for axis in axes)


def nearness(one: Unknown, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The weight of each of the points (N, d): one by its distance to the origin, in half widths of the box along the
    variables in which the function is bent."""
    bent = [any(row) for row in one.curvature]
    half = [max(abs(float(lo)), abs(float(hi))) for lo, hi in one.box]
    found: NDArray[np.float64] = 1 / np.maximum(np.linalg.norm((points / half)[:, bent], axis=1), _NEAR)
    return found


def _outwards(found: Bounds) -> Bounds:
    """The interval with shorter ends, wider by a millionth at most."""
    width = found.hi - found.lo
    if not width:
        return found
    unit = Fraction(10) ** (floor(log10(width)) - 6)
    return found._replace(lo=found.lo // unit * unit, hi=-(-found.hi // unit) * unit)


def _finer(
    one: Unknown, axes: tuple[Point, ...], found: Mapping[Point, Bounds], most: int, near_origin: float
) -> tuple[Point, ...] | None:
    """The axes with the middles of all pairs of values between which the error changes too much, those first that do
    most, as long as the grid has `most` points; None if nothing changes."""
    half = np.array([float(found[p].hi - found[p].lo) / 2 for p in product(*axes)]).reshape([len(a) for a in axes])
    bent = list[tuple[float, int, Fraction]]()
    for j, axis in enumerate(axes):
        if not any(one.curvature[j]):
            continue
        for i, (lo, hi) in enumerate(pairwise(axis)):
            a, b, bend = half.take(i, axis=j), half.take(i + 1, axis=j), float(one.curvature[j][j] * (hi - lo) ** 2) / 8
            error = np.maximum(a, b) + bend
            share = np.divide(np.abs(a - b) + bend, error, out=np.zeros_like(error), where=error > 0)
            middles = np.array(list(product(*axes[:j], [(lo + hi) / 2], *axes[j + 1 :])), dtype=float)
            mean = float(np.average(share.ravel(), weights=nearness(one, middles) ** near_origin))
            if mean > _SHARE:
                bent.append((mean, j, (lo + hi) / 2))
    more = [list(axis) for axis in axes]
    for _, j, middle in sorted(bent, key=lambda each: each[0], reverse=True):
        if prod(len(axis) + (k == j) for k, axis in enumerate(more)) <= most:
            more[j].append(middle)
    finer = tuple(tuple(sorted(axis)) for axis in more)
    return None if finer == axes else finer
