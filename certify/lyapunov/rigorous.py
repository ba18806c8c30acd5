"""A Lyapunov function N and its derivative along the loop in Arb balls: at single points, and on balls of states."""

from __future__ import annotations

import flint
import numpy as np
from numpy.typing import NDArray

from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, differentiate, evaluate
from certify.loop.rigorous import (
    BallAlgebra,
    Balls,
    affine,
    evaluate_arb,
    evaluate_policy,
    field_at,
    matrix,
    network_on,
    points,
    precision,
)
from certify.lyapunov.neural import Neural
from certify.lyapunov.symbolic import Symbolic

Array = NDArray[np.float64]


def evaluate_function(N: Neural | Symbolic, x: Balls) -> flint.arb:
    """N at balls around a state, n of them, at the precision that is set."""
    if isinstance(N, Neural):
        return network_on(N.network, x)[0]
    return evaluate_arb(N.expression, dict(zip(N.states, x, strict=True)))


def evaluate_rise(loop: ClosedLoop, N: Neural | Symbolic, x: Array) -> tuple[flint.arb, flint.arb]:
    """`N(x)` and `N'(x) F(x)` at a binary64 point (n,), as Arb balls."""
    with precision():
        state = points(x)
        values = dict(zip(loop.system.states, state, strict=True))
        values |= zip(loop.system.inputs, evaluate_policy(loop, x), strict=True)
        F = field_at(loop, values)
        if isinstance(N, Neural):
            return network_on(N.network, state)[0], _rise(N, state, F)
        slopes = [evaluate_arb(differentiate(N.expression, s), values) for s in N.states]
        return evaluate_function(N, state), sum((a * b for a, b in zip(slopes, F, strict=True)), flint.arb(0))


def _rise(N: Neural, x: Balls, F: Balls) -> flint.arb:
    """N'F of a network: the layers of the value and of the derivative along F, side by side."""
    zeros = [np.zeros(len(W)) for W in N.weights]
    for k, (W, b) in enumerate(zip(N.weights, N.biases, strict=True)):
        if k:
            h = [v.tanh() for v in x]
            F = [(1 - t * t) * y for t, y in zip(h, F, strict=True)]
            x = h
        x, F = affine(W, b, x), affine(W, zeros[k], F)
    return F[0]


def function_on(function: Neural | Symbolic, x: Balls) -> tuple[flint.arb, Balls]:
    """N and its gradient on balls x; whatever is not finite says that N need not be differentiable there."""
    if isinstance(function, Symbolic):
        values, known = dict(zip(function.states, x, strict=True)), dict[Expression, flint.arb]()
        parts = (function.expression, *(differentiate(function.expression, s) for s in function.states))
        N, *slopes = (evaluate(part, values, BallAlgebra(), known) for part in parts)
        return N, slopes
    y, units = list(x), []
    for k, (W, b) in enumerate(zip(function.weights, function.biases, strict=True)):
        if k:
            y = [v.tanh() for v in y]
            units.append([1 - v * v for v in y])
        y = affine(W, b, y)
    row = matrix(function.weights[-1])
    for W, slopes in zip(function.weights[-2::-1], reversed(units), strict=True):
        row = flint.arb_mat([[row[0, j] * slope for j, slope in enumerate(slopes)]]) * matrix(W)
    return y[0], [row[0, j] for j in range(function.n)]
