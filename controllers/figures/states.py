"""Trajectories of every state, a column for each method: the whole simulation, wider than a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from certify.report.timing import TimingInWords
from controllers.comparison.methods import NAMES, Method
from controllers.comparison.table import Response
from controllers.figures.style import COLOURS, MUTED, count, drawn
from controllers.options import get_plant

Array = NDArray[np.float64]

MOST = 50  # trajectories in a panel


def draw_states(system: System, dt: float, responses: Sequence[Response]) -> bytes:
    """Fifty trajectories at most of every state, positions first; a column for each method, all of the first seed."""

    def build() -> Any:
        from matplotlib.figure import Figure

        names, seed = [symbol.name for symbol in system.states], responses[0].seed
        chosen = {response.method: response.x[:, :MOST] for response in responses if response.seed == seed}
        positions = get_plant(system.name).positions
        shown = [*positions, *(name for name in names if name not in positions)]
        time: Array = dt * np.arange(len(responses[0].x), dtype=np.float64)
        figure = Figure(figsize=(0.9 + 2.2 * len(chosen), 1.1 + 1.55 * len(shown)), layout="constrained")
        panels = figure.subplots(len(shown), len(chosen), sharex=True, sharey="row", squeeze=False)
        for name, line in zip(shown, panels, strict=True):
            k = names.index(name)
            draw_state(line, system, k, time, chosen, reach_of(system, k, chosen.values()))
        for panel, method in zip(panels[0], chosen, strict=True):
            panel.set_title(method.label.replace(", ", ",\n"))  # a panel is narrower than some names
        for panel in panels[-1]:
            panel.set_xlabel(TimingInWords.of(system).axis)
            panel.set_xlim(0, time[-1])
        number = next(iter(chosen.values())).shape[1]
        figure.suptitle(f"{system.name}, seed {seed}: {count(number, 'trajectory', 'trajectories')}, held inputs")
        return figure

    return drawn(build)


def reach_of(system: System, k: int, states: Sequence[Array] | Any) -> float:
    """A frame that most of what stays in the domain needs: half its height, for state k of states (T + 1, N, n)."""
    bound = float(max(map(abs, system.domain[k])))
    sizes = np.abs(np.concatenate([x[..., k].ravel() for x in states]))
    finite = sizes[np.isfinite(sizes)]
    largest = float(finite.max()) if finite.size else bound
    return 1.05 * (min(bound, largest) or bound)


def draw_state(
    panels: Sequence[Any], system: System, k: int, time: Array, chosen: Mapping[Method, Array], reach: float
) -> None:
    """One state in the panels of these methods, within a frame of half-height `reach`."""
    for panel, (method, x) in zip(panels, chosen.items(), strict=True):
        path = x[..., k]
        panel.plot(time, np.clip(path, -10 * reach, 10 * reach), color=COLOURS[method.run], lw=0.6, alpha=0.6)
        panel.axhline(0, color=MUTED, lw=0.5, zorder=0)
        panel.locator_params(nbins=4)
        outside = int((~(np.abs(path) <= reach)).any(axis=0).sum())
        if outside:
            panel.text(
                0.98,
                0.04,
                f"{outside} leave the frame",
                transform=panel.transAxes,
                ha="right",
                fontsize=8.0,
                bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0},
            )
    panels[0].set_ylim(-reach, reach)
    panels[0].set_ylabel(named(system, k))


def named(system: System, k: int) -> str:
    """A state with its unit."""
    name = system.states[k].name
    unit = system.units.get(name, "")
    return f"{name} ({unit})" if unit else name


def short(method: Method) -> str:
    """A method's kind of run, which fits above a narrow panel."""
    return NAMES[method.run].replace(" without", "\nwithout")
