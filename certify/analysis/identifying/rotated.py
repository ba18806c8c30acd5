"""Axes along which measurements bound parameters closely, where they bound sums of them and none alone.

What is left of the parameters is a polytope; here is a small parallelotope around it, found in floats. Whatever its
axes are, what is claimed of them is shown by multipliers.
"""

from __future__ import annotations

import math
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from certify.analysis.identifying.determined import polytope_of
from certify.loop.plants import Axis
from certify.loop.plants.axes import axes_of
from certify.provers.data import Identified

_POINTS, _STARTS, _TURNS = 40, 3, 4  # extreme points for each parameter; searches, and repetitions of one
_MARGIN = 1.0 + 1e-4  # of half-widths, beyond what linear programs say
_SMALLER = 1.1  # least factor by which the parallelotope is smaller than the box, for axes
Array = NDArray[np.float64]


def axes_for(found: Identified) -> tuple[tuple[Axis, ...], float]:
    """Axes, each in [-1, 1] for the parameters that are left, and by what factor their box is smaller than that of the
    parameters' ranges; no axes and 1 where that is hardly any."""
    left = polytope_of(found)
    points = left.extreme(_POINTS * len(left.names))
    if points is None or len(left.names) < 2:
        return (), 1.0
    W = _normals(points)
    ends = [(left.least(w), left.least(-w)) for w in W]
    if any(lo is None or hi is None for lo, hi in ends):
        return (), 1.0
    lo, hi = np.array([[lo, -hi] for lo, hi in ends]).T  # type: ignore[operator]
    half, inverse = (hi - lo) / 2 * _MARGIN, np.linalg.inv(W)
    smaller = float(np.abs(np.linalg.det(W)) / np.prod(half))
    if not smaller > _SMALLER:
        return (), 1.0
    middle = np.array([float(a + b) / 2 for a, b in found.ranges.values()])
    reach = np.array([float(b - a) / 2 for a, b in found.ranges.values()])
    centre, T = middle + reach * (inverse @ (lo + hi)) / 2, reach[:, None] * inverse * half
    return axes_of([_short(row) for row in np.column_stack([centre, T])]), smaller


def _short(row: Array) -> tuple[Fraction, ...]:
    """The value in the middle and the slopes of a parameter, to twelve digits of its largest slope."""
    unit = Fraction(10) ** (math.floor(math.log10(np.abs(row[1:]).max())) - 11)
    return tuple(round(Fraction(v) / unit) * unit for v in row.tolist())


def _normals(points: Array) -> Array:
    """Normals (K, K), of length 1, of the parallelotope of the least volume around points (N, K) that is found."""
    K = points.shape[1]

    def volume(flat: Array) -> float:
        W = _unit(flat.reshape(K, K))
        return float(np.log(np.ptp(points @ W.T, axis=0)).sum() - np.log(np.abs(np.linalg.det(W)) + 1e-300))

    size, turn = np.linalg.eigh(np.cov(points.T))
    starts = [np.eye(K), turn.T, np.linalg.inv(turn * np.sqrt(np.maximum(size, 1e-16)))]
    found = [one.ravel() for one in starts]
    for start in found[:_STARTS]:
        best = start
        for _ in range(_TURNS):
            best = minimize(volume, best, method="Powell", options={"maxiter": 40}).x
        found.append(best)
    return _unit(min(found, key=volume).reshape(K, K))


def _unit(W: Array) -> Array:
    rows: Array = W / np.linalg.norm(W, axis=1, keepdims=True)
    return rows
