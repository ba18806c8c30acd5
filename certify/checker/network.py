"""The policy: its layers, the centring folded into them, and its enclosure on boxes, affine in the box coordinates.

At x = 0 the policy equals u_eq by its form, which the local rule uses; local.py has the enclosure on the ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np

from .document import Policy
from .float64 import EPS, Array, atanh_with_error, ends, float_with_error, gamma, norm, spectral_norm, tanh, total, up


@dataclass(frozen=True)
class Layer:
    """`W h + b`, b within `b_error`; `norm2` is an upper bound of ||W||_2."""

    W: Array
    b: Array
    b_error: Array
    norm2: float

    @cached_property
    def rows(self) -> Array:
        """Upper bounds of the rows' 2-norms, (rows, 1)."""
        return norm(self.W, 1)[:, None]

    def affine(self, h: Array, size: Array) -> tuple[Array, Array]:
        """(y, rounding): W h (width, k, B) with b added to its first column, and for each row the error made.

        With |d_j| <= 1, `rounding` (rows, B) bounds the errors of the affine form y_0 + sum_j y_j d_j: those of its
        products are at most gamma sum_l |W_il| sum_j |h_lj|, and `size` (width, B) is not below the inner sum.
        """
        rows, width = self.W.shape
        y = np.matmul(self.W, h.reshape(width, -1)).reshape(rows, *h.shape[1:])
        y[:, 0] += self.b[:, None]
        made = gamma(width) * (self.rows * norm(size, 0))
        return y, up(made + EPS * (np.abs(y[:, 0]) + np.abs(self.b)[:, None]) + self.b_error[:, None])

    def widest(self, error: Array) -> Array:
        """Upper bounds (rows, B) of what errors (width, B) of h come to, row by row."""
        return np.matmul(np.abs(self.W), error) * (1 + gamma(self.W.shape[1]))


@dataclass(frozen=True)
class Folded:
    """`u = scale * h + offset`, h the last layer's value (through tanh if `squash`), the centring folded in; `clip`
    (lo, hi) is applied to that."""

    layers: tuple[Layer, ...]
    squash: bool
    scale: Array
    offset: Array
    offset_error: Array
    clip: tuple[Array, Array] | None = None


def fold(policy: Policy, u_eq: tuple[Fraction, ...]) -> Folded:
    """Fold the origin into the first bias, the centring into the last or the offset; rule `centring` has to hold."""
    zeros, ones = np.zeros_like(policy.offset), np.ones_like(policy.offset)
    pairs = zip(policy.weights, policy.biases, strict=True)
    first, *others = (Layer(W, b, np.zeros_like(b), spectral_norm(W)) for W, b in pairs)
    layers = (first if policy.origin is None else _moved(first, policy.origin), *others)
    plain = Folded(layers, policy.squash == "tanh", policy.scale, policy.offset, zeros, policy.clip)
    if policy.centre == "none":
        return plain
    if policy.centre == "preactivation":
        bare = (*layers[:-1], replace(layers[-1], b=zeros))
        y, error = _at_origin(Folded(bare, False, ones, zeros, zeros))
        beta, beta_error = np.array([atanh_with_error(q) for q in reaches(policy, u_eq)]).T
        wrong = up(beta_error + error + EPS * (np.abs(beta) + np.abs(y)))
        return replace(plain, layers=(*layers[:-1], replace(layers[-1], b=beta - y, b_error=wrong)))
    h, error = _at_origin(Folded(layers, plain.squash, ones, zeros, zeros))
    centre, centre_error = np.array([float_with_error(q) for q in u_eq]).T
    shift = policy.scale * h
    wrong = up(np.abs(policy.scale) * error + centre_error + EPS * (np.abs(shift) + np.abs(centre)))
    return replace(plain, offset=centre - shift, offset_error=wrong)


def _moved(layer: Layer, origin: Array) -> Layer:
    """`W (origin + x) + b` as a layer that reads x."""
    b = layer.b + layer.W @ origin
    wrong = up(gamma(len(origin)) * (layer.rows[:, 0] * norm(origin, 0)) + EPS * np.abs(b))
    return replace(layer, b=b, b_error=wrong)


def reaches(policy: Policy, u_eq: tuple[Fraction, ...]) -> list[Fraction]:
    """`(u_eq - offset) / scale`, of which beta is the atanh."""
    each = zip(u_eq, policy.offset.tolist(), policy.scale.tolist(), strict=True)
    return [(u - Fraction(offset)) / Fraction(scale) for u, offset, scale in each]


def _at_origin(net: Folded) -> tuple[Array, Array]:
    """The network's value at x = 0, as a box of one point, and a bound of its error, each (m,)."""
    n = net.layers[0].W.shape[1]
    mid, _, error = enclose_on_boxes(net, np.zeros((n, n + 1, 1)), np.zeros((n, 1)))
    return mid[:, 0], error[:, 0]


def relax_tanh(centre: Array, radius: Array) -> tuple[Array, Array, Array]:
    """Parallel lines around tanh: (s, m, gap) with |tanh(y) - s y - m| <= gap for all |y - centre| <= radius.

    The slope s is *any* number in [0, 1] (here near the chord's). D(y) = tanh(y) - s y is odd: what is shown of
    [lo, hi] around |centre|, where hi > 0 and |lo| <= hi, holds around -|centre| with the signs changed. On y >= 0
    tanh is concave, so D lies below its tangent at any p >= 0 and is least at an end; on y <= 0 it is convex, so D is
    largest at an end. Hence sup D is at most D(lo) or the larger end of the tangent over [max(lo, 0), hi]. And inf D
    is at least D(hi) or, if lo >= 0, D(lo), else, as D is odd, minus the larger end over [0, -lo] of the tangent at any
    p >= 0 (at 0 the tangent is not below D(0) = 0). p should be the critical point, or the end that is nearest to it,
    but nothing depends on that.

    Roundings, with |y| <= hi and so |t| <= t_hi (1 + 14u): `t - s y` is within 9u t_hi + 3u s hi, and `excess` within
    18u (7u of t twice, and three roundings); the product with a part of the width adds 2u of it, and the last sum u of
    all: 10u t_hi + 4u s hi + 21u (hi - start) is less than `slack`.
    """
    lo, hi = ends(np.abs(centre), radius)
    (t_lo, _), (t_hi, error) = tanh(lo), tanh(hi)
    slope = np.maximum(np.minimum((t_hi - t_lo) / (hi - lo), 1.0), 0.0)
    start = np.maximum(lo, 0.0)
    p = np.minimum(np.maximum(np.arctanh(np.sqrt(1 - slope)), start), hi)
    t, _ = tanh(p)

    def tangent(p: Array, t: Array, start: Array | float, end: Array) -> Array:
        excess = 1 - t * t - slope
        return t - slope * p + np.maximum(excess * (start - p), excess * (end - p))

    at_lo, at_hi, below = t_lo - slope * lo, t_hi - slope * hi, -lo
    upper = np.maximum(at_lo, tangent(p, t, start, hi))
    least = -tangent(np.minimum(p, below), np.where(p < below, t, -t_lo), 0.0, below)
    lower = np.minimum(at_hi, np.where(lo < 0, least, at_lo))
    slack = up(error + 4 * EPS * (t_hi + slope * hi + (hi - start)))
    upper, lower = upper + slack, lower - slack
    gap = up((upper - lower) / 2 + EPS * (np.abs(upper) + np.abs(lower)))
    return slope, np.where(centre < 0, -0.5, 0.5) * (upper + lower), gap


def enclose_on_boxes(net: Folded, x: Array, x_error: Array) -> tuple[Array, Array, Array]:
    """The policy on a batch of boxes: `|u - mid - slopes.d| <= error` for all d in [-1, 1]^n.

    x (n, n + 1, B) is the state as an affine form: centre, then the slope for each d_j; the state lies within
    x_error (n, B) of it. Returns mid (m, B), slopes (m, n, B), error (m, B).

    Each layer's value is an affine form h in d, plus errors of two ages. `fresh` (width, B) bounds, component by
    component, what the relaxation just before and its roundings have added. `old` (width, B) bounds component by
    component what came through from before that, and `ball` (B,) the 2-norm of the same vector of old errors.
    Forwards, fresh errors pass through |W|, old ones through |W| or ||W_i|| ball, whichever is less; the 2-norm of all
    passes through ||W||_2. That gives the range over which tanh is relaxed. The output's own error is found backwards:
    each layer's fresh error times the magnitude of the weight with which it reaches the output, so that errors cancel
    through W as they do in truth.
    """
    h, size, fresh, old, ball = x, total(np.abs(x), 1), x_error, np.zeros_like(x_error), np.zeros(x.shape[2])
    passed: list[tuple[Array, Array, Array]] = []  # W, slope of the relaxation, fresh error behind it
    for k, layer in enumerate(net.layers):
        y, rounding = layer.affine(h, size)
        if k == len(net.layers) - 1 and not net.squash:
            passed.append((layer.W, np.ones_like(rounding), rounding))
            h = y
            break
        through = np.minimum(layer.widest(old), layer.rows * ball)
        error = up(layer.widest(fresh) + through + rounding)
        ball = up(layer.norm2 * up(ball + norm(fresh, 0)) + norm(rounding, 0))
        spread = total(np.abs(y[:, 1:]), 1)
        slope, shift, gap = relax_tanh(y[:, 0], up(spread + error))
        size = up(slope * up(np.abs(y[:, 0]) + spread) + np.abs(shift))
        fresh = up(gap + slope * rounding + EPS * size)
        y *= slope[:, None]
        y[:, 0] += shift
        h = y
        old = up(slope * error)
        ball = np.minimum(up(np.max(slope, axis=0) * ball), norm(old, 0))
        passed.append((layer.W, slope, fresh))

    through, slopes = net.scale[:, None] * h[:, 0], net.scale[:, None, None] * h[:, 1:]
    mid = through + net.offset[:, None]
    rounding = EPS * (np.abs(through) + np.abs(net.offset)[:, None] + np.abs(mid) + total(np.abs(slopes), 1))
    error = up(rounding + net.offset_error[:, None] + _error_backwards(net.scale, passed, x_error))
    return clipped(mid, slopes, error, *net.clip) if net.clip else (mid, slopes, error)


def clipped(mid: Array, slopes: Array, error: Array, least: Array, most: Array) -> tuple[Array, Array, Array]:
    """`min(max(v, least), most)` of the affine forms v = mid + slopes.d within error, again as affine forms; least and
    most (m,).

    Nothing changes where v certainly stays between them. Elsewhere clip(v) - s v is linear between the corners of clip,
    so that its extremes over the range of v lie at the range's ends or at corners in it; s is *any* number in [0, 1],
    here near the chord's slope.
    """
    least, most, spread = least[:, None], most[:, None], total(np.abs(slopes), 1)
    lo, hi = ends(mid, up(spread + error))
    inside = (lo >= least) & (hi <= most)
    width = np.clip(hi, least, most) - np.clip(lo, least, most)
    s = np.clip(width / (hi - lo), 0.0, 1.0)
    v = np.array([lo, hi, np.clip(least, lo, hi), np.clip(most, lo, hi)])
    u = np.clip(v, least, most)
    away = u - s * v
    upper, lower = np.max(away, axis=0), np.min(away, axis=0)
    slack = np.max(up(EPS * (np.abs(u) + s * np.abs(v))), axis=0)
    shift, gap = (upper + lower) / 2, up((upper - lower) / 2 + slack + EPS * (np.abs(upper) + np.abs(lower)))
    wide = up(s * error + gap + EPS * (s * (np.abs(mid) + spread) + np.abs(shift)))
    return (
        np.where(inside, mid, s * mid + shift),
        np.where(inside[:, None], slopes, s[:, None] * slopes),
        np.where(inside, error, wide),
    )


def _error_backwards(scale: Array, passed: list[tuple[Array, Array, Array]], x_error: Array) -> Array:
    """Bound of each output's error, shape (m, B).

    `weight` (m, width, B), with which an error behind the layer in hand reaches the output, is computed; `doubt` (m, B)
    bounds how far any of its entries is from the product of the stored weights and slopes: at first it is exact.
    """
    m, batch = len(scale), x_error.shape[1]
    weight = np.broadcast_to(np.diag(scale)[:, :, None], (m, m, batch))
    doubt = result = np.zeros((m, batch))
    for W, slope, fresh in reversed(passed):
        result = result + total((np.abs(weight) + doubt) * fresh[:, None], 0)
        through = slope[:, None] * weight
        doubt = float(np.max(total(np.abs(W), 0))) * up(doubt + EPS * np.max(np.abs(weight), axis=0))
        doubt = up(doubt + gamma(len(W)) * (float(np.max(norm(W, 0))) * norm(through, 0)))
        weight = np.matmul(W.T, through.reshape(len(W), -1)).reshape(W.shape[1], m, batch)
    return up(result + total((np.abs(weight) + doubt) * x_error[:, None], 0))
