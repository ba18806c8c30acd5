"""The policy on a ball x = centre + J d, ||d|| <= 1, as models of the inputs before their clip.

A layer is y(d) = y(0) + G J d + L A(d): A stacks what every tanh of the layers before adds to its tangent at y(0). Of
these y(0), G and L depend on the ball's centre alone, and L is most of the work; so they are found once for all balls
around the origin. There the policy is u_eq, by its form or because rule `centring` has shown it; at any other centre it
is a number like others, and so it is at the origin with centring `none` where nothing is asked of it.

What the models of a tanh leave out is an error of its own, which reaches every input through L.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

from flint import arb, arb_mat, fmpq_mat

from .balls import ONE, ZERO, absolute, beta, biased, columns_scaled, finite, net_at_0, origin, tanhs, weights
from .document import Certificate
from .functions import Expansion, beyond_tangent, expansion, steepness, steepness_beyond_tangent
from .model import Model
from .symmetric import half, no_form, whole


@dataclass(frozen=True)
class Bends:
    """The tanhs' differences from their tangents, one row per tanh: d'Hd + C[d] within d'Rd; halves of H, R.

    `lip`, if needed, has the Lipschitz constants of the remainders.
    """

    H: list[list[arb]]
    C: list[list[arb]]
    R: list[list[arb]]
    lip: list[arb]

    def append(self, y: Model, phi: Expansion) -> tuple[arb_mat, arb_mat]:
        """The tanh of y; H and C."""
        H, C, R = beyond_tangent(y, phi)
        self.H.append(half(H))
        self.C.append(C.entries())
        self.R.append(half(R))
        lip = steepness_beyond_tangent(y, phi)
        if lip is not None:
            self.lip.append(lip)
        return H, C


@dataclass(frozen=True)
class Unfolded:
    """A layer at a centre: its values, its gradient in x, and L with the magnitudes of its entries.

    L has a column for each tanh of all layers before, and the first layer has no L.
    """

    at_0: list[arb]
    G: arb_mat
    L: arb_mat | None
    absolute: arb_mat | None

    def on(self, J: arb_mat, bends: Bends, steady: bool) -> list[Model]:
        """The rows on a ball: sums over the tanhs before with L, and of their bounds with its magnitudes."""
        n = J.ncols()
        a = (self.G * J).tolist()
        if self.L is None or self.absolute is None:
            return [Model.affine(v, row, lip=ZERO if steady else None) for v, row in zip(self.at_0, a, strict=True)]
        Q, K, E = (
            (weights * arb_mat(each)).tolist()
            for weights, each in ((self.L, bends.H), (self.L, bends.C), (self.absolute, bends.R))
        )
        lips: list[arb | None] = [None] * len(a)
        if steady:
            lips = list((self.absolute * arb_mat(len(bends.lip), 1, bends.lip)).entries())
        return [
            Model(v, arb_mat(n, 1, row), whole(q, n), arb_mat(1, len(k), k), whole(e, n), lip=lip)
            for v, row, q, k, e, lip in zip(self.at_0, a, Q, K, E, lips, strict=True)
        ]


@dataclass(frozen=True)
class Units:
    """The remainders of all tanhs: e_q, |e_q| <= d'R_q d, of which input j sees sum_q L_jq e_q.

    Each row of R has half of a symmetric matrix, for n variables.
    """

    n: int
    L: arb_mat
    R: list[list[arb]]

    @cached_property
    def squares(self) -> arb_mat:
        """R_q'R_q, a row for each tanh."""
        wholes = [whole(row, self.n) for row in self.R]
        return arb_mat(len(self.R), self.n**2, [v for R in wholes for v in (R.transpose() * R).entries()])

    def errors(self) -> tuple[arb_mat, ...]:
        """U_j of each input: sum_q |L_jq| R_q."""
        if not self.R:
            return tuple(arb_mat(self.n, self.n) for _ in range(self.L.nrows()))
        sums: list[list[arb]] = (absolute(self.L) * arb_mat(self.R)).tolist()
        return tuple(whole(row, self.n) for row in sums)

    def is_finite(self) -> bool:
        return finite(self.L.entries()) and all(finite(row) for row in self.R)


class Network:
    """The policy of a certificate. At the origin it is u_eq, but for claims with a floor, with centring `none`."""

    def __init__(self, c: Certificate) -> None:
        self.c, self.weights = c, weights(c.policy.layers)
        self.net_at_0 = net_at_0(c, self.weights)
        self.beta = beta(c) if c.policy.centre == "preactivation" else []
        self.at_origin = self.unfolded(arb_mat(c.n, 1))

    def unfolded(self, centre: arb_mat) -> list[Unfolded]:
        """The layers at a centre, a column."""
        layers, at_0, G, L = list[Unfolded](), origin(self.c) + centre, arb_mat(self.c.n, self.c.n), arb_mat(0, 0)
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

    def on(self, J: fmpq_mat, centre: fmpq_mat | None = None, steady: bool = False) -> tuple[list[Model], Units]:
        """The inputs before their clip; J may have more columns than rows, and without a centre it is the origin.

        Models have a Lipschitz constant where they are to be `steady`.
        """
        ball, n, m = arb_mat(J), J.ncols(), self.c.m
        layers = self.at_origin if centre is None else self.unfolded(arb_mat(centre))
        bends = Bends([], [], [], [])
        for layer in layers[:-1]:
            for y in layer.on(ball, bends, steady):
                bends.append(y, expansion(y, "tanh"))
        squashed, inputs, reached = self.c.policy.squash == "tanh", list[Model](), list[list[arb]]()
        L, hidden = layers[-1].L, len(bends.R)
        for j, (s, net) in enumerate(
            zip(map(arb, self.c.policy.scale), layers[-1].on(ball, bends, steady), strict=True)
        ):
            y, slope, H, C = replace(net, v=self.before_squash(j, net.v, centre)), ONE, arb_mat(n, n), no_form(n)
            value, own, lip = y.v, [ZERO] * m, y.lip
            if squashed:
                phi = expansion(y, "tanh")
                (value, slope, _, _), lip = phi.at, steepness(y, phi, ZERO)
                H, C = bends.append(y, phi)
                own[j] = s
            ways = [s * slope * L[j, q] for q in range(hidden)] if L is not None else []
            reached.append(ways + own if squashed else ways)
            Q, K = s * (slope * y.Q + H), s * (slope * y.K + C)
            at_0, lip = self.input_at(j, value, centre), None if lip is None else abs(s) * lip
            inputs.append(Model(at_0, s * slope * y.a, Q, K, arb_mat(n, n), lip=lip))
        units = Units(n, arb_mat(m, len(bends.R), [v for row in reached for v in row]), bends.R)
        errors = units.errors()
        unit_vectors = [tuple(ONE if i == j else ZERO for i in range(m)) for j in range(m)]
        return [replace(u, B=B, errors=errors) for u, B in zip(inputs, unit_vectors, strict=True)], units

    def before_squash(self, j: int, net: arb, centre: fmpq_mat | None) -> arb:
        """The value before the squash at the centre, where the network is `net`; `preactivation` gives beta at 0."""
        if self.c.policy.centre != "preactivation":
            return net
        return self.beta[j] if centre is None else net - self.net_at_0[j] + self.beta[j]

    def input_at(self, j: int, squashed: arb, centre: fmpq_mat | None) -> arb:
        """Input j at the centre, before its clip."""
        policy, u_eq = self.c.policy, arb(self.c.plant.u_eq[j])
        if centre is None and (self.c.ends_at_origin or policy.centre != "none"):
            return u_eq
        scale, at_0 = arb(policy.scale[j]), self.net_at_0[j]
        if policy.centre != "output":
            return scale * squashed + arb(policy.offset[j])
        return scale * (squashed - (at_0.tanh() if policy.squash == "tanh" else at_0)) + u_eq


def beside(A: arb_mat, B: arb_mat) -> arb_mat:
    return arb_mat([[*a, *b] for a, b in zip(A.tolist(), B.tolist(), strict=True)])
