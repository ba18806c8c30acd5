"""The closed loop on a ball around the origin, x = J d with ||d|| <= 1: every quantity as a jet (jets.py)."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np

from .case import Case, Failures
from .elementary import elementary
from .expression import evaluate
from .float64 import EPS, Array, ends, float_with_error, frobenius, gamma, norm, total, up, within
from .jets import Jet, constant, widen
from .network import Folded

_MOST_NUMBERS = 2**25  # in the matrices of all jets, or of a layer and the paths to it
_MOST_PRODUCTS = 2**33  # in the sums over paths


@dataclass(frozen=True)
class Ball:
    """What rules need on a ball, each computed when it is first asked for. J (n, n) is exact, `at` its place."""

    case: Case
    J: Array
    at: str

    @cached_property
    def inputs(self) -> list[Jet]:
        """pi(x) on the ball, before it is clipped."""
        gradient, slack, Q, E = enclose_at_origin(self.case.net, self.J)
        parts = zip(self.case.c.u_eq, self.case.net.scale, gradient, slack, Q, E, strict=True)
        return [input_jet(*part) for part in parts]

    @cached_property
    def F(self) -> list[Jet]:
        """The components of F on the ball; F(0) = 0, of which these jets know no more than that 0 is near."""
        n = len(self.J)
        nothing = np.zeros((n, n))
        states = [Jet(np.float64(0), 0.0, row, 0.0, nothing, nothing) for row in self.J]
        return evaluate(self.case.c.dynamics, lambda q: constant(q, n), [*states, *self.inputs])


def fits(ball: Ball) -> Failures:
    """The jets take neither too much memory nor too much time."""
    yield from too_large(ball.case.net, len(ball.case.c.dynamics.operations), len(ball.J))
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
    """Places where jets of so many operations in n states, or the network's, take too much memory or time."""
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


def input_jet(u_eq: Fraction, scale: float, G: Array, slack: float, Q: Array, E: Array) -> Jet:
    """u_eq + scale ((G + s).d + d'Q d + r(d)) with ||s|| <= slack, |r(d)| <= d'E d."""
    (value, error), k, a = float_with_error(u_eq), abs(scale), scale * G
    rest = widen(k * E, EPS * (k * frobenius(Q)))
    return Jet(np.float64(value), error, a, up(k * slack + EPS * norm(a, 0)), scale * Q, rest)


def enclose_at_origin(net: Folded, J: Array) -> tuple[Array, Array, Array, Array]:
    """The policy on the ball x = J d, ||d|| <= 1: `pi = u_eq + scale * (G d + d'Q d + r(d))` with |r_j(d)| <= d'E_j d.

    Returns G (m, n), the slack of each of its rows, Q and E (m, n, n).

    Every layer's value is y(d) = y(0) + X d + M A(d), where A_q is what a tanh of the layers before adds to its tangent
    at y_q(0), and M the product of weights and slopes with which that reaches y, so that errors cancel as they do in
    truth. A_q(d) is d'(quad_q)d within d'(rest_q)d, and `bends` bounds ||quad_q||_2; of the first n of these, which
    stand for the states, all are 0. Each column of [X, M], here X, lies within its `doubt` of the true one.
    """
    n = J.shape[1]
    y, error = np.zeros((len(J), 1, 1)), np.zeros((len(J), 1))
    X, doubt = J, np.zeros(n)
    quad, rest, bends = np.zeros((n, n, n)), np.zeros((n, n, n)), np.zeros(n)
    for k, layer in enumerate(net.layers):
        y, rounding = layer.affine(y)
        error = up(layer.widest(error) + rounding)
        width = layer.W.shape[1]
        doubt = up(layer.norm2 * doubt + gamma(width) * (frobenius(layer.W) * norm(X, 0)))
        X = layer.W @ X
        if k > 0:  # what the tanh just before has added arrives through W alone
            X, doubt = np.concatenate([X, layer.W], 1), np.concatenate([doubt, np.zeros(width)])
        count = len(doubt)
        weight = np.abs(X) + doubt
        Q = (X @ quad.reshape(count, -1)).reshape(-1, n, n)
        E = (weight @ rest.reshape(count, -1)).reshape(-1, n, n)
        E = widen(E, total(doubt * bends + gamma(count) * (weight * bends), 1), gamma(count) + EPS)
        value = Jet(y[:, 0, 0], error[:, 0], X[:, :n], norm(doubt[:n], 0), Q, E)
        if k == len(net.layers) - 1:
            break
        (t, slope, half), (e, wrong, half_error), third = elementary("tanh", value.c, value.error, value.radius)
        added, beyond = value.beyond_tangent(half, half_error, third)
        quad, rest = np.concatenate([quad, added]), np.concatenate([rest, beyond])
        bends = np.concatenate([bends, frobenius(added)])
        doubt = up(np.max(up(slope + wrong)) * doubt + (np.max(wrong) + EPS) * norm(X, 0))
        y, error, X = t[:, None, None], e[:, None], slope[:, None] * X
    if net.squash:
        value = value.function("tanh")
    return value.a, np.broadcast_to(value.slack, len(value.a)), value.Q, value.E
