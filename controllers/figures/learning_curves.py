"""Learning curves: floor and cost of the mean action as a run is trained, to the point where it ended."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import System
from controllers.comparison.learning_curve import CurvePoint
from controllers.comparison.methods import NAMES, Run
from controllers.figures.style import COLOURS, DEEP, WIDTH, count, drawn, log_scale, name_lines, seeds_of

Array = NDArray[np.float64]


def draw_curves(system: System, curves: Sequence[tuple[Run, int, Sequence[CurvePoint]]]) -> bytes:
    """Floor and cost against steps, as PNG: a line for each seed, their median in bold, a ring where a run ended.

    Parameters
    ----------
    curves : kind of run, seed, and the run's evaluations. A kind's median is over all its seeds, so it ends where the
        first of them did. An infinite value, because most trajectories diverged, is a gap.

    Raises
    ------
    InputError : no run has an evaluation.
    """
    if not any(rows for _, _, rows in curves):
        raise InputError("`curves` must have a run with an evaluation; found none.")

    def build() -> Any:
        from matplotlib.figure import Figure

        begun = [curve for curve in curves if curve[2]]
        runs = list(dict.fromkeys(run for run, _, _ in begun))
        figure = Figure(figsize=(WIDTH, 6.2), layout="constrained")
        panels = figure.subplots(2, 1, sharex=True)
        what = (("floor", "floor of ‖x‖"), ("cost", "median accumulated cost"))
        for panel, (name, label) in zip(panels, what, strict=True):
            ends = [_draw_kind(panel, name, run, [rows for kind, _, rows in begun if kind == run]) for run in runs]
            panel.set_ylabel(label)
            panel.grid(axis="y")
            log_scale(panel)
            panel.set_xscale("log")
            name_lines(panel, ends)
        panels[-1].set_xlabel("environment steps")
        seeds = seeds_of([seed for _, seed, _ in begun])
        figure.suptitle(
            f"{system.name}, {seeds}: evaluations during training, mean actions, held\n"
            "bold: the seeds' median, as far as all of them go; ring: where a run ended",
            x=0.01,
            ha="left",
        )
        return figure

    return drawn(build)


def _draw_kind(panel: Any, what: str, run: Run, all_rows: Sequence[Sequence[CurvePoint]]) -> tuple[float, str, str]:
    """One kind of run; the height of its name, the name, its colour."""
    colour, ends = COLOURS[run], []
    curves = [{row.step: float(getattr(row, what)) for row in rows} for rows in all_rows]
    for curve in curves:
        steps, values = np.array(list(curve)), _finite(list(curve.values()))
        panel.plot(steps, values, color=colour, lw=0.8, alpha=0.45)
        panel.plot(steps[-1:], values[-1:], color=DEEP[run], marker="o", ms=5, mfc="white", mew=1.2, ls="", zorder=4)
        ends.append(float(values[-1]))
    common = sorted(set(curves[0]).intersection(*curves[1:]))
    middle = _finite([float(np.median([curve[step] for curve in curves])) for step in common])
    panel.plot(common, middle, color=colour, lw=2.2)
    finite = [end for end in ends if np.isfinite(end)]
    at = float(np.median(finite)) if finite else float("nan")
    return at, f"{NAMES[run]}\n{count(len(curves), 'run')}", DEEP[run]


def _finite(values: Sequence[float]) -> Array:
    found = np.asarray(values, dtype=np.float64)
    return np.where(np.isfinite(found), found, np.nan)
