"""The policy, and its enclosure on a leaf: affine in the box coordinates within an error.

Centring is folded into the last bias and the offset first. `fold` encloses net(0), so that the folded numbers
carry an error bound; at x = 0 the policy equals u_eq by its form, which the local rule uses.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from .arithmetic import Number, carry, ends, lesser, maximum, middle, norm, product, tanh, total, up
from .document import Policy
from .errors import Rejected
from .float64 import EPS, Array, atanh_with_error, float_with_error, gamma, spectral_norm

_SLOPE_ERROR = 2.0**-46  # of 1 - t^2 - s, computed from t = tanh(y) within 2^-47.5


@dataclass(frozen=True)
class Folded:
    """`u = scale * h + offset`, h the last layer's value (through tanh if `squash`), the centring folded in."""

    weights: tuple[Array, ...]
    biases: tuple[Number, ...]
    bias_error: Number  # of the last bias, shape (m,)
    squash: bool
    scale: Number
    offset: Number
    offset_error: Number
    norms: tuple[float, ...]  # upper bounds of ||W||_2


def fold(policy: Policy, u_eq: tuple[Fraction, ...], arithmetic: str = "float64") -> Folded:
    """Fold the centring into the last bias and the offset; raises `Rejected` under rule `centring`."""
    squash, zeros = policy.squash == "tanh", np.zeros_like(policy.offset)
    scale, ones = carry(policy.scale, arithmetic), carry(np.ones_like(policy.offset), arithmetic)
    norms = tuple(spectral_norm(W) for W in policy.weights)
    plain = Folded(policy.weights, policy.biases, zeros, squash, scale, policy.offset, zeros, norms)
    if policy.centre == "none":
        _require_exact_equilibrium(policy, u_eq)
        return plain
    if policy.centre == "preactivation":
        biases = (*policy.biases[:-1], zeros)
        y, error = _at_origin(Folded(policy.weights, biases, zeros, False, ones, zeros, zeros, norms), arithmetic)
        beta, beta_error = _beta(policy, u_eq)
        last_error = up(beta_error + error + EPS * (np.abs(beta) + np.abs(y)))
        biases = (*policy.biases[:-1], beta - y)
        return Folded(policy.weights, biases, last_error, True, scale, policy.offset, zeros, norms)
    h, error = _at_origin(Folded(policy.weights, policy.biases, zeros, squash, ones, zeros, zeros, norms), arithmetic)
    centre, centre_error = np.array([float_with_error(q) for q in u_eq]).T
    shift = scale * h
    offset_error = up(np.abs(scale) * error + centre_error + EPS * (np.abs(shift) + np.abs(centre)))
    return Folded(policy.weights, policy.biases, zeros, squash, scale, centre - shift, offset_error, norms)


def _at_origin(net: Folded, arithmetic: str) -> tuple[Number, Number]:
    """The network's value at x = 0 and a bound of its error, each (m,): a box of one point."""
    n = net.weights[0].shape[1]
    mid, _, error = enclose_on_boxes(net, carry(np.zeros((n, n + 1, 1)), arithmetic), np.zeros((n, 1)))
    return mid[:, 0], error[:, 0]


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


def relax_tanh(centre: Number, radius: Number) -> tuple[Number, Number, Number]:
    """Parallel lines around tanh: (s, m, gap) with |tanh(y) - s y - m| <= gap for all |y - centre| <= radius.

    The slope s is *any* number in [0, 1] (here near the chord's). With D(y) = tanh(y) - s y: on y >= 0 tanh is
    concave, so D lies below its tangent at any point p >= 0; on y <= 0 D is convex, so it is largest at an end. Hence
    sup D <= max(D(lo), D(hi), and if hi > 0 the tangent's larger end over [max(lo, 0), hi]). D is odd, so inf D
    over [lo, hi] is -sup D over [-hi, -lo]. p should be near the critical point, but nothing depends on that.
    """
    lo, hi = ends(centre, radius)
    (t_lo, e_lo), (t_hi, e_hi) = tanh(lo), tanh(hi)
    t = middle(tanh(centre)[0])
    chord = middle(t_hi - t_lo) / middle(hi - lo)
    slope = np.clip(np.where(middle(radius) > 1e-4, chord, 1 - t * t), 0.0, 1.0)
    critical = np.arctanh(np.sqrt(np.clip(1 - slope, 0.0, 1 - EPS)))

    def end(y: Number, t: Number, error: Number) -> Number:
        return t - slope * y + up(error + EPS * (np.abs(t) + slope * np.abs(y)))

    def supremum(lo: Number, hi: Number, at_ends: Number) -> Number:
        start = maximum(lo, 0.0)
        width = up(hi - start)
        p = np.clip(critical, middle(start), np.maximum(middle(hi), 0.0)) + 0 * lo  # in the arithmetic of lo
        t, error = tanh(p)
        excess = 1 - t * t - slope
        rise = maximum(excess * (start - p), excess * (hi - p))
        slack = error + _SLOPE_ERROR * width + EPS * (np.abs(t) + slope * p + np.abs(excess) * width)
        return np.where(hi > 0, maximum(at_ends, t - slope * p + rise + up(slack)), at_ends)

    upper = supremum(lo, hi, maximum(end(lo, t_lo, e_lo), end(hi, t_hi, e_hi)))
    lower = -supremum(-hi, -lo, maximum(end(-hi, -t_hi, e_hi), end(-lo, -t_lo, e_lo)))
    return slope, (upper + lower) / 2, up((upper - lower) / 2 + EPS * (np.abs(upper) + np.abs(lower)))


def enclose_on_boxes(net: Folded, x: Number, x_error: Number) -> tuple[Number, Number, Number]:
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
    passed: list[tuple[Array, Number, Number]] = []  # W, slope of the relaxation, fresh error behind it
    for k, (W, b) in enumerate(zip(net.weights, net.biases, strict=True)):
        last = k == len(net.weights) - 1
        width = W.shape[1]
        y = product(W, h.reshape(width, -1)).reshape(len(W), n + 1, batch)
        centre = y[:, 0] + b[:, None]
        y = np.concatenate([centre[:, None], y[:, 1:]], axis=1)
        rounding = gamma(width) * norm(W, 1)[:, None] * total(norm(h, 0), 0)
        rounding = rounding + EPS * (np.abs(centre) + np.abs(b)[:, None])
        rounding = up(rounding + net.bias_error[:, None] if last else rounding)
        through_fresh, through_old = (product(np.abs(W), e) * (1 + gamma(width)) for e in (fresh, old))
        error = up(through_fresh + lesser(through_old, norm(W, 1)[:, None] * ball) + rounding)
        ball = up(net.norms[k] * up(ball + norm(fresh, 0)) + norm(rounding, 0))
        if last and not net.squash:
            passed.append((W, np.ones(centre.shape), rounding))
            h = y
            continue
        spread = total(np.abs(y[:, 1:]), 1)
        slope, shift, gap = relax_tanh(centre, up(spread + error))
        fresh = up(gap + slope * rounding + EPS * (slope * (np.abs(centre) + spread) + np.abs(shift)))
        h = np.concatenate([(slope * centre + shift)[:, None], slope[:, None] * y[:, 1:]], axis=1)
        old = up(slope * error)
        ball = lesser(up(np.max(slope, axis=0) * ball), norm(old, 0))
        passed.append((W, slope, fresh))

    through, slopes = net.scale[:, None] * h[:, 0], net.scale[:, None, None] * h[:, 1:]
    mid = through + net.offset[:, None]
    rounding = EPS * (np.abs(through) + np.abs(net.offset)[:, None] + np.abs(mid) + total(np.abs(slopes), 1))
    result = rounding + net.offset_error[:, None] + _error_backwards(net.scale, passed, x_error)
    return mid, slopes, up(result)


def _error_backwards(scale: Number, passed: list[tuple[Array, Number, Number]], x_error: Number) -> Number:
    """Bound of each output's error, shape (m, B); `doubt` bounds the rounding error of each entry of `weight`."""
    m, batch = len(scale), x_error.shape[1]
    weight = np.broadcast_to(np.diag(scale)[:, :, None], (m, m, batch))
    doubt = result = np.zeros((m, batch))
    for W, slope, fresh in reversed(passed):
        result = result + total((np.abs(weight) + doubt) * fresh[:, None], 0)
        through = slope[:, None] * weight
        doubt = float(np.max(total(np.abs(W), 0))) * up(doubt + EPS * np.max(np.abs(weight), axis=0))
        doubt = up(doubt + gamma(len(W)) * float(np.max(norm(W, 0))) * norm(through, 0))
        weight = product(W.T, through.reshape(len(W), -1)).reshape(W.shape[1], m, batch)
    return up(result + total((np.abs(weight) + doubt) * x_error[:, None], 0))
