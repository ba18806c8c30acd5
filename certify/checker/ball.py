"""The closed loop on a ball, ||d|| <= 1: every quantity as a jet over d (jets.py).

Around the origin x = J d; there F is 0 at rest. Along a path the last entry of d is the motion of the ball's middle
on a line: x = m + J z + w sigma, d = (z, sigma).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property

import numpy as np

from .case import Case, Failures
from .document import Intervals
from .elementary import elementary
from .expression import evaluate
from .float64 import EPS, Array, ends, float_with_error, frobenius, gamma, norm, total, up, within
from .jets import Jet, between, constant, each, tensor_norm, triples, uncertain, widen
from .network import Folded

_MOST_JETS = 2**26  # numbers in the matrices and tensors of all jets
_MOST_NUMBERS = 2**25  # in those of a layer and the paths to it
_MOST_PRODUCTS = 2**33  # in the sums over paths


@dataclass(frozen=True)
class Units:
    """The remainder of each tanh q of the network: e_q(d) with |e_q(d)| <= d'R_q d, R (N, k, k). It reaches the inputs
    as sum_q L_jq e_q, L (m, N)."""

    L: Array
    R: Array

    @cached_property
    def shares(self) -> Array:
        """Bounds of these sums, (m, k, k)."""
        return np.asarray(widen(np.tensordot(np.abs(self.L), self.R, 1), 0.0, gamma(len(self.R)) + EPS))


@dataclass(frozen=True)
class Ball:
    """The models that rules need on a ball, each computed on first use. J (n, n) is exact, `at` its place."""

    case: Case
    J: Array
    at: str

    @property
    def motion(self) -> tuple[list[Fraction], list[Fraction]] | None:
        """m and w of a ball along a path, n numbers each; None around the origin."""
        return None

    @property
    def starts_at_u_eq(self) -> bool:
        """True if the inputs at d = 0 are u_eq: by form, or by rule `centring`."""
        return self.motion is None and (self.case.c.policy.centre != "none" or not self.case.c.practical)

    @property
    def order(self) -> int:
        """The order of the series in time."""
        return 1

    @property
    def count(self) -> int:
        """The number of variables y: one per uncertain quantity, and one for the period if it has a range."""
        lo, hi = self.case.c.sample or (0, 0)
        return len(self.case.c.ranges) + (lo < hi)

    @cached_property
    def states(self) -> list[Jet]:
        """x on the ball, exact but for rounding."""
        n, still = len(self.J), self.motion is None
        m, w = ([Fraction(0)] * n, [Fraction(0)] * n) if self.motion is None else self.motion
        k = n if still else n + 1
        nothing = constant(Fraction(0), np.zeros((0, k, k)), self.count)
        jets = []
        for row, at, by in zip(self.J, m, w, strict=True):
            (c, error), (step, slack) = float_with_error(at), float_with_error(by)
            a = row if still else np.append(row, step)
            jets.append(replace(nothing, c=np.float64(c), error=error, a=a, slack=slack))
        return jets

    @cached_property
    def outputs(self) -> Jet:
        """The last layer's values, squashed if the policy is: a batch of jets, whose errors belong to the units."""
        return enclose_on_ball(self.case.net, self.states)

    @cached_property
    def units(self) -> Units:
        """All tanh of the network, the last layer's included, and how they reach the inputs."""
        h, scale = self.outputs, self.case.net.scale
        return Units(np.concatenate([scale[:, None] * h.B, np.diag(scale)], 1), np.concatenate([h.U, h.E]))

    @cached_property
    def inputs(self) -> list[Jet]:
        """pi(x) on the ball before the clip, each input with its own error."""
        net, h, U = self.case.net, self.outputs, self.units.shares
        if self.starts_at_u_eq:
            values = [float_with_error(u) for u in self.case.c.u_eq]
        else:
            parts = zip(h.c, h.error, net.scale.tolist(), net.offset.tolist(), net.offset_error.tolist(), strict=True)
            values = [_affine(*part) for part in parts]
        c, error = np.array(values).T
        k, column = np.abs(net.scale), net.scale[:, None]
        a, slack = column * h.a, up(k * h.slack + EPS * (k * h.slope))
        E = widen(np.zeros_like(h.E), EPS * (k * h.spread) + h.faint)
        of_y = np.zeros((len(c), self.count)), np.zeros((len(c), self.count, a.shape[1]))
        lip = up(k * h.lip + 3 * EPS * (k * h.spread))
        batch = Jet(c, error, a, slack, each(net.scale) * h.Q, column * h.K, E, np.eye(len(c)), U, *of_y, lip)
        return batch.members

    def constant(self, q: Fraction) -> Jet:
        """A rational among the jets of this ball."""
        return constant(q, self.units.shares, self.count)

    def F(self, cell: Intervals = ()) -> list[Jet]:
        """The components of F on the ball, for all values of the uncertain quantities in a cell. At rest F(0) = 0, but
        these jets only know that 0 is near."""
        return self.f(self.states, self.symbols(cell))

    def f(self, states: Sequence[Jet], quantities: Sequence[Jet]) -> list[Jet]:
        """f(x, pi(x), q) at such states and quantities."""
        return evaluate(self.case.c.dynamics, self.constant, [*self.shared(states), *self.inputs, *quantities])

    def shared(self, states: Sequence[Jet]) -> list[Jet]:
        """The states as jets with the inputs' errors."""
        U = self.units.shares
        return [replace(x, B=np.zeros(len(U)), U=U) for x in states]

    def symbols(self, cell: Intervals) -> list[Jet]:
        """The uncertain quantities of a cell, as the numbers y have them."""
        U = self.units.shares
        return [uncertain(lo, hi, U, j, self.count) for j, (lo, hi) in enumerate(cell)]

    @property
    def ranges(self) -> list[Jet]:
        """The uncertain quantities, of which only their whole ranges are known."""
        return [between(lo, hi, self.units.shares, self.count) for lo, hi in self.case.c.ranges]


def _affine(h: float, error: float, scale: float, offset: float, offset_error: float) -> tuple[float, float]:
    """scale * h + offset, h within `error`, and its error."""
    through = scale * h
    value = through + offset
    return value, up(abs(scale) * error + offset_error + EPS * (abs(through) + abs(offset)))


def fits(ball: Ball) -> Failures:
    """The jets take neither too much memory nor too much time."""
    symbols = len(ball.J) + (ball.motion is not None)
    operations = len(ball.case.c.dynamics.operations) * ball.order**2 * (1 + ball.count)
    yield from too_large(ball.case.net, operations, symbols)
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
    """Every input lies strictly inside the policy's clip, so that the clip does not change its jets."""
    clip = ball.case.net.clip
    for name, u, *limits in zip(ball.case.c.inputs, ball.inputs, *clip, strict=True) if clip else ():
        low, high = ends(u.c, up(u.error + u.radius))
        if not limits[0] < low <= high < limits[1]:
            yield ball.at, f"{name} may be clipped: policy.clip"
    return 0


def too_large(net: Folded, operations: int, k: int) -> Failures:
    """Places where jets of so many operations in k symbols, or the network's, take too much memory or time."""
    numbers = k * k + len(triples(k)[0])
    if operations * numbers > _MOST_JETS:
        yield "plant.dynamics", "the equations are too large for this rule"
    columns, products = k, 0
    for layer in net.layers[1:]:
        rows, width = layer.W.shape
        products += rows * columns * width
        columns += width
        products += rows * columns * numbers
        if columns * (rows + numbers) > _MOST_NUMBERS or products > _MOST_PRODUCTS:
            yield "policy.layers", "the network is too large for this rule"
    return 0


def enclose_on_ball(net: Folded, states: Sequence[Jet]) -> Jet:
    """The last layer's values, squashed if the policy is, as a batch of jets; the states are jets without Q, K and E.

    Every layer's value is y(d) = y(0) + a.d + B A(d), where A_q is the difference of an earlier tanh from its tangent
    at y_q(0), and B the product of weights and slopes with which it reaches y, so that errors cancel as they do in
    truth. A_q(d) is d'H_q d + C_q[d] + e_q(d), and `sizes` bounds all three. Each column of X = [a, B] lies within its
    `doubt` of the true one.
    """
    X, k = np.array([x.a for x in states]), len(states[0].a)
    y = np.array([x.c for x in states], dtype=np.float64)[:, None, None]
    error = np.array([x.error for x in states])[:, None]
    doubt = np.full(k, norm(np.array([x.slack for x in states]), 0))
    H, C, R = np.zeros((0, k, k)), np.zeros((0, len(triples(k)[0]))), np.zeros((0, k, k))
    sizes = steep = lips = np.zeros(0)
    for number, layer in enumerate(net.layers):
        y, rounding = layer.affine(y, np.abs(y[:, 0]))
        error = up(layer.widest(error) + rounding)
        width = layer.W.shape[1]
        doubt = up(layer.norm2 * doubt + gamma(width) * (frobenius(layer.W) * norm(X, 0)))
        X = layer.W @ X
        if number > 0:  # the difference of the tanh just before arrives through W alone
            X, doubt = np.concatenate([X, layer.W], 1), np.concatenate([doubt, np.zeros(width)])
        a, B, count = X[:, :k], X[:, k:], len(sizes)
        Q = np.tensordot(B, H, 1)
        lost = total(doubt[k:] * sizes + (gamma(count) + EPS) * (np.abs(B) * sizes), 1)
        E = widen(np.zeros_like(Q), lost)
        lip = total(np.abs(B) * lips + (doubt[k:] + (gamma(count) + EPS) * np.abs(B)) * steep, 1)
        slack = np.full(len(a), norm(doubt[:k], 0))
        of_y = np.zeros((len(a), 0)), np.zeros((len(a), 0, k))  # a policy knows nothing of what is uncertain
        value = Jet(y[:, 0, 0], error[:, 0], a, slack, (Q + Q.swapaxes(1, 2)) / 2, B @ C, E, B, R, *of_y, lip)
        if number == len(net.layers) - 1:
            break
        phi = elementary("tanh", value.c, value.error, value.radius)
        (t, slope, _, _), (e, wrong, _, _) = phi.f, phi.e
        added = value.beyond_tangent(phi)
        H, C, R = (np.concatenate(pair) for pair in zip((H, C, R), added, strict=True))
        sizes = up(frobenius(H) + tensor_norm(C, k) + frobenius(R))
        lips = np.concatenate([lips, value.lip_beyond_tangent(phi)])
        steep = up(2 * frobenius(H) + 3 * tensor_norm(C, k) + lips)
        doubt = up(np.max(up(slope + wrong)) * doubt + (np.max(wrong) + EPS) * norm(X, 0))
        y, error, X = t[:, None, None], e[:, None], slope[:, None] * X
    return value.function("tanh") if net.squash else value
