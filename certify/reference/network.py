"""The policy on a ball x = J d, ||d|| <= 1, as models of the inputs before their clip.

A layer is y(d) = y(0) + G J d + L A(d): A stacks what every tanh of the layers before adds to its tangent at y(0). None
of y(0), G and L depends on the ball, and L is most of the work; so they are found once, for all balls of a
certificate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb, arb_mat, fmpq_mat

from .balls import ONE, ZERO, absolute, beta, columns_scaled, weights
from .document import Certificate
from .model import Model
from .taylor import pairs


@dataclass(frozen=True)
class Unfolded:
    """A layer at the origin: its values, its gradient in x, and L with the magnitudes of its entries.

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
        self.c, self.layers = c, list[Unfolded]()
        at_0, G, L = arb_mat(c.n, 1), arb_mat(c.n, c.n), arb_mat(0, 0)
        for k, (W, layer) in enumerate(zip(weights(c.policy), c.policy.layers, strict=True)):
            if k:
                t = [v.tanh() for v in at_0.entries()]
                weighted = columns_scaled(W, [1 - v * v for v in t])
                at_0, G, L = arb_mat(len(t), 1, t), weighted * G, beside(weighted * L, W) if k > 1 else W
            else:
                G = W
            at_0 = W * at_0 + arb_mat(layer.rows, 1, [arb(b) for b in layer.bias])
            blocks = (L, absolute(L)) if k else (None, None)
            self.layers.append(Unfolded(list(at_0.entries()), G, *blocks))

    def on(self, J: fmpq_mat) -> list[Model]:
        """The inputs before their clip."""
        c, ball, n = self.c, arb_mat(J), self.c.n
        H, R = list[list[arb]](), list[list[arb]]()
        for layer in self.layers[:-1]:
            for y in layer.on(ball, H, R):
                bent, rest = y.beyond_tanh(y.v.tanh())
                H.append(half(bent))
                R.append(half(rest))
        last = self.layers[-1].on(ball, H, R)
        if c.policy.centre == "preactivation":
            last = [Model(v, y.a, y.Q, y.E) for v, y in zip(beta(c), last, strict=True)]
        result = []
        for q, s, y in zip(c.plant.u_eq, map(arb, c.policy.scale), last, strict=True):
            slope, (bent, rest) = ONE, (arb_mat(n, n), arb_mat(n, n))
            if c.policy.squash == "tanh":
                t = y.v.tanh()
                slope, (bent, rest) = 1 - t * t, y.beyond_tanh(t)
            Q, E = slope * y.Q + bent, slope * y.E + rest
            result.append(Model(arb(q), s * slope * y.a, s * Q, abs(s) * E))
        return result


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
