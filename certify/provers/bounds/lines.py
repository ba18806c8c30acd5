"""Parallel lines around the activations other than tanh, on arrays of ranges; those of tanh are in `kernels.py`.

Lines of [lo, hi] are (s, m, gap) with |phi(v) - s v - m| <= gap for all v between the ends; NaN where an end is not
finite. They follow the checker's rules (FORMAT.md, functions) with more room for rounding, so that what is proved with
them is accepted.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from certify.loop.activations import ACTIVATIONS, Activation
from certify.provers.bounds.arrays import Array
from certify.provers.bounds.kernels import SLACK, chord, relaxed
from certify.provers.bounds.taylor import EPS, TINY

Lines = tuple[Array, Array, Array]
_PARTS = 8  # points of a range at which a function is looked at, as many as the checker has


def lines_of(function: str) -> Callable[[Array, Array], Lines]:
    """The lines of an activation, by its name."""
    return _tanh if function == "tanh" else LINES[function]


def clip_lines(lo: Array, hi: Array, least: Array, most: Array) -> Lines:
    """Lines of `min(max(v, least), most)`; where that certainly is v, it is its own.

    Between its corners clip(v) - s v is linear, so that its extremes lie at the ends of v's range or at the corners in
    it; s is the chord's slope.
    """

    def clip(v: Array) -> Array:
        return np.minimum(np.maximum(v, least), most)

    inside = (lo >= least) & (hi <= most)
    slope = np.where(inside, 1.0, ((clip(hi) - clip(lo)) / (hi - lo)).clip(0.0, 1.0))
    points = np.stack([lo, hi, *(np.minimum(np.maximum(end, lo), hi) for end in (least, most))])
    above = clip(points) - slope * points
    size = (np.abs(clip(points)) + slope * np.abs(points)).max(0)
    upper, lower = above.max(0), above.min(0)
    gap = (upper - lower) / 2 + 4 * EPS * size + TINY
    return slope, np.where(inside, 0.0, (upper + lower) / 2), np.where(inside, 0.0, gap)


def _tanh(lo: Array, hi: Array) -> Lines:
    """The chord's slope, by `kernels.relaxed`."""
    values = np.tanh(lo), np.tanh(hi)
    s, t = chord(lo, hi, *values)
    m, gap = relaxed((lo, hi), values, s, np.arctanh(t), t, 0.5 * (lo + hi))
    return s, m, gap


def _by_parts(phi: Activation, lo: Array, hi: Array) -> Lines:
    """From values and slopes at points of the range: every v is within `half` of a point p, and there phi(v) - s v is
    within |phi'(p) - s| half + bend half^2 of its value at p. s is near the chord's slope.
    """
    width = hi - lo
    first, last = (phi.pair(lo + width * ((2 * i + 1) / (2 * _PARTS))) for i in (0, _PARTS - 1))
    s = (last[0] - first[0]) / (width * ((_PARTS - 1) / _PARTS))
    size = np.maximum(np.abs(lo), np.abs(hi))
    half = width / (2 * _PARTS) * (1 + EPS) + EPS * size
    rest = phi.bend * half * half
    upper, lower = np.full_like(s, -np.inf), np.full_like(s, np.inf)
    for i in range(_PARTS):
        p = lo + width * ((2 * i + 1) / (2 * _PARTS))
        f, slope = first if i == 0 else last if i == _PARTS - 1 else phi.pair(p)
        away, wide = f - s * p, np.abs(slope - s) * half + rest
        np.maximum(upper, away + wide, out=upper)
        np.minimum(lower, away - wide, out=lower)
    return _between(lower, upper, s, SLACK * (1 + size))


def _relu(lo: Array, hi: Array) -> Lines:
    """Between the ends phi(v) - s v is linear to both sides of 0: its extremes are at the ends and at 0. Where the sign
    is certain, the lines are the function."""
    s = np.where(lo >= 0, 1.0, np.where(hi <= 0, 0.0, hi / (hi - lo)))
    bent = (lo < 0) & (hi > 0)
    upper = np.where(bent, np.maximum(hi - s * hi, -s * lo), 0 * lo + 0 * hi)
    return _between(np.zeros_like(s), upper, s, np.where(bent, 4 * EPS * (hi - lo), 0.0))


def _sigmoid(lo: Array, hi: Array) -> Lines:
    """(1 + tanh(v/2))/2, by the lines of tanh."""
    s, m, gap = _tanh(0.5 * lo, 0.5 * hi)
    return 0.25 * s, 0.5 + 0.5 * m, 0.5 * gap + EPS


def _between(lower: Array, upper: Array, s: Array, slack: Array) -> Lines:
    """Lines of slopes s, from the ends of phi(v) - s v, which are wrong by `slack` at most."""
    gap = (upper - lower) / 2 + EPS * (np.abs(upper) + np.abs(lower)) + slack + TINY
    return s, (upper + lower) / 2, gap


LINES: dict[str, Callable[[Array, Array], Lines]] = {
    "relu": _relu,
    "sigmoid": _sigmoid,
    **{name: partial(_by_parts, ACTIVATIONS[name]) for name in ("elu", "silu", "gelu", "softplus", "mish", "softsign")},
}
"""All activations but tanh, by their names."""
