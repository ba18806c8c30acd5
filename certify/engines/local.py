"""The local step: the largest level below which the linearisation alone proves Vdot < 0.

On the ball `x = rho T d`, ||d|| <= 1, every quantity is written `v(0) + a.d + R(d)` with |R(d)| <= k ||d||^2 for all
d in the ball, so the bound holds for every smaller radius too and leaves no hole at the origin. For the network the
remainder is carried in the 2-norm, layer by layer, with spectral norms instead of products of |W|.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import sympy
from numpy.typing import NDArray

from certify.obligations import Obligations

Array = NDArray[np.float64]
_MARGIN = 1e-3  # share of the smallest eigenvalue that is left to the checker's rounding


@dataclass(frozen=True, slots=True)
class _Jet:
    c: float
    a: Array
    k: float

    @property
    def radius(self) -> float:
        return float(np.linalg.norm(self.a)) + self.k

    def __add__(self, other: _Jet) -> _Jet:
        return _Jet(self.c + other.c, self.a + other.a, self.k + other.k)

    def __mul__(self, other: _Jet) -> _Jet:
        k = abs(self.c) * other.k + abs(other.c) * self.k + self.radius * other.radius
        return _Jet(self.c * other.c, self.c * other.a + other.c * self.a, k)

    def compose(self, f0: float, f1: float, first: float, second: float) -> _Jet:
        return _Jet(f0, f1 * self.a, first * self.k + 0.5 * second * self.radius**2)

    def inverse(self) -> _Jet:
        least = abs(self.c) - self.radius
        if not least > 0:
            return _Jet(math.nan, self.a, math.inf)
        return self.compose(1 / self.c, -1 / self.c**2, 1 / least**2, 2 / least**3)

    def sin(self) -> _Jet:
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(s, c, 1.0, min(1.0, abs(s) + self.radius))

    def cos(self) -> _Jet:
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(c, -s, 1.0, min(1.0, abs(c) + self.radius))


def spectral_norms(obligations: Obligations) -> tuple[float, ...]:
    """||W||_2 of each layer, as loose as the checker's own bound can be."""
    return tuple(float(np.linalg.norm(W, 2)) * min(W.shape) ** (1 / 128) for W in obligations.loop.network.weights)


def local_margin(obligations: Obligations, level: float, norms: tuple[float, ...]) -> float:
    """Share of the smallest decay rate that the remainder leaves on {V <= level}; positive means Vdot < 0.

    `norms` are those of `spectral_norms`, which do not depend on the level.
    """
    loop, P, T = obligations.loop, obligations.P, obligations.T
    system = loop.system
    S = T.T @ P @ T
    least = float(np.min(2 * np.diag(S) - np.abs(S).sum(axis=1)))
    if not least > 0:
        return -math.inf
    rho = math.sqrt(level / least)
    J = rho * T
    states = [_Jet(0.0, J[i], 0.0) for i in range(system.n)]
    gradient, k = _policy(obligations, J, norms)
    scale = np.abs(loop.network.scale)
    inputs = [_Jet(float(u), gradient[j], float(scale[j]) * k) for j, u in enumerate(loop.u_eq)]
    if not obligations.inputs_bounded_by_form:
        for jet, (lo, hi) in zip(inputs, system.input_bounds, strict=True):
            if not (float(lo) < jet.c - jet.radius and jet.c + jet.radius < float(hi)):
                return -math.inf
    values = dict(zip((*system.states, *system.inputs), (*states, *inputs), strict=True))
    F = [_evaluate(e, values) for e in system.exact_dynamics()]
    B = T.T @ P @ np.array([v.a for v in F])
    k_total = float(np.linalg.norm(np.abs(T.T @ P) @ np.array([v.k for v in F])))
    M = -(B + B.T) / 2
    mu = float(np.min(2 * np.diag(M) - np.abs(M).sum(axis=1)))
    return 1 - k_total / mu if mu > 0 and math.isfinite(k_total) else -math.inf


def prove_local(obligations: Obligations, limit: float) -> float | None:
    """The largest level up to `limit` that the local proof reaches, within 2 %; None if there is none."""

    norms = spectral_norms(obligations)

    def good(level: float) -> bool:
        return local_margin(obligations, level, norms) > _MARGIN

    if good(limit):
        return limit
    high, low = limit, limit
    while not good(low):
        high, low = low, low * 1e-2
        if low < 1e-30 * limit:
            return None
    while high > 1.02 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


def _policy(obligations: Obligations, J: Array, norms: tuple[float, ...]) -> tuple[Array, float]:
    """scale * gradient of the network on x = J d, and the 2-norm remainder before scaling."""
    loop = obligations.loop
    network = loop.network
    y, k = np.zeros(network.n), 0.0
    for layer, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        last = layer == len(network.weights) - 1
        k *= norms[layer]
        y, J = W @ y + b, W @ J
        if last:
            if network.squash == "identity":
                break
            if network.centre == "preactivation":
                y = network.beta(loop.u_eq)
        reach = np.linalg.norm(J, axis=1) + k
        t = np.tanh(y)
        slope = 1 - t**2
        half = np.minimum(0.385, np.abs(t) * slope + reach)
        k = float(np.max(slope)) * k + float(np.max(half * reach)) * (float(np.linalg.norm(J)) + k)
        y, J = t, slope[:, None] * J
    return network.scale[:, None] * J, k


def _evaluate(expression: sympy.Expr, values: Mapping[sympy.Symbol, _Jet]) -> _Jet:
    if expression.is_Symbol:
        return values[expression]
    if expression.is_Rational:
        return _Jet(float(expression), np.zeros_like(next(iter(values.values())).a), 0.0)
    if expression.is_Pow:
        base, exponent = _evaluate(expression.base, values), int(expression.exp)
        result = base
        for bit in bin(abs(exponent))[3:]:
            result = result * result
            if bit == "1":
                result = result * base
        return result if exponent > 0 else result.inverse()
    arguments = [_evaluate(a, values) for a in expression.args]
    if expression.is_Add or expression.is_Mul:
        result = arguments[0]
        for argument in arguments[1:]:
            result = result + argument if expression.is_Add else result * argument
        return result
    if isinstance(expression, sympy.sin):
        return arguments[0].sin()
    if isinstance(expression, sympy.cos):
        return arguments[0].cos()
    return arguments[0].sin() * arguments[0].cos().inverse()
