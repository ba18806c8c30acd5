"""A plane of two states: the set, trajectories, the sign of Vdot.

With two states the plane is the whole space and the picture shows the domain. With more there are two exact shapes to
tell apart: the section through the origin `{y: y'P_ij y <= c}`, the points of the plane that lie in the set, and the
projection `{y: y'((P^-1)_ij)^-1 y <= c}`, all values that two states take anywhere in the set; the picture is zoomed
to the latter. The start of a tube has the same two; then the picture is zoomed to the larger one. A tube around a path
leaves the plane through the origin, so the picture shows only its projections and no sign of Vdot.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.report.figures.edges import draw_edges, key_of_edges, worst_of
from certify.report.figures.geometry import ellipse, shadow, shadows, thin
from certify.report.figures.pairs import Pair
from certify.report.figures.scene import Scene
from certify.report.figures.sets import Band
from certify.report.figures.style import (
    GROWTH,
    GROWTH_FILL,
    INK,
    INNER,
    INNER_FILL,
    LEAVING,
    RASTER_FROM,
    REGION,
    SET,
    SET_FILL,
    SIMULATED,
    START,
    START_FILL,
    UNSETTLED,
    Key,
    Picture,
    figure_of,
    to_svg,
)
from certify.report.sampling import Runs
from certify.report.words import below, inner_level, number, symbol

Array = NDArray[np.float64]
Region = tuple[Array, Array, Array]
"""Axes (K,), (L,) of a plane and the share of a simulated region around each point, (K, L)."""
_ABOUT = (
    "Each picture shows two states. The section holds the states of the set in which all others are 0; the projection "
    "holds the values that the two take anywhere in the set. Both are exact shapes. Trajectories start over the "
    "boundary of the projection, and are projected like it."
)
_ABOUT_A_PATH = (
    "Each picture shows two states. Of {V ≤ c₂} the section holds the states in which all others are 0, the projection "
    "the values that the two take anywhere in it. The tube does not lie around the plane of the picture: all that is "
    "shown of it, its start and its path are projections, and where they overlap {V ≤ c₂} here the states need not lie "
    "in it. Trajectories start over the boundary of the start's projection, and are projected like it."
)
_ABOUT_AN_OUTER_SET = (
    "Each picture shows two states over their domain. Of the outer set, and of {V ≤ c₂}, the section holds the states "
    "in which all others are 0; the outline of the former is drawn from a grid. The projection of {V ≤ c₂} holds the "
    "values that the two take anywhere in it; of the outer set there is none. Trajectories start in the plane, at the "
    "outlines of the sections, and are projected."
)
_MOMENTS, _AROUND = 64, 32  # of a tube's time that are drawn, and points around each ellipse


def portraits(scene: Scene, runs: Runs, region: Region | None) -> list[Picture]:
    """The planes of the scene's pairs, under one legend."""
    drawn = []
    for pair in scene.pairs:
        figure, axes = figure_of(5.0, 4.2) if scene.n == 2 else figure_of(4.2, 3.6)
        drawn.append((pair, draw_plane(axes, scene, pair, runs, region), to_svg(figure)))
    legend = keys(scene, runs, region, any(growing for _, growing, _ in drawn))
    title, meaning = "Phase portrait", f"Blue: the {scene.word} set, {scene.meaning}. "
    if scene.centre is not None:
        meaning += (
            "Magenta: the tube around a path that leads into it, of which only the start, around c₀, is claimed. "
        )
    elif scene.start is not None:
        meaning += "Magenta: the start of the tube that leads into it. "
    elif scene.beyond is not None:
        meaning += (
            f"Magenta: the {scene.word} outer set {{N ≤ n₂}} in the domain, from which every trajectory enters the "
            f"blue one{'' if scene.word == 'proved' else ', if the claim is true'}; its outline is that on a grid. "
        )
    elif scene.ranked is not None:
        meaning += "The boxes with ranks, from which it is reached, are in a picture of their own. "
    about = _ABOUT if scene.centre is None else _ABOUT_A_PATH
    about = (about if scene.beyond is None else _ABOUT_AN_OUTER_SET) if len(scene.pairs) > 1 else ""
    meaning += _unseen(scene)
    about = f"{about} {_unseen(scene)}".rstrip() if about else ""
    pictures = []
    for pair, growing, svg in drawn:
        if scene.n > 2:
            names = [symbol(scene.system.states[k].name) for k in pair]
            title = ", ".join(names)
            which = "the set takes" if scene.centre is None and scene.beyond is None else "{V ≤ c₂} takes"
            meaning = f"Of its domain {which} {_takes(scene.shares, names, pair)}. "
            if scene.start_shares is not None:
                both = _takes(scene.start_shares, names, pair), _takes(scene.shares, names, pair)
                meaning = f"Of its domain the start takes {both[0]}, {{V ≤ c₂}} {both[1]}. "
        sign = (
            ""
            if growing or not _shows_sign(scene)
            else f"{scene.falling} < 0 at every grid point of the picture{_but_inside(scene)}{scene.held}. "
        )
        if growing and scene.start is not None:
            sign = "V need not fall outside the blue set: along the tube another function does. "
        sign += "The dots are steps; lines only join them. " if scene.timing.discrete else ""
        sign += f"{scene.timing.simulated.definition} ".lstrip() if scene.n == 2 else ""
        caption = f"{meaning}{sign}*\N{NO-BREAK SPACE}Simulated or evaluated on a grid{scene.held}, not proved."
        pictures.append(Picture(title, caption, svg, simulated=True, wide=scene.n == 2, legend=legend, about=about))
    return pictures


def _unseen(scene: Scene) -> str:
    """Say that the inner set is too small to be seen, if it is so in all of the pictures."""
    if not scene.shows_inner or any(map(scene.sees_inner, scene.pairs)):
        return ""
    below_it = "; a picture below shows it" if scene.n == 2 else ""
    level = inner_level(scene.kind, scene.inner, 3)
    return f"The {scene.words.inner_set}, V ≤ {level}, is too small to be seen here{below_it}. "


def _but_inside(scene: Scene) -> str:
    """Name the states where the sign is not shown."""
    return "" if scene.beyond is None else " outside {V ≤ c₂}"


def _shows_sign(scene: Scene) -> bool:
    """True if the sign of Vdot in the plane applies to everything that is drawn in it."""
    return scene.n == 2 or scene.centre is None


def _takes(shares: Array, names: Sequence[str], pair: Pair) -> str:
    """Shares of the domain in words."""
    return " and ".join(f"{number(100 * shares[k], 3)} % in {name}" for name, k in zip(names, pair, strict=True))


def keys(scene: Scene, runs: Runs, region: Region | None, growing: bool) -> tuple[Key, ...]:
    """The legend of the planes; `growing` says whether Vdot >= 0 somewhere in one of them."""
    outer = f"{scene.word} set, V = {below(scene.outer)}"
    inner = f"{scene.words.inner_set}, V = {inner_level(scene.kind, scene.inner, 3)}"
    start = f"{scene.word} {scene.words.start}"
    found = [Key(outer, SET, 1.8, fill=SET_FILL)]
    if scene.n > 2:
        found = [
            Key(f"{outer}: projection", SET, 1.2, "--"),
            Key("its section through the origin", SET, 1.6, fill=SET_FILL),
        ]
    if scene.centre is not None:
        projected = ": projection" if scene.n > 2 else ""
        begin = [Key(start + projected, START, 1.8)]
        if scene.band is not None:
            shown = f"the tube at {len(_moments(scene.band))} moments{projected}"
            begin += [Key(shown, START_FILL, 0, fill=START_FILL), Key(f"its path c(t){projected}", START, 1.0, ":")]
        found = [*begin, *found]
    elif scene.start is not None and scene.n > 2:
        begin = [Key(f"{start}: projection", START, 1.2, "--"), Key("section of the start", START, 1.6)]
        found = [*begin, *found]
    elif scene.start is not None:
        found = [Key(start, START, 1.8), *found]
    elif scene.beyond is not None:
        shown = ": section through the origin" if scene.n > 2 else ""
        level = below(scene.beyond.level, 4)
        found.insert(0, Key(f"{scene.word} outer set, N = {level}{shown}", START, 1.8, fill=START_FILL))
    if any(map(scene.sees_inner, scene.pairs)):
        found.append(Key(inner + (": section" if scene.n > 2 else ""), INNER, 1.4, fill=INNER_FILL))
    if scene.taking_over is not None:
        shown = ": section" if scene.n > 2 else ""
        found.append(Key(f"the second claim's set, V′ = {below(scene.taking_over[1])}{shown}", INNER, 1.4, "--"))
    if growing:
        found.append(Key(f"{scene.falling} ≥ 0 on a grid*", GROWTH, 1.0, fill=GROWTH_FILL))
    worst = worst_of(scene.certificate)
    if worst is not None and any(np.any(worst(scene.plane(pair)[2]) >= 0) for pair in scene.pairs):
        found.append(key_of_edges("*"))
    found += [Key(text, colour, 1.4, style) for _, colour, style, text in _kinds(scene, runs)]
    if region is not None:
        found.append(Key("boundary of the simulated region*", REGION, 1.4, "--"))
    return (*found, Key("boundary of the domain", INK, 1.0))


def _kinds(scene: Scene, runs: Runs) -> list[tuple[NDArray[np.bool_], str, Any, str]]:
    """The kinds of runs that occur, by their fates: which, colour, style, text."""
    leaving = "trajectories that leave the domain*"
    if np.any(runs.left & ~np.any(np.isnan(runs.path[-1]), axis=-1)):
        leaving = "trajectories that leave the domain or the set*"
    kinds = (
        (runs.settled, SIMULATED, "-", f"{scene.words.runs}*"),
        (
            runs.unsettled,
            UNSETTLED,
            "--",
            f"trajectories not settled in {number(runs.seconds, 3)} {scene.timing.unit}*",
        ),
        (runs.left, LEAVING, "-", leaving),
    )
    return [kind for kind in kinds if np.any(kind[0])]


def draw_plane(axes: Any, scene: Scene, pair: Pair, runs: Runs, region: Region | None) -> bool:
    """Draw everything in one plane; return True if Vdot >= 0 at some grid point."""
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Rectangle

    i, j = pair
    view = scene.view(pair)
    a, b, x = scene.plane(pair)
    change = scene.growth(x)
    section = ellipse(scene.P, pair, scene.outer)
    axes.fill(*section, color=SET_FILL, lw=0, zorder=1)
    _draw_outline(axes, scene, pair)
    draw_edges(axes, scene.certificate, a, b, x, 0.7)
    growing = (change >= 0) & np.any(x != 0, axis=-1) & _shows_sign(scene)
    if np.any(growing):
        axes.contourf(a, b, change, levels=[0, np.inf], colors=[GROWTH_FILL], zorder=0)
        if np.any(change < 0):
            axes.contour(a, b, change, levels=[0.0], colors=[GROWTH], linewidths=1.0, zorder=3)
    size = view.hi - view.lo
    for which, colour, style, _ in _kinds(scene, runs):
        paths = [piece for k in np.flatnonzero(which) for piece in _unbroken(runs.path[:, k], scene.flow.angles)]
        lines = [thin(path[:, [i, j]], size) for path in paths]
        lines = [path for path in lines if len(path) > 1]
        width = 0.4 if scene.timing.discrete else 0.8  # the lines join steps, which are the dots
        axes.add_collection(
            LineCollection(lines, colors=colour, linewidths=width, linestyles=style, zorder=2.5 if style == "--" else 2)
        )
        if scene.timing.discrete:
            points = np.concatenate([np.zeros((0, 2)), *lines])
            axes.plot(
                points[:, 0], points[:, 1], ".", ms=2.0, color=colour, zorder=2.5, rasterized=len(points) > RASTER_FROM
            )
        _arrows(axes, lines, colour, size)
    if region is not None:
        axes.contour(
            region[0], region[1], region[2].T, levels=[0.5], colors=[REGION], linewidths=1.4, linestyles="--", zorder=3
        )
    axes.plot(*section, color=SET, lw=1.8 if scene.n == 2 else 1.5, zorder=4)
    if scene.n > 2:
        axes.plot(*shadow(scene.P, pair, scene.outer), color=SET, lw=1.2, ls="--", zorder=4)
    if scene.centre is not None:
        _draw_tube(axes, scene, pair)
    elif scene.start is not None:
        axes.plot(*ellipse(scene.start, pair, 1.0), color=START, lw=1.8 if scene.n == 2 else 1.5, zorder=4)
        if scene.n > 2:
            axes.plot(*shadow(scene.start, pair, 1.0), color=START, lw=1.2, ls="--", zorder=4)
    if scene.sees_inner(pair):
        inner = ellipse(scene.P, pair, scene.inner)
        axes.fill(*inner, color=INNER_FILL, lw=0, zorder=1.5)
        axes.plot(*inner, color=INNER, lw=1.4, zorder=3.5)
    if scene.taking_over is not None:
        axes.plot(*ellipse(scene.taking_over[0], pair, scene.taking_over[1]), color=INNER, lw=1.4, ls="--", zorder=3.6)
    corner, sides = scene.lo[[i, j]], scene.hi[[i, j]] - scene.lo[[i, j]]
    axes.add_patch(Rectangle(tuple(corner), *sides, fill=False, ec=INK, lw=1.0, zorder=4))
    axes.set_xlim(view.lo[0], view.hi[0])
    axes.set_ylim(view.lo[1], view.hi[1])
    axes.set_xlabel(scene.labels[i])
    axes.set_ylabel(scene.labels[j])
    if scene.n == 2:
        axes.spines[["left", "bottom"]].set_visible(False)  # the domain's box is frame enough
    return bool(np.any(growing))


def _unbroken(path: Array, angles: Sequence[int]) -> list[Array]:
    """The pieces of a path between its full turns."""
    if not angles:
        return [path]
    turns = np.any(np.abs(np.diff(path[:, list(angles)], axis=0)) > np.pi, axis=1)
    return np.split(path, np.flatnonzero(turns) + 1)


def _draw_outline(axes: Any, scene: Scene, pair: Pair) -> None:
    """The outer set and its boundary, if there is one."""
    outline = scene.outline(pair)
    if outline is not None:
        axes.contourf(*outline, levels=[-np.inf, 0], colors=[START_FILL], zorder=0.5)
        axes.contour(*outline, levels=[0.0], colors=[START], linewidths=1.8 if scene.n == 2 else 1.5, zorder=4)


def _moments(band: Band) -> Array:
    """Indices (K,) of the times at which a tube is drawn in a plane, denser where it moves fast for its width."""
    moved = np.max(np.abs(np.diff(band.centre, axis=0)) / band.half[:-1], axis=1)
    travelled = np.append(0.0, np.cumsum(moved + np.diff(band.time) / band.time[-1]))
    return np.unique(np.searchsorted(travelled, np.linspace(0, travelled[-1], _MOMENTS)).clip(max=len(travelled) - 1))


def _draw_tube(axes: Any, scene: Scene, pair: Pair) -> None:
    """The projections of a tube around a path: its start, its ellipsoids at some moments, its path."""
    from matplotlib.collections import PolyCollection

    if scene.start is None or scene.centre is None:
        return
    if scene.band is not None:
        at = _moments(scene.band)
        outlines = shadows(scene.band.P[at], scene.band.centre[at], pair, _AROUND)
        axes.add_collection(PolyCollection(outlines, facecolors=START_FILL, edgecolors="none", zorder=0.5))
        way = thin(scene.band.centre[:, pair], np.ptp(scene.band.centre[:, pair], axis=0) + scene.far[list(pair)])
        axes.plot(way[:, 0], way[:, 1], color=START, lw=1.0, ls=":", zorder=3)
    (outline,) = shadows(scene.start[None], scene.centre[None], pair, 240)
    closed = np.concatenate([outline, outline[:1]])
    axes.plot(closed[:, 0], closed[:, 1], color=START, lw=1.8, zorder=4)


def _arrows(axes: Any, lines: Sequence[Array], colour: str, size: Array) -> None:
    """An arrow head a quarter of the way along each line."""
    heads, directions = [], []
    for path in lines:
        k = max(1, len(path) // 4)
        d = (path[k] - path[k - 1]) / size
        if np.any(d != 0):
            heads.append(path[k])
            directions.append(d / np.linalg.norm(d))
    if heads:
        (x, y), (dx, dy) = np.array(heads).T, np.array(directions).T
        axes.quiver(  # directions are shares of the axes, which are wider than high
            x,
            y,
            dx,
            0.8 * dy,
            angles="uv",
            color=colour,
            pivot="mid",
            units="inches",
            scale=9.5,
            width=0.0145,
            headwidth=4.5,
            headlength=5.5,
            headaxislength=5.0,
            minlength=0,
            zorder=3,
        )
