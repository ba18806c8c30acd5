"""Networks on boxes: their enclosure as forms that are affine in the box coordinates, and the policy's, with its
centring, scale and clip.

At x = 0 the policy equals u_eq by its form, which the local rule uses; ball.py has the models on the ball.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache, cached_property

import numpy as np

from .document import Policy
from .functions import FUNCTIONS
from .near import (
    ZERO,
    Above,
    Array,
    Form,
    Near,
    Uniform,
    all_near,
    near_atanh,
    norm,
    size,
    spectral_norm,
    stacked,
    tanh,
    within,
)
from .networks import Affine, Algebra, Map, Network, Step

TANH = Map((0,), 0, "tanh")  # the policy's squash


@cache
def norm2(step: Affine) -> Above:
    """An upper bound of ||W||_2."""
    return spectral_norm(step.weight)


def prepare(*networks: Network) -> None:
    """Compute what all boxes need of networks once, before there are several processes."""
    for network in networks:
        for step in network.steps:
            if isinstance(step, Affine):
                norm2(step)


@dataclass(frozen=True)
class Enclosed:
    """A vector on boxes: it lies within errors of the forms h (k + 1, width, B), which mean themselves.

    The errors are of two ages: `fresh` (width, B) bounds those that the last steps have added, `old` (width, B) those
    that came through a matrix; `ball` (B,) bounds the 2-norm of the old ones. `step` is the number of the step that
    made the vector, 0 for the argument.
    """

    h: Form
    fresh: Above
    old: Above
    ball: Above
    step: int

    @cached_property
    def spread(self) -> Above:
        """Upper bound of what the coefficients of the symbols add."""
        return size(self.h.value[1:]).sum()

    @property
    def error(self) -> Above:
        """Upper bound of both errors."""
        return self.fresh + self.old

    @property
    def plain(self) -> Form:
        """The forms, whose size is known from their spread."""
        found = Form(self.h.value)
        found.size = size(self.h.value[0]) + self.spread
        return found


class OnBoxes(Algebra[Enclosed]):
    """Networks on a batch of boxes.

    Forwards, fresh errors pass through |W|, old ones through |W| or ||W_i|| ball, whichever is less; the 2-norm of all
    passes through ||W||_2. That gives the ranges over which functions are relaxed. The value's own error is found
    backwards: `added` has what each step adds, and its magnitude counts times that of the weight with which it reaches
    the value, so that errors cancel through W as they do in truth.
    """

    def __init__(self, network: Network, x: Form) -> None:
        """x (k + 1, reads, B) is the argument."""
        self.network, self.added = network, [x.error]
        self.slopes: list[Array | None] = [None]  # of the lines that a step takes for its function
        self.factors: dict[int, tuple[Array, Array]] = {}  # of a product, with which errors of its vectors pass
        self.steps: list[Step | None] = [None]
        start = Enclosed(Form(x.value), x.error, ZERO, ZERO, 0)
        self.last = self.run(network, start)

    def then(self, step: Step, v: Enclosed) -> Enclosed:
        """One more step, of the value."""
        self.last = self.make(step, [v])
        return self.last

    def shift(self, by: Near) -> None:
        """Add numbers (width,) to the value."""
        v = self.last
        moved = v.h.raised(by[:, None])
        self.added[v.step] = self.added[v.step] + moved.error
        self.last = Enclosed(Form(moved.value), v.fresh + moved.error, v.old, v.ball, v.step)

    def make(self, step: Step, vectors: Sequence[Enclosed]) -> Enclosed:
        self.steps.append(step)
        self.slopes.append(None)
        self.added.append(ZERO)
        return super().make(step, vectors)

    def affine(self, step: Affine, v: Enclosed) -> Enclosed:
        W, bound = step.weight, norm2(step)
        y = v.h.through(W).raised(Near(step.bias[:, None]))
        old = v.fresh.through(W)
        if v.old is not ZERO:
            old = old + v.old.through(W).least(norm(W, 1)[:, None] * v.ball)
        self.added[-1] = y.error
        return Enclosed(Form(y.value), y.error, old, bound * (v.ball + v.fresh.norm()), len(self.steps) - 1)

    def map(self, step: Map, v: Enclosed) -> Enclosed:
        lines = FUNCTIONS[step.function].lines(v.h.value[0], v.spread + v.error)
        return self.by_lines(v, (v.plain * Near(lines[0])).raised(Near(lines[1])), lines[0], lines[2])

    def by_lines(self, v: Enclosed, h: Form, slope: Array, gap: Above) -> Enclosed:
        """A function of v that lies within `gap` of lines of these slopes, at v with all of its errors; h are the lines
        of the forms. So errors of v pass times the slopes, exactly, and `gap` and the roundings of h are new.

        Where v was made by a matrix for this step alone, what that step added passes here and nowhere else: it is
        counted as added here, times the slopes, and not once more on the way back.
        """
        new, steep = gap + h.error, size(slope)
        if v.step and self.steps[v.step] is not None and self.is_read_once(v.step):
            new, self.added[v.step] = new + self.added[v.step] * steep, ZERO
            passed = v.old * steep
            ball = (v.ball * steep.max()).least(passed.norm())
        else:
            passed = v.error * steep
            ball = ((v.ball + v.fresh.norm()) * steep.max()).least(passed.norm())
        self.added[-1], self.slopes[-1] = new, slope
        return Enclosed(Form(h.value), new, passed, ball, len(self.steps) - 1)

    def is_read_once(self, k: int) -> bool:
        """True if what step k adds reaches the value through the step in hand alone, and is all that is fresh there:
        the centring and the squash come after the network's last vector, which no step reads."""
        return isinstance(self.steps[k], Affine) and len(self.network.readers.get(k, ())) <= 1

    def backwards(self, rows: Array) -> Above:
        """Bounds of the errors of `rows` (m, width) times the value, (m, B).

        A weight (width, m, B) has the numbers with which an error of a vector reaches these.
        """
        weights: dict[int, Uniform] = {self.last.step: Uniform(rows.T[:, :, None])}
        result = ZERO
        for k in reversed(range(len(self.steps))):
            weight, step = weights.pop(k, None), self.steps[k]
            if weight is None:
                continue
            if self.added[k] is not ZERO:
                result = result + ((size(weight.value) + weight.error) * self.added[k][:, None]).sum()
            for i, part in self.before(k, step, weight):
                weights[i] = weights[i] + part if i in weights else part
        return result

    def before(self, k: int, step: Step | None, weight: Uniform) -> list[tuple[int, Uniform]]:
        """The weights with which errors of the vectors that a step reads reach the value through it."""
        of = (k - 1,) if step is TANH else () if step is None else step.of
        match step:
            case Affine():
                return [(of[0], weight.through(step.weight.T))]
            case Map():
                return [(of[0], weight.times(self.slopes[k][:, None]))]  # type: ignore[index]
            case None:  # the argument
                return []
        from . import wiring

        return wiring.BoxSteps(self).before(k, step, weight)

    def width(self, k: int) -> int:
        """The number of entries of vector k."""
        step = self.steps[k]
        return self.network.reads if step is None else step.size


# ---------------------------------------------------------------------------------------------------------- the policy


@dataclass(frozen=True)
class Folded:
    """`u = scale * h + offset`, h the network's value at origin + x, `shift` added (through tanh if `squash`), so that
    the centring is part of it; `clip` (lo, hi) is applied to that."""

    network: Network
    origin: Array
    shift: Near | None
    squash: bool
    scale: Array
    offset: Near
    clip: tuple[Array, Array] | None = None

    def before_squash(self, x: Form) -> OnBoxes:
        """The network's value, shifted."""
        boxes = OnBoxes(self.network, x.raised(Near(self.origin[:, None])) if np.any(self.origin) else x)
        if self.shift is not None:
            boxes.shift(self.shift)
        return boxes

    def on_boxes(self, x: Form) -> OnBoxes:
        """The network's value, shifted and squashed."""
        boxes = self.before_squash(x)
        if self.squash:
            boxes.then(TANH, boxes.last)
        return boxes

    def ends(self, x: Form) -> list[Near]:
        """The inputs, (m, B), at either end of the range that the squash's argument has on the box, without a clip: as
        tanh is monotone, each input lies between these two."""
        v = self.before_squash(x).last
        both = Near(v.h.value[0], v.spread + v.error).ends
        return [tanh(Near(end)) * Near(self.scale[:, None]) + self.offset[:, None] for end in both]

    @cached_property
    def at_origin(self) -> Near:
        """The network's value at x = 0, shifted and squashed, as on a box of one point, (m,)."""
        boxes = self.on_boxes(Form(np.zeros((1, self.network.reads, 1)), Above(np.zeros((self.network.reads, 1)))))
        return Near(boxes.last.h.value[0, :, 0], boxes.backwards(np.eye(self.network.gives))[:, 0])


def fold(policy: Policy, u_eq: tuple[Fraction, ...]) -> Folded:
    """Fold the centring into a shift or the offset; rule `centring` has to hold."""
    origin = np.zeros(policy.network.reads) if policy.origin is None else policy.origin
    squash = policy.squash == "tanh"
    plain = Folded(policy.network, origin, None, squash, policy.scale, Near(policy.offset), policy.clip)
    if policy.centre == "none":
        return plain
    if policy.centre == "preactivation":
        beta = stacked([near_atanh(q) for q in reaches(policy, u_eq)])
        return replace(plain, shift=beta - replace(plain, squash=False).at_origin)
    return replace(plain, offset=all_near(u_eq) - plain.at_origin * Near(policy.scale))


def reaches(policy: Policy, u_eq: tuple[Fraction, ...]) -> list[Fraction]:
    """`(u_eq - offset) / scale`, of which beta is the atanh."""
    each = zip(u_eq, policy.offset.tolist(), policy.scale.tolist(), strict=True)
    return [(u - Fraction(offset)) / Fraction(scale) for u, offset, scale in each]


def enclose_on_boxes(net: Folded, x: Form) -> Form:
    """The policy on a batch of boxes, x the state, as forms in d in [-1, 1]^n: x (n + 1, n, B), u (n + 1, m, B)."""
    boxes = net.on_boxes(x)
    u = (boxes.last.plain * Near(net.scale[:, None])).raised(net.offset[:, None])
    u = u.wider(boxes.backwards(np.diag(net.scale)))
    if net.clip is None:
        return u
    from .wiring import clip_forms

    cut, slope, gap = clip_forms(Form(u.value), u.range.error, *net.clip)
    return cut.wider(u.error * slope + gap)


def keep_bounds(net: Folded, bounds: Sequence[tuple[Fraction, Fraction]], x: Form, u: Form) -> Array:
    """True for each input and box (m, B) on which the input certainly lies in its bounds: as u encloses it, or as tanh
    is monotone."""
    hold = _all_within(bounds, u.range)
    left = np.flatnonzero(np.logical_not(np.all(hold, axis=0)))
    if len(left) and net.squash and net.clip is None:
        at_a, at_b = (_all_within(bounds, end) for end in net.ends(x[:, left]))
        hold[:, left] |= at_a & at_b
    return hold


def _all_within(bounds: Sequence[tuple[Fraction, Fraction]], u: Near) -> Array:
    return np.array([within(pair, u[j]) for j, pair in enumerate(bounds)])
