"""The figure for a paper: the proved set alone, one or two columns wide.

A page of a journal has no room for long captions: there is one legend below the panels, fonts have their size in print,
and simulated parts keep their star.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

from certify.certificates import AnyCertificate, InvariantCertificate, ReachCertificate, RemainCertificate
from certify.errors import InputError
from certify.loop.plants import System
from certify.report.figures import region_of, simulated_roa
from certify.report.figures.edges import key_of_edges
from certify.report.figures.line import draw_line
from certify.report.figures.pairs import Pair, named_pairs
from certify.report.figures.portrait import draw_plane, keys
from certify.report.figures.ranks import draw_map, planes_of, reach_ground
from certify.report.figures.scene import Scene
from certify.report.figures.staying import Stage, draw_set
from certify.report.figures.style import INK, PAPER, RC, SET, START, Key
from certify.report.figures.trajectories import runs_from, starts

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = ("pdf", "svg", "png")
_WIDTHS = {1: 3.4, 2: 7.0}  # inches
_SMALL: dict[str, Any] = {
    "font.size": 8.0,
    "axes.labelsize": 8.0,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "legend.fontsize": 7.0,
    "pdf.fonttype": 42,  # text stays text
}
_PNG_DPI = 300
_STAR = "* simulated or on a grid, not proved"


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """Options of the figure.

    Parameters
    ----------
    columns : the figure's width in columns of the page, 1 or 2.
    pairs : states to draw against each other, such as `x,x_dot`; empty for the default pairs.
    format : `pdf`, `svg` or `png`.
    """

    columns: Literal[1, 2] = 1
    pairs: tuple[str, ...] = ()
    format: str = "pdf"

    def __post_init__(self) -> None:
        if self.columns not in _WIDTHS:
            raise InputError(f"`columns` must be 1 or 2; found {self.columns}.")
        if self.format not in FORMATS:
            raise InputError(f"a figure must be one of {', '.join(FORMATS)}; found {self.format!r}. Name the file so.")


def paper_figure(certificate: AnyCertificate, accepted: bool, options: PaperOptions | None = None) -> bytes:
    """The proved set in each pair of states, as a file's bytes; equal certificates give equal bytes.

    Parameters
    ----------
    accepted : True if the checker accepted the certificate; if not, the legend speaks of a claim.

    Raises
    ------
    InputError : a pair is not two states of the plant, or a plant with one state is asked for pairs.
    CertificateFormatError : there is no ellipsoid to draw.
    """
    import matplotlib

    options = options or PaperOptions()
    with matplotlib.rc_context({**RC, **_SMALL}):
        return _bytes(set_figure(certificate, accepted, options), options.format)


def set_figure(certificate: AnyCertificate, accepted: bool, options: PaperOptions | None = None) -> Figure:
    """The same as a matplotlib figure, to change and save.

    Of a region it has the ranks of the boxes that lead there, of a set that is never left its extent.

    Raises
    ------
    InputError, CertificateFormatError : as `paper_figure`.
    """
    import matplotlib

    options = options or PaperOptions()
    if options.pairs and certificate.system.n < 2:
        raise InputError(f"pairs need two states or more; {certificate.system.name} has one. Leave --pairs out.")
    with matplotlib.rc_context({**RC, **_SMALL}):
        if isinstance(certificate, ReachCertificate):
            return _reach_figure(certificate, accepted, options)
        if isinstance(certificate, InvariantCertificate | RemainCertificate):
            return _staying_figure(certificate, accepted, options)
        scene = Scene(certificate, accepted, named_pairs(certificate.system, options.pairs) or None)
        figure, panels, height = _panels(1 if scene.n == 1 else len(scene.pairs), options)
        _put_legend(figure, _draw(scene, panels), height, _star(scene))
    return figure


def _panels(count: int, options: PaperOptions) -> tuple[Figure, list[Any], float]:
    """A figure with that many panels, the panels, and their height in inches."""
    from matplotlib.figure import Figure

    across = min(count, 2 * options.columns if count > 2 * options.columns or count % 2 == 0 else 3)
    across = min(across, 2 if options.columns == 1 else 4)
    down = math.ceil(count / across)
    width = _WIDTHS[options.columns]
    panel = min(0.82 * width / across, 4.0)
    figure = Figure(figsize=(width, 1.0), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel().tolist()
    for spare in panels[count:]:
        spare.set_visible(False)
    for axes in panels[:count]:
        axes.locator_params(nbins=5)
    return figure, panels[:count], down * panel


def _planes(system: System, options: PaperOptions) -> list[Pair]:
    return named_pairs(system, options.pairs) or planes_of(system.n)


def _reach_figure(certificate: ReachCertificate, accepted: bool, options: PaperOptions) -> Figure:
    """The numbers of steps to a region, with a scale of their colours."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    planes, ground = _planes(certificate.system, options), reach_ground(certificate, accepted, close=True)
    figure, panels, height = _panels(len(planes), options)
    drawn = [draw_map(axes, ground, pair) for axes, pair in zip(panels, planes, strict=True)]
    steps = "sampling instants" if ground.sampled else "steps"
    scale = ScalarMappable(Normalize(0.0, ground.most), drawn[0][0]["cmap"])
    bar = figure.colorbar(scale, ax=panels, label=f"{steps} to the region, at most", aspect=30)
    bar.locator = _whole()
    bar.update_ticks()
    legend = (
        Key("the region, on a grid", SET, 1.6),
        Key(f"nothing is {ground.word}", INK, 0.4, fill=PAPER),
        *((key_of_edges(),) if any(broken for _, broken in drawn) else ()),
    )
    _put_legend(figure, legend, height, ground.beside.removeprefix(", ") if ground.n > 2 else "")
    return figure


def _staying_figure(
    certificate: InvariantCertificate | RemainCertificate, accepted: bool, options: PaperOptions
) -> Figure:
    """The extent of a set that is never left."""
    planes, stage = _planes(certificate.system, options), Stage.of(certificate)
    figure, panels, height = _panels(len(planes), options)
    broken = [draw_set(axes, stage, pair) for axes, pair in zip(panels, planes, strict=True)]
    word = "proved" if accepted else "claimed"
    legend = (
        Key(f"{word}: never left, on a grid*", SET, 1.6, fill=f"{SET}40"),
        *((Key("a constraint is violated*", START, 0.0, fill=f"{START}59"),) if any(broken) else ()),
        Key("simulated runs*", INK, 0.6),
    )
    _put_legend(figure, legend, height, _STAR)
    return figure


def _whole() -> Any:
    """Ticks at integers."""
    from matplotlib.ticker import MaxNLocator

    return MaxNLocator(integer=True)


def _draw(scene: Scene, panels: Sequence[Any]) -> tuple[Key, ...]:
    """Fill the panels; the legend of all of them."""
    roa = simulated_roa(scene)
    if scene.n == 1:
        return draw_line(panels[0], scene, roa)
    runs, region = runs_from(scene, starts(scene)), region_of(scene, roa)
    growing = [draw_plane(axes, scene, pair, runs, region) for axes, pair in zip(panels, scene.pairs, strict=True)]
    return keys(scene, runs, region, any(growing))


def _star(scene: Scene) -> str:
    """Explain the star; if values are uncertain, a second line gives those that are simulated."""
    return _STAR + (f",\n{scene.held.strip()}" if scene.held else "")


def _put_legend(figure: Any, legend: Sequence[Key], height: float, star: str) -> None:
    """The legend below the panels, in as many columns as fit; the figure's height in inches follows."""
    width = figure.get_size_inches()[0]
    for columns in range(min(len(legend), 4), 0, -1):
        rows = math.ceil(len(legend) / columns)
        figure.set_size_inches(width, height + 0.16 * (rows + 1 + star.count("\n")) + 0.1)
        placed = figure.legend(
            handles=[key.handle() for key in legend],
            loc="outside lower center",
            ncols=columns,
            handlelength=1.8,
            columnspacing=1.2,
            labelspacing=0.35,
            title=star,
            title_fontsize=6.5,
        )
        figure.draw_without_rendering()
        if columns == 1 or placed.get_window_extent().width <= width * figure.dpi:
            return
        placed.remove()


def _bytes(figure: Any, kind: str) -> bytes:
    """The figure as a file, without the date."""
    buffer = io.BytesIO()
    metadata: dict[str, Any] = {
        "pdf": {"CreationDate": None, "Producer": None, "Creator": None},
        "svg": dict.fromkeys(("Creator", "Date", "Format", "Type")),
        "png": {"Software": None},
    }[kind]
    ground = {"facecolor": "white"} if kind == "png" else {}
    figure.savefig(buffer, format=kind, dpi=_PNG_DPI, metadata=metadata, **ground)
    return buffer.getvalue()
