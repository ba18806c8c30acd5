"""Loops over numbers, compiled by numba: what lies between two products of matrices, one walk through memory each.

`compiled.py` says when they are worth their start, and nothing imports this file before. Signatures are given, so that
all is compiled, or read from numba's cache, when the file is imported. IEEE arithmetic throughout: no `fastmath`, so
that nothing is contracted or reordered, and a comparison with NaN is false; each choice below is written so that a NaN
reaches the result. Each loop over boxes is the innermost, where it becomes vector instructions. tanh and its inverse
stay torch's, which evaluates many at once: what is compiled here would call libm for each.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from certify.provers.bounds.tape import (
    ADD,
    ATAN,
    CONSTANT,
    COS,
    EXP,
    INVERSE,
    MULTIPLY,
    SCALED,
    SHIFTED,
    SIN,
    SQRT,
    TANH,
)

Line: TypeAlias = NDArray[np.float64]  # of one dimension, in C's order
Plane: TypeAlias = NDArray[np.float64]  # of two
Block: TypeAlias = NDArray[np.float64]  # of three
Steps: TypeAlias = NDArray[np.int64]
Four: TypeAlias = tuple[float, float, float, float]
Five: TypeAlias = tuple[float, float, float, float, float]
F = TypeVar("F", bound=Callable[..., Any])
EPS, TINY = 2.0**-50, 2.0**-900  # as in taylor.py
SLACK = 2.0**-47  # as in policy.py
EXP_END = 64.0  # as in taylor.py
CHUNK = 32  # boxes at a time in the plant: their models stay in a core's cache
LOST = 2.0**-500  # more than a 2-norm loses where squares underflow
_TYPES = {"Line": "f8[::1]", "Plane": "f8[:,::1]", "Block": "f8[:,:,::1]", "float": "f8", "int": "i8", "None": "void"}
_TYPES |= {"Steps": "i8[:,::1]", "Four": "UniTuple(f8, 4)", "Five": "UniTuple(f8, 5)"}


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
    """Add the bias to a layer's affine forms y (H, n + 1, B); their rounding, errors, spreads, and ends of range.

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
            at, value = p[i, k], t[i, k]
            value = t_lo if at < lo else t_hi if at > hi else value
            at = lo if at < lo else hi if at > hi else at
            tangent = value - s * at
            upper = a if a > b else b
            upper = (tangent if tangent > upper else upper) + slack
            at, value = -p[i, k], -t[i, k]
            value = t_lo if at < lo else t_hi if at > hi else value
            at = lo if at < lo else hi if at > hi else at
            tangent = value - s * at
            lower = a if a < b else b
            lower = (tangent if tangent < lower else lower) - slack
            reach = abs(centre) + (hi - lo) / 2  # infinite or NaN where an end is, and then the gap is NaN
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
    """Add what a layer's fresh errors, `errors[:, 0]` of (H, 2, B), weigh in the outputs (m, B), whose weights
    (H, m, B) then go on through the slopes of tanh."""
    units, outputs, batch = weight.shape
    for i in range(units):
        for j in range(outputs):
            for k in range(batch):
                result[j, k] += abs(weight[i, j, k]) * errors[i, 0, k]
                weight[i, j, k] *= slope[i, k]


@_compiled
def expansion(operation: int, c: float, reach: float) -> Four:
    """phi(c), phi'(c), phi''(c)/2 and a bound of |phi'''|/6 within `reach` of c, as `Taylor` takes them; NaN where
    there is none. libm errs by a few units in the last place at most, `Taylor.compose` allows for sixteen."""
    if operation == INVERSE:
        least = abs(c) - reach
        least = least if least > 0 else np.nan
        f = 1 / c
        cube = f * f * f
        return f, -f * f, cube, abs(cube) / least * (1 + EPS) + TINY
    if operation == SQRT:
        least = c - reach
        s, w = np.sqrt(c), np.sqrt(least if least > 0 else np.nan)
        p, q = 1 / s, 1 / (s + w)
        return s, p / 2, -p * p * p / 8, p * p * q * q * (2 * q + p) / 8 * (1 + 32 * EPS) + TINY
    if operation == EXP:
        e, most = math.exp(c), c + reach
        third = math.exp(most) / 6 * (1 + 128 * EPS) + TINY if most < EXP_END else np.nan
        return e, e, e / 2, third
    if operation == TANH:
        t = math.tanh(c)
        slope = 1 - t * t
        return t, slope, -t * slope, 1 / 3 + EPS
    if operation == ATAN:
        slope = 1 / (1 + c * c)
        return math.atan(c), slope, -c * slope * slope, 1 / 3 + EPS
    sine, cosine = math.sin(c), math.cos(c)
    if operation == SIN:
        third = abs(cosine) + reach + EPS
        return sine, cosine, -sine / 2, (1.0 if third > 1.0 else third) / 6
    if operation == COS:
        third = abs(sine) + reach + EPS
        return cosine, -sine, -cosine / 2, (1.0 if third > 1.0 else third) / 6
    return np.nan, np.nan, np.nan, np.nan


@_compiled
def coefficients(operation: int, k: float, u: Four, v: Four) -> Five:
    """`alpha`, `beta`, `gamma`, the constant term and the remainder of an operation, as `Taylor` has them; of its
    operands are given c, sum |g_i|, sum |Q_ij| and r."""
    (c, G, S, r), (vc, vG, vS, vr) = u, v
    whole, other = abs(c) + G + S, abs(vc) + vG + vS
    if operation == ADD:
        return 1.0, 1.0, 0.0, c + vc, r + vr + EPS * (whole + other) + TINY
    if operation == SCALED:
        return k, 0.0, 0.0, k * c, abs(k) * r * (1 + EPS) + EPS * (abs(k) * whole) + TINY
    if operation == SHIFTED:
        return 1.0, 0.0, 0.0, c + k, r + EPS * (abs(c) + abs(k)) + TINY
    if operation == CONSTANT:
        return 0.0, 0.0, 0.0, k, EPS * abs(k) + TINY
    if operation == MULTIPLY:
        rest = abs(c) * vr + abs(vc) * r + G * vS + vG * S + S * vS + r * (vG + vS + vr) + vr * (G + S)
        return vc, c, 1.0, c * vc, rest + EPS * (whole * other + rest) + TINY
    q = S + r
    rho = G + q
    f0, f1, f2, third = expansion(operation, c, rho * (1 + EPS))
    rest = abs(f1) * r + abs(f2) * (2 * G * q + q * q) + third * (rho * rho * rho)
    rest += 2 * EPS * (abs(f0) + abs(f1) * (1 + rho) + abs(f2) * (1 + rho * rho) + rest)
    return f1, 0.0, f2, f0, rest + TINY


@_compiled
def sizes(model: Plane, symbols: int) -> None:
    """The last two rows of a model in that many symbols: sums of magnitudes of its linear and its quadratic part."""
    rest = 1 + symbols + symbols * (symbols + 1) // 2
    model[rest + 1 :] = 0.0
    for row in range(1, rest):
        to = rest + 1 if row <= symbols else rest + 2
        for b in range(CHUNK):
            model[to, b] += abs(model[row, b])


@_compiled
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
) -> None:
    """The result (c, g, Q, r) of a tape whose inputs are n states, m inputs and k uncertain quantities, as
    `loop_models` makes them; `quantities` (k, 3) are the middle of each, its reach and the rounding of these.

    A place holds a model of CHUNK boxes, a row each: c, g, the coefficients of d_i d_j for i <= j, ordered by i and
    then by j, then r, sum |g_i| and the sum of the coefficients' magnitudes. Each operation is `alpha u + beta v`, with
    `gamma` times the product of the linear parts, and a remainder of its own.
    """
    n, inputs, batch = x.shape[0], x.shape[0] + len(wide), len(c)
    N = inputs + len(quantities)
    R = 1 + N + N * (N + 1) // 2
    G, S = R + 1, R + 2
    memory = np.zeros((places, R + 3, CHUNK))
    alpha, beta, gamma, start = np.zeros(CHUNK), np.zeros(CHUNK), np.zeros(CHUNK), np.zeros(CHUNK)
    for first in range(0, batch, CHUNK):
        count = min(CHUNK, batch - first)
        for i in range(N):
            w = memory[i]
            w[:] = 0.0
            for b in range(count):
                if i < n:
                    w[0, b], w[R, b] = x[i, 0, first + b], x_error[i, first + b]
                elif i < inputs:
                    w[0, b], w[1 + i, b] = middle[i - n, first + b], wide[i - n, first + b]
                else:
                    w[0, b], w[1 + i, b] = quantities[i - inputs, 0], quantities[i - inputs, 1]
                    w[R, b] = quantities[i - inputs, 2]
                if i < inputs:
                    for j in range(n):
                        w[1 + j, b] = x[i, 1 + j, first + b] if i < n else slopes[i - n, j, first + b]
            sizes(w, N)
        for at in range(len(steps)):
            operation, k = steps[at, 0], constants[at]
            u, v, w = memory[steps[at, 1]], memory[steps[at, 2]], memory[steps[at, 3]]
            bent = operation >= MULTIPLY
            for b in range(CHUNK):
                mine, other = (u[0, b], u[G, b], u[S, b], u[R, b]), (v[0, b], v[G, b], v[S, b], v[R, b])
                alpha[b], beta[b], gamma[b], start[b], w[R, b] = coefficients(operation, k, mine, other)
            for row in range(R):
                for b in range(CHUNK):
                    w[row, b] = alpha[b] * u[row, b] + beta[b] * v[row, b]
            w[0] = start
            row = 1 + N
            for i in range(N if bent else 0):
                for b in range(CHUNK):
                    w[row, b] += gamma[b] * (u[1 + i, b] * v[1 + i, b])
                for j in range(i + 1, N):
                    for b in range(CHUNK):
                        w[row + j - i, b] += gamma[b] * (u[1 + i, b] * v[1 + j, b] + u[1 + j, b] * v[1 + i, b])
                row += N - i
            sizes(w, N)
        w = memory[steps[-1, 3]]
        row = 1 + N
        for b in range(count):
            c[first + b], r[first + b] = w[0, b], w[R, b]
        for i in range(N):
            for b in range(count):
                g[i, first + b] = w[1 + i, b]
            for j in range(i, N):
                for b in range(count):
                    Q[i, j, first + b] = w[row, b] if i == j else 0.5 * w[row, b]
                    Q[j, i, first + b] = Q[i, j, first + b]
                row += 1
