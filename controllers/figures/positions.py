"""Positions over time as a page shows them: a column for each kind of run, mean actions above, sampled ones below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from certify.report.timing import TimingInWords
from controllers.comparison.methods import Method, Run
from controllers.comparison.table import Response
from controllers.figures.states import MOST, draw_state, reach_of, short
from controllers.figures.style import MUTED, WIDTH, count, drawn
from controllers.options import get_plant

Array = NDArray[np.float64]


def draw_positions(system: System, dt: float, responses: Sequence[Response]) -> bytes:
    """Fifty trajectories at most of the plant's positions, all of the first seed, as PNG.

    Ours acts by its mean only, so its column has no sampled actions.
    """

    def build() -> Any:
        from matplotlib.figure import Figure

        seed = responses[0].seed
        chosen = {response.method: response.x[:, :MOST] for response in responses if response.seed == seed}
        runs = list(dict.fromkeys(method.run for method in chosen))
        names, positions = [symbol.name for symbol in system.states], get_plant(system.name).positions
        lines = [(k, sampled) for sampled in _kinds(chosen) for k in map(names.index, positions)]
        time: Array = dt * np.arange(len(responses[0].x), dtype=np.float64)
        height = 1.5 if len(lines) <= 4 else 1.2
        figure = Figure(figsize=(WIDTH, 0.9 + height * len(lines)), layout="constrained")
        panels = figure.subplots(len(lines), len(runs), sharex=True, sharey="row", squeeze=False)
        for (k, sampled), line in zip(lines, panels, strict=True):
            reach = reach_of(system, k, chosen.values())
            for panel, run in zip(line, runs, strict=True):
                _fill(panel, system, k, time, chosen, run, sampled, reach)
            line[0].set_ylim(-reach, reach)
            unit = system.units.get(names[k], "")
            line[0].set_ylabel(f"{names[k]} ({unit})" if unit else names[k])
            line[-1].annotate(
                "stochastic" if sampled else "mean",
                (1.02, 0.5),
                xycoords="axes fraction",
                rotation=-90,
                va="center",
                color=MUTED,
                fontsize=8.5,
            )
        for panel, run in zip(panels[0], runs, strict=True):
            panel.set_title(short(Method(run, False)))
        for panel in panels[-1]:
            panel.set_xlabel(TimingInWords.of(system).axis)
        panels[0, 0].set_xlim(0, time[-1])
        number = next(iter(chosen.values())).shape[1]
        figure.suptitle(
            f"{system.name}, seed {seed}: positions, {count(number, 'trajectory', 'trajectories')}, held inputs",
            x=0.01,
            ha="left",
        )
        return figure

    return drawn(build)


def _kinds(chosen: dict[Method, Array]) -> list[bool]:
    return sorted({method.sampled for method in chosen})


def _fill(
    panel: Any, system: System, k: int, time: Array, chosen: dict[Method, Array], run: Run, sampled: bool, reach: float
) -> None:
    method = Method(run, sampled)
    if method in chosen:
        draw_state([panel], system, k, time, {method: chosen[method]}, reach)
        panel.set_ylabel("")
        return
    panel.text(0.5, 0.5, "acts by\nits mean", transform=panel.transAxes, ha="center", va="center", color=MUTED)
    panel.tick_params(length=0)
