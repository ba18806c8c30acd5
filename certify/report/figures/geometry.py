"""Curves of quadratic level sets and of paths, as arrays of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.lyapunov import inverse
from certify.report.flow import Field

Array = NDArray[np.float64]
PARTS = 3
"""Pieces that each step of a path is drawn in."""


@dataclass(frozen=True, slots=True)
class Box:
    """A box of states by its corners."""

    lo: Array
    hi: Array


def circle(count: int) -> Array:
    """Unit vectors in all directions of the plane, shape (count, 2)."""
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def on_level(P: Array, directions: Array, level: float) -> Array:
    """Points with `x'Px = level`: `sqrt(level) L'^-1 d` for unit vectors d and `P = L L'`."""
    return np.asarray(np.sqrt(level) * np.linalg.solve(np.linalg.cholesky(P).T, directions.T).T)


def ellipse(P: Array, pair: tuple[int, int], level: float) -> tuple[Array, Array]:
    """The boundary of the section of `{V <= level}` with the plane of two states."""
    points = on_level(P[np.ix_(pair, pair)], circle(240), level)
    closed = np.concatenate([points, points[:1]])
    return closed[:, 0], closed[:, 1]


def shadow(P: Array, pair: tuple[int, int], level: float) -> tuple[Array, Array]:
    """The boundary of the projection of `{V <= level}` onto the plane of two states."""
    return ellipse(inverse(inverse(P)[np.ix_(pair, pair)]), (0, 1), level)


def shadows(P: Array, centre: Array, pair: tuple[int, int], count: int) -> list[Array]:
    """The outlines of the projections of {(x - c)'P(x - c) <= 1} onto the plane of two states, each (count, 2).

    For P (K, n, n) and centres (K, n).
    """
    around = circle(count)
    block = np.linalg.inv(P)[:, pair][:, :, pair]  # of each ellipsoid, whose outline is c + L d with L L' = block
    return [c + around @ L.T for c, L in zip(centre[:, pair], np.linalg.cholesky(block), strict=True)]


def over_level(P: Array, pair: tuple[int, int], directions: Array, level: float) -> Array:
    """States with `V = level` that lie over the outline of the projection, (N, n), for unit vectors (N, 2).

    Over a point y of the outline V is least at `x = P^-1_{:,pair} (P^-1_pair)^-1 y`, where it is the level.
    """
    covariance = inverse(P)
    block = covariance[np.ix_(pair, pair)]
    y = on_level(inverse(block), directions, level)
    return np.asarray(np.linalg.solve(block, y.T).T @ covariance[list(pair)])


def refine(path: Array, field: Field, step: float) -> Array:
    """Each step in `PARTS` pieces by cubic Hermite interpolation, so that curves look as smooth as they are."""
    with np.errstate(all="ignore"):
        slope = step * field(path)
    x0, x1, f0, f1 = path[:-1], path[1:], slope[:-1], slope[1:]
    fine = np.empty((PARTS * (len(path) - 1) + 1, *path.shape[1:]))
    fine[::PARTS] = path
    for k in range(1, PARTS):
        t = k / PARTS
        bend = t * (1 - t) ** 2 * f0 - t**2 * (1 - t) * f1
        fine[k::PARTS] = (1 + 2 * t) * (1 - t) ** 2 * x0 + t**2 * (3 - 2 * t) * x1 + bend
    return fine


def thin(path: Array, size: Array) -> Array:
    """Drop points that lie closer together than 1/250 of the picture's size (2,); the end is where NaN begins."""
    path = path[np.all(np.isfinite(path), axis=1)]
    if len(path) < 3:
        return path
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0) / size, axis=1))])
    _, first = np.unique(np.floor(travelled * 250), return_index=True)
    return np.asarray(path[np.unique(np.append(first, len(path) - 1))])
