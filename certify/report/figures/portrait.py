"""The phase portrait of a plane of two states: level sets, trajectories, the sign of Vdot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.report.figures.geometry import ellipse, shadow, thin
from certify.report.figures.scene import Scene, settled
from certify.report.figures.style import (
    GROWTH,
    GROWTH_FILL,
    INK,
    INNER,
    INNER_FILL,
    LEAVING,
    SET,
    SET_FILL,
    SIMULATED,
    Picture,
    figure_of,
    legend_beside,
    line,
    to_svg,
)
from certify.report.sampling import SimulatedRoa
from certify.report.words import below, inner_level, symbol

Array = NDArray[np.float64]


def portrait(scene: Scene, pair: tuple[int, int], paths: Array, roa: SimulatedRoa | None, *, single: bool) -> Picture:
    """The plane with everything in it; `single` makes it as wide as the page."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Patch, Rectangle

    i, j = pair
    figure, axes = figure_of(7.6, 4.9, right=1.95) if single else figure_of(4.2, 4.4, bottom=1.35)
    small = 0.8 if single else 0.6
    a, b, x = scene.plane(i, j)
    vdot = scene.vdot(x)
    handles: list[Any] = []
    sign = ""
    boundary = ellipse(scene.P, pair, scene.outer)
    axes.fill(*boundary, color=SET_FILL, lw=0, zorder=1)
    growing = (vdot >= 0) & np.any(x != 0, axis=-1)
    if np.any(growing) and not np.all(growing):
        axes.contourf(a, b, vdot, levels=[0, np.inf], colors=[GROWTH_FILL], zorder=0)
        axes.contour(a, b, vdot, levels=[0.0], colors=[GROWTH], linewidths=1.0, zorder=3)
        handles.append(Patch(facecolor=GROWTH_FILL, edgecolor=GROWTH, lw=1.0, label="V̇ ≥ 0 on a grid*"))
    elif not np.any(growing):
        sign = " V̇ < 0 at every grid point, so that no line V̇ = 0 appears.*"
    calm = settled(scene, paths)
    for keep, colour, text in (
        (calm, SIMULATED, f"{scene.words.runs}*"),
        (~calm, LEAVING, "other trajectories*"),
    ):
        lines = [thin(paths[:, k][:, [i, j]], scene, pair) for k in np.flatnonzero(keep)]
        lines = [path for path in lines if len(path) > 1]
        if lines:
            axes.add_collection(LineCollection(lines, colors=colour, linewidths=small, zorder=2))
            _arrows(axes, lines, colour, scene, pair)
            handles.append(line(colour, small, text))
    if roa is not None and np.any(roa.attracted) and not np.all(roa.attracted):
        attracted = roa.attracted.T.astype(np.float64)
        axes.contour(*roa.axes, attracted, levels=[0.5], colors=[LEAVING], linewidths=1.2, linestyles="--", zorder=3)
        handles.append(line(LEAVING, 1.2, "simulated region*", "--"))
    axes.plot(*boundary, color=SET, lw=1.8, zorder=4)
    handles.insert(0, line(SET, 1.8, f"{scene.word} set, V = {below(scene.outer, 4)}"))
    if scene.n > 2:
        axes.plot(*shadow(scene.P, pair, scene.outer), color=SET, lw=1.0, ls=":", zorder=4)
        handles.insert(1, line(SET, 1.0, "its projection", ":"))
    inner = ellipse(scene.P, pair, scene.inner)
    axes.fill(*inner, color=INNER_FILL, lw=0, zorder=1.5)
    axes.plot(*inner, color=INNER, lw=1.4, zorder=3.5)
    handles.insert(1, line(INNER, 1.4, f"{scene.words.inner_set}, V = {inner_level(scene.kind, scene.inner, 3)}"))
    width, height = scene.hi[i] - scene.lo[i], scene.hi[j] - scene.lo[j]
    box = Rectangle((scene.lo[i], scene.lo[j]), width, height, fill=False, ec=INK, lw=1.0, zorder=4)
    axes.add_patch(box)
    handles.append(line(INK, 1.0, "domain"))
    axes.set_xlim(scene.lo[i] - 0.03 * width, scene.hi[i] + 0.03 * width)
    axes.set_ylim(scene.lo[j] - 0.03 * height, scene.hi[j] + 0.03 * height)
    axes.set_xlabel(scene.labels[i])
    axes.set_ylabel(scene.labels[j])
    axes.spines[["left", "bottom"]].set_visible(False)  # the domain's box is frame enough
    if single:
        legend_beside(axes, handles)
    else:
        axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)
    what = (
        f"Section through the origin, all states but {scene.labels[i]} and {scene.labels[j]} being 0; trajectories are "
        "projected onto it. "
    )
    return Picture(
        "Phase portrait" if scene.n == 2 else f"Section {_title(scene, pair)}",
        f"{what if scene.n > 2 else ''}Blue: the {scene.word} set, {scene.meaning}. "
        f"*\N{NO-BREAK SPACE}Simulated or evaluated on a grid, not proved.{sign}",
        to_svg(figure),
        simulated=True,
        wide=single,
    )


def _arrows(axes: Any, lines: Sequence[Array], colour: str, scene: Scene, pair: tuple[int, int]) -> None:
    """An arrow head a quarter of the way along each line."""
    scale = np.array([scene.hi[k] - scene.lo[k] for k in pair])
    heads, directions = [], []
    for path in lines:
        k = max(1, len(path) // 4)
        d = (path[k] - path[k - 1]) / scale
        if np.any(d != 0):
            heads.append(path[k])
            directions.append(d / np.linalg.norm(d))
    if heads:
        (x, y), (dx, dy) = np.array(heads).T, np.array(directions).T
        axes.quiver(  # directions are shares of the axes, which are wider than high
            x,
            y,
            dx,
            0.8 * dy,
            angles="uv",
            color=colour,
            pivot="mid",
            scale=42,
            width=0.0035,
            headwidth=4.5,
            headlength=5.5,
            headaxislength=5.0,
            minlength=0,
            zorder=3,
        )


def _title(scene: Scene, pair: tuple[int, int]) -> str:
    return ", ".join(symbol(scene.system.states[k].name) for k in pair)
