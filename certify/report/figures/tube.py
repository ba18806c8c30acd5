"""How far a tube reaches in each state while time passes, one small picture a state.

The ellipsoid {x'P(t)x <= 1} cannot be drawn in many dimensions, but its shadow on each axis can: |x_i| is at most
sqrt((P(t)^-1)_ii) on it, with equality somewhere. The trajectories are those of the planes, which begin on the edge of
the start.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from certify.certificate import Slab
from certify.lyapunov import extents
from certify.report.figures.scene import Scene
from certify.report.figures.style import LEAVING, SET, SIMULATED, START, START_FILL, Key, Picture, figure_of, to_svg
from certify.report.sampling import Runs
from certify.report.words import above, pretty_unit, symbol

Array = NDArray[np.float64]
MOST = 12
"""States that are shown at most."""
_POINTS = 240  # of the band's edge, about


def tube(scene: Scene, runs: Runs) -> list[Picture]:
    """A picture for each state, with `runs` from the tube's start; none without a tube that can be drawn.

    Where there are more than `MOST` states, those that the start drives furthest into the domain.
    """
    if scene.start is None or scene.start_reach is None or not scene.slabs:
        return []
    time, half = shadow_over_time(scene.start, scene.slabs)
    if not (np.all(np.isfinite(time)) and np.all(np.isfinite(half)) and np.all(np.diff(time) > 0)):
        return []  # a rejected file's tube need not be one
    passed = int(np.searchsorted(runs.step * np.arange(len(runs.path)), time[-1], side="right")) + 1
    last = extents(scene.slabs[-1].end, 1.0)
    legend = _keys(scene, runs)
    shares = np.zeros(scene.n) if scene.start_shares is None else np.nan_to_num(scene.start_shares)
    shown = sorted(np.argsort(-shares, kind="stable")[:MOST].tolist())
    pictures = []
    for k in shown:
        figure, axes = figure_of(4.2, 2.5)
        axes.fill_between(time, -half[:, k], half[:, k], color=START_FILL, lw=0)
        for left, colour in ((False, SIMULATED), (True, LEAVING)):
            some = runs.path[:passed, runs.left == left, k]
            axes.plot(runs.step * np.arange(len(some)), some, color=colour, lw=0.6)
        for sign in (-1, 1):
            axes.plot(time, sign * half[:, k], color=START, lw=1.5)
            axes.axhline(sign * scene.reach[k], color=SET, lw=1.1, ls="--")
        top = 1.08 * max(float(np.max(half[:, k])), float(scene.reach[k]))
        axes.set_ylim(-top, top)
        axes.set_xlim(0, time[-1])
        axes.set_xlabel("time (s)")
        axes.set_ylabel(scene.labels[k])
        name, unit = scene.system.states[k].name, pretty_unit(scene.system.units.get(scene.system.states[k].name, ""))
        reached = [f"± {above(float(v), 3)} {unit}".rstrip() for v in (scene.start_reach[k], last[k])]
        caption = f"{reached[0]} at the start, {reached[1]} at the end. *\N{NO-BREAK SPACE}Simulated, not proved."
        pictures.append(
            Picture(f"The tube in {symbol(name)}", caption, to_svg(figure), True, legend=legend, about=_about(scene))
        )
    return pictures


def shadow_over_time(start: Array, slabs: Sequence[Slab]) -> tuple[Array, Array]:
    """Times (K,) and half-widths `sqrt((P(t)^-1)_ii)` of the tube along each state, (K, n), in floats.

    On a slab P(s) = (1 - s)^2 P_0 + 2 s (1 - s) M + s^2 P_1 for s from 0 to 1, from one node to the next.
    """
    pieces = max(1, _POINTS // len(slabs))
    s = np.arange(1, pieces + 1)[:, None, None] / pieces
    times, matrices = [np.zeros(1)], [start[None]]
    P, begin = start, 0.0
    for slab in slabs:
        times.append(begin + slab.duration * s[:, 0, 0])
        matrices.append((1 - s) ** 2 * P + 2 * s * (1 - s) * slab.middle + s**2 * slab.end)
        P, begin = slab.end, begin + slab.duration
    with np.errstate(invalid="ignore"):  # a rejected file's matrices need not be definite
        half = np.sqrt(np.diagonal(np.linalg.inv(np.concatenate(matrices)), axis1=1, axis2=2))
    return np.concatenate(times), half


def _keys(scene: Scene, runs: Runs) -> tuple[Key, ...]:
    found = [
        Key(f"{scene.word} tube", START, 1.5, fill=START_FILL),
        Key("reach of {V ≤ c₂}", SET, 1.1, "--"),
        Key("trajectories from the start*", SIMULATED, 0.8),
    ]
    return (*found, Key("trajectories that leave the domain*", LEAVING, 0.8)) if np.any(runs.left) else tuple(found)


def _about(scene: Scene) -> str:
    more = "" if scene.n <= MOST else f" The {MOST} of {scene.n} states that the start drives furthest into the domain."
    true = "" if scene.proved == "proved" else ", if the claim is true"
    return (
        "The tube over time: a trajectory from its start is in the ellipsoid {x′P(t)x ≤ 1} at time t, and so each of "
        f"its states in its band{true}. Edges are the certificate's numbers in floating point.{more}"
    )
