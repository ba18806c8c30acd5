"""The distance of the learned gain, and of the policy's Jacobian, from the true gain over a run."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.loop.plants import System
from controllers.figures.style import DEEP, MUTED, WIDTH, drawn, log_scale, name_lines
from controllers.history.gain_distance import Distances

Array = NDArray[np.float64]
_LINES = (  # a field of Distances, its name, colour, line
    ("K", "learned K", DEEP["ours"], "-"),
    ("mean", "Jacobian of\nthe mean action", DEEP["sac"], "-"),
    ("A", "learned A", MUTED, "--"),
    ("B", "learned B", MUTED, ":"),
)


def draw_gain(
    system: System, seed: int, found: Sequence[Distances], settled: Sequence[tuple[int, float]] = ()
) -> bytes:
    """Relative distances against steps, logarithmically; below them, if it is known, which share settled, as PNG."""

    def build() -> Any:
        from matplotlib.figure import Figure

        figure = Figure(figsize=(WIDTH, 5.0 if settled else 3.6), layout="constrained")
        panels = figure.subplots(
            2 if settled else 1, 1, sharex=True, squeeze=False, height_ratios=[3, 1] if settled else None
        )[:, 0]
        steps = [each.step for each in found]
        above, ends = panels[0], []
        for name, label, colour, style in _LINES:
            values = np.array([getattr(each, name) for each in found])
            if np.isnan(values).all():  # a run that learns no gain
                continue
            thin = name in ("A", "B")
            above.plot(
                steps, values, color=colour, ls=style, lw=1.0 if thin else 1.6, marker="" if thin else ".", ms=5,
                drawstyle="default" if name == "mean" else "steps-post",
            )  # fmt: skip
            ends.append((float(values[-1]), f"{label} {values[-1]:.1e}", colour))
        log_scale(above)
        above.set_ylabel("relative distance, Frobenius")
        above.grid(axis="y")
        name_lines(above, ends)
        if settled:
            panels[1].plot(*zip(*settled, strict=True), color=MUTED, marker=".", ms=5)
            panels[1].set_ylim(-0.05, 1.05)
            panels[1].set_ylabel("share that\nsettles")
        panels[-1].set_xlim(0, max([*steps, *(step for step, _ in settled)]))
        panels[-1].set_xlabel("environment steps")
        figure.suptitle(
            f"{system.name}, seed {seed}: what is learned against the simulator's linearisation\n"
            "and its discrete LQR gain; the mean action's Jacobian at the origin should be −K",
            x=0.01,
            ha="left",
        )
        return figure

    return drawn(build)
