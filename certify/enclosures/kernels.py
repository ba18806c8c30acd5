"""Loops over numbers, compiled by numba: what lies between two products of matrices, one walk through memory each.

`compiled.py` says when they are worth their start, and nothing imports this file before. Signatures are given, so that
all is compiled, or read from numba's cache, when the file is imported. IEEE arithmetic throughout: no `fastmath`, so
that nothing is contracted or reordered, and a comparison with NaN is false; each choice below is written so that a NaN
reaches the result. Each loop over boxes is the innermost, where it becomes vector instructions. tanh and its inverse
stay torch's, which evaluates many at once: what is compiled here would call libm for each.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

Line = Plane = Block = NDArray[np.float64]  # of one, two and three dimensions, in C's order
F = TypeVar("F", bound=Callable[..., Any])
EPS, TINY = 2.0**-50, 2.0**-900  # as in taylor.py
SLACK = 2.0**-47  # as in policy.py
LOST = 2.0**-500  # more than a 2-norm loses where squares underflow
_TYPES = {"Line": "f8[::1]", "Plane": "f8[:,::1]", "Block": "f8[:,:,::1]", "float": "f8", "int": "i8", "None": "void"}


def _compiled(function: F) -> F:
    """Compile for the annotated types, without the interpreter's lock; into numba's cache, if one can be written."""
    *parameters, returned = (_TYPES[name] for name in function.__annotations__.values())
    signature, how = f"{returned}({','.join(parameters)})", {"nogil": True, "error_model": "numpy"}
    try:
        result: F = numba.njit(signature, cache=True, **how)(function)
    except (RuntimeError, OSError):  # there is no folder for the cache, or it is full
        result = numba.njit(signature, **how)(function)
    return result


@_compiled
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
    """Add the bias to a layer's affine forms y (H, n + 1, B); their rounding errors, errors, spreads, and ends of range.

    Parameters
    ----------
    row : the 2-norms of the weights' rows (H,).
    through : what comes through |W| (H, 2, B) of the fresh errors and of the older ones.
    size, fresh : squared 2-norms (B,) of the sizes of what came in, and of its fresh errors.
    ball : the 2-norm (B,) of the older errors that came in; becomes that of all errors that go out.
    norm, width : of the weights, in the 2-norm, and how many come in.
    """
    units, forms, batch = y.shape
    grown, wider = 1 + width * EPS, 1 + (forms - 1) * EPS
    each = (width + 2) * EPS * forms**0.5
    square, reach = np.zeros(batch), np.sqrt(size) + LOST
    for i in range(units):
        b, b_error, r = bias[i], bias_error[i], row[i]
        for k in range(batch):
            spread[i, k] = abs(y[i, 1, k])
        for j in range(2, forms):
            for k in range(batch):
                spread[i, k] += abs(y[i, j, k])
        for k in range(batch):
            centre = y[i, 0, k] + b
            own = each * r * reach[k] + 8 * EPS * (abs(centre) + abs(b)) + TINY + b_error
            older, in_ball = through[i, 1, k], r * ball[k]
            older = in_ball if in_ball < older else older
            whole = (through[i, 0, k] + older) * grown + own
            radius = (spread[i, k] + whole) * wider * (1 + EPS) + EPS * abs(centre) + TINY
            y[i, 0, k] = centre
            ends[0, i, k], ends[1, i, k] = centre - radius, centre + radius
            error[i, k], rounding[i, k] = whole, own
            square[k] += own * own
    for k in range(batch):
        ball[k] = (norm * (ball[k] + np.sqrt(fresh[k]) + LOST) + np.sqrt(square[k]) + LOST) * grown


@_compiled
def chords(ends: Block, values: Block, slope: Plane, t: Plane) -> None:
    """The slopes s (H, B) of tanh's chords between `ends` (2, H, B), `values` being tanh there; and sqrt(1 - s)."""
    _, units, batch = ends.shape
    for i in range(units):
        for k in range(batch):
            s = (values[1, i, k] - values[0, i, k]) / (ends[1, i, k] - ends[0, i, k])
            s = 0.0 if s < 0.0 else s
            s = 1.0 if s > 1.0 else s
            rest = 1 - s
            slope[i, k] = s
            t[i, k] = np.sqrt(1 - EPS if rest > 1 - EPS else rest)


@_compiled
def bend(
    y: Block,
    ends: Block,
    values: Block,
    slope: Plane,
    t: Plane,
    p: Plane,
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
    """tanh of a layer's affine forms y (H, n + 1, B), in their place: `relax_tanh` and what follows from it.

    Parameters
    ----------
    t, p : sqrt(1 - slope), and where tanh is that.
    width : how many came into the layer.
    spread : overwritten.
    errors : becomes the fresh errors and the older ones (H, 2, B).
    size, fresh : become squared 2-norms (B,) of the forms' sizes and of the fresh errors.
    ball : the 2-norm (B,) of the older errors.
    share : (n, B) gets what each axis spreads the units, as they err; or (0, B).
    """
    units, forms, batch = y.shape
    grown, wider = 1 + width * EPS, 1 + (forms - 1) * EPS
    older, steepest = np.zeros(batch), np.zeros(batch)
    size[:] = 0.0
    fresh[:] = 0.0
    for i in range(units):
        for k in range(batch):
            lo, hi, t_lo, t_hi = ends[0, i, k], ends[1, i, k], values[0, i, k], values[1, i, k]
            s, centre = slope[i, k], y[i, 0, k]
            a, b = t_lo - s * lo, t_hi - s * hi
            slack = SLACK * (1 + (hi - lo))
            at, value = (p[i, k], t[i, k]) if p[i, k] < hi else (hi, t_hi)
            at, value = (at, value) if at > lo else (lo, t_lo)
            tangent = value - s * at
            upper = a if a > b else b
            upper = (tangent if tangent > upper else upper) + slack
            at, value = (-p[i, k], -t[i, k]) if -p[i, k] > lo else (lo, t_lo)
            at, value = (at, value) if at < hi else (hi, t_hi)
            tangent = value - s * at
            lower = a if a < b else b
            lower = (tangent if tangent < lower else lower) - slack
            reach = abs(centre) + (hi - lo)  # infinite or NaN where an end is, and then the gap is NaN
            gap = (upper - lower) / 2 + EPS * (abs(upper) + abs(lower) + s * reach) + TINY
            shift = (upper + lower) / 2
            new = gap + s * rounding[i, k] + EPS * (s * (abs(centre) + spread[i, k]) + abs(shift)) + TINY
            old = s * error[i, k]
            middle = s * centre + shift
            form = (abs(middle) + s * spread[i, k]) * wider
            y[i, 0, k] = middle
            errors[i, 0, k], errors[i, 1, k] = new, old
            spread[i, k] = gap / (spread[i, k] + TINY)
            size[k] += form * form
            fresh[k] += new * new
            older[k] += old * old
            steepest[k] = s if s > steepest[k] else steepest[k]
        for j in range(len(share)):
            for k in range(batch):
                share[j, k] += spread[i, k] * abs(y[i, j + 1, k])
        for j in range(1, forms):
            for k in range(batch):
                y[i, j, k] *= slope[i, k]
    for k in range(batch):
        bent, alone = steepest[k] * ball[k], (np.sqrt(older[k]) + LOST) * grown
        ball[k] = bent if bent < alone else alone


@_compiled
def backwards(weight: Block, errors: Block, slope: Plane, result: Plane) -> None:
    """Add what a layer's fresh errors, `errors[:, 0]` of (H, 2, B), weigh in the outputs (m, B), whose weights (H, m, B)
    then go on through the slopes of tanh."""
    units, outputs, batch = weight.shape
    for i in range(units):
        for j in range(outputs):
            for k in range(batch):
                result[j, k] += abs(weight[i, j, k]) * errors[i, 0, k]
                weight[i, j, k] *= slope[i, k]
