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
    ends = 0.5 * lo, 0.5 * hi
    values = np.tanh(ends[0]), np.tanh(ends[1])
    s, t = chord(*ends, *values)
    m, gap = relaxed(ends, values, s, np.arctanh(t), t, 0.5 * (ends[0] + ends[1]))
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
