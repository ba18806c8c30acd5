"""The policy, enclosed: affine in the box coordinates on a leaf, a jet with quadratic remainder on the local ball.

Centring is folded into the last bias and the offset first. `fold` encloses net(0), so that the folded numbers
carry an error bound; at x = 0 the policy equals u_eq by its form, which the local rule uses.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from .document import Policy
from .errors import Rejected
from .float64 import (
    EPS,
    Array,
    atanh_with_error,
    float_with_error,
    frobenius_norm,
    gamma,
    norm,
    spectral_norm,
    tanh,
    total,
    up,
)

_SLOPE_ERROR = 2.0**-46  # of 1 - t^2 - s, computed from t = tanh(y) within 2^-47.5


@dataclass(frozen=True)
class Folded:
    """`u = scale * h + offset`, h the last layer's value (through tanh if `squash`), the centring folded in."""

    weights: tuple[Array, ...]
    biases: tuple[Array, ...]
    bias_error: Array  # of the last bias, shape (m,)
    squash: bool
    scale: Array
    offset: Array
    offset_error: Array
    norms: tuple[float, ...]  # upper bounds of ||W||_2


def fold(policy: Policy, u_eq: tuple[Fraction, ...]) -> Folded:
    """Fold the centring into the last bias and the offset; raises `Rejected` under rule `centring`."""
    squash, zeros, ones = policy.squash == "tanh", np.zeros_like(policy.offset), np.ones_like(policy.offset)
    norms = tuple(spectral_norm(W) for W in policy.weights)
    plain = Folded(policy.weights, policy.biases, zeros, squash, policy.scale, policy.offset, zeros, norms)
    if policy.centre == "none":
        _require_exact_equilibrium(policy, u_eq)
        return plain
    if policy.centre == "preactivation":
        biases = (*policy.biases[:-1], zeros)
        y, error = _at_origin(Folded(policy.weights, biases, zeros, False, ones, zeros, zeros, norms))
        beta, beta_error = _beta(policy, u_eq)
        last_error = up(beta_error + error + EPS * (np.abs(beta) + np.abs(y)))
        biases = (*policy.biases[:-1], beta - y)
        return Folded(policy.weights, biases, last_error, True, policy.scale, policy.offset, zeros, norms)
    h, error = _at_origin(Folded(policy.weights, policy.biases, zeros, squash, ones, zeros, zeros, norms))
    centre, centre_error = np.array([float_with_error(q) for q in u_eq]).T
    shift = policy.scale * h
    offset_error = up(np.abs(policy.scale) * error + centre_error + EPS * (np.abs(shift) + np.abs(centre)))
    return Folded(policy.weights, policy.biases, zeros, squash, policy.scale, centre - shift, offset_error, norms)


def _at_origin(net: Folded) -> tuple[Array, Array]:
    """The network's value at x = 0 and a bound of its error, each (m,): a box of one point."""
    n = net.weights[0].shape[1]
    mid, _, error = enclose_on_boxes(net, np.zeros((n, n + 1, 1)), np.zeros((n, 1)))
    return mid[:, 0], error[:, 0]


def _product(W: Array, h: Array, error: Array) -> tuple[Array, Array]:
    """`W h` and a bound of its error, for h within `error`."""
    return W @ h, up(total(np.abs(W) * error, 1) + gamma(len(h)) * norm(W, 1) * norm(h, 0))


def _beta(policy: Policy, u_eq: tuple[Fraction, ...]) -> tuple[Array, Array]:
    pairs = []
    for u, scale, offset in zip(u_eq, policy.scale, policy.offset, strict=True):
        ratio = (u - Fraction(float(offset))) / Fraction(float(scale))
        if not -1 < ratio < 1:
            raise Rejected("centring", "policy.offset", "u_eq must lie strictly inside offset +- scale")
        pairs.append(atanh_with_error(ratio))
    values, errors = np.array(pairs).T
    return values, errors


def _require_exact_equilibrium(policy: Policy, u_eq: tuple[Fraction, ...]) -> None:
    """raw(0) = u_eq in exact arithmetic; tanh is known only at exact 0, and 0 times an unknown number is 0."""

    def affine(W: Array, b: Array, h: list[Fraction | None]) -> list[Fraction | None]:
        result: list[Fraction | None] = []
        for row, bias in zip(W, b, strict=True):
            terms = [(Fraction(float(w)), v) for w, v in zip(row, h, strict=True) if w != 0]
            unknown = any(v is None for _, v in terms)
            known = sum((w * v for w, v in terms if v is not None), Fraction(float(bias)))
            result.append(None if unknown else known)
        return result

    def squash(h: list[Fraction | None]) -> list[Fraction | None]:
        return [Fraction(0) if v == 0 else None for v in h]

    h: list[Fraction | None] = [Fraction(0)] * policy.weights[0].shape[1]
    for k, (W, b) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        h = affine(W, b, squash(h) if k else h)
    h = squash(h) if policy.squash == "tanh" else h
    for v, scale, offset, u in zip(h, policy.scale, policy.offset, u_eq, strict=True):
        if v is None or Fraction(float(scale)) * v + Fraction(float(offset)) != u:
            raise Rejected("centring", "policy.centre", "pi(0) = u_eq cannot be shown exactly without centring")


def relax_tanh(centre: Array, radius: Array) -> tuple[Array, Array, Array]:
    """Parallel lines around tanh: (s, m, gap) with |tanh(y) - s y - m| <= gap for all |y - centre| <= radius.

    The slope s is *any* number in [0, 1] (here near the chord's). With D(y) = tanh(y) - s y: on y >= 0 tanh is
    concave, so D lies below its tangent at any point p >= 0; on y <= 0 D is convex, so it is largest at an end. Hence
    sup D <= max(D(lo), D(hi), and if hi > 0 the tangent's larger end over [max(lo, 0), hi]). D is odd, so inf D
    over [lo, hi] is -sup D over [-hi, -lo]. p should be near the critical point, but nothing depends on that.
    """
    radius = up(radius + EPS * np.abs(centre))
    lo, hi = centre - radius, centre + radius
    (t_lo, e_lo), (t_hi, e_hi), (t, _) = tanh(lo), tanh(hi), tanh(centre)
    slope = np.clip(np.where(radius > 1e-4, (t_hi - t_lo) / (hi - lo), 1 - t * t), 0.0, 1.0)
    critical = np.arctanh(np.sqrt(np.clip(1 - slope, 0.0, 1 - EPS)))

    def end(y: Array, t: Array, error: Array) -> Array:
        return np.asarray(t - slope * y + up(error + EPS * (np.abs(t) + slope * np.abs(y))))

    def supremum(lo: Array, hi: Array, ends: Array) -> Array:
        start = np.maximum(lo, 0.0)
        width = up(hi - start)
        p = np.clip(critical, start, hi)
        t, error = tanh(p)
        excess = 1 - t * t - slope
        rise = np.maximum(excess * (start - p), excess * (hi - p))
        slack = error + _SLOPE_ERROR * width + EPS * (np.abs(t) + slope * p + np.abs(excess) * width)
        return np.where(hi > 0, np.maximum(ends, t - slope * p + rise + up(slack)), ends)

    upper = supremum(lo, hi, np.maximum(end(lo, t_lo, e_lo), end(hi, t_hi, e_hi)))
    lower = -supremum(-hi, -lo, np.maximum(end(-hi, -t_hi, e_hi), end(-lo, -t_lo, e_lo)))
    return slope, (upper + lower) / 2, up((upper - lower) / 2 + EPS * (np.abs(upper) + np.abs(lower)))


def enclose_on_boxes(net: Folded, x: Array, x_error: Array) -> tuple[Array, Array, Array]:
    """The policy on a batch of boxes: `|u - mid - slopes.d| <= error` for all d in [-1, 1]^n.

    x (n, n + 1, B) is the state as an affine form: centre, then the slope for each d_j; the state lies within
    x_error (n, B) of it. Returns mid (m, B), slopes (m, n, B), error (m, B).

    Each layer's value is an affine form in d, plus the `fresh` error made there, plus `old` errors from the layers
    before, which are bounded both by component and, by `ball`, in the 2-norm. Forwards, fresh errors pass through |W|,
    old ones through |W| or ||W_i|| ball, whichever is less; the 2-norm of all passes through ||W||_2. That gives the
    range over which tanh is relaxed. The output's own error is found backwards: each layer's fresh error times the
    magnitude of the weight with which it reaches the output, so that errors cancel through W as they do in truth.
    """
    n, batch = x.shape[0], x.shape[2]
    h, fresh, old, ball = x, x_error, np.zeros_like(x_error), np.zeros(batch)
    passed: list[tuple[Array, Array, Array]] = []  # W, slope of the relaxation, fresh error behind it
    for k, (W, b) in enumerate(zip(net.weights, net.biases, strict=True)):
        last = k == len(net.weights) - 1
        width = W.shape[1]
        y = (W @ h.reshape(width, -1)).reshape(len(W), n + 1, batch)
        y[:, 0] += b[:, None]
        rounding = gamma(width) * norm(W, 1)[:, None] * total(norm(h, 0), 0)
        rounding = rounding + EPS * (np.abs(y[:, 0]) + np.abs(b)[:, None])
        rounding = up(rounding + net.bias_error[:, None] if last else rounding)
        through_old = np.minimum((np.abs(W) @ old) * (1 + gamma(width)), norm(W, 1)[:, None] * ball)
        error = up((np.abs(W) @ fresh) * (1 + gamma(width)) + through_old + rounding)
        ball = up(net.norms[k] * up(ball + norm(fresh, 0)) + norm(rounding, 0))
        if last and not net.squash:
            passed.append((W, np.ones_like(error), rounding))
            h = y
            continue
        spread = total(np.abs(y[:, 1:]), 1)
        slope, shift, gap = relax_tanh(y[:, 0], up(spread + error))
        fresh = up(gap + slope * rounding + EPS * (slope * (np.abs(y[:, 0]) + spread) + np.abs(shift)))
        h = slope[:, None] * y
        h[:, 0] += shift
        old = up(slope * error)
        ball = np.minimum(up(np.max(slope, axis=0) * ball), norm(old, 0))
        passed.append((W, slope, fresh))

    through, slopes = net.scale[:, None] * h[:, 0], net.scale[:, None, None] * h[:, 1:]
    mid = through + net.offset[:, None]
    rounding = EPS * (np.abs(through) + np.abs(net.offset)[:, None] + np.abs(mid) + total(np.abs(slopes), 1))
    result = rounding + net.offset_error[:, None] + _error_backwards(net.scale, passed, x_error)
    return mid, slopes, np.asarray(up(result))


def _error_backwards(scale: Array, passed: list[tuple[Array, Array, Array]], x_error: Array) -> Array:
    """Bound of each output's error, shape (m, B); `doubt` bounds the rounding error of each entry of `weight`."""
    m, batch = len(scale), x_error.shape[1]
    weight = np.broadcast_to(np.diag(scale)[:, :, None], (m, m, batch))
    doubt = np.zeros((m, batch))
    result = np.zeros((m, batch))
    for W, slope, fresh in reversed(passed):
        result = result + total((np.abs(weight) + doubt) * fresh[:, None], 0)
        through = slope[:, None] * weight
        columns = float(np.max(total(np.abs(W), 0)))
        doubt = columns * (doubt + EPS * np.max(np.abs(weight), axis=0))
        doubt = up(doubt + gamma(len(W)) * float(np.max(norm(W, 0))) * norm(through, 0))
        weight = (W.T @ through.reshape(len(W), -1)).reshape(W.shape[1], m, batch)
    return np.asarray(up(result + total((np.abs(weight) + doubt) * x_error[:, None], 0)))


def enclose_at_origin(net: Folded, J: Array, slack: float) -> tuple[Array, float, float]:
    """The policy on the ball x = J d, ||d|| <= 1: `pi = u_eq + scale * (G d + R(d))` with ||R(d)||_2 <= k ||d||^2.

    J (n, n) lies within `slack` of the true matrix in the 2-norm. Returns scale * G (m, n), and before scaling
    the slack of G in the 2-norm and k.

    Layer by layer, with y(d) = y(0) + J d + R(d): tanh adds at most half the largest second derivative over the
    reached range times (y_i(d) - y_i(0))^2, and W multiplies 2-norms by at most ||W||_2. The second derivative of
    tanh is at most 4 / (3 sqrt 3) < 0.77 in magnitude, the third at most 2.
    """
    y, error, k = np.zeros(len(J)), np.zeros(len(J)), 0.0
    for layer, (W, b) in enumerate(zip(net.weights, net.biases, strict=True)):
        last = layer == len(net.weights) - 1
        sigma = net.norms[layer]
        slack = float(up(sigma * slack + gamma(W.shape[1]) * frobenius_norm(W) * frobenius_norm(J)))
        product, error = _product(W, y, error)
        y, J, k = product + b, W @ J, float(up(sigma * k))
        error = up(error + EPS * (np.abs(product) + np.abs(b)) + (net.bias_error if last else 0.0))
        if last and not net.squash:
            break
        reach = up(norm(J, 1) + slack + k)  # |y_i(d) - y_i(0)| <= reach_i ||d||
        whole = float(up(frobenius_norm(J) + slack + k))
        t, e = tanh(y)
        e = up(e + error)
        slope = 1 - t * t
        slope_error = up(2 * e * (1 + e) + EPS)
        steepest = float(np.max(up(slope + slope_error)))
        half = np.minimum(0.385, up((np.abs(t) + e) * (slope + slope_error) + reach))
        k = float(up(steepest * k + float(np.max(up(half * reach))) * whole))
        slack = float(up(steepest * slack + (float(np.max(slope_error)) + EPS) * whole))
        y, error, J = t, e, slope[:, None] * J
    return net.scale[:, None] * J, slack, k
