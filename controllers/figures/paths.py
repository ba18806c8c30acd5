"""Trajectories in space: where the vehicle flies, for plants that move in a plane or in three directions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from certify.report.timing import TimingInWords
from controllers.comparison.table import Response
from controllers.figures.states import named, reach_of, short
from controllers.figures.style import COLOURS, DEEP, INK, MUTED, PALE, WIDTH, count, drawn
from controllers.options import get_plant

Array = NDArray[np.float64]
_SPACE = ("x", "y", "z")


_MOST = 30  # trajectories in a panel: more of them hide each other
_COLUMNS = 2


def draw_space(system: System, dt: float, responses: Sequence[Response]) -> bytes | None:
    """Thirty trajectories at most in space, under mean actions, one panel a method, all of the first seed, as PNG.

    None for a plant whose positions are not two or three coordinates x, y, z in space.
    """
    coordinates = [name for name in get_plant(system.name).positions if name in _SPACE]
    if len(coordinates) not in (2, 3):
        return None
    names, seed = [symbol.name for symbol in system.states], responses[0].seed
    axes = [names.index(name) for name in coordinates]
    chosen = {
        response.method: response.x[:, :_MOST]
        for response in responses
        if response.seed == seed and not response.method.sampled
    }
    reaches = [reach_of(system, k, chosen.values()) for k in axes]

    def build() -> Any:
        from matplotlib.figure import Figure

        rows = -(-len(chosen) // _COLUMNS)
        columns = min(_COLUMNS, len(chosen))
        figure = Figure(figsize=(WIDTH * columns / _COLUMNS, 0.9 + 3.5 * rows), layout="constrained")
        for number, (method, x) in enumerate(chosen.items(), 1):
            if len(axes) == 3:
                panel = figure.add_subplot(rows, columns, number, projection="3d")
                panel.view_init(elev=22, azim=-58)
                panel.set_box_aspect((1, 1, 0.9), zoom=0.9)
                panel.tick_params(pad=-1)
                for axis in (panel.xaxis, panel.yaxis, panel.zaxis):
                    axis.pane.set_facecolor("white")
                    axis.pane.set_edgecolor(PALE)
                panel.set_zlim(-reaches[2], reaches[2])
                panel.set_zlabel(named(system, axes[2]), labelpad=-2)
            else:
                panel = figure.add_subplot(rows, columns, number)
                panel.axhline(0, color=PALE, lw=0.7, zorder=0)
                panel.axvline(0, color=PALE, lw=0.7, zorder=0)
            panel.set_xlim(-reaches[0], reaches[0])
            panel.set_ylim(-reaches[1], reaches[1])
            panel.set_xlabel(named(system, axes[0]))
            panel.set_ylabel(named(system, axes[1]))
            panel.locator_params(nbins=5)
            leaving = _draw_paths(panel, x[..., axes], np.array(reaches), COLOURS[method.run])
            title = short(method).replace("\n", " ") + (f": {leaving} leave the frame" if leaving else "")
            panel.set_title(title, color=DEEP[method.run])
        number = next(iter(chosen.values())).shape[1]
        duration = f"{dt * (len(responses[0].x) - 1):g} {TimingInWords.of(system).unit}"
        what = f"{count(number, 'trajectory', 'trajectories')} of {duration} in space"
        figure.suptitle(
            f"{system.name}, seed {seed}: {what}, mean actions, held\n"
            "small dots: where they begin; large ones: where they end; cross: the equilibrium",
            x=0.01,
            ha="left",
        )
        return figure

    return drawn(build)


def _draw_paths(panel: Any, paths: Array, reaches: Array, colour: str) -> int:
    """Paths (T + 1, N, d) within the frame; how many leave it.

    A path is drawn up to where it leaves: three-dimensional axes do not cut what is beyond them.
    """
    inside = np.asarray((np.abs(paths) <= reaches).all(axis=2))  # not so for NaN
    leaving = 0
    for k in range(paths.shape[1]):
        ends = len(paths) if inside[:, k].all() else int((~inside[:, k]).argmax())
        leaving += ends < len(paths)
        path = paths[:ends, k]
        if not len(path):
            continue
        panel.plot(*path.T, color=colour, lw=0.8, alpha=0.6)
        panel.plot(*path[:1].T, color=MUTED, marker=".", ms=3, ls="")
        if ends == len(paths):
            panel.plot(*path[-1:].T, color=colour, marker="o", ms=4.5, mec="white", mew=0.4, ls="", zorder=5)
    panel.plot(*np.zeros((paths.shape[2], 1)), color=INK, marker="x", ms=7, mew=1.4, ls="", zorder=6)
    return leaving
