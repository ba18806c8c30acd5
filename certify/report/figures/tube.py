"""A tube's extent in each state over time, one small picture per state.

The ellipsoid {(x - c(t))'P(t)(x - c(t)) <= 1} cannot be drawn in many dimensions, but its shadow on each axis can:
|x_i - c_i(t)| is at most sqrt((P(t)^-1)_ii) on it, with equality somewhere. The trajectories are those of the planes,
which begin on the boundary of the start.
"""

from __future__ import annotations

import numpy as np

from certify.lyapunov import extents
from certify.report.figures.scene import Scene
from certify.report.figures.style import LEAVING, SET, SIMULATED, START, START_FILL, Key, Picture, figure_of, to_svg
from certify.report.sampling import Runs
from certify.report.words import above, number, pretty_unit, symbol

MOST = 12
"""States that are shown at most."""


def tube(scene: Scene, runs: Runs) -> list[Picture]:
    """A picture for each state, with `runs` from the tube's start; none without a tube that can be drawn.

    With more than `MOST` states: those along which the start reaches furthest into the domain.
    """
    if scene.start_reach is None or scene.band is None:
        return []  # a rejected file's tube need not be one
    time, middle, half = scene.band.time, scene.band.centre, scene.band.half
    passed = int(np.searchsorted(runs.step * np.arange(len(runs.path)), time[-1], side="right")) + 1
    last = extents(scene.slabs[-1].end, 1.0)
    legend = _keys(scene, runs)
    shares = np.nan_to_num(np.max(np.abs(middle) + half, axis=0) / np.minimum(-scene.lo, scene.hi))
    shares = shares if scene.start_shares is None else np.nan_to_num(scene.start_shares)
    shown = sorted(np.argsort(-shares, kind="stable")[:MOST].tolist())
    pictures = []
    for k in shown:
        figure, axes = figure_of(4.2, 2.5)
        low, high = middle[:, k] - half[:, k], middle[:, k] + half[:, k]
        axes.fill_between(time, low, high, color=START_FILL, lw=0)
        for left, colour in ((False, SIMULATED), (True, LEAVING)):
            some = runs.path[:passed, runs.left == left, k]
            axes.plot(runs.step * np.arange(len(some)), some, color=colour, lw=0.6)
        for edge, reach in ((low, -scene.reach[k]), (high, scene.reach[k])):
            axes.plot(time, edge, color=START, lw=1.5)
            axes.axhline(reach, color=SET, lw=1.1, ls="--")
        if scene.centre is not None:
            axes.plot(time, middle[:, k], color=START, lw=1.0, ls=":")
        bottom, top = min(float(np.min(low)), -scene.reach[k]), max(float(np.max(high)), scene.reach[k])
        axes.set_ylim(bottom - 0.04 * (top - bottom), top + 0.04 * (top - bottom))
        axes.set_xlim(0, time[-1])
        axes.set_xlabel("time (s)")
        axes.set_ylabel(scene.labels[k])
        name, unit = scene.system.states[k].name, pretty_unit(scene.system.units.get(scene.system.states[k].name, ""))
        reached = [f"± {above(float(v), 3)} {unit}".rstrip() for v in (scene.start_reach[k], last[k])]
        if scene.centre is not None:
            ends = zip((scene.centre[k], middle[-1, k]), reached, strict=True)
            reached = [f"{number(float(c), 4)} {text}" for c, text in ends]
        caption = f"{reached[0]} at the start, {reached[1]} at the end. *\N{NO-BREAK SPACE}Simulated, not proved."
        pictures.append(
            Picture(f"The tube in {symbol(name)}", caption, to_svg(figure), True, legend=legend, about=_about(scene))
        )
    return pictures


def _keys(scene: Scene, runs: Runs) -> tuple[Key, ...]:
    found = [
        Key(f"{scene.word} tube", START, 1.5, fill=START_FILL),
        *([] if scene.centre is None else [Key("its path c(t)", START, 1.0, ":")]),
        Key("reach of {V ≤ c₂}", SET, 1.1, "--"),
        Key("trajectories from the start*", SIMULATED, 0.8),
    ]
    return (*found, Key("trajectories that leave the domain*", LEAVING, 0.8)) if np.any(runs.left) else tuple(found)


def _about(scene: Scene) -> str:
    furthest = "the start drives" if scene.centre is None else "the tube drives"
    more = "" if scene.n <= MOST else f" The {MOST} of {scene.n} states that {furthest} furthest into the domain."
    true = "" if scene.word == "proved" else ", if the claim is true"
    ellipsoid = "{x′P(t)x ≤ 1}" if scene.centre is None else "{(x − c(t))′P(t)(x − c(t)) ≤ 1}"
    reach = (
        ""
        if scene.centre is None
        else (
            " The dashed lines are how far {V ≤ c₂} reaches: a band between them does not tell that the tube is in it "
            "before its end."
        )
    )
    return (
        f"The tube over time: a trajectory from its start is in the ellipsoid {ellipsoid} at time t, and so each of "
        f"its states in its band{true}.{reach} Edges are the certificate's numbers in floating point.{more}"
    )
