"""Rule `local`: Vdot < 0 on the ball z = rho d, 0 < ||d|| <= 1, without a hole at the origin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from flint import arb, arb_mat, fmpq, fmpq_mat

from .balls import (
    ZERO,
    absolute,
    beta,
    bounded_by_form,
    columns_scaled,
    derivatives,
    finite,
    identity,
    norm,
    spectral,
    third,
    weights,
    within_bounds,
)
from .document import Certificate, exact
from .rational import discs
from .refusal import Refused, require


@dataclass(frozen=True)
class Local:
    """v(0) + a.d + d'Qd + r(d) with |r(d)| <= d'Ed, for ||d|| <= 1; a is a column."""

    v: arb
    a: arb_mat
    Q: arb_mat
    E: arb_mat

    @classmethod
    def affine(cls, v: arb, a: Sequence[arb]) -> Local:
        n = len(a)
        return cls(v, arb_mat(n, 1, list(a)), arb_mat(n, n), arb_mat(n, n))

    @cached_property
    def slope(self) -> arb:
        return norm(self.a.entries())

    @cached_property
    def bend(self) -> arb:
        return norm(self.Q.entries())

    @cached_property
    def curve(self) -> arb:
        return self.bend + norm(self.E.entries())

    @property
    def radius(self) -> arb:
        return self.slope + self.curve

    def __add__(self, other: Local) -> Local:
        return Local(self.v + other.v, self.a + other.a, self.Q + other.Q, self.E + other.E)

    def __neg__(self) -> Local:
        return Local(-self.v, -self.a, -self.Q, self.E)

    def __mul__(self, other: Local) -> Local:
        """v w = v(0) w(0) + v(0) dw + w(0) dv + (a_v.d)(a_w.d) + dv (dw - a_w.d) + (dv - a_v.d)(a_w.d)."""
        v, w, outer = self, other, self.a * other.a.transpose()
        Q = v.v * w.Q + w.v * v.Q + (outer + outer.transpose()) / 2
        E = (abs(v.v) + v.radius) * w.E + (abs(w.v) + w.slope) * v.E
        E += (v.radius * w.bend + w.slope * v.bend) * identity(outer.nrows())
        return Local(v.v * w.v, v.v * w.a + w.v * v.a, Q, E)

    def function(self, name: str) -> Local:
        at = derivatives(name, self.v)
        most = third(name, at[3], self.v, self.radius)
        if most is None:
            raise Refused(
                "local",
                "ball",
                "a root of what may not be positive" if name == "sqrt" else "a division by what may be 0",
            )
        H, R = self.beyond_tangent(at[2] / 2, most)
        return Local(at[0], at[1] * self.a, at[1] * self.Q + H, abs(at[1]) * self.E + R)

    def beyond_tangent(self, half: arb, most: arb) -> tuple[arb_mat, arb_mat]:
        """(H, R): a function of v less its tangent at v(0) is d'Hd within d'Rd.

        half = phi''(v(0)) / 2, most >= |phi'''| on the range. (v - v(0))^2 is d'aa'd but for (v - v(0) - a.d)(v - v(0)
        + a.d), that is within (2 slope + curve) d'(bend I + E)d, and |v - v(0)|^3 <= radius (v - v(0))^2.
        """
        square, cubic = self.a * self.a.transpose(), most * self.radius / 6
        spread = (abs(half) + cubic) * (2 * self.slope + self.curve)
        return half * square, spread * self.E + cubic * square + spread * self.bend * identity(square.nrows())

    def tanh(self) -> tuple[arb, arb, arb_mat, arb_mat]:
        """The value and the slope of the tangent at v(0), and (H, R) of what tanh adds to it; |tanh'''| <= 2."""
        t = self.v.tanh()
        return t, 1 - t * t, *self.beyond_tangent(-t * (1 - t * t), arb(2))


def local(c: Certificate, T: fmpq_mat, S: fmpq_mat) -> None:
    """||I - N||_2 + ||W||_2 < 1, and before that rule `inputs` on the ball."""
    rho = arb(arb(exact(c.inner) / discs(S)).sqrt().upper())
    states = local_states(T, rho)
    u = local_policy(c, states)
    bounded = bounded_by_form(c) or within_bounds(c, [(v.v, v.radius) for v in u])
    require(bounded, "inputs", "ball", "an input is not certain to stay in its bounds")
    for j, v in enumerate(u):
        lo, hi = c.policy.limits(j) or (None, None)
        alone = lo is None or bool(v.v - v.radius > arb(lo))
        alone = alone and (hi is None or bool(v.v + v.radius < arb(hi)))
        require(alone, "local", "ball", f"{c.plant.inputs[j]} is not certain to be left alone by the clip")
    B, C, E = local_vdot(c, T, states, u)
    require(all(finite(A.entries()) for A in (B, E, *C)), "local", "ball", "F has no finite model")
    diagonal = [-B[i, i] for i in range(c.n)]
    require(all(bool(v > 0) for v in diagonal), "local", "ball", "the linear part does not decrease V along an axis")
    D = arb_mat([[1 / v.sqrt() if i == j else ZERO for j in range(c.n)] for i, v in enumerate(diagonal)])
    N = D * (-(B + B.transpose()) / 2 - E) * D
    W = arb_mat([(D * A * D).entries() for A in C])
    bound = spectral(identity(c.n) - N) + spectral(W)
    require(bool(bound < 1), "local", "ball", f"||I - N|| + ||W|| may be {bound.str(6)}, and must be less than 1")


def local_states(T: fmpq_mat, rho: arb) -> list[Local]:
    """x = T rho d."""
    return [Local.affine(ZERO, row) for row in (rho * arb_mat(T)).tolist()]


def local_policy(c: Certificate, states: Sequence[Local]) -> list[Local]:
    """The policy before its clip: y(d) = y(0) + J d + L A(d), A_q(d) being d'H_q d within d'R_q d for each tanh q.

    `bends` holds, for each layer before, its block of L, and H and R with one row for each of its tanhs.
    """
    n, policy = c.n, c.policy
    J = arb_mat([list(x.a.entries()) for x in states])
    at_0, bends = arb_mat(n, 1), list[tuple[arb_mat, arb_mat, arb_mat]]()
    for k, (W, layer) in enumerate(zip(weights(policy), policy.layers, strict=True)):
        own = None
        if k:
            tangents = [y.tanh() for y in rows(at_0, J, bends)]
            at_0 = arb_mat(len(tangents), 1, [t for t, *_ in tangents])
            own = (W, stacked([H for *_, H, _ in tangents], n), stacked([R for *_, R in tangents], n))
            weighted = columns_scaled(W, [slope for _, slope, *_ in tangents])
            bends = [(weighted * L, H, R) for L, H, R in bends]
        else:
            weighted = W
        at_0 = W * at_0 + arb_mat(layer.rows, 1, [arb(b) for b in layer.bias])
        J = weighted * J
        bends += [own] if own else []
    if policy.centre == "preactivation":
        at_0 = arb_mat(c.m, 1, beta(c))
    result = []
    for q, s, y in zip(c.plant.u_eq, map(arb, policy.scale), rows(at_0, J, bends), strict=True):
        _, slope, H, R = y.tanh() if policy.squash == "tanh" else (None, arb(1), arb_mat(n, n), arb_mat(n, n))
        result.append(  # pi(0) = u_eq exactly
            Local(arb(q), s * slope * y.a, s * (slope * y.Q + H), abs(s) * (slope * y.E + R))
        )
    return result


def rows(at_0: arb_mat, J: arb_mat, bends: Sequence[tuple[arb_mat, arb_mat, arb_mat]]) -> list[Local]:
    """The models of a layer: Q_i = sum_q L_iq H_q and E_i = sum_q |L_iq| R_q."""
    count, n = J.nrows(), J.ncols()
    Q, E = arb_mat(count, n * n), arb_mat(count, n * n)
    for L, H, R in bends:
        Q, E = Q + L * H, E + absolute(L) * R
    each = zip(at_0.entries(), J.tolist(), Q.tolist(), E.tolist(), strict=True)
    return [Local(v, arb_mat(n, 1, a), arb_mat(n, n, q), arb_mat(n, n, e)) for v, a, q, e in each]


def stacked(matrices: Sequence[arb_mat], n: int) -> arb_mat:
    return arb_mat(len(matrices), n * n, [v for A in matrices for v in A.entries()])


def local_vdot(
    c: Certificate, T: fmpq_mat, states: Sequence[Local], u: Sequence[Local]
) -> tuple[arb_mat, list[arb_mat], arb_mat]:
    """B, C, E: Vdot / (2 rho) is d'Bd + sum_j d_j d'C_j d within d'Ed; F(0) = 0 exactly."""
    n = c.n
    names = dict(zip(c.plant.states + c.plant.inputs, [*states, *u], strict=True))

    def constant(q: fmpq) -> Local:
        return Local.affine(arb(q), [ZERO] * n)

    F = c.plant.dynamics.evaluate(names, constant)
    PT, zero = arb_mat(c.P * T), arb_mat(n, n)
    B = PT.transpose() * arb_mat([list(f.a.entries()) for f in F])
    C = [sum((PT[i, j] * f.Q for i, f in enumerate(F)), zero) for j in range(n)]
    E = sum((norm(row) * f.E for row, f in zip(PT.tolist(), F, strict=True)), zero)
    return B, C, E
