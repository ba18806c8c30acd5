"""The closed loop at single points in Arb balls: what REFUTED rests on, and the eigenvalues at the origin.

A comparison of balls is True only if it is certain, so `not (a < b)` proves nothing; whatever is not certain here
counts as not shown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from typing import Any

import flint
import numpy as np
import sympy
from numpy.typing import NDArray

from certify.closed_loop import ClosedLoop
from certify.expressions import Algebra, evaluate
from certify.policies import TanhNetwork

Array = NDArray[np.float64]
_PRECISION = 200  # bits
Balls = list[flint.arb]


class _Balls(Algebra[flint.arb]):
    def constant(self, q: Fraction) -> flint.arb:
        return ball(q)

    def inverse(self, value: flint.arb) -> flint.arb:
        return 1 / value


@contextmanager
def _precision() -> Iterator[None]:
    before, flint.ctx.prec = flint.ctx.prec, _PRECISION
    try:
        yield
    finally:
        flint.ctx.prec = before


def ball(q: Fraction) -> flint.arb:
    """The ball around a rational."""
    return flint.arb(flint.fmpq(q.numerator, q.denominator))


def evaluate_arb(expression: sympy.Expr, values: Mapping[sympy.Symbol, flint.arb]) -> flint.arb:
    """An expression of the plant in Arb balls."""
    return evaluate(expression, values, _Balls())


def evaluate_policy(loop: ClosedLoop, x: Array) -> Balls:
    """pi(x) at a binary64 point (n,), as Arb balls."""
    with _precision():
        network = loop.network
        y = _net(network, _points(x))
        shift, offset = _shift_and_offset(loop)
        return [
            flint.arb(float(s)) * _squash(network)(v + d) + o
            for v, d, s, o in zip(y, shift, network.scale, offset, strict=True)
        ]


def evaluate_vdot(loop: ClosedLoop, P: Array, x: Array) -> flint.arb:
    """`Vdot = 2 x'P F(x)` at a binary64 point (n,), as an Arb ball."""
    with _precision():
        state = _points(x)
        values: dict[sympy.Symbol, flint.arb] = dict(zip(loop.system.states, state, strict=True))
        values |= zip(loop.system.inputs, evaluate_policy(loop, x), strict=True)
        total, known = flint.arb(0), dict[Any, flint.arb]()
        for row, expression in zip(P, loop.system.exact_dynamics(), strict=True):
            Px = sum((flint.arb(float(p)) * v for p, v in zip(row, state, strict=True)), flint.arb(0))
            total += 2 * Px * evaluate(expression, values, _Balls(), known)
        return total


def eigenvalues(loop: ClosedLoop) -> list[flint.acb] | None:
    """Rigorous enclosures of the eigenvalues of the closed loop's Jacobian at 0; None if Arb cannot isolate them."""
    with _precision():
        try:
            return list(flint.acb_mat(_jacobian(loop)).eig(multiple=True))
        except (ValueError, ArithmeticError):
            return None


def _jacobian(loop: ClosedLoop) -> flint.arb_mat:
    """The closed loop's Jacobian at the origin."""
    network = loop.network
    y: Balls = [flint.arb(0)] * network.n
    J = flint.arb_mat([[int(i == j) for j in range(network.n)] for i in range(network.n)])
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        if k:
            y, J = _through_tanh(y, J)
        y, J = _affine(W, b, y), _matrix(W) * J
    if network.squash == "tanh":
        shift, _ = _shift_and_offset(loop)
        _, J = _through_tanh([v + d for v, d in zip(y, shift, strict=True)], J)
    scale = _points(network.scale)
    gain = flint.arb_mat([[scale[i] * J[i, j] for j in range(network.n)] for i in range(network.m)])
    A, B = (
        flint.arb_mat([[evaluate_arb(M[i, j], {}) for j in range(M.shape[1])] for i in range(M.shape[0])])
        for M in loop.plant_jacobians()
    )
    return A + B * gain


def _shift_and_offset(loop: ClosedLoop) -> tuple[Balls, Balls]:
    """The centring, see `certify.policies.exact`."""
    network, u_eq = loop.network, loop.u_eq
    offset = _points(network.offset)
    if network.centre == "none":
        return [flint.arb(0)] * network.m, offset
    at_0 = _net(network, [flint.arb(0)] * network.n)
    if network.centre == "preactivation":
        return [ball(q).atanh() - v for q, v in zip(network.ratios(u_eq), at_0, strict=True)], offset
    each = zip(u_eq, network.scale, at_0, strict=True)
    return [flint.arb(0)] * network.m, [ball(u) - flint.arb(float(s)) * _squash(network)(v) for u, s, v in each]


def _squash(network: TanhNetwork) -> Callable[[flint.arb], flint.arb]:
    return (lambda v: v.tanh()) if network.squash == "tanh" else (lambda v: v)


def _net(network: TanhNetwork, h: Balls) -> Balls:
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        h = _affine(W, b, [v.tanh() for v in h] if k else h)
    return h


def _affine(W: Array, b: Array, h: Balls) -> Balls:
    product = _matrix(W) * flint.arb_mat([[v] for v in h])
    return [product[i, 0] + flint.arb(float(c)) for i, c in enumerate(b)]


def _through_tanh(y: Balls, J: flint.arb_mat) -> tuple[Balls, flint.arb_mat]:
    t = [v.tanh() for v in y]
    slope = [1 - v * v for v in t]  # Arb's own power is NaN for a ball around 0
    return t, flint.arb_mat([[slope[i] * J[i, j] for j in range(J.ncols())] for i in range(J.nrows())])


def _matrix(W: Array) -> flint.arb_mat:
    return flint.arb_mat([_points(row) for row in W])


def _points(x: Array) -> Balls:
    return [flint.arb(float(v)) for v in x]
