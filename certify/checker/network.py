"""The policy: its layers, the centring folded into them, and its enclosure on boxes, affine in the box coordinates.

At x = 0 the policy equals u_eq by its form, which the local rule uses; local.py has the enclosure on the ball.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np

from .document import Policy
from .near import (
    ZERO,
    Above,
    Array,
    Form,
    Near,
    Uniform,
    all_near,
    clip_of,
    lines_around_tanh,
    near_atanh,
    norm,
    size,
    spectral_norm,
    stacked,
)


@dataclass(frozen=True)
class Layer:
    """`W h + b`; `norm2` is an upper bound of ||W||_2."""

    W: Array
    b: Near
    norm2: Above

    @cached_property
    def rows(self) -> Above:
        """Upper bounds of the rows' 2-norms, (rows, 1)."""
        return norm(self.W, 1)[:, None]

    def affine(self, h: Form) -> Form:
        """`W h + b` of forms h (k, width, B)."""
        return h.through(self.W).raised(self.b[:, None])


@dataclass(frozen=True)
class Folded:
    """`u = scale * h + offset`, h the last layer's value (through tanh if `squash`), the centring folded in; `clip`
    (lo, hi) is applied to that."""

    layers: tuple[Layer, ...]
    squash: bool
    scale: Array
    offset: Near
    clip: tuple[Array, Array] | None = None


def layer(W: Array, b: Array) -> Layer:
    """A layer as it stands in the file."""
    return Layer(W, Near(b), spectral_norm(W))


def fold(policy: Policy, u_eq: tuple[Fraction, ...]) -> Folded:
    """Fold the origin into the first bias, the centring into the last or the offset; rule `centring` has to hold."""
    first, *others = (layer(W, b) for W, b in zip(policy.weights, policy.biases, strict=True))
    if policy.origin is not None:
        first = replace(first, b=Near(policy.origin).through(first.W) + first.b)
    plain = Folded((first, *others), policy.squash == "tanh", policy.scale, Near(policy.offset), policy.clip)
    one, zero = np.ones_like(policy.scale), np.zeros_like(policy.scale)
    if policy.centre == "none":
        return plain
    if policy.centre == "preactivation":
        last = plain.layers[-1]
        bare = Folded((*plain.layers[:-1], replace(last, b=Near(zero))), False, one, Near(zero))
        beta = stacked([near_atanh(q) for q in reaches(policy, u_eq)])
        return replace(plain, layers=(*plain.layers[:-1], replace(last, b=beta - _at_origin(bare))))
    h = _at_origin(replace(plain, scale=one, offset=Near(zero), clip=None))
    return replace(plain, offset=all_near(u_eq) - h * Near(policy.scale))


def reaches(policy: Policy, u_eq: tuple[Fraction, ...]) -> list[Fraction]:
    """`(u_eq - offset) / scale`, of which beta is the atanh."""
    each = zip(u_eq, policy.offset.tolist(), policy.scale.tolist(), strict=True)
    return [(u - Fraction(offset)) / Fraction(scale) for u, offset, scale in each]


def _at_origin(net: Folded) -> Near:
    """The network's value at x = 0, as a box of one point, (m,)."""
    n = net.layers[0].W.shape[1]
    u = enclose_on_boxes(net, Form(np.zeros((n + 1, n, 1)), Above(np.zeros((n, 1)))))
    return Near(u.value[0, :, 0], u.error[:, 0])


def enclose_on_boxes(net: Folded, x: Form) -> Form:
    """The policy on a batch of boxes, x the state, as forms in d in [-1, 1]^n: x (n + 1, n, B), u (n + 1, m, B).

    Each layer's value is an affine form h in d, plus errors of two ages. `fresh` (width, B) bounds, component by
    component, what the relaxation just before and its roundings have added. `old` (width, B) bounds component by
    component what came through from before that, and `ball` (B,) the 2-norm of the same vector of old errors.
    Forwards, fresh errors pass through |W|, old ones through |W| or ||W_i|| ball, whichever is less; the 2-norm of all
    passes through ||W||_2. That gives the range over which tanh is relaxed. The output's own error is found backwards:
    each layer's fresh error times the magnitude of the weight with which it reaches the output, so that errors cancel
    through W as they do in truth.
    """
    h, fresh, old, ball = Form(x.value), x.error, ZERO, ZERO
    passed: list[tuple[Array, Array | None, Above]] = []  # W, slope of the relaxation, fresh error behind it
    for k, layer in enumerate(net.layers):
        y = layer.affine(h)
        if k == len(net.layers) - 1 and not net.squash:
            passed.append((layer.W, None, y.error))
            h = Form(y.value)
            break
        error = fresh.through(layer.W) + y.error
        if old is not ZERO:
            error = error + old.through(layer.W).least(layer.rows * ball)
        ball = layer.norm2 * (ball + fresh.norm()) + y.error.norm()
        spread = size(y.value[1:]).sum()
        slope, shift, gap = lines_around_tanh(y.value[0], spread + error)
        plain = Form(y.value)
        plain.size = size(y.value[0]) + spread
        h = (plain * Near(slope)).raised(Near(shift))
        fresh = gap + y.error * slope + h.error
        h = Form(h.value)
        old = error * slope
        ball = (ball * size(slope).max()).least(old.norm())
        passed.append((layer.W, slope, fresh))
    error = _error_backwards(net.scale, passed, x.error)
    u = (h * Near(net.scale[:, None])).raised(net.offset[:, None])
    u = u.wider(error)
    return clipped(u, *net.clip) if net.clip else u


def clipped(u: Form, least: Array, most: Array) -> Form:
    """`min(max(v, least), most)` of the affine forms v, again as affine forms; least and most (m,).

    Nothing changes where v certainly stays between them.
    """
    v = u.range
    lo, hi = v.ends
    inside = (lo >= least[:, None]) & (hi <= most[:, None])
    slope, shift, gap = clip_of(v, least[:, None], most[:, None])
    cut = (u * Near(slope)).raised(Near(shift))
    return Form(np.where(inside, u.value, cut.value), Above(np.where(inside, u.error.top, (cut.error + gap).top)))


def _error_backwards(scale: Array, passed: list[tuple[Array, Array | None, Above]], of_x: Above) -> Above:
    """Bound of each output's error, shape (m, B).

    `weight` (width, m, B) are the numbers with which an error behind the layer in hand reaches the output.
    """
    weight, result = Uniform(np.diag(scale)[:, :, None]), ZERO
    for W, slope, fresh in reversed(passed):
        result = result + ((size(weight.value) + weight.error) * fresh[:, None]).sum()
        weight = (weight if slope is None else weight.times(slope[:, None])).through(W.T)
    return result + ((size(weight.value) + weight.error) * of_x[:, None]).sum()
