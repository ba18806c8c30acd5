"""The inner set and its surroundings, for two states."""

from __future__ import annotations

import numpy as np

from certify.lyapunov import extents
from certify.report.figures.geometry import circle, ellipse, on_level, thin
from certify.report.figures.partition import add_leaves
from certify.report.figures.scene import Scene
from certify.report.figures.style import INK, INNER, INNER_FILL, SET, SIMULATED, Picture, figure_of, to_svg
from certify.report.figures.trajectories import runs_from
from certify.report.words import inner_level


def near_origin(scene: Scene) -> Picture:
    """Draw the inner set, the innermost leaves if there are any, and trajectories that enter."""
    from matplotlib.collections import LineCollection

    figure, axes = figure_of(4.2, 3.6)
    reach = 2.6 * scene.inner_reach
    if scene.taking_over is not None:
        reach = np.maximum(reach, 1.2 * extents(*scene.taking_over))
        axes.plot(*ellipse(scene.taking_over[0], (0, 1), scene.taking_over[1]), color=INNER, lw=1.6, ls="--", zorder=4)
    leaves = None if scene.local_is_enough else scene.leaves
    if leaves is not None:
        add_leaves(axes, scene, leaves, (0, 1), within=reach)
    begin = on_level(scene.P, circle(scene.detail.starts), min(9 * scene.inner, 0.999 * scene.outer))
    paths = runs_from(scene, begin, steps=60).path
    lines = [thin(paths[:, k], 2 * reach) for k in range(paths.shape[1])]
    axes.add_collection(LineCollection(lines, colors=SIMULATED, linewidths=0.8, zorder=3))
    axes.fill(*ellipse(scene.P, (0, 1), scene.inner), facecolor=INNER_FILL, edgecolor=INNER, lw=1.6, zorder=2)
    axes.plot(*ellipse(scene.P, (0, 1), scene.outer), color=SET, lw=1.6, zorder=4)
    axes.plot(0, 0, "o", ms=3, color=INK, zorder=5)
    axes.set_xlim(-reach[0], reach[0])
    axes.set_ylim(-reach[1], reach[1])
    axes.ticklabel_format(style="sci", scilimits=(-2, 3))
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel(scene.labels[1])
    around = "" if leaves is None else " Around it the innermost leaves (blue)."
    inner = f"{{V ≤ {inner_level(scene.kind, scene.inner, 3)}}}"
    keeps = "which trajectories enter and do not leave"
    if not scene.timing.is_plain:
        keeps = f"which every trajectory enters and in which it {scene.there}".replace(" is there at ", " is at ")
    after = "nothing is claimed about it" if scene.taking_over is None else "dashed: where the second claim begins"
    green = {
        "asymptotic": f"Green: the local set {inner}, {scene.word} at all radii at once.",
        "practical": f"Green: the inner set {inner}, {keeps}; the dot marks the origin; {after}.",
    }[scene.kind]
    return Picture(
        "Near the operating point" if any(scene.system.exact_x_eq()) else "Near the origin",
        f"{green}{around} Grey trajectories are simulated{scene.held}, not proved.",
        to_svg(figure),
        simulated=True,
    )
