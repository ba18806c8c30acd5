"""The style of figures: as wide as a page of the documentation, so that a printed letter keeps its size there.

A page shows a picture some 700 pixels wide whatever its own width is. Figures are therefore `WIDTH` inches wide, and
what does not fit is put below, not beside. Lines bear their names where there is room, in their own colour.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from controllers.comparison.methods import Run

Array = NDArray[np.float64]

WIDTH = 7.4  # inches
INK, MUTED, PALE = "#1f2933", "#6b7785", "#d5dae0"
COLOURS: dict[Run, str] = {  # Okabe and Ito's, told apart with any colour vision
    "ours": "#0072b2",
    "sac": "#d55e00",
    "before": "#56b4e9",
    "uncentred": "#e69f00",
    "sb3-sac": "#009e73",
    "sb3-ppo": "#cc79a7",
}
DEEP: dict[Run, str] = {  # the same hues for letters: those above are too light on white
    "ours": "#005f96",
    "sac": "#b34e00",
    "before": "#1f7cb4",
    "uncentred": "#946200",
    "sb3-sac": "#007a58",
    "sb3-ppo": "#a84b80",
}
_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.0,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.linewidth": 0.7,
    "grid.color": "#e4e8ec",
    "grid.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "figure.titlesize": 10.0,
    "text.color": INK,
    "xtick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.color": MUTED,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
}
_DPI, _SHADES = 160, 256


def drawn(build: Callable[[], Any]) -> bytes:
    """The figure that `build` makes, in this style, as PNG; equal figures give equal bytes.

    A palette of 256 colours says all that these lines say, in a fraction of the bytes.
    """
    import matplotlib
    from PIL import Image

    with matplotlib.rc_context(_STYLE):
        figure, buffer = build(), io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    image, smaller = Image.open(buffer).convert("RGB"), io.BytesIO()
    image.quantize(_SHADES, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        smaller, format="PNG", optimize=True
    )
    return smaller.getvalue()


def count(number: int, one: str, many: str = "") -> str:
    """A number of things in words.

    >>> count(1, "seed"), count(3, "seed"), count(2, "trajectory", "trajectories")
    ('1 seed', '3 seeds', '2 trajectories')
    """
    return f"{number} {one if number == 1 else many or one + 's'}"


def seeds_of(numbers: Sequence[int]) -> str:
    """The seeds in words.

    >>> seeds_of([0]), seeds_of([2, 0, 1]), seeds_of([0, 2, 5])
    ('seed 0', 'seeds 0 to 2', 'seeds 0, 2, 5')
    """
    found = sorted(set(numbers))
    if len(found) == 1:
        return f"seed {found[0]}"
    if found == list(range(found[0], found[-1] + 1)):
        return f"seeds {found[0]} to {found[-1]}"
    return f"seeds {', '.join(map(str, found))}"


def spread(places: Sequence[float], room: float) -> list[float]:
    """Places of labels that keep at least `room` between them and stay near where they belong.

    Places that come too close are moved apart around their middle; their order stays.

    >>> spread([0.0, 4.0, 0.0], 1.0)
    [-0.5, 4.0, 0.5]
    """
    order = sorted(range(len(places)), key=lambda k: places[k])
    groups: list[tuple[list[int], float]] = []  # labels, and the place of the first
    for k in order:
        groups.append(([k], places[k]))
        while len(groups) > 1 and groups[-1][1] < groups[-2][1] + room * len(groups[-2][0]):
            members = groups[-2][0] + groups[-1][0]
            mean = sum(places[j] - room * i for i, j in enumerate(members)) / len(members)
            groups[-2:] = [(members, mean)]
    found = [0.0] * len(places)
    for members, first in groups:
        for i, k in enumerate(members):
            found[k] = first + room * i
    return found


def name_lines(panel: Any, named: Sequence[tuple[float, str, str]], height: float = 0.062) -> None:
    """Names at the right of a panel, each at the height of its line's end and none on another.

    Parameters
    ----------
    named : for each line the value at its end, which may not be finite, the name, and its colour.
    height : room that a name of one line takes, as a share of the panel's height; of two lines twice.
    """
    if not named:
        return
    lines = max(name.count("\n") + 1 for _, name, _ in named)
    ends = [_share(panel, value) for value, _, _ in named]
    room = height * lines
    places = np.array(spread(ends, room))
    highest, lowest = 1 - room / 2, room / 2
    if places.max() > highest:  # pushed beyond the top: those below make room
        places = _pressed(places, highest, room)
    if places.min() < lowest:
        places = -_pressed(-places, -lowest, room)
    for (_, name, colour), end, place in zip(named, ends, places, strict=True):
        panel.annotate(
            name,
            (1.0, end),
            xytext=(1.035, place),
            xycoords="axes fraction",
            textcoords="axes fraction",
            va="center",
            color=colour,
            fontsize=8.5,
            linespacing=1.05,
            annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "lw": 0.6, "shrinkA": 0, "shrinkB": 0, "relpos": (0, 0.5)},
        )


def _share(panel: Any, value: float) -> float:
    """The height of a value between the panel's bottom, 0, and its top, 1; all else at an edge."""
    lo, hi = panel.get_ylim()
    if not math.isfinite(value):
        return 1.0
    if panel.get_yscale() == "log":
        if value <= 0:
            return 0.0
        lo, hi, value = math.log10(lo), math.log10(hi), math.log10(value)
    return float(min(1.0, max(0.0, (value - lo) / (hi - lo))))


def _pressed(places: Array, highest: float, room: float) -> Array:
    """Places moved down, and apart where they come too close, so that none is above `highest`."""
    found, top = places.copy(), highest
    for k in np.argsort(-places, kind="stable"):
        found[k] = min(found[k], top)
        top = found[k] - room
    return found


def log_scale(panel: Any) -> None:
    """A logarithmic axis of values, if there is a positive number to show; one without has no such scale."""
    values = [np.asarray(line.get_ydata(), dtype=np.float64) for line in panel.lines]
    if any((np.isfinite(v) & (v > 0)).any() for v in values):
        panel.set_yscale("log")
