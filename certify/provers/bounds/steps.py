"""A network of any steps on boxes: affine forms with errors, as `policy.py` describes them, step after step.

Forwards, fresh errors pass through |W|, older ones through |W| or by their 2-norm, whichever is less; that gives the
ranges over which functions are relaxed. Backwards, each step's own error counts times the magnitude of the weight with
which it reaches the value, through sums and branches alike, but not through observations, which keep no way back.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from certify.loop.expressions import Expression, evaluate
from certify.loop.networks import Affine, Algebra, Clip, Concat, Map, Network, Observe, Product, Step, Sum
from certify.provers.bounds.arrays import Array
from certify.provers.bounds.lines import clip_lines, lines_of
from certify.provers.bounds.taylor import EPS, TINY, Models, Taylor

_SQUASH = Map((0,), "tanh")
_GROWN = 1 + 1e-12  # more than rounding makes of sums of magnitudes


class Enclosed(NamedTuple):
    """A vector on boxes: forms h (w, n + 1, B) within `fresh` + `old` (w, B), the errors that the last steps have added
    and those that came through a matrix, of which `ball` (B,) bounds the 2-norm; `number` is that of the vector."""

    h: Array
    fresh: Array
    old: Array
    ball: Array
    number: int

    @property
    def spread(self) -> Array:
        """The sum of the coefficients of the box coordinates, in magnitude, (w, B)."""
        return np.asarray(np.abs(self.h[:, 1:]).sum(1))

    @property
    def radius(self) -> Array:
        """The distance that the vector may have from the middle of its form."""
        whole = self.spread + self.fresh + self.old
        return whole * _GROWN + EPS * np.abs(self.h[:, 0]) + TINY


@dataclass(slots=True)
class _Made:
    """A vector: the step that made it, which read vectors `of`, the errors (w, B) that it added, and the slopes with
    which it has those of the vectors that it read, if it is made by lines, or a product."""

    step: Step | None
    of: tuple[int, ...]
    added: Array
    slope: Array | None = None
    others: Array | None = None  # of a product's second vector


class StepsOnBoxes(Algebra[Enclosed]):
    """A network on a batch of boxes; `norms` are those of its matrices."""

    def __init__(self, norms: dict[Step, float]) -> None:
        self.norms, self.made, self.share = norms, list[_Made](), np.zeros(0)

    def value(self, network: Network, x: Array, x_error: Array) -> Enclosed:
        """The network of x (reads, n + 1, B) within x_error (reads, B)."""
        self.made, self.share = [_Made(None, (), x_error)], np.zeros((x.shape[1] - 1, x.shape[2]))
        none = np.zeros_like(x_error)
        return self.run(network, Enclosed(x, x_error, none, none.sum(0), 0))

    def shifted(self, v: Enclosed, shift: Array, shift_error: Array) -> Enclosed:
        """The value with numbers (w,) added, within shift_error."""
        b, h = shift[:, None], v.h.copy()
        more = shift_error[:, None] + EPS * (np.abs(h[:, 0]) + np.abs(b)) + TINY
        h[:, 0] += b
        return self._then(None, (v.number,), h, v.fresh + more, v.old, v.ball, more)

    def squashed(self, v: Enclosed) -> Enclosed:
        """tanh of the value."""
        return self.map(_SQUASH, v)

    def affine(self, step: Affine, v: Enclosed) -> Enclosed:
        W, b = step.weight, step.bias[:, None]
        magnitude, rows = np.abs(W), np.linalg.norm(W, axis=1)[:, None]
        size = np.abs(v.h).sum(1)
        own = (W.shape[1] + 2) * EPS * (magnitude @ size + np.abs(b)) + TINY
        h = (W @ v.h.reshape(len(v.h), -1)).reshape(len(W), *v.h.shape[1:])
        h[:, 0] += b
        old = (magnitude @ v.fresh + np.minimum(magnitude @ v.old, rows * _GROWN * v.ball)) * _GROWN + TINY
        ball = self.norms[step] * (v.ball + np.sqrt((v.fresh * v.fresh).sum(0)) + TINY) * _GROWN + TINY
        return self._then(step, (v.number,), h, own, old, ball, own)

    def map(self, step: Map, v: Enclosed) -> Enclosed:
        reach = v.radius
        return self._by_lines(step, v, *lines_of(step.function)(v.h[:, 0] - reach, v.h[:, 0] + reach))

    def clip(self, step: Clip, v: Enclosed) -> Enclosed:
        reach = v.radius
        lines = clip_lines(v.h[:, 0] - reach, v.h[:, 0] + reach, step.lo[:, None], step.hi[:, None])
        return self._by_lines(step, v, *lines)

    def _by_lines(self, step: Step, v: Enclosed, slope: Array, shift: Array, gap: Array) -> Enclosed:
        """A function of v that lies within `gap` of lines of these slopes."""
        steep, spread = np.abs(slope), v.spread
        self.share += ((gap / (spread + TINY))[:, None] * np.abs(v.h[:, 1:])).sum(0)
        own = gap + 4 * EPS * (steep * (np.abs(v.h[:, 0]) + spread) + np.abs(shift)) + TINY
        h = slope[:, None] * v.h
        h[:, 0] += shift
        passed = steep * (v.fresh + v.old) * _GROWN + TINY
        whole = steep.max(0) * (v.ball + np.sqrt((v.fresh * v.fresh).sum(0)) + TINY)
        ball = np.minimum(whole, np.sqrt((passed * passed).sum(0))) * _GROWN + TINY
        made = self._then(step, (v.number,), h, own, passed, ball, own)
        self.made[-1].slope = slope
        return made

    def sum(self, step: Sum, *vectors: Enclosed) -> Enclosed:
        h, fresh, old, ball = (sum(parts[1:], parts[0]) for parts in zip(*(v[:4] for v in vectors), strict=True))
        own = len(vectors) * EPS * sum(np.abs(v.h).sum(1) for v in vectors) + TINY
        fresh, old, ball = (part * _GROWN + TINY for part in (fresh + own, old, ball))
        return self._then(step, tuple(v.number for v in vectors), h, fresh, old, ball, own)

    def concat(self, step: Concat, *vectors: Enclosed) -> Enclosed:
        h, fresh, old = (np.concatenate(parts) for parts in zip(*(v[:3] for v in vectors), strict=True))
        ball = np.sqrt(sum(v.ball * v.ball for v in vectors)) * _GROWN + TINY
        return self._then(step, tuple(v.number for v in vectors), h, fresh, old, ball, np.zeros_like(fresh))

    def product(self, step: Product, v: Enclosed, w: Enclosed) -> Enclosed:
        """c_v c_w + c_w V + c_v W + V W, where V = g_v.d + e_v and W are how far v and w are from their middles."""
        a, b = v.h[:, 0], w.h[:, 0]
        h = b[:, None] * v.h + a[:, None] * w.h
        h[:, 0] = a * b
        least, most = second_order(v, w)
        shift, gap = 0.5 * (most - least), 0.5 * (most + least)
        h[:, 0] += shift
        size = np.abs(a) * (np.abs(b) + w.spread) + np.abs(b) * v.spread
        own = gap * _GROWN + 4 * EPS * (size + shift) + TINY
        old = (np.abs(b) * (v.fresh + v.old) + np.abs(a) * (w.fresh + w.old)) * _GROWN + TINY
        bent = gap / (v.spread + w.spread + TINY)
        self.share += (bent[:, None] * (np.abs(v.h[:, 1:]) + np.abs(w.h[:, 1:]))).sum(0)
        ball = np.minimum(_length(v, b) + _length(w, a), np.sqrt((old * old).sum(0))) * _GROWN + TINY
        made = self._then(step, (v.number, w.number), h, own, old, ball, own)
        self.made[-1].slope, self.made[-1].others = b, a
        return made

    def observe(self, step: Observe, v: Enclosed) -> Enclosed:
        h, own, bent = observed(step, v.h, v.fresh + v.old)
        self.share += bent.sum(0)
        return self._then(step, (v.number,), h, own, np.zeros_like(own), np.zeros(own.shape[1]), own)

    def _then(
        self, step: Step | None, of: tuple[int, ...], h: Array, fresh: Array, old: Array, ball: Array, added: Array
    ) -> Enclosed:
        self.made.append(_Made(step, of, added))
        return Enclosed(h, fresh, old, ball, len(self.made) - 1)

    def backwards(self, rows: Array) -> Array:
        """Bounds (m, B) of the errors of `rows` (m, w) times the value."""
        batch = self.made[0].added.shape[1]
        start = np.repeat(rows.T[:, :, None], batch, axis=2)
        weights, result = {len(self.made) - 1: start}, np.zeros((len(rows), batch))
        for number in reversed(range(len(self.made))):
            if (weight := weights.pop(number, None)) is None:
                continue
            made = self.made[number]
            result += (np.abs(weight) * made.added[:, None]).sum(0)
            for i, part in zip(made.of, self._before(made, weight), strict=False):
                weights[i] = weights[i] + part if i in weights else part
        return result

    def _before(self, made: _Made, weight: Array) -> Sequence[Array]:
        """The weights with which the vectors that a step reads reach the value through it; none behind observations."""
        match made.step:
            case Affine(weight=W):
                return [(W.T @ weight.reshape(len(weight), -1)).reshape(W.shape[1], *weight.shape[1:])]
            case Concat():
                ends = np.cumsum([len(self.made[i].added) for i in made.of])[:-1]
                return np.split(weight, ends)
            case Product():
                return [
                    self._gathered(weight * slope[:, None], i)
                    for i, slope in zip(made.of, (made.slope, made.others), strict=True)
                    if slope is not None
                ]
            case Observe():
                return []
        return [weight] * len(made.of) if made.slope is None else [weight * made.slope[:, None]]

    def _gathered(self, weight: Array, number: int) -> Array:
        """The weights of a vector in a product's entries; of a single entry that of all of them together."""
        alone = len(self.made[number].added) == 1 < len(weight)
        return np.asarray(weight.sum(0, keepdims=True)) if alone else weight


def second_order(v: Enclosed, w: Enclosed) -> tuple[Array, Array]:
    """(l, u), both (w, B), with -l <= V W <= u for a product's two vectors, V and W being how far they are from their
    middles.

    4 V W = p ((V + W/p)^2 - (V - W/p)^2) for any p > 0, here that at which V and W/p are of equal size. |V W| is at
    most the product of both, which takes the place of what is not finite. A vector times itself is a square.
    """
    of_v, of_w = v.fresh + v.old, w.fresh + w.old
    reach_v, reach_w = v.spread + of_v, w.spread + of_w
    most = reach_v * reach_w * _GROWN + TINY
    if v.number == w.number:
        return np.zeros_like(most), most
    p = reach_w / reach_v
    p = np.where(np.isfinite(p) & (p > 0), p, 1.0)
    g, other, errors = v.h[:, 1:], w.h[:, 1:] / p[:, None], of_v + of_w / p
    plus, minus = (np.abs(g + sign * other).sum(1) + errors for sign in (1.0, -1.0))
    least, top = (np.fmin(0.25 * p * r * r * _GROWN + TINY, most) for r in (minus, plus))
    return least, top


def _length(v: Enclosed, slope: Array) -> Array:
    """Bounds the 2-norm of slopes times the errors of v."""
    whole = v.ball + np.sqrt((v.fresh * v.fresh).sum(0))
    alone = len(v.fresh) == 1
    return np.asarray((np.sqrt((slope * slope).sum(0)) if alone else np.abs(slope).max(0)) * whole)


def observed(step: Observe, h: Array, error: Array) -> tuple[Array, Array, Array]:
    """Observations as forms (w, n + 1, B), their errors (w, B), and what each axis adds to these, (w, n, B); the
    entries are forms h (k, n + 1, B) within `error` (k, B)."""
    n, batch = h.shape[1] - 1, h.shape[2]
    none = np.zeros((n, n, batch))
    values = {s: Taylor(v[0], v[1:], none, e) for s, v, e in zip(step.symbols, h, error, strict=True)}
    models, known = Models(next(iter(values.values()))), dict[Expression, Taylor]()
    made = [evaluate(e, values, models, known) for e in step.expressions]
    bent = np.stack([np.abs(v.Q).sum(0) for v in made])
    forms = np.stack([np.concatenate([v.c[None], v.g]) for v in made])
    return forms, (np.stack([v.r for v in made]) + bent.sum(1)) * _GROWN + TINY, bent
