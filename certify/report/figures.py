"""The figures of a report, drawn as SVG with matplotlib's object-oriented interface (no pyplot, no display).

Lines of level sets come from the certificate's numbers rounded to floats; everything simulated or sampled on a grid
says so in its caption. Thousands of leaves are drawn as one collection and rasterised, which keeps the page small.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificate import Certificate, PartitionTree
from certify.closed_loop import ClosedLoop
from certify.errors import CertificateFormatError
from certify.lyapunov import extents
from certify.report.partition import Leaves, rebuild_leaves
from certify.report.sampling import (
    Field,
    Flow,
    SimulatedRoa,
    quadratic,
    simulate,
    simulated_roa_fraction,
    time_scales,
)
from certify.report.words import label, symbol, units_of

Array = NDArray[np.float64]

INK, MUTED, RULE = "#1f2933", "#6b7785", "#d5dae0"
SET, SET_FILL = "#1d5fa3", "#dbe8f5"
LOCAL, LOCAL_FILL = "#14795a", "#bfe5d6"
GROWTH, GROWTH_FILL = "#b03a48", "#f3d9db"
SIMULATED, LEAVING = "#8a94a0", "#c9813a"
_FONTS = "system-ui, -apple-system, &quot;Segoe UI&quot;, Helvetica, Arial, &quot;DejaVu Sans&quot;, sans-serif"
_RASTER_FROM = 3000  # leaves
_MOST_LEAVES = 400_000
_GRID = 101
_ON_BOUNDARY = 14  # trajectories that start on the certified boundary, in each plane
_PATH_STEP = 0.6  # of the step of `time_scales`
_MOST_STEPS = 500
_PARTS = 3  # pieces that each step is drawn in
_RC: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.unicode_minus": True,
    "text.color": INK,
    "text.parse_math": False,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.fontsize": 8.0,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "svg.fonttype": "none",
    "svg.hashsalt": "certify",
}


@dataclass(frozen=True, slots=True)
class Picture:
    """One figure of a report.

    Parameters
    ----------
    title, caption : for the page; the caption says what is simulated or sampled.
    svg : the drawing.
    simulated : whether anything in it comes from simulation or a grid.
    wide : whether it takes the page's full width.
    """

    title: str
    caption: str
    svg: str
    simulated: bool
    wide: bool = False

    @property
    def data_uri(self) -> str:
        """The drawing for an `img` element: nothing in it can run or reach out."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg.encode("utf-8")).decode("ascii")


def is_ellipsoid(certificate: Certificate) -> bool:
    """Whether `{V <= c2}` is one, in floats, with levels in order; a rejected file may hold anything."""
    P = certificate.P
    positive = np.all(np.isfinite(P)) and np.all(np.linalg.eigvalsh((P + P.T) / 2) > 0)
    return bool(positive) and 0 < certificate.inner <= certificate.roa < np.inf


class _Scene:
    """What the figures of one certificate share."""

    def __init__(self, certificate: Certificate, accepted: bool) -> None:
        if not is_ellipsoid(certificate):
            raise CertificateFormatError("P must be positive definite and the levels positive and in order.")
        self.certificate = certificate
        self.word = "certified" if accepted else "claimed"
        self.system, self.P, self.c1, self.c2 = (
            certificate.system, certificate.P, certificate.inner, certificate.roa,
        )  # fmt: skip
        self.loop = ClosedLoop(self.system, certificate.network)
        self.flow = Flow.of(self.loop)
        self.lo, self.hi = self.flow.lo, self.flow.hi
        self.step, self.horizon = time_scales(self.flow)
        self.n = self.system.n
        units = units_of(self.system)
        self.labels = [label(s.name, units.get(s.name, "")) for s in self.system.states]
        self.input_labels = [label(s.name, units.get(s.name, "")) for s in self.system.inputs]
        # Another solver's word has no leaves; the partition in z, x = T z, is drawn only if it is small enough.
        evidence = certificate.evidence
        self.T, self.root = np.eye(self.n), np.ones(self.n)
        self.leaves: Leaves | None = None
        if isinstance(evidence, PartitionTree) and len(evidence.tree) <= 2 * _MOST_LEAVES:
            self.T, self.root = evidence.T, evidence.root
            self.leaves = rebuild_leaves(evidence.tree, evidence.root)

    def vdot(self, x: Array) -> Array:
        """Vdot in float64; NaN where the equations have a pole."""
        with np.errstate(all="ignore"):
            value = 2 * np.einsum("...i,...i->...", x @ self.P, self.flow.field(x))
        return np.where(np.isfinite(value), value, np.nan)

    def simulate(self, starts: Array, steps: int | None = None) -> Array:
        """Trajectories for a picture, by default over half the horizon."""
        step = _PATH_STEP * self.step
        count = steps or min(int(0.5 * self.horizon / step) + 1, _MOST_STEPS)
        return _refine(simulate(self.flow, starts, step, count), self.flow.field, step)

    def plane(self, i: int, j: int, points: int = _GRID) -> tuple[Array, Array, Array]:
        """Grid coordinates along states i and j, and the states themselves (all others 0)."""
        a, b = (np.linspace(self.lo[k], self.hi[k], points) for k in (i, j))
        x = np.zeros((points, points, self.n))
        x[..., i], x[..., j] = a[None, :], b[:, None]
        return a, b, x


def draw(certificate: Certificate, accepted: bool) -> tuple[list[Picture], SimulatedRoa | None]:
    """All figures of a certificate, and the simulated region of attraction where there is one (n <= 2).

    Parameters
    ----------
    accepted : whether the checker accepted it; if not, the captions speak of claims.
    """
    import matplotlib

    with matplotlib.rc_context(_RC):
        scene = _Scene(certificate, accepted)
        roa = None
        if scene.n <= 2:
            roa = simulated_roa_fraction(scene.system, certificate.network, scene.P, scene.c2)
        pictures = _line_figures(scene, roa) if scene.n == 1 else _plane_figures(scene, roa)
    return pictures, roa


def _line_figures(scene: _Scene, roa: SimulatedRoa | None) -> list[Picture]:
    x = np.linspace(scene.lo[0], scene.hi[0], 601)[:, None]
    r1, r2 = (float(extents(scene.P, c)[0]) for c in (scene.c1, scene.c2))
    figure, axes = _figure(7.6, 3.4, right=2.1)
    vdot = scene.vdot(x)
    axes.axhline(0, color=MUTED, lw=0.7)
    axes.axvspan(-r2, r2, color=SET_FILL, lw=0, label=f"{scene.word} set")
    axes.axvspan(-r1, r1, color=LOCAL_FILL, lw=0, label="local set")
    axes.plot(x[:, 0], vdot, color=INK, label="V̇ (float64, not proved)")
    axes.fill_between(x[:, 0], 0, vdot, where=vdot >= 0, color=GROWTH_FILL, lw=0, label="V̇ ≥ 0 (not proved)")
    if roa is not None:
        inside = roa.axes[0][roa.attracted]
        if inside.size:
            ends = [float(inside.min()), float(inside.max())]
            axes.plot(ends, [0, 0], color=LEAVING, lw=2.4, label="simulated ROA (not proved)")
    if scene.leaves is not None and len(scene.leaves) <= _RASTER_FROM:
        edges = scene.leaves.lower[:, 0] * scene.T[0, 0]
        axes.plot(edges, np.zeros_like(edges), "|", ms=5, color=SET, label="leaves")
    axes.set_xlim(scene.lo[0], scene.hi[0])
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel("V̇")
    _legend_beside(axes)
    first = Picture(
        "V̇ along the state",
        f"Shaded: the {scene.word} interval. The curve of V̇ and the interval where runs settle come from floating "
        "point and simulation; they are not proved.",
        _svg(figure), True, wide=True,
    )  # fmt: skip
    figure, axes = _figure(4.2, 3.6)
    u = scene.loop.policy(x)
    for k, name in enumerate(scene.input_labels):
        axes.plot(x[:, 0], u[:, k], color=(INK, SET, LOCAL, GROWTH)[k % 4], label=name)
    axes.axvspan(-r2, r2, color=SET_FILL, lw=0, zorder=0)
    axes.set_xlim(scene.lo[0], scene.hi[0])
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel(", ".join(scene.input_labels))
    caption = f"u = π(x) over the domain; shaded: the {scene.word} interval."
    second = Picture("The policy", caption, _svg(figure), False)
    starts = np.array([[-0.999 * r2], [-0.5 * r2], [0.5 * r2], [0.999 * r2]])
    return [first, second, _decay(scene, scene.simulate(starts))]


def _plane_figures(scene: _Scene, roa: SimulatedRoa | None) -> list[Picture]:
    pairs = planes(scene)
    paths = scene.simulate(_starts(scene, pairs))
    pictures = [_portrait(scene, pair, paths, roa, single=len(pairs) == 1) for pair in pairs]
    if scene.n == 2:
        pictures.append(_near_origin(scene))
    if scene.leaves is not None:
        pictures.append(_partition(scene, scene.leaves))
    pictures.append(_policy(scene, pairs[0]))
    pictures.append(_decay(scene, paths[:, :_ON_BOUNDARY]))
    return pictures


def planes(scene: _Scene) -> list[tuple[int, int]]:
    """Pairs of states to show: each position with its rate where names tell, else neighbours; three at most."""
    names = [s.name for s in scene.system.states]
    pairs = [(i, names.index(f"{name}_dot")) for i, name in enumerate(names) if f"{name}_dot" in names]
    return (pairs or [(i, i + 1) for i in range(0, scene.n - 1, 2)])[:3]


def _portrait(scene: _Scene, pair: tuple[int, int], paths: Array, roa: SimulatedRoa | None, *, single: bool) -> Picture:
    from matplotlib.collections import LineCollection
    from matplotlib.patches import Patch, Rectangle

    i, j = pair
    figure, axes = _figure(7.6, 4.9, right=1.95) if single else _figure(4.2, 4.4, bottom=1.35)
    small = 0.8 if single else 0.6
    a, b, x = scene.plane(i, j)
    vdot = scene.vdot(x)
    handles: list[Any] = []
    sign = ""
    ellipse = _ellipse(scene.P, pair, scene.c2)
    axes.fill(*ellipse, color=SET_FILL, lw=0, zorder=1)
    growing = (vdot >= 0) & np.any(x != 0, axis=-1)
    if np.any(growing) and not np.all(growing):
        axes.contourf(a, b, vdot, levels=[0, np.inf], colors=[GROWTH_FILL], zorder=0)
        axes.contour(a, b, vdot, levels=[0.0], colors=[GROWTH], linewidths=1.0, zorder=3)
        handles.append(Patch(facecolor=GROWTH_FILL, edgecolor=GROWTH, lw=1.0, label="V̇ ≥ 0 on a grid*"))
    elif not np.any(growing):
        sign = " V̇ < 0 at every grid point, so that no line V̇ = 0 appears.*"
    settled = _settled(scene, paths)
    for keep, colour, text in (
        (settled, SIMULATED, "trajectories that settle*"),
        (~settled, LEAVING, "trajectories that leave*"),
    ):
        lines = [_thin(paths[:, k][:, [i, j]], scene, pair) for k in np.flatnonzero(keep)]
        lines = [line for line in lines if len(line) > 1]
        if lines:
            axes.add_collection(LineCollection(lines, colors=colour, linewidths=small, zorder=2))
            _arrows(axes, lines, colour, scene, pair)
            handles.append(_line(colour, small, text))
    if roa is not None and np.any(roa.attracted) and not np.all(roa.attracted):
        inside = roa.attracted.T.astype(np.float64)
        axes.contour(*roa.axes, inside, levels=[0.5], colors=[LEAVING], linewidths=1.2, linestyles="--", zorder=3)
        handles.append(_line(LEAVING, 1.2, "simulated ROA*", "--"))
    axes.plot(*ellipse, color=SET, lw=1.8, zorder=4)
    handles.insert(0, _line(SET, 1.8, f"{scene.word} set, V = {scene.c2:.4g}"))
    if scene.n > 2:
        axes.plot(*_shadow(scene.P, pair, scene.c2), color=SET, lw=1.0, ls=":", zorder=4)
        handles.insert(1, _line(SET, 1.0, "its projection", ":"))
    local = _ellipse(scene.P, pair, scene.c1)
    axes.fill(*local, color=LOCAL_FILL, lw=0, zorder=1.5)
    axes.plot(*local, color=LOCAL, lw=1.4, zorder=3.5)
    handles.insert(1, _line(LOCAL, 1.4, f"local set, V = {scene.c1:.3g}"))
    width, height = scene.hi[i] - scene.lo[i], scene.hi[j] - scene.lo[j]
    box = Rectangle((scene.lo[i], scene.lo[j]), width, height, fill=False, ec=INK, lw=1.0, zorder=4)
    axes.add_patch(box)
    handles.append(_line(INK, 1.0, "domain"))
    axes.set_xlim(scene.lo[i] - 0.03 * width, scene.hi[i] + 0.03 * width)
    axes.set_ylim(scene.lo[j] - 0.03 * height, scene.hi[j] + 0.03 * height)
    axes.set_xlabel(scene.labels[i])
    axes.set_ylabel(scene.labels[j])
    axes.spines[["left", "bottom"]].set_visible(False)  # the domain's box is frame enough
    if single:
        _legend_beside(axes, handles)
    else:
        axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2)
    what = "" if scene.n == 2 else (
        f"Section through the origin, all states but {scene.labels[i]} and {scene.labels[j]} being 0; trajectories are "
        "projected onto it. "
    )  # fmt: skip
    return Picture(
        "Phase portrait" if scene.n == 2 else f"Section {_title(scene, pair)}",
        f"{what}Blue: the {scene.word} set, in which every trajectory converges to the origin. "
        f"*\N{NO-BREAK SPACE}Simulated or evaluated on a grid, not proved.{sign}",
        _svg(figure), True, wide=single,
    )  # fmt: skip


def _near_origin(scene: _Scene) -> Picture:
    from matplotlib.collections import LineCollection

    figure, axes = _figure(4.2, 3.6)
    reach = 2.6 * extents(scene.P, scene.c1)
    if scene.leaves is not None:
        _add_leaves(axes, scene, scene.leaves, (0, 1), within=reach)
    paths = scene.simulate(_on_level(scene.P, _circle(14), min(9 * scene.c1, 0.999 * scene.c2)), steps=60)
    lines = [_thin(paths[:, k], _Box(-reach, reach), (0, 1)) for k in range(paths.shape[1])]
    axes.add_collection(LineCollection(lines, colors=SIMULATED, linewidths=0.8, zorder=3))
    axes.fill(*_ellipse(scene.P, (0, 1), scene.c1), facecolor=LOCAL_FILL, edgecolor=LOCAL, lw=1.6, zorder=2)
    axes.plot(*_ellipse(scene.P, (0, 1), scene.c2), color=SET, lw=1.6, zorder=4)
    axes.plot(0, 0, "o", ms=3, color=INK, zorder=5)
    axes.set_xlim(-reach[0], reach[0])
    axes.set_ylim(-reach[1], reach[1])
    axes.ticklabel_format(style="sci", scilimits=(-2, 3))
    axes.set_xlabel(scene.labels[0])
    axes.set_ylabel(scene.labels[1])
    return Picture(
        "Near the origin",
        f"Green: the local set {{V ≤ {scene.c1:.3g}}}, {scene.word} from the linearisation at all radii at once. "
        "Around it the innermost leaves (blue). Grey trajectories are simulated, not proved.",
        _svg(figure), True,
    )  # fmt: skip


def _partition(scene: _Scene, leaves: Leaves) -> Picture:
    figure, axes = _figure(4.2, 3.6)
    if scene.n == 2:
        corners = _add_leaves(axes, scene, leaves, (0, 1), within=None)
        axes.plot(*_ellipse(scene.P, (0, 1), scene.c2), color=SET, lw=1.6, zorder=4)
        reach = np.max(np.abs(corners), axis=0) * 1.04
        axes.set_xlim(-reach[0], reach[0])
        axes.set_ylim(-reach[1], reach[1])
        axes.set_xlabel(scene.labels[0])
        axes.set_ylabel(scene.labels[1])
        where = "in the plane of the states"
    else:
        first, last = 0, scene.n - 1
        _add_leaves(axes, scene, leaves, (first, last), within=None)
        reach = scene.root[[first, last]] * 1.04
        axes.set_xlim(-reach[0], reach[0])
        axes.set_ylim(-reach[1], reach[1])
        axes.set_xlabel(symbol(f"z{first + 1}"))
        axes.set_ylabel(symbol(f"z{last + 1}"))
        where = "cut by a plane through the origin of the coordinates x = T z"
    return Picture(
        "The leaf partition",
        f"The {_count(len(leaves))} of the certificate, {where}. On each blue one the checker "
        f"{'showed' if scene.word == 'certified' else 'has to show'} V̇ < 0; white ones lie outside the ring between "
        "the two levels.",
        _svg(figure), False,
    )  # fmt: skip


def _add_leaves(axes: Any, scene: _Scene, leaves: Leaves, pair: tuple[int, int], within: Array | None) -> Array:
    """Add the leaves (n = 2: as parallelograms in x; else a cut in z); the corners that were drawn, (N * 4, 2)."""
    from matplotlib.collections import PolyCollection

    i, j = pair
    others = [k for k in range(scene.n) if k not in pair]
    keep = np.all((leaves.lower[:, others] <= 0) & (leaves.upper[:, others] > 0), axis=1)
    lower, upper = leaves.lower[keep], leaves.upper[keep]
    corners = np.stack(
        [np.stack([(lower, upper)[p][:, i], (lower, upper)[q][:, j]], -1) for p, q in ((0, 0), (1, 0), (1, 1), (0, 1))],
        axis=1,
    )
    if scene.n == 2:
        corners = corners @ scene.T.T
    ring = _in_ring(scene, lower, upper)
    if within is not None:
        visible = np.all((corners.min(axis=1) <= within) & (corners.max(axis=1) >= -within), axis=1)
        corners, ring = corners[visible], ring[visible]
    many = len(corners) > _RASTER_FROM
    for kind, face in ((~ring, "#ffffff"), (ring, SET_FILL)):
        if np.any(kind):
            width = 0.15 if many else 0.45
            boxes = PolyCollection(list(corners[kind]), facecolors=face, edgecolors="#8fb0d3", linewidths=width)
            boxes.set_zorder(1)
            boxes.set_rasterized(many)
            axes.add_collection(boxes)
    return np.asarray(corners.reshape(-1, 2))


def _in_ring(scene: _Scene, lower: Array, upper: Array) -> NDArray[np.bool_]:
    """Which leaves meet `c1 <= V <= c2`, by the diagonal of `T'PT`: for colour only."""
    T = scene.T
    weight = np.diag(T.T @ scene.P @ T)
    near, far = np.clip(0.0, lower, upper), np.maximum(np.abs(lower), np.abs(upper))
    return np.asarray((near**2 @ weight <= scene.c2) & (far**2 @ weight >= scene.c1))


def _policy(scene: _Scene, pair: tuple[int, int]) -> Picture:
    from matplotlib.colors import LinearSegmentedColormap
    from matplotlib.figure import Figure

    shown = min(scene.system.m, 4)
    rows = (shown + 1) // 2
    figure = Figure(figsize=(4.2 * min(shown, 2), 3.6 * rows))
    a, b, x = scene.plane(*pair)
    u = scene.loop.policy(x)
    colours = LinearSegmentedColormap.from_list("input", ["#2f5d8a", "#a9c4dd", "#f7f6f2", "#e5c08a", "#a4652a"])
    ellipse = _ellipse(scene.P, pair, scene.c2)
    for k in range(shown):
        left, bottom = 4.2 * (k % 2), 3.6 * (rows - 1 - k // 2)
        axes = _add_axes(figure, left + 0.66, bottom + 0.52, 2.72, 2.96)
        centre = float(scene.loop.u_eq[k])
        spread = max(float(np.max(np.abs(u[..., k] - centre))), 1e-9)
        image = axes.imshow(
            u[..., k], origin="lower", extent=(a[0], a[-1], b[0], b[-1]), aspect="auto", interpolation="bilinear",
            cmap=colours, vmin=centre - spread, vmax=centre + spread,
        )  # fmt: skip
        axes.contour(a, b, u[..., k], levels=11, colors=INK, linewidths=0.35, alpha=0.7, linestyles="solid")
        axes.plot(*ellipse, color=SET, lw=1.6)
        bar = figure.colorbar(image, cax=_add_axes(figure, left + 3.48, bottom + 0.52, 0.1, 2.96))
        bar.outline.set_visible(False)
        bar.set_label(scene.input_labels[k])
        axes.set_xlabel(scene.labels[pair[0]])
        axes.set_ylabel(scene.labels[pair[1]])
    rest = "" if scene.n == 2 else " All other states are 0."
    return Picture(
        "The policy's surface",
        f"u = π(x) over the domain with the boundary of the {scene.word} set.{rest}",
        _svg(figure), False, wide=shown > 1,
    )  # fmt: skip


def _decay(scene: _Scene, paths: Array) -> Picture:
    V = quadratic(scene.P, paths)
    time = _PATH_STEP * scene.step * np.arange(len(V)) / _PARTS
    figure, axes = _figure(4.2, 3.6)
    axes.semilogy(time, np.maximum(V, 1e-300), color=SIMULATED, lw=0.8)
    axes.axhline(scene.c2, color=SET, lw=1.4)
    axes.axhline(scene.c1, color=LOCAL, lw=1.4)
    apart = scene.c1 < 0.5 * scene.c2
    for level, name, colour in ((scene.c2, "c₂", SET), (scene.c1, "c₁", LOCAL))[: 1 + apart]:
        axes.annotate(name, (time[-1], level), (2, 2), textcoords="offset points", color=colour, fontsize=9)
    floor = float(np.nanmin(V[-1])) if np.any(np.isfinite(V[-1])) else scene.c1
    axes.set_ylim(max(min(floor, scene.c1 / 10), 1e-14 * scene.c2), scene.c2 * 4)
    axes.set_xlim(0, time[-1])
    _plain_powers(axes)
    axes.set_xlabel("time (s)")
    axes.set_ylabel("V(x(t))")
    return Picture(
        "V along trajectories",
        f"V from starting points on and in the {scene.word} set: simulated, not proved. That V falls to 0 is "
        f"{'proved' if scene.word == 'certified' else 'claimed'}; how fast is not.",
        _svg(figure), True,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class _Box:
    lo: Array
    hi: Array


def _figure(width: float, height: float, *, right: float = 0.14, bottom: float = 0.52) -> tuple[Any, Any]:
    """A figure with one set of axes; sizes in inches. Margins are fixed: measuring all texts would double the time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, _add_axes(figure, 0.66, bottom, width - 0.66 - right, height - bottom - 0.12)


def _add_axes(figure: Any, left: float, bottom: float, width: float, height: float) -> Any:
    """Axes at a place given in inches, with few ticks."""
    W, H = figure.get_size_inches()
    axes = figure.add_axes((left / W, bottom / H, width / W, height / H))
    axes.locator_params(nbins=6)
    return axes


def _svg(figure: Any) -> str:
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    FigureCanvasSVG(figure).print_svg(buffer, metadata=metadata)
    text = buffer.getvalue()
    return text[text.index("<svg") :].replace("'DejaVu Sans', sans-serif", _FONTS)


def _legend_beside(axes: Any, handles: Sequence[Any] | None = None) -> None:
    options: dict[str, Any] = {} if handles is None else {"handles": handles}
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), handlelength=1.6, labelspacing=0.7, **options)


def _line(colour: str, width: float, text: str, style: str = "-") -> Any:
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, lw=width, ls=style, label=text)


def _plain_powers(axes: Any) -> None:
    """Decades as 10⁻³ in Unicode: no mathematical layout engine is needed for them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    digits = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    axes.yaxis.set_major_locator(LogLocator(numticks=7))
    axes.yaxis.set_minor_locator(NullLocator())
    powers = FuncFormatter(lambda v, _: "10" + str(round(np.log10(v))).translate(digits) if v > 0 else "")
    axes.yaxis.set_major_formatter(powers)


def _circle(count: int) -> Array:
    angle = 2 * np.pi * (np.arange(count) + 0.5) / count
    return np.stack([np.cos(angle), np.sin(angle)], -1)


def _on_level(P: Array, directions: Array, level: float) -> Array:
    """Points with `x'Px = level`: `sqrt(level) L'^-1 d` for unit vectors d and `P = L L'`."""
    return np.asarray(np.sqrt(level) * np.linalg.solve(np.linalg.cholesky(P).T, directions.T).T)


def _ellipse(P: Array, pair: tuple[int, int], level: float) -> tuple[Array, Array]:
    """The boundary of the section of `{V <= level}` with the plane of two states."""
    points = _on_level(P[np.ix_(pair, pair)], _circle(240), level)
    closed = np.concatenate([points, points[:1]])
    return closed[:, 0], closed[:, 1]


def _shadow(P: Array, pair: tuple[int, int], level: float) -> tuple[Array, Array]:
    """The boundary of the projection of `{V <= level}` onto the plane of two states."""
    inverse = np.linalg.inv(P)[np.ix_(pair, pair)]
    return _ellipse(np.asarray(np.linalg.inv((inverse + inverse.T) / 2), dtype=np.float64), (0, 1), level)


def _starts(scene: _Scene, pairs: Sequence[tuple[int, int]]) -> Array:
    """Starting points in the planes: around the certified boundary and, for two states, along the domain's edge."""
    blocks = []
    for pair in pairs:
        block = np.zeros((_ON_BOUNDARY, scene.n))
        block[:, list(pair)] = _on_level(scene.P[np.ix_(pair, pair)], _circle(_ON_BOUNDARY), 0.999 * scene.c2)
        blocks.append(block)
    if scene.n == 2:
        edge = 2 * np.pi * (np.arange(22) + 0.25) / 22
        ring = np.stack([np.cos(edge), np.sin(edge)], -1)
        ring /= np.max(np.abs(ring), axis=1, keepdims=True)
        middle, half = (scene.lo + scene.hi) / 2, (scene.hi - scene.lo) / 2
        blocks.append(middle + 0.985 * half * ring)
    return np.concatenate(blocks)


def _settled(scene: _Scene, paths: Array) -> NDArray[np.bool_]:
    """Runs that end deep inside the certified set."""
    with np.errstate(invalid="ignore"):
        return np.asarray(quadratic(scene.P, paths[-1]) <= 0.1 * scene.c2)


def _refine(path: Array, field: Field, step: float) -> Array:
    """Each step in `_PARTS` pieces by cubic Hermite interpolation, so that curves look as smooth as they are."""
    with np.errstate(all="ignore"):
        slope = step * field(path)
    x0, x1, f0, f1 = path[:-1], path[1:], slope[:-1], slope[1:]
    fine = np.empty((_PARTS * (len(path) - 1) + 1, *path.shape[1:]))
    fine[::_PARTS] = path
    for k in range(1, _PARTS):
        t = k / _PARTS
        bend = t * (1 - t) ** 2 * f0 - t**2 * (1 - t) * f1
        fine[k::_PARTS] = (1 + 2 * t) * (1 - t) ** 2 * x0 + t**2 * (3 - 2 * t) * x1 + bend
    return fine


def _thin(path: Array, box: _Scene | _Box, pair: tuple[int, int]) -> Array:
    """Drop points that lie closer together than 1/250 of the picture; the end is where NaN begins."""
    path = path[np.all(np.isfinite(path), axis=1)]
    if len(path) < 3:
        return path
    scale = np.array([box.hi[k] - box.lo[k] for k in pair])
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0) / scale, axis=1))])
    _, first = np.unique(np.floor(travelled * 250), return_index=True)
    return np.asarray(path[np.unique(np.append(first, len(path) - 1))])


def _arrows(axes: Any, lines: Sequence[Array], colour: str, scene: _Scene, pair: tuple[int, int]) -> None:
    """An arrow head a quarter of the way along each line."""
    scale = np.array([scene.hi[k] - scene.lo[k] for k in pair])
    heads, directions = [], []
    for line in lines:
        k = max(1, len(line) // 4)
        d = (line[k] - line[k - 1]) / scale
        if np.any(d != 0):
            heads.append(line[k])
            directions.append(d / np.linalg.norm(d))
    if heads:
        (x, y), (dx, dy) = np.array(heads).T, np.array(directions).T
        axes.quiver(  # directions are shares of the axes, which are wider than high
            x, y, dx, 0.8 * dy, angles="uv", color=colour, pivot="mid", scale=42, width=0.0035,
            headwidth=4.5, headlength=5.5, headaxislength=5.0, minlength=0, zorder=3,
        )  # fmt: skip


def _count(leaves: int) -> str:
    return f"{leaves:,} leaves" if leaves != 1 else "one leaf"


def _title(scene: _Scene, pair: tuple[int, int]) -> str:
    return ", ".join(symbol(scene.system.states[k].name) for k in pair)
