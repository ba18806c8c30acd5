"""The closed loop at single points in Arb balls: what REFUTED rests on, and the eigenvalues at the origin.

A comparison of balls is True only if it is certain, so `not (a < b)` proves nothing; whatever is not certain here
counts as not shown.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
def precision() -> Iterator[None]:
    """Arb at the precision of this module."""
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
    with precision():
        network = loop.network
        y = _net(network, _points(x))
        shift, offset = _centring(loop)
        u = [
            flint.arb(float(s)) * network.squashed(v + d, _NUMBERS) + o
            for v, d, s, o in zip(y, shift, network.scale, offset, strict=True)
        ]
        return list(network.clipped(u, _NUMBERS))


def centring_with_errors(loop: ClosedLoop) -> tuple[Array, Array, Array, Array]:
    """`shift` and `offset` of the centring rounded to binary64, each followed by an upper bound of its error, (m,)."""
    with precision():
        columns = []
        for balls in _centring(loop):
            middle = [float(b.mid()) for b in balls]
            columns += [middle, [rounded_up((b - m).abs_upper()) for b, m in zip(balls, middle, strict=True)]]
    shift, shift_error, offset, offset_error = map(np.array, columns)
    return shift, shift_error, offset, offset_error


def rounded_up(x: flint.arb) -> float:
    """A binary64 number that is not below x >= 0."""
    value = float(x)
    return value if value >= x else float(np.nextafter(value * (1 + 2.0**-50), np.inf))


def evaluate_vdot(loop: ClosedLoop, P: Array, x: Array) -> flint.arb:
    """`Vdot = 2 x'P F(x)` at a binary64 point (n,), as an Arb ball."""
    with precision():
        state = _points(x)
        values: dict[sympy.Symbol, flint.arb] = dict(zip(loop.system.states, state, strict=True))
        values |= zip(loop.system.inputs, evaluate_policy(loop, x), strict=True)
        total, known = flint.arb(0), dict[Any, flint.arb]()
        for row, expression in zip(P, loop.dynamics, strict=True):
            Px = sum((flint.arb(float(p)) * v for p, v in zip(row, state, strict=True)), flint.arb(0))
            total += 2 * Px * evaluate(expression, values, _Balls(), known)
        return total


def eigenvalues(loop: ClosedLoop) -> list[flint.acb] | None:
    """Rigorous enclosures of the eigenvalues of the closed loop's Jacobian at 0.

    None if Arb cannot isolate them, or the clip is not certain to be inactive at the origin.
    """
    with precision():
        if not _unclipped(loop):
            return None
        try:
            return list(flint.acb_mat(_jacobian(loop)).eig(multiple=True))
        except (ValueError, ArithmeticError):
            return None


def policy_on(loop: ClosedLoop, x: Balls) -> tuple[Balls, flint.arb_mat]:
    """pi and its Jacobian (m, n) on balls x.

    Where it is not certain on which side of a bound of the clip its argument lies, the slope is the ball of all slopes
    between 0 and 1: good for mean values, and for nothing else.
    """
    network, y = loop.network, list(x)
    J = flint.arb_mat([[int(i == j) for j in range(network.n)] for i in range(network.n)])
    for k, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        if k:
            y, J = _through_tanh(y, J)
        y, J = _affine(W, b, y), _matrix(W) * J
    shift, offset = _centring(loop)
    squashed = [network.squashed(v + d, _NUMBERS) for v, d in zip(y, shift, strict=True)]
    slopes = [network.squash_slope(v, _NUMBERS) for v in squashed]
    scale = [flint.arb(float(s)) for s in network.scale]
    u = [s * v + o for s, v, o in zip(scale, squashed, offset, strict=True)]
    slopes = [s * slope * clip for s, slope, clip in zip(scale, slopes, _clip_slopes(network, u), strict=True)]
    gain = flint.arb_mat([[slopes[i] * J[i, j] for j in range(network.n)] for i in range(network.m)])
    return list(network.clipped(u, _NUMBERS)), gain


def _clip_slopes(network: TanhNetwork, u: Balls) -> Balls:
    if network.clip is None:
        return [flint.arb(1)] * len(u)
    slopes = []
    for v, lo, hi in zip(u, *network.clip, strict=True):
        inside, outside = v > float(lo) and v < float(hi), v < float(lo) or v > float(hi)
        slopes.append(flint.arb(1) if inside else flint.arb(0) if outside else flint.arb(0.5, 0.5))
    return slopes


def field_on(loop: ClosedLoop, x: Balls) -> tuple[Balls, flint.arb_mat]:
    """F and its Jacobian (n, n) on balls x, the Jacobian as `policy_on` says."""
    system = loop.system
    u, gain = policy_on(loop, x)
    values = dict(zip((*system.states, *system.inputs), (*x, *u), strict=True))
    known: dict[Any, flint.arb] = {}
    F = [evaluate(e, values, _Balls(), known) for e in loop.dynamics]
    A, B = (
        flint.arb_mat([[evaluate(e.diff(s), values, _Balls(), known) for s in by] for e in loop.dynamics])
        for by in (system.states, system.inputs)
    )
    return F, A + B * gain


def _jacobian(loop: ClosedLoop) -> flint.arb_mat:
    """The closed loop's Jacobian at the origin and u_eq."""
    _, gain = policy_on(loop, [flint.arb(0)] * loop.network.n)
    A, B = (
        flint.arb_mat([[evaluate_arb(M[i, j], {}) for j in range(M.shape[1])] for i in range(M.shape[0])])
        for M in loop.plant_jacobians()
    )
    return A + B * gain


def _unclipped(loop: ClosedLoop) -> bool:
    """Whether every input at the origin, before the clip, lies certainly and strictly inside it."""
    network = loop.network
    if network.clip is None:
        return True
    u, _ = policy_on(loop, [flint.arb(0)] * network.n)
    return all(bool(v > float(lo)) and bool(v < float(hi)) for v, lo, hi in zip(u, *network.clip, strict=True))


class _Numbers:
    def number(self, q: Fraction) -> flint.arb:
        return ball(q)

    def atanh(self, q: Fraction) -> flint.arb:
        return ball(q).atanh()

    def tanh(self, v: flint.arb) -> flint.arb:
        return v.tanh()

    def clip(self, v: flint.arb, lo: Fraction, hi: Fraction) -> flint.arb:
        return v.max(ball(lo)).min(ball(hi))


_NUMBERS = _Numbers()


def _centring(loop: ClosedLoop) -> tuple[Balls, Balls]:
    at_0 = _net(loop.network, [flint.arb(0)] * loop.network.n)
    return loop.network.centring(loop.u_eq, at_0, _NUMBERS)


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
