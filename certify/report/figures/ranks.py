"""The map of ranks: the number of steps after which the target is reached at the latest, in planes of the states.

The colours are those of the leaves at the middles of a picture's points, in the plane in which all other states are at
rest, or in the middle of a box. Map and scale are images both, so that dark colours turn them alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import AnyCertificate, RankTree, ReachCertificate, leaves_within
from certify.certificates.membership import angles_in
from certify.certificates.ranked import Ranked
from certify.loop.plants.floating_point import function_of
from certify.report.figures.edges import draw_edges
from certify.report.figures.geometry import ellipse
from certify.report.figures.pairs import MOST, Pair
from certify.report.figures.scene import Scene
from certify.report.figures.style import INK, MUTED, PAPER, SET, START, Picture, add_axes, figure_of, to_svg
from certify.report.flow import Flow, simulate, time_scales
from certify.report.words import deviation, symbol

Array = NDArray[np.float64]
_LINE = (PAPER, 3.0), (SET, 1.6)  # an outline that is seen on every colour
_BOX = (PAPER, 3.0), (START, 2.0)
_RUNS = (PAPER, 1.4), (INK, 0.6)
_POINTS = 480  # of a map along each side
_SAMPLES = 100_000  # states that tell where a region is
_ROOM = 1.1  # of a set's reach, in its picture
_STARTS, _LONGEST = 6, 4000  # simulated runs, and their steps
_COLOURS = "viridis_r"  # light is near, and no colour is white


@dataclass(frozen=True, slots=True)
class Ground:
    """The ranks that maps show.

    Parameters
    ----------
    certificate : of the claim.
    ranked, most : the leaves, and the most steps from one.
    labels, names : of the states.
    middle : the state (n,) through which planes go.
    lo, hi : corners (n,) of the pictures.
    target, outline : the target's name, and the function that draws its outline in a plane.
    sampled : the steps are sampling instants.
    word : "proved", or "claimed".
    """

    certificate: AnyCertificate
    ranked: Ranked
    most: float
    labels: Sequence[str]
    names: Sequence[str]
    middle: Array
    lo: Array
    hi: Array
    target: str
    outline: Callable[[Any, Pair], None]
    sampled: bool
    word: str
    beside: str = ", all other states at rest"

    @property
    def n(self) -> int:
        """The number of states."""
        return len(self.names)


def rank_maps(scene: Scene) -> list[Picture]:
    """A map of the ranks around {V <= c2} for each pair of states, or of the line; none without ranks."""
    ranked, claim = scene.ranked, scene.certificate.claim
    if ranked is None or claim.ranks is None:
        return []
    ground = Ground(
        scene.certificate,
        ranked,
        float(claim.ranks.steps),
        scene.labels,
        [s.name for s in scene.system.states],
        np.zeros(scene.n),
        np.minimum(ranked.tree.lo, -_ROOM * scene.reach),
        np.maximum(ranked.tree.hi, _ROOM * scene.reach),
        "{V ≤ c₂}",
        lambda axes, pair: _level_set(axes, scene, ranked, pair),
        scene.timing.sample is not None,
        scene.word,
    )
    return [_picture(ground, pair) for pair in (scene.pairs if scene.n > 1 else [(0, 0)])]


def reach_maps(certificate: ReachCertificate, accepted: bool, box: tuple[Array, Array] | None = None) -> list[Picture]:
    """A map of the ranks around a region for each pair of states, or of the line; with `box`, corners (n,), through its
    middle, and with simulated runs from it.
    """
    more = (
        " Magenta: the box that was asked about. Thin lines: simulated runs from it, until they are there; between two "
        "boxes, several steps apart, they may pass states without a rank."
    )
    ground = reach_ground(certificate, accepted, box)
    return [_picture(ground, pair, "" if box is None else more) for pair in planes_of(ground.n)]


def planes_of(n: int) -> list[Pair]:
    """The first pairs of n states, or (0, 0) for the line of one."""
    return list(combinations(range(n), 2))[:MOST] if n > 1 else [(0, 0)]


def reach_ground(
    certificate: ReachCertificate, accepted: bool, box: tuple[Array, Array] | None = None, *, close: bool = False
) -> Ground:
    """The ranks around a region, as `reach_maps` draws them; `close` is where there are ranks or the region."""
    system = certificate.system
    ranked = Ranked(certificate.evidence.ranks, None, angles_in(system))
    domain = np.array([[float(end) for end in pair] for pair in system.domain]).T
    at_rest = box is None and bool(np.all(domain[0] < 0) and np.all(domain[1] > 0))
    middle = np.zeros(system.n) if at_rest else 0.5 * np.sum(domain if box is None else box, axis=0)
    beyond = function_of(system, certificate.claim.target, (), "numpy")
    path = (
        None if box is None else _runs(certificate, box, lambda x: beyond(x, np.zeros((*x.shape[:-1], system.m)), ()))
    )
    lo, hi = ends = np.minimum(ranked.tree.lo, domain[0]), np.maximum(ranked.tree.hi, domain[1])
    if box is not None and path is not None:
        lo, hi = _view(ranked.tree, np.concatenate([np.stack(box), path.reshape(-1, system.n)]), ends)
    elif close:
        x = np.random.default_rng(0).uniform(lo, hi, (_SAMPLES, system.n))
        lo, hi = _view(ranked.tree, x[beyond(x, np.zeros((len(x), system.m)), ()).max(-1) <= 0], ends)

    def outline(axes: Any, pair: Pair) -> None:
        a, b, states = _plane(lo, hi, middle, pair)
        with np.errstate(all="ignore"):
            value = beyond(states, np.zeros((*states.shape[:-1], system.m)), ()).max(-1)
        if system.n > 1:
            for colour, width in _LINE:
                axes.contour(a, b, value, levels=[0.0], colors=[colour], linewidths=[width], zorder=4)
        else:
            for at in a[1:][np.diff(np.sign(value[0])) != 0]:
                axes.axvline(at, color=SET, lw=1.6, zorder=4)
        if box is not None and path is not None and system.n > 1:
            _drawn_runs(axes, path, pair)
            _drawn_box(axes, box, pair)

    shown = zip(system.states, system.exact_x_eq(), strict=True)
    return Ground(
        certificate,
        ranked,
        float(certificate.claim.ranks.steps),
        [deviation(s.name, q, system.units.get(s.name, "")) for s, q in shown],
        [s.name for s in system.states],
        middle,
        lo,
        hi,
        "the region",
        outline,
        system.sample is not None,
        "proved" if accepted else "claimed",
        ", all other states "
        + ("at 0" if at_rest else f"in the middle of the {'domain' if box is None else 'box that was asked about'}"),
    )


def _picture(ground: Ground, pair: Pair, more: str = "") -> Picture:
    """The map of one plane, with the outline of the target on top."""
    figure, axes = figure_of(4.4, 3.6 if ground.n > 1 else 1.6, left=0.86, right=0.8)
    show, broken = draw_map(axes, ground, pair)
    _scale(figure, axes, ground.most, show)
    grey = " Grey: a constraint is violated there, on a grid." if broken else ""
    steps = "sampling instants" if ground.sampled else "steps"
    other = ground.beside if ground.n > 2 else ""
    turned = [symbol(ground.names[k]) for k in ground.ranked.angles]
    place = f" Full turns of {', '.join(turned)} are the same place." if turned else ""
    unless = "" if ground.word == "proved" else ", if the claim is true"
    title = f"Steps to {ground.target}, at most"
    i, j = pair
    return Picture(
        title if ground.n <= 2 else f"{title}: {ground.labels[i]}, {ground.labels[j]}",
        f"Colour: the number of {steps} after which every trajectory from there is in {ground.target}, the blue "
        f"outline, at the latest{unless}{other}. White: nothing is {ground.word}.{grey}{place}{more}",
        to_svg(figure),
        simulated=bool(more),
    )


def draw_map(axes: Any, ground: Ground, pair: Pair) -> tuple[dict[str, Any], bool]:
    """Draw the ranks, violated constraints and the target's outline in a plane; returns how numbers become colours, and
    whether a constraint is violated somewhere in the plane."""
    i, j = pair
    lo, hi = ground.lo, ground.hi
    a, b, states = _plane(lo, hi, ground.middle, pair)
    values = ground.ranked.ranks_at(states.reshape(-1, ground.n)).reshape(states.shape[:-1])
    box = (lo[i], hi[i], lo[j], hi[j]) if ground.n > 1 else (lo[0], hi[0], 0.0, 1.0)
    show = {"cmap": _COLOURS, "vmin": 0.0, "vmax": ground.most, "origin": "lower", "interpolation": "nearest"}
    axes.imshow(values, extent=box, aspect="auto", zorder=1, **show)
    if ground.n > 1:
        axes.set_ylabel(ground.labels[j])
    else:
        axes.set_yticks([])
    broken = draw_edges(axes, ground.certificate, a, b, states, 1.5)
    ground.outline(axes, pair)
    axes.set_xlim(*box[:2])
    axes.set_ylim(*box[2:])
    axes.set_xlabel(ground.labels[i])
    return show, broken


def _view(tree: RankTree, states: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
    """The box of leaves with a rank and of these states (N, n), with some room, between corners (n,)."""
    lower, upper = leaves_within(tree.tree, tree.lo, tree.hi)
    known, states = tree.proved, states[np.isfinite(states).all(-1)]
    lo = np.concatenate([states, lower[known]]).min(0)
    hi = np.concatenate([states, upper[known]]).max(0)
    room = 0.2 * (hi - lo)
    return np.maximum(lo - room, ends[0]), np.minimum(hi + room, ends[1])


def _plane(lo: Array, hi: Array, middle: Array, pair: Pair) -> tuple[Array, Array, Array]:
    """The middles of a map's points along two states, and the states there, (rows, columns, n)."""
    i, j = pair
    shares = (np.arange(_POINTS) + 0.5) / _POINTS
    a, b = (lo[k] + shares * (hi[k] - lo[k]) for k in pair)
    states = np.tile(middle, (len(b) if len(middle) > 1 else 1, _POINTS, 1))
    states[..., i] = a[None, :]
    if len(middle) > 1:
        states[..., j] = b[:, None]
    return a, b, states


def _level_set(axes: Any, scene: Scene, ranked: Ranked, pair: Pair) -> None:
    """The section of {V <= c2}, and the same after the turns that are in the picture; of one state its ends."""
    if scene.n == 1:
        for end in (-scene.reach[0], scene.reach[0]):
            for colour, width in _LINE:
                axes.axvline(end, color=colour, lw=width, zorder=4)
        return
    x, y = ellipse(scene.P, pair, scene.outer)
    turns = [(-1, 0, 1) if k in ranked.angles else (0,) for k in pair]
    for v in turns[0]:
        for w in turns[1]:
            for colour, width in _LINE:
                axes.plot(x + 2 * np.pi * v, y + 2 * np.pi * w, color=colour, lw=width, zorder=4)


def _runs(certificate: ReachCertificate, box: tuple[Array, Array], beyond: Callable[[Array], Array]) -> Array:
    """Simulated runs from a box, (steps, runs, n); NaN once they are in the region."""
    flow = Flow.of(certificate.system, certificate.network)
    step = flow.fitting(time_scales(flow)[0])
    shares = np.random.default_rng(0).uniform(size=(_STARTS - 2, len(box[0])))
    starts = np.concatenate([[box[0]], [box[1]], box[0] + shares * (box[1] - box[0])])
    each = 1 if flow.discrete else flow.steps_between(step)
    most = min(_LONGEST, certificate.claim.ranks.steps * each)
    path = simulate(flow, starts, step, most)
    with np.errstate(all="ignore"):
        there = np.cumsum(beyond(path).max(-1) <= 0, axis=0) > 1
    path[there] = np.nan
    return path


def _drawn_runs(axes: Any, path: Array, pair: Pair) -> None:
    for run in range(path.shape[1]):
        for colour, width in _RUNS:
            axes.plot(path[:, run, pair[0]], path[:, run, pair[1]], color=colour, lw=width, zorder=3)


def _drawn_box(axes: Any, box: tuple[Array, Array], pair: Pair) -> None:
    """The box's section, which may be a line."""
    (a, b), (c, d) = ((box[0][k], box[1][k]) for k in pair)
    for colour, width in _BOX:
        axes.plot([a, b, b, a, a], [c, c, d, d, c], color=colour, lw=width, zorder=5)


def _scale(figure: Any, axes: Any, most: float, show: dict[str, Any]) -> None:
    """The colours of the numbers of steps, to the right of the map."""
    (width, _), place = figure.get_size_inches(), axes.get_position()
    height = figure.get_size_inches()[1]
    bar = add_axes(figure, width - 0.66, place.y0 * height, 0.14, place.height * height)
    bar.imshow(np.linspace(0.0, most, 256)[:, None], extent=(0.0, 1.0, 0.0, most), aspect="auto", **show)
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.yaxis.get_major_locator().set_params(integer=True)
    bar.tick_params(colors=MUTED)
