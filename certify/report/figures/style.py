"""The style of figures: colours, fonts, sizes in inches, legends, and the drawing as SVG.

A drawing brings its own dark colours: the page's style sheet does not reach an image, but the image can ask the
reader's device for its colour scheme. Print stays light.
"""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

INK, MUTED = "#1f2933", "#6b7785"
SET, SET_FILL = "#1d5fa3", "#dbe8f5"
INNER, INNER_FILL = "#14795a", "#bfe5d6"
START, START_FILL = "#a3297a", "#f4dfec"
GROWTH, GROWTH_FILL = "#b03a48", "#f3d9db"
SIMULATED, LEAVING, UNSETTLED, REGION = "#8a94a0", "#c9813a", "#8466ad", "#7a4c12"
EDGE, EDGE_FILL = "#4d4d4d", "#dedede"
PAPER, LEAF_EDGE = "#ffffff", "#8fb0d3"
_DARK = {
    INK: "#e4e8ec", MUTED: "#a4adb8", SET: "#7db8f0", SET_FILL: "#1d3a57", INNER: "#5ccaa3", INNER_FILL: "#1c4d3f",
    START: "#ee8fc9", START_FILL: "#472a3e", GROWTH: "#f08c99", GROWTH_FILL: "#4b2830",
    SIMULATED: "#87919c", LEAVING: "#e3a35f", UNSETTLED: "#bda2e4", REGION: "#e8c48a", PAPER: "#161b20",
    LEAF_EDGE: "#41668c", EDGE: "#c4c4c4", EDGE_FILL: "#3b3f44",
}  # fmt: skip
RASTER_FROM = 3000  # leaves, from which on they are drawn as an image
_FONTS = "system-ui, -apple-system, &quot;Segoe UI&quot;, Helvetica, Arial, &quot;DejaVu Sans&quot;, sans-serif"
RC: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
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
class Key:
    """An entry of a legend.

    Parameters
    ----------
    text : its meaning; a star marks simulation or a grid.
    colour : colour of the line, or of the area's boundary.
    width : width of the line in points, 0 for none.
    style : style of the line, `-`, `--` or `:`.
    fill : the area's colour; None for a line.
    """

    text: str
    colour: str
    width: float = 1.2
    style: Literal["-", "--", ":"] = "-"
    fill: str | None = None

    @property
    def border(self) -> str:
        """The line's style as CSS names it."""
        return {"-": "solid", "--": "dashed", ":": "dotted"}[self.style]

    def handle(self) -> Any:
        """For a legend inside a drawing."""
        from matplotlib.lines import Line2D
        from matplotlib.patches import Patch

        if self.fill is not None:
            return Patch(facecolor=self.fill, edgecolor=self.colour, lw=self.width, ls=self.style, label=self.text)
        return Line2D([], [], color=self.colour, lw=self.width, ls=self.style, label=self.text)


@dataclass(frozen=True, slots=True)
class Picture:
    """One figure of a report.

    Parameters
    ----------
    title, caption : texts for the page; the caption marks simulated or sampled parts.
    svg : the drawing.
    simulated : True if anything in it comes from simulation or a grid.
    wide : True if it takes the page's full width.
    legend : legend of its colours; consecutive pictures with the same legend share it.
    about : text above the pictures that share a legend.
    """

    title: str
    caption: str
    svg: str
    simulated: bool
    wide: bool = False
    legend: tuple[Key, ...] = ()
    about: str = ""

    @property
    def data_uri(self) -> str:
        """The drawing for an `img` element: nothing in it can run or reach out."""
        return "data:image/svg+xml;base64," + base64.b64encode(self.svg.encode("utf-8")).decode("ascii")


def figure_of(
    width: float, height: float, *, left: float = 0.66, right: float = 0.14, bottom: float = 0.52
) -> tuple[Any, Any]:
    """A figure with one set of axes; sizes in inches. Margins are fixed: measuring all texts would double the time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, add_axes(figure, left, bottom, width - left - right, height - bottom - 0.12)


def add_axes(figure: Any, left: float, bottom: float, width: float, height: float) -> Any:
    """Axes at a place given in inches, with few ticks."""
    W, H = figure.get_size_inches()
    axes = figure.add_axes((left / W, bottom / H, width / W, height / H))
    axes.locator_params(nbins=6)
    return axes


def to_svg(figure: Any) -> str:
    """The drawing, without the date."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    buffer = io.StringIO()
    metadata = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    FigureCanvasSVG(figure).print_svg(buffer, metadata=metadata)
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace("'DejaVu Sans', sans-serif", _FONTS)
    head = text.index(">") + 1
    return f"{text[:head]}\n <style>{dark_style()}</style>{text[head:]}"


def dark_style() -> str:
    """The rules that give a drawing, and the samples of a legend, their dark colours."""
    swaps = [
        f'[style*="{what}: {light}"]{{{what}:{dark} !important}}'
        for light, dark in _DARK.items()
        for what in ("fill", "stroke")
    ]
    # Images of a partition or a surface hold no colours that could be named one by one.
    turned = "image{filter:invert(.9) hue-rotate(180deg)}"
    return f"@media screen and (prefers-color-scheme: dark){{{''.join(swaps)}{turned}}}"


def legend_style() -> str:
    """The colours of legends as the page's style sheet gives them, light and dark, by the light colour's digits."""
    light = "".join(f"--c{colour[1:]}:{colour};" for colour in _DARK)
    dark = "".join(f"--c{colour[1:]}:{other};" for colour, other in _DARK.items())
    return f":root{{{light}}}@media screen and (prefers-color-scheme: dark){{:root{{{dark}}}}}"


def plain_powers(axes: Any) -> None:
    """Decades as 10⁻³ in Unicode: no mathematical layout engine is needed for them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    digits = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    axes.yaxis.set_major_locator(LogLocator(numticks=7))
    axes.yaxis.set_minor_locator(NullLocator())
    powers = FuncFormatter(lambda v, _: "10" + str(round(np.log10(v))).translate(digits) if v > 0 else "")
    axes.yaxis.set_major_formatter(powers)
