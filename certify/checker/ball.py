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
from .expression import evaluate
from .functions import FUNCTIONS
from .jets import Jet, between, constant, uncertain
from .near import Above, Array, Cubic, Near, Square, Vector, all_near, mixed, near, size, stacked, triples, within
from .network import Folded

_MOST_JETS = 2**26  # numbers in the matrices and tensors of all jets
_MOST_NUMBERS = 2**25  # in those of a layer and the paths to it
_MOST_PRODUCTS = 2**33  # in the sums over paths


@dataclass(frozen=True)
class Units:
    """The remainder of each tanh q of the network: e_q(d) with |e_q(d)| <= d'R_q d, R (k, k, N). It reaches the inputs
    as sum_q L_jq e_q, L (m, N)."""

    L: Array
    R: Array

    @cached_property
    def shares(self) -> Array:
        """Bounds of these sums, (k, k, m)."""
        found: Square = mixed(Square(self.R), Near(np.abs(self.L.T)))
        return found.majorant


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
        nothing = constant(Fraction(0), np.zeros((k, k, 0)), self.count)
        jets = []
        for row, at, by in zip(self.J, m, w, strict=True):
            step = near(by)
            a = Vector(row) if still else Vector(np.append(row, step.value), step.error)
            jets.append(replace(nothing, c=near(at), a=a))
        return jets

    @cached_property
    def outputs(self) -> Jet:
        """The last layer's values, squashed if the policy is: a batch of jets, whose errors belong to the units."""
        return enclose_on_ball(self.case.net, self.states)

    @cached_property
    def reach(self) -> Near:
        """The numbers (N, m) with which the units of `outputs` reach the inputs."""
        return Near(self.outputs.B.value) * Near(self.case.net.scale)

    @cached_property
    def units(self) -> Units:
        """All tanh of the network, the last layer's included, and how they reach the inputs."""
        L = np.concatenate([self.reach.value, np.diag(self.case.net.scale)])
        return Units(L.T, np.concatenate([self.outputs.U, self.outputs.remainder], 2))

    @cached_property
    def inputs(self) -> list[Jet]:
        """pi(x) on the ball before the clip, each input with its own error."""
        h, scale, m = self.outputs, Near(self.case.net.scale), len(self.case.c.inputs)
        c = all_near(self.case.c.u_eq) if self.starts_at_u_eq else h.c * scale + self.case.net.offset
        a, Q, K = h.a * scale, Square(h.Q.value) * scale, Cubic(h.K.value) * scale
        E, lip = mixed(Square(h.U), Near(self.reach.error.top)), h.lipschitz * size(scale.value)
        return [
            Jet(
                c[j],
                a[j],
                Q[j],
                K[j],
                E[j],
                Near(np.eye(m)[j]),
                self.units.shares,
                Near(np.zeros(self.count)),
                Vector(np.zeros((len(h.a.value), self.count))),
                lip[j],
            )
            for j in range(m)
        ]

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
        return [replace(x, B=Near(np.zeros(U.shape[2])), U=U) for x in states]

    def symbols(self, cell: Intervals) -> list[Jet]:
        """The uncertain quantities of a cell, as the numbers y have them."""
        U = self.units.shares
        return [uncertain(lo, hi, U, j, self.count) for j, (lo, hi) in enumerate(cell)]

    @property
    def ranges(self) -> list[Jet]:
        """The uncertain quantities, of which only their whole ranges are known."""
        return [between(lo, hi, self.units.shares, self.count) for lo, hi in self.case.c.ranges]


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
            if not within(bounds, u.range):
                yield ball.at, f"{name} may leave its bounds"
    return len(c.inputs)


def is_not_clipped(ball: Ball) -> Failures:
    """Every input lies strictly inside the policy's clip, so that the clip does not change its jets."""
    clip = ball.case.net.clip
    for name, u, *limits in zip(ball.case.c.inputs, ball.inputs, *clip, strict=True) if clip else ():
        low, high = u.range.ends
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
    truth. A_q(d) is d'H_q d + C_q[d] + e_q(d), |e_q(d)| <= d'R_q d, and e_q has the Lipschitz constant lips_q. Each
    column of X = [a, B] has an error of its own.
    """
    k = len(states[0].a.value)
    y = stacked([x.c for x in states])
    X = Vector(
        np.array([x.a.value for x in states]), stacked([Near(0.0, x.a.error) for x in states]).error.norm() * np.ones(k)
    )
    H, C, R = np.zeros((k, k, 0)), np.zeros((len(triples(k)[0]), 0)), np.zeros((k, k, 0))
    lips = Above(np.zeros(0))
    for number, layer in enumerate(net.layers):
        y, X = y.through(layer.W) + layer.b, X.mapped(layer.W, layer.norm2)
        if number > 0:  # the difference of the tanh just before arrives through W alone
            X = X.beside(layer.W)
        B, rows = Near(X.value[:, k:].T, X.error[k:, None]), np.ones(len(y.value))
        a, Q, K = Vector(X.value[:, :k].T, X.error[:k].norm() * rows), mixed(Square(H), B), mixed(Cubic(C), B)
        E = Square(np.zeros_like(Q.value), (B.error * Square(R).size[:, None]).sum() * rows)
        lip = (B.size * lips[:, None]).sum()
        of_y = Near(np.zeros((0, len(rows)))), Vector(np.zeros((k, 0, len(rows))))  # a policy knows nothing of y
        value = Jet(y, a, Q, K, E, Near(B.value), R, *of_y, lip)
        if number == len(net.layers) - 1:
            break
        phi = FUNCTIONS["tanh"].expansion(value.v0, value.radius)
        bent, twisted, rest = value.beyond_tangent(phi)
        rest = rest.wider(bent.error + twisted.error)
        H, C, R = (np.concatenate(pair, -1) for pair in ((H, bent.value), (C, twisted.value), (R, rest.majorant)))
        lips = lips.beside(value.lip_beyond_tangent(phi) + bent.error * 2 + twisted.error * 3)
        y, X = phi.f[0], X.times(phi.f[1])
    return value.function("tanh") if net.squash else value
