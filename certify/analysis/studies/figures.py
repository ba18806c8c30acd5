"""The figures of a sweep: a map over two quantities, a line over one, points over names.

A verdict is a word or a sign of its own, never a colour alone: a cell without a proof is hatched and says so, and a
marker has a shape. If more is varied than a figure has directions, there is a figure for each combination of the rest;
if these are too many, they are in the table, and the page says so.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from certify.analysis.studies.rows import Row
from certify.analysis.studies.study import Axis
from certify.certificates.verdict import Verdict
from certify.loop.plants import exact
from certify.report.figures.style import INK, MUTED, RC, Picture, add_axes, figure_of, to_svg
from certify.report.words import below, pretty_unit, symbol, volume_name

_MOST_PANELS, _MOST_SERIES, _MOST_TICKS = 12, 6, 12
_LONG = 14  # characters at a tick
_LIGHT, _DEEP = np.array([0xDC, 0xE9, 0xF6]) / 255, np.array([0x0F, 0x40, 0x76]) / 255  # the same by day and by night
_ON_LIGHT, _ON_DEEP = "#10161c", "#fefefe"
_COLOURS = ("#1d5fa4", "#a3297b", "#14795b", "#c9813b", "#8466ae", "#7a4c13")  # not those that a dark page changes
_MARKERS, _STYLES = ("o", "s", "^", "D", "v", "P"), ("-", "--", ":", "-.", "-", "--")
_SIGNS = {"unknown": "?", "refuted": "R", "trusted": "T", "error": "E", "not run": "\N{EN DASH}"}


@dataclass(frozen=True, slots=True)
class Drawn:
    """The figures, and a sentence about those that are left out; empty if there are none."""

    pictures: tuple[Picture, ...]
    left_out: str = ""


def draw(varied: Sequence[Axis], rows: Sequence[Row]) -> Drawn:
    """The figures of a sweep in which these axes have more than one value."""
    import matplotlib

    numeric = [axis for axis in varied if axis.is_numeric]
    known = [row for row in rows if row.states]
    if not varied or not known:
        return Drawn(())
    with matplotlib.rc_context(RC):
        if len(numeric) >= 2:
            return _maps(numeric[0], numeric[1], [a for a in varied if a not in numeric[:2]], rows)
        across = numeric[0] if numeric else varied[0]
        return _lines(across, [a for a in varied if a is not across], rows)


def word_of(row: Row | None) -> str:
    """A case's end in a word."""
    return "not run" if row is None else "error" if row.failed else row.verdict.value.lower()


def label_of(key: str, units: Mapping[str, str]) -> str:
    """An entry of the study as people read it, with its unit.

    >>> label_of("parameters.m", {"m": "kg"}), label_of("options.sample_time", {}), label_of("policies", {})
    ('m (kg)', 'sample time', 'policy')
    """
    table, _, name = key.partition(".")
    if not name:
        return {"policies": "policy", "systems": "plant", "candidates": "candidate"}[table]
    shown = name.replace("_", " ") if table == "options" else symbol(name)
    if table == "domain":
        shown = f"domain of {shown}"
    unit = pretty_unit(units.get(name, "")) if table != "options" else ""
    return f"{shown} ({unit})" if unit else shown


def _maps(x: Axis, y: Axis, others: Sequence[Axis], rows: Sequence[Row]) -> Drawn:
    """A heat map for each combination of the other axes."""
    combinations = list(product(*(axis.values for axis in others)))
    pictures = []
    for values in combinations[:_MOST_PANELS]:
        fixed = dict(zip((axis.key for axis in others), values, strict=True))
        found = {
            (row.coordinates[x.key], row.coordinates[y.key]): row
            for row in rows
            if all(row.coordinates[key] == value for key, value in fixed.items())
        }
        if any(row.states for row in found.values()):
            pictures.append(_map(x, y, fixed, found))
    return Drawn(tuple(pictures), _left_out(len(combinations), _MOST_PANELS))


def _map(x: Axis, y: Axis, fixed: Mapping[str, str], found: Mapping[tuple[str, str], Row]) -> Picture:
    from matplotlib.patches import Rectangle

    some = next(row for row in found.values() if row.states)
    proved = [r.volume for r in found.values() if r.verdict is Verdict.PROVED and r.volume is not None]
    lo, hi = (min(proved), max(proved)) if proved else (0.0, 1.0)
    words, numbers = len(x.values) <= 9, len(x.values) <= 14
    width, height = 6.6, 1.0 + max(1.6, min(5.6, 0.42 * len(y.values)))
    figure, axes = figure_of(width, height, right=1.5, bottom=0.55)
    for i, a in enumerate(x.values):
        for j, b in enumerate(y.values):
            row = found.get((a, b))
            volume = row.volume if row is not None and row.verdict is Verdict.PROVED else None
            if volume is None:
                word = word_of(row)
                axes.add_patch(Rectangle((i - 0.5, j - 0.5), 1, 1, fc="none", ec=MUTED, lw=0.4, hatch="///"))
                text = axes.text(i, j, word if words else _SIGNS[word], ha="center", va="center", color=INK, size=7.5)
                text.set_bbox({"facecolor": "#ffffff", "edgecolor": "none", "pad": 1.2})
                continue
            share = 1.0 if hi == lo else (volume - lo) / (hi - lo)
            colour = tuple(_LIGHT + share * (_DEEP - _LIGHT))
            axes.add_patch(Rectangle((i - 0.5, j - 0.5), 1, 1, fc=colour, ec=colour, lw=0.4))
            if numbers:
                ink = _ON_DEEP if share > 0.5 else _ON_LIGHT
                axes.text(i, j, below(volume, 3), ha="center", va="center", color=ink, size=7.5)
    _ticks(axes.xaxis, x)
    _ticks(axes.yaxis, y)
    axes.set_xlim(-0.5, len(x.values) - 0.5)
    axes.set_ylim(-0.5, len(y.values) - 0.5)
    axes.set_xlabel(label_of(x.key, some.units))
    axes.set_ylabel(label_of(y.key, some.units))
    size = _size(some)
    if proved:
        _scale(figure, width, height, lo, hi, size)
    signs = "" if words else f" ({', '.join(f'{sign} {word}' for word, sign in _SIGNS.items())})"
    return Picture(
        _title(f"{volume_name(len(some.states))} over {_name(x.key)} and {_name(y.key)}", fixed),
        f"Each cell is a case: the {size} of its proved set, rounded down, or hatched and in a word{signs} where "
        "nothing is proved. Cells are as wide for each value, whatever lies between the values.",
        to_svg(figure),
        simulated=False,
        wide=True,
    )


def _scale(figure: Any, width: float, height: float, lo: float, hi: float, label: str) -> None:
    """The colours beside a map, with their volumes."""
    bar = add_axes(figure, width - 1.25, 0.55, 0.16, height - 0.67)
    steps = 48
    for k in range(steps):
        colour = tuple(_LIGHT + (k + 0.5) / steps * (_DEEP - _LIGHT))
        bar.axhspan(lo + (hi - lo) * k / steps, lo + (hi - lo) * (k + 1) / steps, fc=colour, ec=colour, lw=0.4)
    bar.set_xticks([])
    bar.yaxis.tick_right()
    bar.yaxis.set_label_position("right")
    bar.set_ylabel(label)
    if hi > lo:
        bar.set_ylim(lo, hi)
    else:
        bar.set_yticks([lo])


def _lines(across: Axis, others: Sequence[Axis], rows: Sequence[Row]) -> Drawn:
    """A curve for each combination of the other axes; figures for plants of different states."""
    combinations = list(product(*(axis.values for axis in others)))
    series: dict[tuple[tuple[str, ...], str], list[tuple[str, dict[str, Row]]]] = {}
    for values in combinations:
        fixed = dict(zip((axis.key for axis in others), values, strict=True))
        mine = [row for row in rows if all(row.coordinates[key] == value for key, value in fixed.items())]
        for states in dict.fromkeys(row.states for row in mine if row.states):
            shown = {row.coordinates[across.key]: row for row in mine if row.states in (states, ())}
            some = next(row for row in mine if row.states == states)
            name = ", ".join(f"{_name(key)} {value}" for key, value in fixed.items())
            series.setdefault((states, _size(some)), []).append((name, shown))
    chunks = [
        (kind, curves[k : k + _MOST_SERIES])
        for kind, curves in series.items()
        for k in range(0, len(curves), _MOST_SERIES)
    ]
    pictures = [_line(across, kind[1], curves) for kind, curves in chunks[:_MOST_PANELS]]
    return Drawn(tuple(pictures), _left_out(len(chunks), _MOST_PANELS))


def _line(across: Axis, size: str, curves: Sequence[tuple[str, Mapping[str, Row]]]) -> Picture:
    some = next(row for _, shown in curves for row in shown.values() if row.states)
    figure, axes = figure_of(6.6, 3.4 if across.is_numeric else 3.9, bottom=0.55 if across.is_numeric else 1.1)
    at = [float(exact(v)) for v in across.values] if across.is_numeric else list(range(len(across.values)))
    unproved: set[str] = set()
    for k, (name, shown) in enumerate(curves):
        colour, marker, style = _COLOURS[k], _MARKERS[k], _STYLES[k]
        points = []
        for place, value in zip(at, across.values, strict=True):
            row = shown.get(value)
            if row is not None and row.verdict is Verdict.PROVED and row.volume is not None:
                points.append((place, row.volume))
                continue
            points.append((place, np.nan))
            unproved.add(word_of(row))
            axes.text(
                place, 0.02 + 0.06 * k, _SIGNS[word_of(row)], color=colour, size=8.5, weight="bold", ha="center",
                transform=axes.get_xaxis_transform(),
            )  # fmt: skip
        xs, ys = zip(*points, strict=True)
        axes.plot(
            xs,
            ys,
            marker=marker,
            ms=5,
            ls=style if across.is_numeric else "none",
            color=colour,
            label=name,
            clip_on=False,
        )
    axes.set_ylim(bottom=0)
    if len(curves) > 1:
        axes.legend()
    if across.is_numeric:
        axes.set_xlabel(label_of(across.key, some.units))
    else:
        axes.set_xlim(-0.5, len(at) - 0.5)
        axes.set_xlabel(f"{label_of(across.key, {})} {_ticks(axes.xaxis, across, turned=True)}".rstrip())
    axes.set_ylabel(size)
    signs = ", ".join(f"{_SIGNS[word]} {word}" for word in _SIGNS if word in unproved)
    return Picture(
        f"{volume_name(len(some.states))} over {_name(across.key)}".capitalize(),
        f"Each point is a case: the {size} of its proved set."
        + (f" Signs at the bottom are cases without a proof: {signs}." if signs else ""),
        to_svg(figure),
        simulated=False,
        wide=True,
    )


def _ticks(axis: Any, values: Axis, turned: bool = False) -> str:
    """Label an axis with the study's values, as many as can be read; the text that was cut from all of them."""
    every = -(-len(values.values) // _MOST_TICKS)
    places = range(0, len(values.values), every)
    shown, cut = (_rounded(values.values), "") if values.is_numeric else _distinct(values.values)
    axis.set_ticks(list(places), [shown[k] for k in places], **({"rotation": 30, "ha": "right"} if turned else {}))
    return cut


def _rounded(values: Sequence[str]) -> list[str]:
    return [f"{float(exact(text)):.4g}" for text in values]


def _distinct(values: Sequence[str]) -> tuple[list[str], str]:
    """Names short enough for an axis: without the beginning and end that all of them share, if they are long.

    >>> _distinct(["seeds/seed-1/policy.pt", "seeds/seed-10/policy.pt"]), _distinct(["lqr", "auto"])
    ((['1', '10'], 'seeds/seed-…/policy.pt'), (['lqr', 'auto'], ''))
    """
    if len(values) < 2 or max(map(len, values)) <= _LONG:
        return list(values), ""
    parts = [re.findall(r"[A-Za-z0-9]+|[^A-Za-z0-9]", value) for value in values]
    first = _alike([part[:-1] for part in parts])
    last = _alike([part[:first:-1] for part in parts])  # at least one part is left of each
    shown = ["".join(part[first : len(part) - last]) for part in parts]
    head, tail = "".join(parts[0][:first]), "".join(parts[0][len(parts[0]) - last :])
    cut = f"{head}…{tail}" if head or tail else ""
    return [text if len(text) <= _LONG else f"…{text[1 - _LONG :]}" for text in shown], cut


def _alike(rows: Sequence[Sequence[str]]) -> int:
    """The number of entries with which all rows begin."""
    count = 0
    while count < min(map(len, rows)) and len({row[count] for row in rows}) == 1:
        count += 1
    return count


def _size(row: Row) -> str:
    """The name of a volume, with its unit."""
    name = volume_name(len(row.states))
    return f"{name} ({row.volume_unit})" if row.volume_unit else name


def _name(key: str) -> str:
    return label_of(key, {})


def _title(text: str, fixed: Mapping[str, str]) -> str:
    where = ", ".join(f"{_name(key)} {value}" for key, value in fixed.items())
    return f"{text.capitalize()}{f': {where}' if where else ''}"


def _left_out(found: int, most: int) -> str:
    return "" if found <= most else f"{found - most} more figures are left out; the table has all cases."
