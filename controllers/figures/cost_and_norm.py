"""A quantity over time, of all methods: mean actions above, sampled ones below."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from certify.report.timing import TimingInWords
from controllers.comparison.methods import NAMES, OURS
from controllers.comparison.table import Response, Row, quartiles
from controllers.figures.style import COLOURS, DEEP, WIDTH, count, drawn, log_scale, name_lines, seeds_of

Array = NDArray[np.float64]
_NORM = "‖x‖ (units of the states)"


_COST = {"continuous": "∫ x'Qx + ũ'Rũ dt,  ũ = u − u_eq", "discrete": "Σ x'Qx + ũ'Rũ,  ũ = u − u_eq"}
_SMALLEST = 1e-16  # norms are drawn from here on: a logarithmic axis has no 0


def draw_over_time(
    what: Literal["cost", "norm"], system: System, dt: float, responses: Sequence[Response], rows: Sequence[Row]
) -> bytes:
    """Median and quartiles over seeds and states against time: mean actions, and below them sampled ones, as PNG."""

    def build() -> Any:
        from matplotlib.figure import Figure

        methods = list(dict.fromkeys(response.method for response in responses))
        kinds = sorted({method.sampled for method in methods})
        figure = Figure(figsize=(WIDTH, 1.0 + 2.7 * len(kinds)), layout="constrained")
        panels = figure.subplots(len(kinds), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
        ends = []
        for panel, sampled in zip(panels, kinds, strict=True):
            shown = [method for method in methods if method == OURS or method.sampled == sampled]
            named = []
            for method in shown:
                own = [response for response in responses if response.method == method]
                row = next(row for row in rows if row.seed is None and row.method == method.name)
                named.append(_draw_band(panel, what, dt, own, row))
            ends.append(named)
            panel.set_title("stochastic actions (ours: its mean)" if sampled else "mean actions")
            panel.set_ylabel(_NORM if what == "norm" else _COST[system.time])
            panel.grid(axis="y")
        panels[-1].set_xlim(0, dt * (len(responses[0].x) - 1))
        panels[-1].set_xlabel(TimingInWords.of(system).axis)
        for panel in panels:
            log_scale(panel)
        for panel, named in zip(panels, ends, strict=True):
            name_lines(panel, named)
        seeds = sorted({response.seed for response in responses})
        title = "accumulated cost" if what == "cost" else "distance from the equilibrium"
        told = f"{system.name}, {seeds_of(seeds)}: {title}\nmedian and quartiles of "
        discrete = system.time == "discrete"
        held = "step by step" if discrete else f"inputs held {dt:g} s"
        told += f"{count(len(seeds), 'seed')} × {count(responses[0].x.shape[1], 'initial state')}, {held}"
        if what == "norm":
            told += f"\ndotted: floor, the median of the largest in the last {'steps' if discrete else 'second'}"
        figure.suptitle(told, x=0.01, ha="left")
        return figure

    return drawn(build)


def _draw_band(
    panel: Any, what: Literal["cost", "norm"], dt: float, responses: Sequence[Response], row: Row
) -> tuple[float, str, str]:
    """One method: its median as a line, its quartiles as a band, its floor dotted; the line's end, name and colour."""
    run = responses[0].method.run
    values = np.concatenate([getattr(response, what) for response in responses], axis=1)
    lower, median, upper = np.maximum(quartiles(values), _SMALLEST)
    first = 1 if what == "cost" else 0  # no cost at time 0, and no 0 on a logarithmic axis
    time = dt * np.arange(len(median))[first:]
    seen = _drawable(median)[first:]
    panel.plot(time, seen, color=COLOURS[run])
    panel.fill_between(
        time, _drawable(lower)[first:], _drawable(upper, median)[first:], color=COLOURS[run], alpha=0.13, lw=0
    )
    said, at = row.cost_median, float(seen[-1])
    if what == "norm":
        said = row.floor
        if np.isfinite(row.floor):
            at = max(row.floor, _SMALLEST)
            panel.axhline(at, color=COLOURS[run], lw=0.9, ls=":")
    name = f"{NAMES[run]}\n{'floor' if what == 'norm' else 'median'} {_number(said)}"
    if row.diverged:
        name += f"\n{row.diverged} of {row.trajectories} diverge"
    return at, name, DEEP[run]


def _number(value: float) -> str:
    return f"{value:.2g}" if np.isfinite(value) else "infinite"


def _drawable(values: Array, otherwise: Array | None = None) -> Array:
    """Infinity is not drawn; an infinite edge of a band is drawn far above its finite median."""
    far = np.nan if otherwise is None else np.where(np.isfinite(otherwise), 1e3 * otherwise, np.nan)
    return np.where(np.isfinite(values), values, far)
