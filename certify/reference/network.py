"""The policy on a ball x = centre + J d, ||d|| <= 1, as models of the inputs before their clip.

A layer is y(d) = y(0) + G J d + L A(d): A stacks what every tanh of the layers before adds to its tangent at y(0). Of
these y(0), G and L depend on the ball's centre alone, and L is most of the work; so they are found once for all balls
around the origin. There the policy is u_eq, by its form or because rule `centring` has shown it; at any other centre it
is a number like others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb, arb_mat, fmpq_mat

from .balls import ONE, ZERO, absolute, beta, biased, columns_scaled, net_at_0, tanhs, weights
from .document import Certificate
from .model import Model
from .taylor import pairs


@dataclass(frozen=True)
class Unfolded:
    """A layer at a centre: its values, its gradient in x, and L with the magnitudes of its entries.

    L has a column for each tanh of all layers before, and the first layer has no L.
    """

    at_0: list[arb]
    G: arb_mat
    L: arb_mat | None
    absolute: arb_mat | None

    def on(self, J: arb_mat, H: Sequence[list[arb]], R: Sequence[list[arb]]) -> list[Model]:
        """The rows on a ball: Q_i = sum_q L_iq H_q and E_i = sum_q |L_iq| R_q, H_q and R_q halves of matrices."""
        n = J.ncols()
        a = (self.G * J).tolist()
        if self.L is None or self.absolute is None:
            return [Model.affine(v, row) for v, row in zip(self.at_0, a, strict=True)]
        Q, E = (self.L * arb_mat(H)).tolist(), (self.absolute * arb_mat(R)).tolist()
        each = zip(self.at_0, a, Q, E, strict=True)
        return [Model(v, arb_mat(n, 1, row), whole(q, n), whole(e, n)) for v, row, q, e in each]


class Network:
    """The policy of a certificate whose origin is an equilibrium: pi(0) = u_eq exactly."""

    def __init__(self, c: Certificate) -> None:
        self.c, self.weights = c, weights(c.policy)
        self.net_at_0 = net_at_0(c, self.weights)
        self.beta = beta(c) if c.policy.centre == "preactivation" else []
        self.at_origin = self.unfolded(arb_mat(c.n, 1))

    def unfolded(self, centre: arb_mat) -> list[Unfolded]:
        """The layers at a centre, a column."""
        layers, at_0, G, L = list[Unfolded](), centre, arb_mat(self.c.n, self.c.n), arb_mat(0, 0)
        for k, (W, layer) in enumerate(zip(self.weights, self.c.policy.layers, strict=True)):
            if k:
                at_0 = tanhs(at_0)
                weighted = columns_scaled(W, [1 - t * t for t in at_0.entries()])
                G, L = weighted * G, beside(weighted * L, W) if k > 1 else W
            else:
                G = W
            at_0 = biased(W, layer, at_0)
            blocks = (L, absolute(L)) if k else (None, None)
            layers.append(Unfolded(list(at_0.entries()), G, *blocks))
        return layers

    def on(self, J: fmpq_mat, centre: fmpq_mat | None = None) -> list[Model]:
        """The inputs before their clip; J may have more columns than rows, and without a centre it is the origin."""
        ball, size = arb_mat(J), J.ncols()
        layers = self.at_origin if centre is None else self.unfolded(arb_mat(centre))
        H, R = list[list[arb]](), list[list[arb]]()
        for layer in layers[:-1]:
            for y in layer.on(ball, H, R):
                bent, rest = y.beyond_tanh(y.v.tanh())
                H.append(half(bent))
                R.append(half(rest))
        result = []
        for j, (s, y) in enumerate(zip(map(arb, self.c.policy.scale), layers[-1].on(ball, H, R), strict=True)):
            value, slope, (bent, rest) = self.before_squash(j, y.v, centre), ONE, (arb_mat(size, size),) * 2
            if self.c.policy.squash == "tanh":
                value = value.tanh()
                slope, (bent, rest) = 1 - value * value, y.beyond_tanh(value)
            Q, E = slope * y.Q + bent, slope * y.E + rest
            result.append(Model(self.input_at(j, value, centre), s * slope * y.a, s * Q, abs(s) * E))
        return result

    def before_squash(self, j: int, net: arb, centre: fmpq_mat | None) -> arb:
        """What is squashed at the centre, where the network is `net`: with `preactivation` at the origin beta alone."""
        if self.c.policy.centre != "preactivation":
            return net
        return self.beta[j] if centre is None else net - self.net_at_0[j] + self.beta[j]

    def input_at(self, j: int, squashed: arb, centre: fmpq_mat | None) -> arb:
        """Input j at the centre, before its clip."""
        policy, u_eq = self.c.policy, arb(self.c.plant.u_eq[j])
        if centre is None:
            return u_eq
        scale, at_0 = arb(policy.scale[j]), self.net_at_0[j]
        if policy.centre != "output":
            return scale * squashed + arb(policy.offset[j])
        return scale * (squashed - (at_0.tanh() if policy.squash == "tanh" else at_0)) + u_eq


def beside(A: arb_mat, B: arb_mat) -> arb_mat:
    return arb_mat([[*a, *b] for a, b in zip(A.tolist(), B.tolist(), strict=True)])


def half(A: arb_mat) -> list[arb]:
    """A symmetric matrix without what stands below its diagonal: one number for each of `pairs`."""
    entries, n = A.entries(), A.nrows()
    return [entries[i * n + j] for i, j in pairs(n)]


def whole(values: Sequence[arb], n: int) -> arb_mat:
    """The matrix of such a half."""
    rows = [[ZERO] * n for _ in range(n)]
    for (i, j), v in zip(pairs(n), values, strict=True):
        rows[i][j] = rows[j][i] = v
    return arb_mat(rows)
