"""The local step: the largest level below which the linearisation alone proves Vdot < 0.

On the ball `x = rho T d`, ||d|| <= 1, every quantity is written `v(0) + a.d + R(d)` with |R(d)| <= k ||d||^2 for all
d in the ball, so the bound holds for every smaller radius too and leaves no hole at the origin. What each tanh adds to
its tangent reaches the output through the products of weights and slopes at the origin, `Paths`, in which it cancels as
it does in truth; they do not depend on the level.
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
_MOST_PATHS = 2**25  # entries of a layer's J and M together: the checker refuses more
_MARGIN = 1e-3  # share of the decay that is left to the checker's rounding


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


@dataclass(frozen=True, slots=True)
class _Layer:
    """`y = y(0) + J z + M E`: E stacks what every tanh before this layer adds to its tangent at the origin."""

    J: Array
    M: Array
    bend: Array  # half the magnitude of its second derivative at the origin


@dataclass(frozen=True, slots=True)
class Paths:
    """The network at the origin in the coordinates z: all of the local proof that does not depend on the level."""

    layers: tuple[_Layer, ...]
    slope: Array | None  # of the last layer's tanh, (m,); None with squash `identity`


def paths(obligations: Obligations) -> Paths | None:
    """Follow T and every tanh's output through the network's linearisation at the origin; None if that is too large."""
    network = obligations.loop.network
    n, squash, columns = network.n, network.squash == "tanh", network.n
    for W in network.weights[1:]:
        columns += W.shape[1]
        if len(W) * columns > _MOST_PATHS:
            return None
    h, X = np.zeros(n), obligations.T
    layers = []
    for number, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        last = number == len(network.weights) - 1
        y, X = W @ h + b, W @ X
        if number:
            X = np.concatenate([X, W], axis=1)
        if last and squash and network.centre == "preactivation":
            y = network.beta(obligations.loop.u_eq)
        h = np.tanh(y)
        slope = 1 - h**2
        layers.append(_Layer(X[:, :n], X[:, n:], np.abs(h) * slope))
        X = slope[:, None] * X
    return Paths(tuple(layers), slope if squash else None)


def local_margin(obligations: Obligations, level: float, known: Paths) -> float:
    """Share of the decay that the remainder leaves on {V <= level}; positive means Vdot < 0.

    `known` are the `paths` of these obligations.
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
    slopes, ks = _policy(known, rho)
    each = zip(loop.u_eq, loop.network.scale, slopes, ks, strict=True)
    inputs = [_Jet(float(u), float(s) * a, abs(float(s)) * float(k)) for u, s, a, k in each]
    if not obligations.inputs_bounded_by_form:
        for jet, (lo, hi) in zip(inputs, system.input_bounds, strict=True):
            if not (float(lo) < jet.c - jet.radius and jet.c + jet.radius < float(hi)):
                return -math.inf
    values = dict(zip((*system.states, *system.inputs), (*states, *inputs), strict=True))
    F = [_evaluate(e, values) for e in system.exact_dynamics()]
    B = T.T @ P @ np.array([v.a for v in F])
    k = np.abs(T.T @ P) @ np.array([v.k for v in F])
    M = -(B + B.T) / 2
    mu = 2 * np.diag(M) - np.abs(M).sum(axis=1)
    if not (np.all(mu > 0) and np.all(np.isfinite(k))):
        return -math.inf
    return 1 - math.sqrt(float(np.sum(k**2 / mu)) / float(np.min(mu)))


def prove_local(obligations: Obligations, limit: float) -> float | None:
    """The largest level up to `limit` that the local proof reaches, within 2 %; None if there is none."""

    known = paths(obligations)
    if known is None:
        return None

    def good(level: float) -> bool:
        return local_margin(obligations, level, known) > _MARGIN

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


def _policy(known: Paths, rho: float) -> tuple[Array, Array]:
    """Gradients (m, n) and remainders (m,) of the network's outputs on z = rho d, before scaling."""
    added = np.zeros(0)
    for layer in known.layers:
        k = np.abs(layer.M) @ added
        reach = rho * np.linalg.norm(layer.J, axis=1) + k
        fresh = np.minimum(0.385, layer.bend + reach) * reach**2
        added = np.concatenate([added, fresh])
    if known.slope is None:
        return rho * layer.J, k
    return rho * known.slope[:, None] * layer.J, known.slope * k + fresh


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
