"""The loops of `kernels.py` on arrays of numpy: for searches that end before compiling would have paid.

The formulas are those of that file, and sums go the same way, a row after the other, so that both give the same bits.
"""

from __future__ import annotations

import numpy as np

from certify.provers.bounds.kernels import (
    LOST,
    Block,
    Line,
    Plane,
    Steps,
    bent,
    chord,
    coefficients,
    enclosed,
    relaxed,
    smaller,
)
from certify.provers.bounds.tape import INNER, MULTIPLY
from certify.provers.bounds.taylor import EPS, TINY, third


def ranges(
    y: Block,
    bias: Line,
    bias_error: Line,
    row: Line,
    through: Block,
    size: Line,
    fresh: Line,
    ball: Line,
    norm: float,
    width: int,
    ends: Block,
    error: Plane,
    rounding: Plane,
    spread: Plane,
) -> None:
    """See `kernels.ranges`."""
    forms = y.shape[1]
    grown, wider = 1 + width * EPS, 1 + (forms - 1) * EPS
    each = (width + 2) * EPS * np.sqrt(forms) * (np.sqrt(size) + LOST)
    np.abs(y[:, 1:]).sum(1, out=spread)
    y[:, 0] += bias[:, None]
    b, b_error, r = (v[:, None] for v in (bias, bias_error, row))
    passed = through[:, 0], through[:, 1]
    ends[0], ends[1], error[:], rounding[:] = enclosed(
        y[:, 0], b, b_error, r, passed, ball, each, spread, (grown, wider)
    )
    ball[:] = (norm * (ball + np.sqrt(fresh) + LOST) + np.sqrt((rounding * rounding).sum(0)) + LOST) * grown


def chords(ends: Block, values: Block, slope: Plane, t: Plane) -> None:
    """See `kernels.chords`."""
    slope[:], t[:] = chord(*ends, *values)


def relax(ends: Block, values: Block, slope: Plane, t: Plane, p: Plane, y: Block) -> None:
    """See `kernels.relax`."""
    t[:], p[:] = relaxed(tuple(ends), tuple(values), slope, p, t, y[:, 0])


def bend(
    y: Block,
    slope: Plane,
    shift: Plane,
    gap: Plane,
    width: int,
    error: Plane,
    rounding: Plane,
    spread: Plane,
    errors: Block,
    size: Line,
    fresh: Line,
    ball: Line,
    share: Plane,
) -> None:
    """See `kernels.bend`."""
    grown, wider = 1 + width * EPS, 1 + (y.shape[1] - 1) * EPS
    steep = np.abs(slope)
    y[:, 0], errors[:, 0] = bent(y[:, 0], spread, slope, steep, shift, gap, rounding)
    errors[:, 1] = steep * error
    form = (np.abs(y[:, 0]) + steep * spread) * wider
    size[:], fresh[:], older = ((v * v).sum(0) for v in (form, errors[:, 0], errors[:, 1]))
    ball[:] = smaller(np.fmax.reduce(steep, 0, initial=0.0) * ball, (np.sqrt(older) + LOST) * grown)
    if len(share):
        share += ((gap / (spread + TINY))[:, None] * np.abs(y[:, 1:])).sum(0)
    y[:, 1:] *= slope[:, None]


def backwards(weight: Block, errors: Block, slope: Plane, result: Plane) -> None:
    """See `kernels.backwards`."""
    result += (np.abs(weight) * errors[:, :1]).sum(0)
    weight *= slope[:, None]


def play(
    steps: Steps,
    constants: Line,
    places: int,
    x: Block,
    x_error: Plane,
    middle: Plane,
    slopes: Block,
    wide: Plane,
    quantities: Plane,
    c: Line,
    g: Plane,
    Q: Block,
    r: Line,
    t: Plane,
) -> None:
    """See `kernels.play`."""
    n, inputs = len(x), len(x) + len(wide)
    N = inputs + len(quantities)
    R = 1 + N + N * (N + 1) // 2
    memory = np.zeros((places, R + 3, len(c)))
    inner = bool(np.any(steps[:, 0] == INNER))
    T = np.zeros((N, R - 1 - N, len(c)) if inner else (0, 0, 0))
    memory[:n, : 1 + n], memory[:n, R] = x, x_error
    memory[n:inputs, 0], memory[n:inputs, 1 : 1 + n] = middle, slopes
    for i in range(n, N):
        memory[i, 1 + i] = wide[i - n] if i < inputs else quantities[i - inputs, 1]
    memory[inputs:N, 0], memory[inputs:N, R] = quantities[:, :1], quantities[:, 2:]
    for place in memory[:N]:
        _sizes(place, N)
    for (operation, *at), k in zip(steps.tolist(), constants.tolist(), strict=True):
        u, v, w = (memory[place] for place in at)
        alpha, beta, gamma, start, rest = coefficients(operation, k, *((m[0], m[-2], m[-1], m[R]) for m in (u, v)))
        w[:R] = alpha * u[:R] + beta * v[:R]
        w[0], w[R], row = start, rest, 1 + N
        for i in range(1, 1 + N if operation >= MULTIPLY else 1):
            w[row] += gamma * (u[i] * v[i])
            w[row + 1 : row + 1 + N - i] += gamma * (u[i] * v[i + 1 : 1 + N] + u[i + 1 : 1 + N] * v[i])
            row += 1 + N - i
        if operation == INNER:
            T += u[1 : 1 + N, None] * v[1 + N : R] + v[1 : 1 + N, None] * u[1 + N : R]
        _sizes(w, N)
    t[:] = 0.0
    if inner:
        third(T, t)
    c[:], g[:], r[:], row = w[0], w[1 : 1 + N], w[R], 1 + N
    for i in range(N):
        Q[i, i:] = 0.5 * w[row : row + N - i]
        Q[i, i] = w[row]
        Q[i:, i] = Q[i, i:]
        row += N - i


def _sizes(model: Plane, symbols: int) -> None:
    """See `kernels.sizes`."""
    np.abs(model[1 : 1 + symbols]).sum(0, out=model[-2])
    np.abs(model[1 + symbols : -3]).sum(0, out=model[-1])
