"""The formulas for a batch of boxes between two products of matrices, and loops over them.

A formula is written once, for arrays and for single numbers alike: `vectors.py` gives it the arrays of numpy, and the
loops here, which `compiled.py` compiles, a number each. Both do the same IEEE operations in the same order, so that
they give the same bits: no `fastmath`, so that nothing is contracted or reordered. A comparison with NaN is false; each
choice below is written so that a NaN reaches the result. Each loop over boxes is the innermost, where it becomes vector
instructions. tanh and its inverse of a network stay numpy's, which evaluates many at once: compiled loops call libm for
each.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from certify.provers.bounds.tape import (
    ABS,
    ADD,
    ATAN,
    CONSTANT,
    COS,
    EXP,
    INNER,
    INVERSE,
    MULTIPLY,
    SCALED,
    SHIFTED,
    SIN,
    SQRT,
    TANH,
)

Line: TypeAlias = NDArray[np.float64]  # one dimension, in C's order
Plane: TypeAlias = NDArray[np.float64]  # two dimensions
Block: TypeAlias = NDArray[np.float64]  # three dimensions
Steps: TypeAlias = NDArray[np.int64]
Real: TypeAlias = Any  # a number where it is compiled, else an array too
Two: TypeAlias = tuple[Real, Real]
Four: TypeAlias = tuple[Real, Real, Real, Real]
Five: TypeAlias = tuple[Real, Real, Real, Real, Real]
EPS, TINY, EXP_END = 2.0**-50, 2.0**-900, 64.0  # as in taylor.py; written here, because numba keeps what it has seen
THIRD = (1 + 2.0**-40) / 3  # likewise
SLACK = 2.0**-47  # error allowed to tanh, relative to 1; numpy's errs by 2^-51 at most
CHUNK = 32  # boxes at a time in the plant: their models stay in a core's cache
LOST = 2.0**-500  # more than a 2-norm loses where squares underflow


def _number_by_number(function: Callable[[float], float]) -> Callable[[Real], Real]:
    """A function of libm on an array, because numpy's own may differ by a rounding from the compiled one."""

    def at(v: float) -> float:
        try:
            return function(v)
        except OverflowError:
            return math.inf
        except ValueError:
            return math.nan

    every = np.frompyfunc(at, 1, 1)
    return lambda v: np.asarray(every(v), dtype=np.float64)


LIBM = {"exp": math.exp, "tanh": math.tanh, "atan": math.atan, "sin": math.sin, "cos": math.cos}
exp, tanh, atan, sin, cos = map(_number_by_number, LIBM.values())  # compiled, they are those of libm
choose = np.where  # compiled, it is `one`


def one(condition: bool, a: float, b: float) -> float:
    """`choose` of numbers."""
    return a if condition else b


def smaller(a: Real, b: Real) -> Real:
    """a, if it is less than b."""
    return choose(a < b, a, b)


def larger(a: Real, b: Real) -> Real:
    """a, if it is more than b."""
    return choose(a > b, a, b)


def enclosed(
    centre: Real, b: Real, b_error: Real, row: Real, passed: Two, ball: Real, each: Real, spread: Real, growths: Two
) -> Four:
    """The ends of a unit's range, its error and the rounding in that, from its affine form's `centre` and `spread`.

    Parameters
    ----------
    b, b_error, row : its bias, the error of that, and the 2-norm of its weights.
    passed : what comes through |W| of the fresh errors and of the older ones.
    ball : the 2-norm of the older errors that came in.
    each : the rounding of a product of matrices, of a row of norm 1.
    growths : what rounding makes of sums over all that come in, and over the columns of the form.
    """
    (fresh, older), (grown, wider) = passed, growths
    own = each * row + 8 * EPS * (abs(centre) + abs(b)) + TINY + b_error
    whole = (fresh + smaller(row * ball, older)) * grown + own
    radius = (spread + whole) * wider * (1 + EPS) + EPS * abs(centre) + TINY
    return centre - radius, centre + radius, whole, own


def chord(lo: Real, hi: Real, t_lo: Real, t_hi: Real) -> Two:
    """The slope s of tanh's chord between lo and hi, and sqrt(1 - s)."""
    s = (t_hi - t_lo) / (hi - lo)
    s = choose(s < 0.0, 0.0, s)
    s = choose(s > 1.0, 1.0, s)
    rest = 1 - s
    return s, np.sqrt(choose(rest > 1 - EPS, 1 - EPS, rest))


def relaxed(ends: Two, values: Two, s: Real, p: Real, t: Real, centre: Real) -> Two:
    """Parallel lines: (m, gap) with |tanh(y) - s y - m| <= gap for y between the ends, `values` being tanh there.

    s is the chord's slope. D(y) = tanh(y) - s y rises up to the p >= 0 at which tanh' is s and falls beyond, among
    y >= 0; among y <= 0 it is convex and largest at an end; and it is odd. tanh(p) = t = sqrt(1 - s), so that neither
    bound needs another tanh. Where p is not exact, |D'(p)| <= 2^-48 and D' is monotone between p and the exact one.
    """
    (lo, hi), (t_lo, t_hi) = ends, values
    slack = SLACK * (1 + (hi - lo))
    a, b = t_lo - s * lo, t_hi - s * hi
    value = choose(p < lo, t_lo, choose(p > hi, t_hi, t))
    at = choose(p < lo, lo, choose(p > hi, hi, p))
    upper = larger(value - s * at, larger(a, b)) + slack
    value = choose(-p < lo, t_lo, choose(-p > hi, t_hi, -t))
    at = choose(-p < lo, lo, choose(-p > hi, hi, -p))
    lower = smaller(value - s * at, smaller(a, b)) - slack
    reach = abs(centre) + (hi - lo) / 2  # infinite or NaN where an end is, and then the gap is NaN
    gap = (upper - lower) / 2 + EPS * (abs(upper) + abs(lower) + s * reach) + TINY
    return (upper + lower) / 2, gap


def bent(centre: Real, spread: Real, s: Real, steep: Real, shift: Real, gap: Real, own: Real) -> Two:
    """The middle of a unit's affine form behind a function, and its fresh error, from the rounding in front; `steep` is
    the size of s."""
    fresh = gap + steep * own + EPS * (steep * (abs(centre) + spread) + abs(shift)) + TINY
    return s * centre + shift, fresh


def expansion(operation: int, c: Real, reach: Real) -> Four:
    """phi(c), phi'(c), phi''(c)/2 and a bound of |phi'''|/6 within `reach` of c, as `Taylor` takes them; NaN where
    there is none. libm errs by a few units in the last place at most, `Taylor.compose` allows for sixteen."""
    if operation == INVERSE:
        least = abs(c) - reach
        least = choose(least > 0, least, np.nan)
        f = 1 / c
        cube = f * f * f
        return f, -f * f, cube, abs(cube) / least * (1 + EPS) + TINY
    if operation == SQRT:
        least = c - reach
        s, w = np.sqrt(c), np.sqrt(choose(least > 0, least, np.nan))
        p, q = 1 / s, 1 / (s + w)
        return s, p / 2, -p * p * p / 8, p * p * q * q * (2 * q + p) / 8 * (1 + 32 * EPS) + TINY
    if operation == EXP:
        e, most = exp(c), c + reach
        third = choose(most < EXP_END, exp(most) / 6 * (1 + 128 * EPS) + TINY, np.nan)
        return e, e, e / 2, third
    if operation == TANH:
        t = tanh(c)
        slope = 1 - t * t
        return t, slope, -t * slope, 1 / 3 + EPS
    if operation == ATAN:
        slope = 1 / (1 + c * c)
        return atan(c), slope, -c * slope * slope, 1 / 3 + EPS
    sine, cosine = sin(c), cos(c)
    if operation == SIN:
        third = abs(cosine) + reach + EPS
        return sine, cosine, -sine / 2, choose(third > 1.0, 1.0, third) / 6
    if operation == COS:
        third = abs(sine) + reach + EPS
        return cosine, -sine, -cosine / 2, choose(third > 1.0, 1.0, third) / 6
    return np.nan, np.nan, np.nan, np.nan


def corner(c: Real, reach: Real) -> Two:
    """|v| within `reach` of c, as `Taylor` has it: a slope s, and a number that |v| - s v is within that of."""
    s = choose(c >= reach, 1.0, choose(c <= -reach, -1.0, c / (reach + TINY)))
    half = larger((reach - c) * (1 + s), (reach + c) * (1 - s)) / 2 * (1 + EPS)
    return s, choose(abs(c) >= reach, 0.0, half)


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
    if operation == INNER:  # what is of third order has at most 2^9 roundings
        rest = abs(c) * vr + abs(vc) * r + S * vS + r * (vG + vS + vr) + vr * (G + S)
        return vc, c, 1.0, c * vc, rest + 64 * EPS * (whole * other + rest) + TINY
    q = S + r
    rho = G + q
    if operation == ABS:
        s, half = corner(c, rho * (1 + EPS))
        start = s * c + half
        rest = abs(s) * r + half
        return s, 0.0, 0.0, start, rest + 2 * EPS * (abs(start) + abs(s) * (1 + rho) + rest) + TINY
    f0, f1, f2, third = expansion(operation, c, rho * (1 + EPS))
    rest = abs(f1) * r + abs(f2) * (2 * G * q + q * q) + third * (rho * rho * rho)
    rest = rest + 2 * EPS * (abs(f0) + abs(f1) * (1 + rho) + abs(f2) * (1 + rho * rho) + rest)
    return f1, 0.0, f2, f0, rest + TINY


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
    square = np.zeros(batch)
    each = (width + 2) * EPS * np.sqrt(forms) * (np.sqrt(size) + LOST)
    for i in range(units):
        b, b_error, r = bias[i], bias_error[i], row[i]
        for k in range(batch):
            spread[i, k] = abs(y[i, 1, k])
        for j in range(2, forms):
            for k in range(batch):
                spread[i, k] += abs(y[i, j, k])
        for k in range(batch):
            centre = y[i, 0, k] + b
            passed = through[i, 0, k], through[i, 1, k]
            lo, hi, whole, own = enclosed(centre, b, b_error, r, passed, ball[k], each[k], spread[i, k], (grown, wider))
            y[i, 0, k] = centre
            ends[0, i, k], ends[1, i, k], error[i, k], rounding[i, k] = lo, hi, whole, own
            square[k] += own * own
    for k in range(batch):
        ball[k] = (norm * (ball[k] + np.sqrt(fresh[k]) + LOST) + np.sqrt(square[k]) + LOST) * grown


def chords(ends: Block, values: Block, slope: Plane, t: Plane) -> None:
    """The slopes s (H, B) of tanh's chords between `ends` (2, H, B), `values` being tanh there; and sqrt(1 - s)."""
    _, units, batch = ends.shape
    for i in range(units):
        for k in range(batch):
            slope[i, k], t[i, k] = chord(ends[0, i, k], ends[1, i, k], values[0, i, k], values[1, i, k])


def relax(ends: Block, values: Block, slope: Plane, t: Plane, p: Plane, y: Block) -> None:
    """The lines of `relaxed` for a layer's units: t and p, sqrt(1 - slope) and where tanh is that, become their shifts
    and gaps (H, B)."""
    _, units, batch = ends.shape
    for i in range(units):
        for k in range(batch):
            there, known = (ends[0, i, k], ends[1, i, k]), (values[0, i, k], values[1, i, k])
            t[i, k], p[i, k] = relaxed(there, known, slope[i, k], p[i, k], t[i, k], y[i, 0, k])


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
    """A function of a layer's affine forms y (H, n + 1, B), in their place, by parallel lines around it.

    Parameters
    ----------
    slope, shift, gap : of the lines; a slope may be negative.
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
            steep = abs(slope[i, k])
            middle, new = bent(y[i, 0, k], spread[i, k], slope[i, k], steep, shift[i, k], gap[i, k], rounding[i, k])
            old = steep * error[i, k]
            form = (abs(middle) + steep * spread[i, k]) * wider
            y[i, 0, k] = middle
            errors[i, 0, k], errors[i, 1, k] = new, old
            spread[i, k] = gap[i, k] / (spread[i, k] + TINY)
            size[k] += form * form
            fresh[k] += new * new
            older[k] += old * old
            steepest[k] = steep if steep > steepest[k] else steepest[k]
        for j in range(len(share)):
            for k in range(batch):
                share[j, k] += spread[i, k] * abs(y[i, j + 1, k])
        for j in range(1, forms):
            for k in range(batch):
                y[i, j, k] *= slope[i, k]
    for k in range(batch):
        ball[k] = smaller(steepest[k] * ball[k], (np.sqrt(older[k]) + LOST) * grown)


def backwards(weight: Block, errors: Block, slope: Plane, result: Plane) -> None:
    """Add what a layer's fresh errors, `errors[:, 0]` of (H, 2, B), weigh in the outputs (m, B), and multiply their
    weights (H, m, B) by the slopes of its lines."""
    units, outputs, batch = weight.shape
    total = np.zeros((outputs, batch))
    for i in range(units):
        for j in range(outputs):
            for k in range(batch):
                total[j, k] += abs(weight[i, j, k]) * errors[i, 0, k]
                weight[i, j, k] *= slope[i, k]
    result += total


def sizes(model: Plane, symbols: int) -> None:
    """The last two rows of a model in that many symbols: sums of magnitudes of its linear and its quadratic part."""
    rest = 1 + symbols + symbols * (symbols + 1) // 2
    model[rest + 1 :] = 0.0
    for row in range(1, rest):
        to = rest + 1 if row <= symbols else rest + 2
        for b in range(CHUNK):
            model[to, b] += abs(model[row, b])


def result(w: Plane, first: int, count: int, c: Line, g: Plane, Q: Block, r: Line) -> None:
    """A place's model of `count` boxes as (c, g, Q, r) of the boxes from `first` on."""
    N = len(g)
    R = 1 + N + N * (N + 1) // 2
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


def cube(u: Plane, v: Plane, symbols: int, T: Plane) -> None:
    """Add what is of third order in the product of two models: row i P + p of T is for d_i times the p-th of the P
    pairs d_j d_k, j <= k."""
    P = symbols * (symbols + 1) // 2
    for i in range(symbols):
        for p in range(P):
            for b in range(CHUNK):
                T[i * P + p, b] += u[1 + i, b] * v[1 + symbols + p, b] + v[1 + i, b] * u[1 + symbols + p, b]


def third(T: Plane, symbols: int, first: int, count: int, t: Plane) -> None:
    """t (N, B) for which what T holds lies within sum_i t_i d_i^2: |d_i d_j d_k| <= (d_i^2 + d_j^2 + d_k^2) / 3."""
    P = symbols * (symbols + 1) // 2
    for i in range(symbols):
        for j in range(i, symbols):
            ij = i * symbols - i * (i - 1) // 2 + j - i
            for k in range(j, symbols):
                ik = i * symbols - i * (i - 1) // 2 + k - i
                jk = j * symbols - j * (j - 1) // 2 + k - j
                for b in range(count):
                    c = T[i * P + jk, b]
                    c = c + T[j * P + ik, b] if j > i else c
                    c = c + T[k * P + ij, b] if k > j else c
                    c = abs(c) * THIRD
                    t[i, first + b] += c
                    t[j, first + b] += c
                    t[k, first + b] += c


def enter(
    memory: Block,
    x: Block,
    x_error: Plane,
    middle: Plane,
    slopes: Block,
    wide: Plane,
    quantities: Plane,
    first: int,
    count: int,
) -> None:
    """Put the inputs of a tape, for `count` boxes from `first` on, in the first places; see `play`."""
    n, inputs = x.shape[0], x.shape[0] + len(wide)
    N = inputs + len(quantities)
    R = 1 + N + N * (N + 1) // 2
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
    """The result (c, g, Q, r) of a tape whose inputs are n states, m inputs and k uncertain quantities, as
    `loop_models` makes them; `quantities` (k, 3) are the middle of each, its reach and the rounding of these. The third
    order of an inner product is within sum_i t_i d_i^2, t (N, B).

    A place holds a model of CHUNK boxes, a row each: c, g, the coefficients of d_i d_j for i <= j, ordered by i and
    then by j, then r, sum |g_i| and the sum of the coefficients' magnitudes. Each operation is `alpha u + beta v`, with
    `gamma` times the product of the linear parts, and a remainder of its own.
    """
    N, batch = len(g), len(c)
    R = 1 + N + N * (N + 1) // 2
    G, S = R + 1, R + 2
    memory = np.zeros((places, R + 3, CHUNK))
    inner = np.any(steps[:, 0] == INNER)
    T = np.zeros((N * (R - 1 - N) if inner else 0, CHUNK))
    t[:] = 0.0
    alpha, beta, gamma, start = np.zeros(CHUNK), np.zeros(CHUNK), np.zeros(CHUNK), np.zeros(CHUNK)
    for first in range(0, batch, CHUNK):
        count = min(CHUNK, batch - first)
        T[:] = 0.0
        enter(memory, x, x_error, middle, slopes, wide, quantities, first, count)
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
            if operation == INNER:
                cube(u, v, N, T)
            sizes(w, N)
        if inner:
            third(T, N, first, count, t)
        result(memory[steps[-1, 3]], first, count, c, g, Q, r)
