"""The page of an identified plant: priors against the ranges that are left, and measurements against predictions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.report.figures.style import (
    INNER,
    LEAF_EDGE,
    MUTED,
    RC,
    SET,
    SIMULATED,
    Key,
    Picture,
    figure_of,
    to_svg,
)
from certify.report.sheet import filled
from certify.report.words import above, below, label, pretty_unit, symbol

TEMPLATE = "certify.report", "identified.html"
Array = NDArray[np.float64]
_MOST_DOTS = 4000  # of a figure
_UPWARDS = 1.005  # by which three digits are no smaller
_LEAST_FACTOR = Fraction(1, 10**4)  # that a sum shows
Pair = tuple[Fraction, Fraction]


@dataclass(frozen=True, slots=True)
class Residuals:
    """Transitions against their predictions.

    Parameters
    ----------
    names, units : of the n states.
    difference : measured less predicted at the middle of the ranges, (n, T); NaN without a prediction.
    reach : how far it may be off for some parameters and errors, (n, T).
    used : transitions on which the ranges rest, (T,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    difference: Array
    reach: Array
    used: NDArray[np.bool_]


def direction_in_words(entries: Mapping[str, float], share: float) -> str:
    """The direction in which most is left, and the part of the priors that it is."""
    moved = [f"{symbol(name)} {v:+.2g}" for name, v in entries.items() if abs(v) >= 0.01]
    return f"{', '.join(moved)} in half-widths of priors; {above(100 * share, 3)} % of the priors is left along it"


def noise_in_words(factor: float | None) -> str:
    """The least noise that the measurements allow."""
    if factor is None:
        return "no statement about the noise"
    if factor == 0:
        return "no bound: no smaller noise is contradicted, as far as is shown here"
    return f"no noise smaller than {below(factor, 3)} times that, in all states at once: it is contradicted"


def factors_in_words(one: Mapping[str, Any]) -> str:
    """Factors of the bounds of residuals: one that is contradicted, and one that is not."""
    names, refuted = ", ".join(map(symbol, one["refuted"])), max(one["refuted"].values())
    least = None if one["open"] is None else max(one["open"].values())
    if least is not None and not refuted:
        what = "none is needed" if not least else f"no more than {above(least, 3)} times the bound is needed"
        return f"{names}: {what}, as far as is shown here"
    rest = "" if least is None else f"; {above(least, 3)} times is not, as far as is shown here"
    return f"{names}: {below(refuted, 3)} times the bound is contradicted{rest}"


def constants_in_words(one: Mapping[str, Any]) -> str:
    """Residuals of constant bounds: some that are contradicted, and some that are not."""
    if one["open"] is None:
        return f"{_sizes(one['refuted'], below)} is contradicted as well"
    rest = f"{_sizes(one['open'], above)} is not, as far as is shown here"
    return f"{_sizes(one['refuted'], below)} is contradicted as well; {rest}" if any(one["refuted"].values()) else rest


def table_of_constants(each: Sequence[Mapping[str, Any]]) -> str:
    """Entries for a structure's table `residual`: the first constant bounds that are not contradicted, rounded up."""
    first: Mapping[str, float] = next((one["open"] for one in each if one["open"]), {})
    return ", ".join(f'{name} = "{_UPWARDS * size:.3g}"' for name, size in first.items())


def _sizes(each: Mapping[str, float], rounded: Callable[[float, int], str]) -> str:
    return "at most " + ", ".join(f"{rounded(size, 3)} in {symbol(name)}′" for name, size in each.items())


@dataclass(frozen=True, slots=True)
class Along:
    """A sum of parameters that an axis bounds, of which the largest factor is 1 in size.

    Parameters
    ----------
    name : of the axis.
    factors : by parameter.
    prior, range : between what the sum lies for priors, and for what is left.
    """

    name: str
    factors: Mapping[str, Fraction]
    prior: Pair
    range: Pair

    @property
    def shrink(self) -> float:
        (a, b), (lo, hi) = self.prior, self.range
        return float((b - a) / (hi - lo))

    @property
    def text(self) -> str:
        """The sum, of factors with four digits."""
        shown = ""
        for name, q in self.factors.items():
            if abs(q) >= _LEAST_FACTOR:
                sign = ("−" if q < 0 else "") if not shown else " − " if q < 0 else " + "
                shown += sign + ("" if abs(q) == 1 else f"{abs(float(q)):.4g} ") + symbol(name)
        return shown

    @property
    def ends(self) -> str:
        """The range, rounded outwards."""
        lo, hi = self.range
        return f"{below(lo)} to {above(hi)}"


def sums_along(data: Mapping[str, Any]) -> list[Along]:
    """The axes of an identified plant, from the object that `certify identify --json` prints."""
    priors, found = {p["name"]: tuple(map(Fraction, p["prior"])) for p in data["parameters"]}, []
    for name, sums in data["axes"]["sums"].items():
        at, *by = map(Fraction, sums)
        size = max(by, key=abs)
        factors = {p: q / size for p, q in zip(priors, by, strict=True)}
        each = [sorted((q * a, q * b)) for q, (a, b) in zip(factors.values(), priors.values(), strict=True)]
        lo, hi = sorted(((-1 - at) / size, (1 - at) / size))
        found.append(
            Along(
                name,
                factors,
                (sum((a for a, _ in each), Fraction(0)), sum((b for _, b in each), Fraction(0))),
                (lo, hi),
            )
        )
    return found


def page(residuals: Residuals, data: Mapping[str, Any]) -> str:
    """The page as one HTML document, from the object that `certify identify --json` prints."""
    from matplotlib import rc_context

    sums = sums_along(data)
    bars = [_bar(p) for p in data["parameters"]] + [(symbol(a.name), a.prior, a.range) for a in sums]
    with rc_context(RC):
        pictures = [_ranges(bars), *_differences(residuals)]
    axis = data["least_determined"]
    return filled(
        *TEMPLATE,
        one_plane=True,
        data=data,
        parameters=[_row(p) for p in data["parameters"]],
        sums=[_sum(a) for a in sums],
        smaller=below(data["axes"]["smaller"], 3),
        noise=[_bound(name, w, residuals) for name, w in data["noise"].items()],
        period=" to ".join(dict.fromkeys(_short(h) for h in data["period"] or ())),
        pictures=pictures,
        axis=None if axis is None else direction_in_words(axis["direction"], axis["share_of_priors"]),
        telling=None if axis is None else axis["telling"],
        least=noise_in_words(data["least_noise"]),
        lacking=[factors_in_words(one) for one in data["least_residual"]],
        missing=int(np.count_nonzero(~np.isfinite(residuals.difference).all(0))),
    )


def _row(p: Mapping[str, Any]) -> dict[str, str]:
    (a, b), (lo, hi) = (map(Fraction, p[key]) for key in ("prior", "range"))
    return {
        "name": symbol(p["name"]),
        "unit": pretty_unit(p["unit"]),
        "prior": f"{below(a)} to {above(b)}",
        "range": f"{below(lo)} to {above(hi)}",
        "shrink": below(p["shrink"], 3),
        "by": ", ".join(p["shown_by"]) or "a partition of the priors",
    }


def _bar(p: Mapping[str, Any]) -> tuple[str, Pair, Pair]:
    (a, b), (lo, hi) = (map(Fraction, p[key]) for key in ("prior", "range"))
    return label(p["name"], p["unit"]), (a, b), (lo, hi)


def _sum(a: Along) -> dict[str, str]:
    lo, hi = a.prior
    prior = f"{below(lo)} to {above(hi)}"
    return {"name": symbol(a.name), "sum": a.text, "prior": prior, "range": a.ends, "shrink": below(a.shrink, 3)}


def _bound(name: str, bound: str, residuals: Residuals) -> str:
    unit = pretty_unit(residuals.units[residuals.names.index(name)])
    return f"{symbol(name)} {_short(bound)} {unit}".rstrip()


def _short(value: str) -> str:
    return f"{float(Fraction(value)):g}"


def _ranges(bars: Sequence[tuple[str, Pair, Pair]]) -> Picture:
    """Each prior as a bar of one length, and in it the range; also of sums of parameters."""
    height = 0.75 + 0.42 * len(bars)
    figure, axes = figure_of(8.6, height, left=1.1, right=0.2, bottom=0.5)
    for k, (_, (a, b), (lo, hi)) in enumerate(reversed(bars)):
        axes.plot([0, 1], [k, k], color=LEAF_EDGE, lw=7, solid_capstyle="butt")
        left, right = (float((v - a) / (b - a)) for v in (lo, hi))
        axes.plot([left, right], [k, k], color=SET, lw=7, solid_capstyle="butt")
        axes.plot([(left + right) / 2], [k], color=SET, marker="|", ms=15, lw=0)
        axes.text(1.012, k, f"{above(100 * (right - left), 3)} %", va="center", fontsize=8.0)
    axes.set_yticks(range(len(bars)), [name for name, _, _ in reversed(bars)])
    axes.set_xlim(-0.02, 1.08)
    axes.set_ylim(-0.6, len(bars) - 0.4)
    axes.set_xlabel("place in the prior, from its lower to its upper end")
    keys = (Key("prior", LEAF_EDGE, 5.0), Key("range that is left", SET, 5.0))
    caption = (
        "What the measurements leave of each prior. Every consistent constant value lies in the dark part; its share "
        "of the prior is beside it."
    )
    return Picture("Priors and ranges", caption, to_svg(figure), False, wide=True, legend=keys)


def _differences(residuals: Residuals) -> list[Picture]:
    """For each state the transitions' ends: measured less predicted, and how far that may be off."""
    count = residuals.difference.shape[1]
    shown = np.unique(np.linspace(0, count - 1, min(count, _MOST_DOTS)).astype(np.intp))
    shown = np.union1d(shown, np.flatnonzero(residuals.used))
    used = residuals.used[shown]
    keys = (
        Key("how far it may be off", LEAF_EDGE, 3.0),
        Key("measured less predicted", SIMULATED, 3.0),
        Key("the same, of transitions on which the ranges rest", INNER, 3.0),
    )
    found = list[Picture]()
    each = zip(residuals.names, residuals.units, residuals.difference, residuals.reach, strict=True)
    for name, unit, difference, reach in each:
        figure, axes = figure_of(4.2, 2.6, left=0.86)
        axes.vlines(shown, -reach[shown], reach[shown], color=LEAF_EDGE, lw=max(0.3, min(3.0, 200 / len(shown))))
        axes.axhline(0.0, color=MUTED, lw=0.6)
        size = max(1.0, min(3.5, 400 / len(shown)))
        axes.plot(shown[~used], difference[shown[~used]], ".", color=SIMULATED, ms=size + 1)
        axes.plot(shown[used], difference[shown[used]], ".", color=INNER, ms=4.5)
        axes.set_xlabel("transition, in the file's order")
        axes.set_ylabel(label(name, unit))
        caption = (
            f"{symbol(name)} at the end of each transition, less what the middle of the ranges predicts from its "
            "beginning. It may be off by parameters, noise and remainder, as far as the line reaches."
        )
        found.append(Picture(symbol(name), caption, to_svg(figure), False, legend=keys))
    return found
