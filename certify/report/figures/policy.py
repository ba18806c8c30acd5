"""The policy over the domain."""

from __future__ import annotations

import numpy as np

from certify.report.figures.geometry import ellipse, shadows
from certify.report.figures.line import add_outer
from certify.report.figures.scene import Scene
from certify.report.figures.style import (
    GROWTH,
    INK,
    INNER,
    SET,
    SET_FILL,
    START,
    START_FILL,
    Picture,
    add_axes,
    figure_of,
    to_svg,
)


def curves(scene: Scene) -> Picture:
    """Every input over the one state."""
    x = np.linspace(scene.lo[0], scene.hi[0], 601)[:, None]
    figure, axes = figure_of(4.2, 3.6)
    u = scene.flow.policy(x)
    for k, name in enumerate(scene.input_labels):
        axes.plot(x[:, 0], u[:, k], color=(INK, SET, INNER, GROWTH)[k % 4], label=name)
    if scene.start_reach is not None:
        axes.axvspan(*scene.start_on_line, color=START_FILL, lw=0, zorder=-1)
    if scene.beyond is not None:
        add_outer(axes, scene, x)
    axes.axvspan(-scene.reach[0], scene.reach[0], color=SET_FILL, lw=0, zorder=0.6)
    axes.set_xlim(scene.lo[0], scene.hi[0])
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel(", ".join(scene.input_labels))
    what = "interval" if scene.start is None else "interval (blue) and the start of its tube"
    what = what if scene.beyond is None else "interval (blue) and the outer set"
    caption = f"u = π(x) over the domain; shaded: the {scene.word} {what}."
    return Picture("The policy", caption, to_svg(figure), simulated=False)


def surface(scene: Scene, pair: tuple[int, int]) -> Picture:
    """At most four inputs over a plane of two states, each around its equilibrium value."""
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    shown = min(scene.system.m, 4)
    rows = (shown + 1) // 2
    figure = Figure(figsize=(4.2 * min(shown, 2), 3.6 * rows))
    a, b, x = scene.plane(pair)
    u = scene.flow.policy(x)
    colours = LinearSegmentedColormap.from_list("input", ["#2f5d8a", "#a9c4dd", "#f7f6f2", "#e5c08a", "#a4652a"])
    boundary = ellipse(scene.P, pair, scene.outer)
    start, outline = _start(scene, pair), scene.outline(pair)
    for k, centre in enumerate([float(v) for v in scene.system.exact_u_eq()[:shown]]):
        left, bottom = 4.2 * (k % 2), 3.6 * (rows - 1 - k // 2)
        axes = add_axes(figure, left + 0.66, bottom + 0.52, 2.54, 2.96)
        spread = max(float(np.max(np.abs(u[..., k] - centre))), 1e-9)
        image = axes.imshow(
            u[..., k],
            origin="lower",
            extent=(a[0], a[-1], b[0], b[-1]),
            aspect="auto",
            interpolation="bilinear",
            cmap=colours,
            vmin=centre - spread,
            vmax=centre + spread,
        )
        axes.contour(a, b, u[..., k], levels=11, colors=INK, linewidths=0.35, alpha=0.7, linestyles="solid")
        axes.plot(*boundary, color=SET, lw=1.6)
        if start is not None:
            axes.plot(*start, color=START, lw=1.6)
        if outline is not None:
            axes.contour(*outline, levels=[0.0], colors=[START], linewidths=1.6)
        axes.set_xlim(a[0], a[-1])
        axes.set_ylim(b[0], b[-1])
        bar = figure.colorbar(image, cax=add_axes(figure, left + 3.3, bottom + 0.52, 0.1, 2.96))
        bar.outline.set_visible(False)
        bar.set_label(scene.input_labels[k])
        axes.set_xlabel(scene.labels[pair[0]])
        axes.set_ylabel(scene.labels[pair[1]])
    where = "over the domain" if scene.n == 2 else "around the set, all other states being 0,"
    edges = "boundary" if start is None else "boundaries of the start (magenta) and"
    edges = edges if outline is None else "boundaries of the outer set (magenta) and"
    more = "" if shown == scene.system.m else f" The first {shown} of {scene.system.m} inputs."
    return Picture(
        "The policy's surface",
        f"u = π(x) {where} with the {edges} of the {scene.word} set.{more}",
        to_svg(figure),
        simulated=False,
        wide=shown > 1,
    )


def _start(scene: Scene, pair: tuple[int, int]) -> tuple[np.ndarray, np.ndarray] | None:
    """The boundary of a tube's start in the plane; None without a tube, or if it is not around the origin."""
    if scene.start is None or (scene.centre is not None and scene.n > 2):
        return None
    if scene.centre is None:
        return ellipse(scene.start, pair, 1.0)
    (outline,) = shadows(scene.start[None], scene.centre[None], pair, 240)
    return outline[[*range(240), 0], 0], outline[[*range(240), 0], 1]
