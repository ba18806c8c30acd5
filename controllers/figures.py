"""The figures of a comparison, drawn as PNG with matplotlib's object-oriented interface."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from certify.systems import System
from controllers.options import get_plant
from controllers.responses import NAMES, OURS, Method, Response, Row, Run, quartiles

Array = NDArray[np.float64]

_COLOURS: dict[Run, str] = {  # Okabe and Ito's, told apart with any colour vision
    "ours": "#0072b2",
    "sac": "#d55e00",
    "before": "#56b4e9",
    "uncentred": "#e69f00",
    "sb3-sac": "#009e73",
    "sb3-ppo": "#cc79a7",
}
_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
}
_SMALLEST = 1e-16  # norms are drawn from here on: a logarithmic axis has no 0


def draw_over_time(
    what: Literal["cost", "norm"], system: System, dt: float, responses: Sequence[Response], rows: Sequence[Row]
) -> bytes:
    """Median and quartiles over seeds and states against time: mean actions, and beside them sampled ones."""
    import matplotlib
    from matplotlib.figure import Figure

    seeds, states = len({response.seed for response in responses}), responses[0].x.shape[1]
    methods = list(dict.fromkeys(response.method for response in responses))
    kinds = sorted({method.sampled for method in methods})
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(5.0 * len(kinds) + (len(kinds) == 1), 4.8), layout="constrained")
        panels = figure.subplots(1, len(kinds), sharey=True, squeeze=False)[0]
        for panel, sampled in zip(panels, kinds, strict=True):
            for method in methods:
                if method == OURS or method.sampled == sampled:
                    own = [response for response in responses if response.method == method]
                    row = next(row for row in rows if row.seed is None and row.method == method.name)
                    _draw_band(panel, what, dt, own, row)
            panel.set_xlim(0, dt * (len(responses[0].x) - 1))
            panel.set_xlabel("time (s)")
            panel.set_title("stochastic actions (ours: mean)" if sampled else "mean actions")
            panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)
        if any(np.isfinite(line.get_ydata()).any() for panel in panels for line in panel.lines):
            panels[0].set_yscale("log")  # of all panels; an axis without a finite value has no logarithmic scale
        if what == "cost":
            panels[0].set_ylabel("∫ x'Qx + (u − u_eq)'R(u − u_eq) dt")
            title = "accumulated cost"
        else:
            panels[0].set_ylabel("‖x‖ (units of the states)")
            title = "distance from the equilibrium (dotted: floor, the largest in the last second)"
        figure.suptitle(
            f"{system.name}: {title}\nmedian and quartiles of {_count(seeds, 'seed')} × {states} states", fontsize=10.0
        )
        return _png(figure)


def _draw_band(panel: Any, what: Literal["cost", "norm"], dt: float, responses: Sequence[Response], row: Row) -> None:
    """One method: its median as a line, its quartiles as a band, its floor dotted."""
    run = responses[0].method.run
    colour, label = _COLOURS[run], NAMES[run]
    values = np.concatenate([getattr(response, what) for response in responses], axis=1)
    lower, median, upper = np.maximum(quartiles(values), _SMALLEST)
    first = 1 if what == "cost" else 0  # no cost at time 0, and no 0 on a logarithmic axis
    time = dt * np.arange(len(median))[first:]
    if what == "norm":
        label += f", floor {row.floor:.1e}"
        if math.isfinite(row.floor):
            panel.axhline(max(row.floor, _SMALLEST), color=colour, lw=0.8, ls=":")
    if row.diverged:
        label += f" ({row.diverged} of {row.trajectories} diverged)"
    panel.plot(time, _drawable(median)[first:], color=colour, label=label)
    panel.fill_between(time, _drawable(lower)[first:], _drawable(upper, median)[first:], color=colour, alpha=0.18, lw=0)


def draw_states(system: System, dt: float, responses: Sequence[Response]) -> bytes:
    """Fifty trajectories at most of every state, positions first; one column a method, all of the first seed."""
    import matplotlib
    from matplotlib.figure import Figure

    names, seed = [symbol.name for symbol in system.states], responses[0].seed
    chosen = {response.method: response.x[:, :50] for response in responses if response.seed == seed}
    positions = get_plant(system.name).positions
    shown = [*positions, *(name for name in names if name not in positions)]
    time: Array = dt * np.arange(len(responses[0].x), dtype=np.float64)
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(0.9 + 2.2 * len(chosen), 1.1 + 1.55 * len(shown)), layout="constrained")
        panels = figure.subplots(len(shown), len(chosen), sharex=True, sharey="row", squeeze=False)
        for name, line in zip(shown, panels, strict=True):
            _draw_state(line, system, names.index(name), time, chosen)
        for panel, method in zip(panels[0], chosen, strict=True):
            panel.set_title(method.label.replace(", ", ",\n"))  # a panel is narrower than some names
        for panel in panels[-1]:
            panel.set_xlabel("time (s)")
            panel.set_xlim(0, time[-1])
        number = next(iter(chosen.values())).shape[1]
        figure.suptitle(
            f"{system.name}: {_count(number, 'trajectory', 'trajectories')}, held actions, seed {seed}", fontsize=10.0
        )
        return _png(figure)


def _draw_state(panels: Sequence[Any], system: System, k: int, time: Array, chosen: Mapping[Method, Array]) -> None:
    """One state in the panels of all methods, in a frame that most of what stays in the domain needs."""
    name, bound = system.states[k].name, float(max(map(abs, system.domain[k])))
    sizes = np.abs(np.concatenate([x[..., k].ravel() for x in chosen.values()]))
    finite = sizes[np.isfinite(sizes)]
    largest = float(finite.max()) if finite.size else bound
    reach = 1.05 * (min(bound, largest) or bound)
    for panel, (method, x) in zip(panels, chosen.items(), strict=True):
        path = x[..., k]
        panel.plot(time, np.clip(path, -10 * reach, 10 * reach), color=_COLOURS[method.run], lw=0.6, alpha=0.6)
        panel.axhline(0, color="#6b7785", lw=0.5, zorder=0)
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
    unit = system.units.get(name, "")
    panels[0].set_ylabel(f"{name} ({unit})" if unit else name)


def _drawable(values: Array, otherwise: Array | None = None) -> Array:
    """Infinity is not drawn; an infinite edge of a band is drawn far above its finite median."""
    far = math.nan if otherwise is None else np.where(np.isfinite(otherwise), 1e3 * otherwise, math.nan)
    return np.where(np.isfinite(values), values, far)


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number} {one if number == 1 else many or one + 's'}"


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=150, metadata={"Software": None})
    return buffer.getvalue()
