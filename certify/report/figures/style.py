"""How figures look: colours, fonts, sizes in inches, and the drawing as SVG."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

INK, MUTED = "#1f2933", "#6b7785"
SET, SET_FILL = "#1d5fa3", "#dbe8f5"
INNER, INNER_FILL = "#14795a", "#bfe5d6"
GROWTH, GROWTH_FILL = "#b03a48", "#f3d9db"
SIMULATED, LEAVING = "#8a94a0", "#c9813a"
RASTER_FROM = 3000  # leaves, from which on they are drawn as an image
_FONTS = "system-ui, -apple-system, &quot;Segoe UI&quot;, Helvetica, Arial, &quot;DejaVu Sans&quot;, sans-serif"
RC: dict[str, Any] = {
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


def figure_of(width: float, height: float, *, right: float = 0.14, bottom: float = 0.52) -> tuple[Any, Any]:
    """A figure with one set of axes; sizes in inches. Margins are fixed: measuring all texts would double the time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    return figure, add_axes(figure, 0.66, bottom, width - 0.66 - right, height - bottom - 0.12)


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
    return text[text.index("<svg") :].replace("'DejaVu Sans', sans-serif", _FONTS)


def legend_beside(axes: Any, handles: Sequence[Any] | None = None) -> None:
    """The legend at the right of the axes."""
    options: dict[str, Any] = {} if handles is None else {"handles": handles}
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), handlelength=1.6, labelspacing=0.7, **options)


def line(colour: str, width: float, text: str, style: str = "-") -> Any:
    """A legend's line."""
    from matplotlib.lines import Line2D

    return Line2D([], [], color=colour, lw=width, ls=style, label=text)


def plain_powers(axes: Any) -> None:
    """Decades as 10⁻³ in Unicode: no mathematical layout engine is needed for them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

    digits = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")
    axes.yaxis.set_major_locator(LogLocator(numticks=7))
    axes.yaxis.set_minor_locator(NullLocator())
    powers = FuncFormatter(lambda v, _: "10" + str(round(np.log10(v))).translate(digits) if v > 0 else "")
    axes.yaxis.set_major_formatter(powers)
