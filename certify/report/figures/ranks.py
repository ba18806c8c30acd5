"""The map of ranks: the number of steps after which {V <= c2} is reached at the latest, in the planes of the states.

The colours are those of the leaves at the middles of a picture's points, in the plane in which all other states are at
rest. Map and scale are images both, so that dark colours turn them alike.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.ellipsoids import sublevel_set
from certify.certificates.membership import angles_in
from certify.certificates.ranked import Ranked
from certify.report.figures.geometry import ellipse
from certify.report.figures.pairs import Pair
from certify.report.figures.scene import Scene
from certify.report.figures.sets import tree_of
from certify.report.figures.style import MUTED, SET, Picture, add_axes, figure_of, to_svg
from certify.report.words import symbol

Array = NDArray[np.float64]
_POINTS = 480  # of a map along each side
_COLOURS = "YlGnBu"  # light is near


def rank_maps(scene: Scene) -> list[Picture]:
    """A map for each pair of states, or of the line; none without ranks."""
    tree = tree_of(scene.certificate)
    if tree is None:
        return []
    ranked = Ranked(tree, sublevel_set(scene.P, scene.outer), angles_in(scene.system))
    if scene.n == 1:
        return [_picture(scene, ranked, (0, 0))]
    return [_picture(scene, ranked, pair) for pair in scene.pairs]


def _picture(scene: Scene, ranked: Ranked, pair: Pair) -> Picture:
    """The map of one plane, with the ellipse of {V <= c2} on top."""
    figure, axes = figure_of(5.0, 4.2 if scene.n > 1 else 1.6, right=0.85)
    i, j = pair
    lo, hi = ranked.tree.lo, ranked.tree.hi
    most = float(scene.certificate.claim.ranks.steps) if scene.certificate.claim.ranks is not None else 1.0
    values = _ranks(scene, ranked, pair)
    box = (lo[i], hi[i], lo[j], hi[j]) if scene.n > 1 else (lo[0], hi[0], 0.0, 1.0)
    show = {"cmap": _COLOURS, "vmin": 0.0, "vmax": most, "origin": "lower", "interpolation": "nearest"}
    axes.imshow(values, extent=box, aspect="auto", zorder=1, **show)
    if scene.n > 1:
        _outline(axes, scene, ranked, pair)
        axes.set_ylabel(scene.labels[j])
    else:
        for end in (-scene.reach[0], scene.reach[0]):
            axes.axvline(end, color=SET, lw=1.6, zorder=4)
        axes.set_yticks([])
    axes.set_xlim(*box[:2])
    axes.set_ylim(*box[2:])
    axes.set_xlabel(scene.labels[i])
    _scale(figure, axes, most, show)
    steps = "steps" if scene.timing.sample is None else "sampling instants"
    other = ", all other states at rest" if scene.n > 2 else ""
    turned = [symbol(scene.system.states[k].name) for k in ranked.angles]
    place = f" Full turns of {', '.join(turned)} are the same place." if turned else ""
    unless = "" if scene.word == "proved" else ", if the claim is true"
    title = "Steps to {V ≤ c₂}, at most"
    return Picture(
        title if scene.n <= 2 else f"{title}: {scene.labels[i]}, {scene.labels[j]}",
        f"Colour: the number of {steps} after which every trajectory from there is in {{V ≤ c₂}}, the blue outline, at "
        f"the latest{unless}{other}. White: nothing is {scene.word}.{place}",
        to_svg(figure),
        simulated=False,
        wide=scene.n == 2,
    )


def _ranks(scene: Scene, ranked: Ranked, pair: Pair) -> Array:
    """The ranks at the middles of a map's points, (rows, columns)."""
    i, j = pair
    shares = (np.arange(_POINTS) + 0.5) / _POINTS
    a, b = (ranked.tree.lo[k] + shares * (ranked.tree.hi[k] - ranked.tree.lo[k]) for k in pair)
    rows = len(b) if scene.n > 1 else 1
    states = np.zeros((rows, _POINTS, scene.n))
    states[..., i] = a[None, :]
    if scene.n > 1:
        states[..., j] = b[:, None]
    found = ranked.ranks_at(states.reshape(-1, scene.n))
    return np.asarray(found.reshape(rows, _POINTS))


def _outline(axes: Any, scene: Scene, ranked: Ranked, pair: Pair) -> None:
    """The section of {V <= c2}, and the same after the turns that are in the picture."""
    x, y = ellipse(scene.P, pair, scene.outer)
    turns = [(-1, 0, 1) if k in ranked.angles else (0,) for k in pair]
    for v in turns[0]:
        for w in turns[1]:
            axes.plot(x + 2 * np.pi * v, y + 2 * np.pi * w, color=SET, lw=1.6, zorder=4)


def _scale(figure: Any, axes: Any, most: float, show: dict[str, Any]) -> None:
    """The colours of the numbers of steps, to the right of the map."""
    (width, _), place = figure.get_size_inches(), axes.get_position()
    height = figure.get_size_inches()[1]
    bar = add_axes(figure, width - 0.72, place.y0 * height, 0.14, place.height * height)
    bar.imshow(np.linspace(0.0, most, 256)[:, None], extent=(0.0, 1.0, 0.0, most), aspect="auto", **show)
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.yaxis.get_major_locator().set_params(integer=True)
    bar.tick_params(colors=MUTED)
