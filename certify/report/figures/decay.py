"""V along trajectories."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.report.figures.scene import Scene
from certify.report.figures.style import INNER, SET, SIMULATED, START, Picture, figure_of, plain_powers, to_svg
from certify.report.sampling import quadratic


def decay(scene: Scene, paths: NDArray[np.float64], step: float) -> Picture:
    """V over time along paths (T + 1, N, n) with `step` seconds between states, on a logarithmic axis."""
    V = quadratic(scene.P, paths)
    time = step * np.arange(len(V))
    figure, axes = figure_of(4.2, 3.6)
    if scene.timing.is_plain:
        axes.semilogy(time, np.maximum(V, 1e-300), color=SIMULATED, lw=0.8)
    else:  # the claim is about V at the dots
        apart = scene.flow.steps_between(step)
        axes.semilogy(time, np.maximum(V, 1e-300), color=SIMULATED, lw=0.5, ls=":" if scene.timing.discrete else "-")
        axes.semilogy(time[::apart], np.maximum(V[::apart], 1e-300), ".", ms=2.5, color=SIMULATED, rasterized=True)
    axes.axhline(scene.outer, color=SET, lw=1.4)
    if scene.inner < scene.outer:
        axes.axhline(scene.inner, color=INNER, lw=1.4)
    apart = scene.inner < 0.5 * scene.outer
    for level, name, colour in ((scene.outer, "c₂", SET), (scene.inner, scene.words.inner, INNER))[: 1 + apart]:
        axes.annotate(name, (time[-1], level), (2, 2), textcoords="offset points", color=colour, fontsize=9)
    highest = scene.outer
    if scene.start is not None or scene.beyond is not None:
        highest = max(highest, float(np.nanmax(V)))
    if scene.start is not None:
        axes.axvline(scene.duration, color=START, lw=1.4, ls="--")
        axes.annotate(
            "end of the tube",
            (scene.duration, 1),
            (3, -10),
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            color=START,
            fontsize=8,
        )
    lowest = float(np.nanmin(V[-1])) if np.any(np.isfinite(V[-1])) else scene.inner
    axes.set_ylim(max(min(lowest, scene.inner / 10), 1e-14 * scene.outer), highest * 4)
    axes.set_xlim(0, time[-1])
    plain_powers(axes)
    axes.set_xlabel(scene.timing.axis)
    axes.set_ylabel("V(x(t))")
    begin = f"on and in the {scene.word} set" if scene.start is None else "on the boundary of the tube's start"
    begin += "" if scene.centre is None else " around c₀"
    begin = begin if scene.beyond is None else "at the boundary of the outer set, in planes through the origin"
    return Picture(
        "V along trajectories",
        f"V from starting points {begin}: simulated{scene.held}, not proved{_dots(scene)}. "
        + scene.words.decay.format(word=scene.word),
        to_svg(figure),
        simulated=True,
    )


def _dots(scene: Scene) -> str:
    """Explain the dots on the lines; empty if there are none."""
    if scene.timing.is_plain:
        return ""
    return "; a dot for each step" if scene.timing.discrete else "; the dots are at sampling instants"
