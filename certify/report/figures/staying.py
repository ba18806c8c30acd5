"""Pictures of a set that is never left: its extent in planes of the states, its constraints, simulated runs from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates import InvariantCertificate, RemainCertificate
from certify.certificates.membership import region_of
from certify.report.figures.edges import worst_of
from certify.report.figures.pairs import Pair
from certify.report.figures.ranks import planes_of
from certify.report.figures.style import INK, PAPER, SET, START, Picture, figure_of, to_svg
from certify.report.flow import Flow, simulate, time_scales
from certify.report.words import deviation

Array = NDArray[np.float64]
Staying = InvariantCertificate | RemainCertificate
_POINTS, _DEEP = 200, 240  # of a picture along each side; values of the other states at each of them
_STARTS, _STEPS, _SAMPLES = 8, 1500, 200_000
_RUNS = (PAPER, 1.4), (INK, 0.6)


@dataclass(frozen=True, slots=True)
class Stage:
    """A set with its loop: `beyond` is at most 0 at states (..., n) of it, corners `lo` and `hi` (n,) of the domain,
    simulated `runs` (steps, runs, n) from states of the set, and the states' `labels`."""

    certificate: Staying
    beyond: Callable[[Array], Array]
    lo: Array
    hi: Array
    runs: Array
    labels: Sequence[str]

    @classmethod
    def of(cls, certificate: Staying) -> Stage:
        system = certificate.system
        lo, hi = np.array([[float(end) for end in pair] for pair in system.domain]).T
        shown = zip(system.states, system.exact_x_eq(), strict=True)
        labels = [deviation(s.name, q, system.units.get(s.name, "")) for s, q in shown]
        beyond = _beyond(certificate)
        return cls(certificate, beyond, lo, hi, _runs(certificate, beyond, lo, hi), labels)


def _beyond(certificate: Staying) -> Callable[[Array], Array]:
    """N less its level; of boxes -1 in one of them, and 1 elsewhere."""
    if isinstance(certificate, InvariantCertificate):
        outer = certificate.claim.outer
        return lambda x: np.nan_to_num(outer.function(x) - outer.level, nan=np.inf)
    region = region_of(certificate)
    return lambda x: np.where(region.holds_in_floats(x.reshape(-1, x.shape[-1])), -1.0, 1.0).reshape(x.shape[:-1])


def staying_pictures(certificate: Staying, accepted: bool) -> list[Picture]:
    """The set's extent for each pair of states, or along the line of one."""
    stage = Stage.of(certificate)
    return [_picture(stage, accepted, pair) for pair in planes_of(certificate.system.n)]


def _picture(stage: Stage, accepted: bool, pair: Pair) -> Picture:
    """The set in one plane."""
    labels, n = stage.labels, len(stage.labels)
    figure, axes = figure_of(4.4, 3.6 if n > 1 else 1.6, left=0.86)
    broken = draw_set(axes, stage, pair)
    extent = "the states of the set, whatever the others are, by samples of these" if n > 2 else "the set"
    unless = "" if accepted else ", if the claim is true"
    red = " Magenta: a constraint is violated there." if broken else ""
    return Picture(
        "The set that is never left" if n <= 2 else f"The set: {labels[pair[0]]}, {labels[pair[1]]}",
        f"Blue: {extent}, which no trajectory leaves{unless}.{red} Thin lines: simulated runs from states of the set.",
        to_svg(figure),
        simulated=True,
    )


def draw_set(axes: Any, stage: Stage, pair: Pair) -> bool:
    """Draw the set in a plane, with simulated runs; True if a constraint is violated somewhere in it."""
    certificate, lo, hi, runs, labels = stage.certificate, stage.lo, stage.hi, stage.runs, stage.labels
    (i, j), n = pair, len(stage.labels)
    a, b, states = _plane(lo, hi, pair)
    with np.errstate(all="ignore"):
        value = stage.beyond(states).min(0)
    worst = worst_of(certificate)
    broken = None if worst is None else worst(states).min(0)
    if n > 1:
        finite = np.where(np.isfinite(value), value, 1.0)
        axes.contourf(a, b, finite, levels=[-np.inf, 0.0], colors=[SET], alpha=0.25, zorder=1)
        axes.contour(a, b, finite, levels=[0.0], colors=[SET], linewidths=[1.6], zorder=4)
        if broken is not None and np.any(broken >= 0):
            axes.contourf(a, b, broken, levels=[0.0, np.inf], colors=[START], alpha=0.35, zorder=2)
        for run in range(runs.shape[1]):
            for colour, width in _RUNS:
                axes.plot(runs[:, run, i], runs[:, run, j], color=colour, lw=width, zorder=3)
        axes.set_ylabel(labels[j])
        axes.set_ylim(lo[j], hi[j])
        units = [certificate.system.units.get(certificate.system.states[k].name) for k in pair]
        if units[0] is not None and units[0] == units[1]:
            axes.set_aspect("equal")
    else:
        for left, right, inside in zip(a, a[1:], value[0] <= 0, strict=False):
            if inside:
                axes.axvspan(left, right, color=SET, alpha=0.4, lw=0)
        axes.set_yticks([])
    axes.set_xlim(lo[i], hi[i])
    axes.set_xlabel(labels[i])
    return broken is not None and bool(np.any(broken >= 0))


def _plane(lo: Array, hi: Array, pair: Pair) -> tuple[Array, Array, Array]:
    """Points along two states, and the states there with samples of all others, (samples, rows, columns, n)."""
    n, (i, j) = len(lo), pair
    a, b = (np.linspace(lo[k], hi[k], _POINTS) for k in pair)
    others = np.random.default_rng(0).uniform(lo, hi, (_DEEP if n > 2 else 1, n))
    if n > 2:
        others[0] = np.clip(0.0, lo, hi)
    states = np.tile(others[:, None, None], (1, _POINTS if n > 1 else 1, _POINTS, 1))
    states[..., i] = a
    if n > 1:
        states[..., j] = b[:, None]
    return a, b, states


def _runs(certificate: Staying, beyond: Callable[[Array], Array], lo: Array, hi: Array) -> Array:
    """Simulated runs from states of the set, (steps, runs, n)."""
    x = np.random.default_rng(1).uniform(lo, hi, (_SAMPLES, len(lo)))
    with np.errstate(all="ignore"):
        value = beyond(x)
    inside = np.flatnonzero(value <= 0)
    order = inside[np.argsort(-value[inside], kind="stable")]
    starts = x[order[np.linspace(0, len(order) - 1, _STARTS).astype(int)]] if len(order) else x[:0]
    flow = Flow.of(certificate.system, certificate.network)
    return simulate(flow, starts, flow.fitting(time_scales(flow)[0] / 2), _STEPS)
