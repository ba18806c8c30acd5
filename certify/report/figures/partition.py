"""The leaves of the partition tree, in the plane of the states or cut in the coordinates z."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.report.figures.geometry import ellipse
from certify.report.figures.scene import Leaves, Scene
from certify.report.figures.style import LEAF_EDGE, PAPER, RASTER_FROM, SET, SET_FILL, Picture, figure_of, to_svg
from certify.report.words import symbol

Array = NDArray[np.float64]


def partition(scene: Scene, leaves: Leaves) -> Picture:
    """The leaves, those in the ring in blue."""
    figure, axes = figure_of(4.2, 3.6)
    pair = (0, scene.n - 1)
    reach = add_leaves(axes, scene, leaves, pair, within=None)
    if scene.n == 2:
        axes.plot(*ellipse(scene.P, pair, scene.outer), color=SET, lw=1.6, zorder=4)
        labels, where = scene.labels, "in the plane of the states"
    else:
        labels = [symbol(f"z{k + 1}") for k in pair]
        where = "cut by a plane through the origin of the coordinates x = T z"
    axes.set_xlim(-1.04 * reach[0], 1.04 * reach[0])
    axes.set_ylim(-1.04 * reach[1], 1.04 * reach[1])
    axes.set_xlabel(labels[0])
    axes.set_ylabel(labels[1])
    shown = "showed" if scene.word == "proved" else "has to show"
    always = " for all values in the ranges" if scene.system.ranges else ""
    asked = (
        f"On each blue one the checker {shown} {scene.timing.decrease} < 0{always}; the others lie outside the ring "
        "between the two levels."
    )
    return Picture(
        "The leaf partition",
        f"The {_count(len(leaves[0]))} of the certificate, {where}. {asked}",
        to_svg(figure),
        simulated=False,
    )


def add_leaves(axes: Any, scene: Scene, leaves: Leaves, pair: tuple[int, int], within: Array | None) -> Array:
    """Add the leaves (n = 2: as parallelograms in x; else a cut in z); how far those in the ring reach, (2,)."""
    from matplotlib.collections import PolyCollection

    i, j = pair
    others = [k for k in range(scene.n) if k not in pair]
    keep = np.all((leaves[0][:, others] <= 0) & (leaves[1][:, others] > 0), axis=1)
    lower, upper = leaves[0][keep], leaves[1][keep]
    corners = np.stack(
        [np.stack([(lower, upper)[p][:, i], (lower, upper)[q][:, j]], -1) for p, q in ((0, 0), (1, 0), (1, 1), (0, 1))],
        axis=1,
    )
    if scene.n == 2:
        corners = corners @ scene.T.T
    ring = _in_ring(scene, lower, upper)
    if within is not None:
        visible = np.all((corners.min(axis=1) <= within) & (corners.max(axis=1) >= -within), axis=1)
        corners, ring = corners[visible], ring[visible]
    many = len(corners) > RASTER_FROM
    for kind, face in ((~ring, PAPER), (ring, SET_FILL)):
        if np.any(kind):
            width = 0.15 if many else 0.45
            boxes = PolyCollection(list(corners[kind]), facecolors=face, edgecolors=LEAF_EDGE, linewidths=width)
            boxes.set_zorder(1)
            boxes.set_rasterized(many)
            axes.add_collection(boxes)
    telling = corners[ring] if np.any(ring) else corners
    return np.asarray(np.max(np.abs(telling), axis=(0, 1), initial=0.0))


def _in_ring(scene: Scene, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """True for each leaf that meets `c1 <= V <= c2`, by the diagonal of `T'PT`: for colour only."""
    T = scene.T
    weight = np.diag(T.T @ scene.P @ T)
    near, far = np.clip(0.0, lower, upper), np.maximum(np.abs(lower), np.abs(upper))
    return np.asarray((near**2 @ weight <= scene.outer) & (far**2 @ weight >= scene.certificate.inner))


def _count(leaves: int) -> str:
    return f"{leaves:,} leaves" if leaves != 1 else "one leaf"
