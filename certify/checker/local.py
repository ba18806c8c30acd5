"""The local rule: Vdot < 0 on a ball around the origin, with no hole.

With z = rho d, {V <= c1} lies in ||d|| <= 1, where Vdot = 2 rho d'G(d), G = T'P F(T rho d).
"""

from __future__ import annotations

from fractions import Fraction
from functools import cached_property

import numpy as np

from .case import Case, Failures
from .elementary import elementary
from .expression import evaluate
from .float64 import EPS, Array, ends, float_with_error, frobenius, gamma, norm, spectral_norm, total, up, within
from .jets import Jet, constant, widen
from .network import Folded

_MOST_NUMBERS = 2**25  # in the matrices of all jets, or of a layer and the paths to it
_MOST_PRODUCTS = 2**33  # in the sums over paths


class Ball:
    """The ball, and what the rules on it need; each is computed when it is first asked for."""

    def __init__(self, case: Case) -> None:
        self.case, self.c = case, case.c

    @cached_property
    def rho(self) -> float:
        """Upper bound of the radius of {V <= c1} in the coordinates z, once `fits` has held."""
        ratio, _ = float_with_error(Fraction(self.c.c1) / self.case.least) if self.case.least > 0 else (np.nan, 0.0)
        return float(np.sqrt(ratio) * (1 + 2.0**-40)) + 2.0**-960

    @cached_property
    def J(self) -> tuple[Array, float]:
        """x = J d, J (n, n), and a bound of its rounding error in the 2-norm."""
        J = self.rho * self.case.partition.T
        return J, float(up(EPS * frobenius(J)))

    @cached_property
    def inputs(self) -> list[Jet]:
        """pi(x) on the ball, before it is clipped."""
        gradient, slack, Q, E = enclose_at_origin(self.case.net, *self.J)
        parts = zip(self.c.u_eq, self.case.net.scale, gradient, slack, Q, E, strict=True)
        return [input_jet(*part) for part in parts]

    @cached_property
    def remainder(self) -> float:
        """What is not the decay e'e, as a share of it: Vdot < 0 on the ball if this is below 1.

        F(0) = 0 exactly, so d'G = d'B d + sum_j d_j d'C_j d + R, where |R| <= d'E d with E = sum_i ||(PT)_i|| E_i.
        Take any diagonal D > 0 and d = D e. With N = D (-(B + B')/2 - E) D and the n x n^2 matrix W of all D C_j D,
        d'G is at most -e'N e + ||W||_2 ||e||^2, and e'N e >= (1 - ||I - N||_2) ||e||^2.
        """
        n, T, P, (J, slack) = len(self.c.states), self.case.partition.T, self.c.P, self.J
        nothing = np.zeros((n, n))
        states = [Jet(np.float64(0), 0.0, row, slack, nothing, nothing) for row in J]
        F = evaluate(self.c.dynamics, lambda q: constant(q, n), [*states, *self.inputs])
        gradients, Q, E = (np.array([getattr(jet, field) for jet in F]) for field in ("a", "Q", "E"))
        slopes, slacks, bends = (np.array([[getattr(jet, field)] for jet in F]) for field in ("slope", "slack", "bend"))
        PT, doubt = P @ T, up(gamma(n) * (norm(P, 1)[:, None] * norm(T, 0)[None, :]))  # of each entry
        size = up(np.abs(PT) + doubt)
        B, C = PT.T @ gradients, PT.T @ Q.reshape(n, -1)
        wrong = total(size * slacks + doubt * slopes + gamma(n) * (size * slopes), 0)  # of each row of B, in the 2-norm
        wrong = norm(wrong, 0) + norm(total(doubt * bends + gamma(n) * (size * bends), 0), 0)  # and of each C_j
        E = (norm(size, 1)[None] @ E.reshape(n, -1)).reshape(n, n)
        M = -(B + B.T) / 2
        D = 1 / np.sqrt(np.diagonal(M))
        N = D[:, None] * (M - widen(E, wrong + EPS * frobenius(M), gamma(n) + EPS)) * D
        W = (C.reshape(n, n, n) * D[:, None] * D).reshape(n, -1)
        return float(spectral_norm(np.eye(n) - N) + spectral_norm(W) + EPS * (frobenius(N) + frobenius(W) + n))


def fits(ball: Ball) -> Failures:
    """`local`: the level is in range, and the jets take neither too much memory nor too much time."""
    c, rho, n = ball.c, ball.rho, len(ball.c.states)
    if not (rho < np.inf and ball.case.least * Fraction(rho) ** 2 >= Fraction(c.c1)):
        yield "levels.local", "the level is out of range"
    yield from too_large(ball.case.net, len(c.dynamics.operations), n)
    return 0


def keeps_inputs(ball: Ball) -> Failures:
    """`inputs`: by form, or by the enclosure on the ball."""
    if not ball.case.bounded:
        for name, bounds, u in zip(ball.c.inputs, ball.c.input_bounds, ball.inputs, strict=True):
            if not within(bounds, u.c, up(u.error + u.radius)):
                yield "local ball", f"{name} may leave its bounds"
    return len(ball.c.inputs)


def is_not_clipped(ball: Ball) -> Failures:
    """`local`: every input lies strictly inside the policy's clip, so that the jets of what is clipped are its own."""
    clip = ball.case.net.clip
    for name, u, *limits in zip(ball.c.inputs, ball.inputs, *clip, strict=True) if clip else ():
        low, high = ends(u.c, up(u.error + u.radius))
        if not limits[0] < low <= high < limits[1]:
            yield "policy.clip", f"{name} may be clipped on the local ball"
    return 0


def decreases(ball: Ball) -> Failures:
    """`local`: Vdot < 0 on the ball without its centre."""
    if not ball.remainder < 1:
        yield "levels.local", f"Vdot < 0 is not shown on the local ball: {ball.remainder:.3g} of the decay"
    return 1


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


def enclose_at_origin(net: Folded, J: Array, slack: float) -> tuple[Array, Array, Array, Array]:
    """The policy on the ball x = J d, ||d|| <= 1: `pi = u_eq + scale * (G d + d'Q d + r(d))` with |r_j(d)| <= d'E_j d.

    J (n, n) lies within `slack` of the true matrix in the 2-norm. Returns G (m, n), the slack of each of its rows, Q
    and E (m, n, n).

    Every layer's value is y(d) = y(0) + J d + M A(d), where A_q is what a tanh of the layers before adds to its tangent
    at y_q(0), and M the product of weights and slopes with which that reaches y, so that errors cancel as they do in
    truth. A_q(d) is d'(quad_q)d within d'(rest_q)d, and `bends` bounds ||quad_q||_2; of the first n of these, which
    stand for the states, all are 0. Each column of X = [J, M] lies within its `doubt` of the true one in the 2-norm.
    """
    n = J.shape[1]
    y, error = np.zeros((len(J), 1, 1)), np.zeros((len(J), 1))
    X, doubt = J, slack + np.zeros(n)
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
