"""The closed loop on a ball, ||d|| <= 1: every quantity as a jet over d (jets.py).

At rest x = J d, around the origin, where F is 0. Along a path the last entry of d is the motion of the ball's middle
on a line: x = m + J z + w sigma, d = (z, sigma).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from .case import Case, Failures
from .document import Intervals
from .elementary import elementary
from .expression import evaluate
from .float64 import EPS, Array, ends, float_with_error, frobenius, gamma, norm, total, up, within
from .jets import Jet, constant, uncertain, widen
from .network import Folded

_MOST_NUMBERS = 2**25  # in the matrices of all jets, or of a layer and the paths to it
_MOST_PRODUCTS = 2**33  # in the sums over paths


@dataclass(frozen=True)
class Ball:
    """What rules need on a ball, each computed when it is first asked for. J (n, n) is exact, `at` its place."""

    case: Case
    J: Array
    at: str

    @property
    def motion(self) -> tuple[list[Fraction], list[Fraction]] | None:
        """m and w of a ball along a path, n numbers each; None at rest."""
        return None

    @cached_property
    def states(self) -> list[Jet]:
        """x on the ball."""
        if self.motion is None:
            nothing = np.zeros((len(self.J), len(self.J)))
            return [Jet(np.float64(0), 0.0, row, 0.0, nothing, nothing) for row in self.J]
        nothing, jets = np.zeros((len(self.J) + 1, len(self.J) + 1)), []
        for row, m, w in zip(self.J, *self.motion, strict=True):
            (value, error), (step, slack) = float_with_error(m), float_with_error(w)
            jets.append(Jet(np.float64(value), error, np.append(row, step), slack, nothing, nothing))
        return jets

    @cached_property
    def inputs(self) -> list[Jet]:
        """pi(x) on the ball, before it is clipped. At rest its value at d = 0 is u_eq by form."""
        net, h = self.case.net, enclose_on_ball(self.case.net, self.states)
        if self.motion is None:
            values = [float_with_error(u) for u in self.case.c.u_eq]
        else:
            each = zip(h, net.scale.tolist(), net.offset.tolist(), net.offset_error.tolist(), strict=True)
            values = [_affine(v, scale, offset, error) for v, scale, offset, error in each]
        return [input_jet(*part) for part in zip(values, net.scale.tolist(), h, strict=True)]

    def F(self, cell: Intervals = ()) -> list[Jet]:
        """The components of F on the ball, enclosed for all values of the uncertain quantities in a cell. At rest
        F(0) = 0, of which these jets know no more than that 0 is near."""
        k = len(self.states[0].a)
        quantities = [uncertain(lo, hi, k) for lo, hi in cell]
        return evaluate(self.case.c.dynamics, lambda q: constant(q, k), [*self.states, *self.inputs, *quantities])


def _affine(h: Jet, scale: float, offset: float, offset_error: float) -> tuple[float, float]:
    """scale * h(0) + offset, and its error."""
    through = scale * h.c
    value = through + offset
    return value, up(abs(scale) * h.error + offset_error + EPS * (abs(through) + abs(offset)))


def fits(ball: Ball) -> Failures:
    """The jets take neither too much memory nor too much time."""
    symbols = len(ball.J) + (ball.motion is not None)
    yield from too_large(ball.case.net, len(ball.case.c.dynamics.operations), symbols)
    return 0


def keeps_inputs(ball: Ball) -> Failures:
    """`inputs`: by form, or by the enclosure on the ball."""
    c = ball.case.c
    if not ball.case.bounded:
        for name, bounds, u in zip(c.inputs, c.input_bounds, ball.inputs, strict=True):
            if not within(bounds, u.c, up(u.error + u.radius)):
                yield ball.at, f"{name} may leave its bounds"
    return len(c.inputs)


def is_not_clipped(ball: Ball) -> Failures:
    """Every input lies strictly inside the policy's clip, so that the jets of what is clipped are its own."""
    clip = ball.case.net.clip
    for name, u, *limits in zip(ball.case.c.inputs, ball.inputs, *clip, strict=True) if clip else ():
        low, high = ends(u.c, up(u.error + u.radius))
        if not limits[0] < low <= high < limits[1]:
            yield ball.at, f"{name} may be clipped: policy.clip"
    return 0


def too_large(net: Folded, operations: int, n: int) -> Failures:
    """Places where jets of so many operations in n symbols, or the network's, take too much memory or time."""
    if operations * n * n > _MOST_NUMBERS:
        yield "plant.dynamics", "the equations are too large for this rule"
    columns, products = n, 0
    for layer in net.layers[1:]:
        rows, width = layer.W.shape
        products += rows * columns * width
        columns += width
        products += rows * columns * n * n
        if columns * (rows + n * n) > _MOST_NUMBERS or products > _MOST_PRODUCTS:
            yield "policy.layers", "the network is too large for this rule"
    return 0


def input_jet(u: tuple[float, float], scale: float, h: Jet) -> Jet:
    """u + scale ((a + s).d + d'Q d + r(d)): an input on the ball, whose value at d = 0 is `u`, with an error."""
    k, a = abs(scale), scale * h.a
    rest = widen(k * h.E, EPS * (k * frobenius(h.Q)))
    return Jet(np.float64(u[0]), u[1], a, up(k * h.slack + EPS * norm(a, 0)), scale * h.Q, rest)


def enclose_on_ball(net: Folded, states: Sequence[Jet]) -> list[Jet]:
    """What the network's last layer has, through tanh if it is squashed, where the states are these jets, which have
    no Q and no E.

    Every layer's value is y(d) = y(0) + X d + M A(d), where A_q is what a tanh of the layers before adds to its tangent
    at y_q(0), and M the product of weights and slopes with which that reaches y, so that errors cancel as they do in
    truth. A_q(d) is d'(quad_q)d within d'(rest_q)d, and `bends` bounds ||quad_q||_2; of the first k of these, which
    stand for the symbols d, all are 0. Each column of [X, M], here X, lies within its `doubt` of the true one.
    """
    X, k = np.array([x.a for x in states]), len(states[0].a)
    y = np.array([x.c for x in states], dtype=np.float64)[:, None, None]
    error = np.array([x.error for x in states])[:, None]
    doubt = np.full(k, norm(np.array([x.slack for x in states]), 0))
    quad, rest, bends = np.zeros((k, k, k)), np.zeros((k, k, k)), np.zeros(k)
    for number, layer in enumerate(net.layers):
        y, rounding = layer.affine(y)
        error = up(layer.widest(error) + rounding)
        width = layer.W.shape[1]
        doubt = up(layer.norm2 * doubt + gamma(width) * (frobenius(layer.W) * norm(X, 0)))
        X = layer.W @ X
        if number > 0:  # what the tanh just before has added arrives through W alone
            X, doubt = np.concatenate([X, layer.W], 1), np.concatenate([doubt, np.zeros(width)])
        count = len(doubt)
        weight = np.abs(X) + doubt
        Q = (X @ quad.reshape(count, -1)).reshape(-1, k, k)
        E = (weight @ rest.reshape(count, -1)).reshape(-1, k, k)
        E = widen(E, total(doubt * bends + gamma(count) * (weight * bends), 1), gamma(count) + EPS)
        value = Jet(y[:, 0, 0], error[:, 0], X[:, :k], norm(doubt[:k], 0), Q, E)
        if number == len(net.layers) - 1:
            break
        (t, slope, half), (e, wrong, half_error), third = elementary("tanh", value.c, value.error, value.radius)
        added, beyond = value.beyond_tangent(half, half_error, third)
        quad, rest = np.concatenate([quad, added]), np.concatenate([rest, beyond])
        bends = np.concatenate([bends, frobenius(added)])
        doubt = up(np.max(up(slope + wrong)) * doubt + (np.max(wrong) + EPS) * norm(X, 0))
        y, error, X = t[:, None, None], e[:, None], slope[:, None] * X
    if net.squash:
        value = value.function("tanh")
    slack = np.broadcast_to(value.slack, len(value.a))
    each = zip(value.c, value.error, value.a, slack, value.Q, value.E, strict=True)
    return [Jet(*parts) for parts in each]
