"""Vdot, or V's change over a step, along the one state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.lyapunov import extents
from certify.report.figures.scene import Scene
from certify.report.figures.style import (
    GROWTH_FILL,
    INK,
    INNER,
    INNER_FILL,
    MUTED,
    RASTER_FROM,
    REGION,
    SET,
    SET_FILL,
    START_FILL,
    Key,
    Picture,
    figure_of,
    to_svg,
)
from certify.report.sampling import SimulatedRoa


def line_figure(scene: Scene, roa: SimulatedRoa | None) -> Picture:
    """V's change over the domain, the two intervals, and where runs settle."""
    figure, axes = figure_of(5.0, 3.4)
    legend = draw_line(axes, scene, roa)
    wider = "" if scene.start is None else ", and around it the start of the tube that leads into it"
    if scene.beyond is not None:
        wider = ", and the outer set {N ≤ n₂} in the domain, from which every trajectory enters it"
        wider += (", if the claim is true" if scene.word == "claimed" else "") + ", drawn from a grid"
    if scene.centre is not None:
        wider = ", and the start of the tube that leads into it; nothing is claimed about states between them"
    return Picture(
        f"{scene.falling} along the state",
        f"Shaded: the {scene.word} interval, {scene.meaning}{wider}. The curve of {scene.falling} and the "
        f"interval of the runs that "
        f"{scene.words.settles} come from floating point and simulation{scene.held}; they are not proved. "
        f"{scene.timing.simulated.definition}".rstrip(),
        to_svg(figure),
        simulated=True,
        wide=True,
        legend=legend,
    )


def add_outer(axes: Any, scene: Scene, x: NDArray[np.float64]) -> None:
    """Shade the states (N, 1) of a grid that lie in the outer set."""
    axes.fill_between(
        x[:, 0], 0, 1, where=scene.in_outer(x), color=START_FILL, lw=0, transform=axes.get_xaxis_transform(), zorder=0.5
    )


def draw_line(axes: Any, scene: Scene, roa: SimulatedRoa | None) -> tuple[Key, ...]:
    """Fill the axes; their legend."""
    x = np.linspace(scene.lo[0], scene.hi[0], 601)[:, None]
    outer, inner = scene.reach[0], scene.inner_reach[0]
    change, symbol = scene.growth(x), scene.falling
    keys = [
        Key(f"{scene.word} set", SET_FILL, 0, fill=SET_FILL),
        Key(scene.words.inner_set, INNER_FILL, 0, fill=INNER_FILL),
        Key(f"{symbol} (float64, not proved)", INK),
        Key(f"{symbol} ≥ 0 (not proved)", GROWTH_FILL, 0, fill=GROWTH_FILL),
    ]
    axes.axhline(0, color=MUTED, lw=0.7)
    if scene.start_reach is not None:
        keys.insert(0, Key(f"{scene.word} {scene.words.start}", START_FILL, 0, fill=START_FILL))
        axes.axvspan(*scene.start_on_line, color=START_FILL, lw=0)
    if scene.beyond is not None:
        keys.insert(0, Key(f"{scene.word} outer set", START_FILL, 0, fill=START_FILL))
        add_outer(axes, scene, x)
    axes.axvspan(-outer, outer, color=SET_FILL, lw=0)
    axes.axvspan(-inner, inner, color=INNER_FILL, lw=0)
    if scene.taking_over is not None:
        keys.append(Key("the second claim's set", INNER, 1.4, "--"))
        for end in extents(*scene.taking_over)[0] * np.array([-1.0, 1.0]):
            axes.axvline(float(end), color=INNER, lw=1.4, ls="--")
    axes.plot(x[:, 0], change, color=INK)
    axes.fill_between(x[:, 0], 0, change, where=change >= 0, color=GROWTH_FILL, lw=0)
    if roa is not None:
        inside = roa.axes[0][roa.attracted]
        if inside.size:
            ends = [float(inside.min()), float(inside.max())]
            axes.plot(ends, [0, 0], color=REGION, lw=2.4)
            keys.append(Key("simulated region (not proved)", REGION, 2.4))
    if scene.leaves is not None and len(scene.leaves[0]) <= RASTER_FROM:
        edges = scene.leaves[0][:, 0] * scene.T[0, 0]
        axes.plot(edges, np.zeros_like(edges), "|", ms=5, color=SET)
        keys.append(Key("leaves", SET, 1.0))
    axes.set_xlim(scene.lo[0], scene.hi[0])
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel(symbol)
    return tuple(keys)
