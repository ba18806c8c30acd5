"""The local step: the largest level below which the linearisation alone proves Vdot < 0.

On the ball `x = rho T d`, ||d|| <= 1, every quantity is written `v(0) + a.d + d'Q d + r(d)` with |r(d)| <= d'E d and E
positive semidefinite, for all d in the ball, so the bound holds for every smaller radius too and leaves no hole at the
origin. What each tanh adds to its tangent reaches the output through the products of weights and slopes at the origin,
`Paths`, in which it cancels as it does in truth; they do not depend on the level.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.claims import Problem
from certify.enclosures.taylor import EXP_END
from certify.errors import InputError
from certify.expressions import Algebra, evaluate
from certify.policies import bounded_by_form

Array = NDArray[np.float64]
_MOST_NUMBERS, _MOST_PRODUCTS = 2**25, 2**33  # of the sums over paths: the checker refuses more
_LEAST = 1e-280  # a level, below which binary64 holds nothing more
_MARGIN = 1e-3  # share of the decay that is left to the checker's rounding


@dataclass(frozen=True, slots=True)
class _Jet:
    c: float
    a: Array
    Q: Array
    E: Array

    @property
    def slope(self) -> float:
        return float(np.linalg.norm(self.a))

    @property
    def bend(self) -> float:
        return float(np.linalg.norm(self.Q))

    @property
    def curve(self) -> float:
        return self.bend + float(np.linalg.norm(self.E))

    @property
    def radius(self) -> float:
        return self.slope + self.curve

    def __add__(self, other: _Jet) -> _Jet:
        return _Jet(self.c + other.c, self.a + other.a, self.Q + other.Q, self.E + other.E)

    def __mul__(self, other: _Jet) -> _Jet:
        x, y = self, other
        outer = np.outer(x.a, y.a)
        Q = x.c * y.Q + y.c * x.Q + (outer + outer.T) / 2
        E = (abs(x.c) + x.radius) * y.E + (abs(y.c) + y.slope) * x.E
        return _Jet(x.c * y.c, x.c * y.a + y.c * x.a, Q, E + (x.radius * y.bend + y.slope * x.bend) * np.eye(len(x.a)))

    def compose(self, f0: float, f1: float, f2: float, third: float) -> _Jet:
        """A function's value and derivatives at c, and the largest third derivative on the range."""
        cubic, outer = third * self.radius / 6, np.outer(self.a, self.a)
        spread = (abs(f2) / 2 + cubic) * (2 * self.slope + self.curve)
        E = (abs(f1) + spread) * self.E + cubic * outer + spread * self.bend * np.eye(len(self.a))
        return _Jet(f0, f1 * self.a, f1 * self.Q + f2 / 2 * outer, E)

    def inverse(self) -> _Jet:
        least = abs(self.c) - self.radius
        if not least > 0:
            return _Jet(math.nan, self.a, self.Q, self.E + math.inf)
        return self.compose(1 / self.c, -1 / self.c**2, 2 / self.c**3, 6 / least**4)

    def sqrt(self) -> _Jet:
        least = self.c - self.radius
        if not least > 0:
            return _Jet(math.nan, self.a, self.Q, self.E + math.inf)
        s, w = math.sqrt(self.c), math.sqrt(least)
        third = 6 * (3 * s + w) / (8 * s**3 * (s + w) ** 3)  # the remainder's own factor, as for 1/v
        return self.compose(s, 1 / (2 * s), -1 / (4 * s**3), third)

    def exp(self) -> _Jet:
        if not self.c + self.radius < EXP_END:
            return _Jet(math.nan, self.a, self.Q, self.E + math.inf)
        e = math.exp(self.c)
        return self.compose(e, e, e, math.exp(self.c + self.radius))

    def tanh(self) -> _Jet:
        t = math.tanh(self.c)
        return self.compose(t, 1 - t * t, -2 * t * (1 - t * t), 2.0)

    def atan(self) -> _Jet:
        slope = 1 / (1 + self.c**2)
        return self.compose(math.atan(self.c), slope, -2 * self.c * slope**2, 2.0)

    def sin(self) -> _Jet:
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(s, c, -s, min(1.0, abs(c) + self.radius))

    def cos(self) -> _Jet:
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(c, -s, -c, min(1.0, abs(s) + self.radius))


class _Jets(Algebra[_Jet]):
    def __init__(self, n: int) -> None:
        self.n = n

    def constant(self, q: Fraction) -> _Jet:
        nothing = np.zeros((self.n, self.n))
        return _Jet(float(q), np.zeros(self.n), nothing, nothing)


@dataclass(frozen=True, slots=True)
class _Layer:
    """`y = y(0) + X [z, A]`: A stacks what every tanh before this layer adds to its tangent at the origin."""

    X: Array
    half: Array  # half of this layer's tanh's second derivative at the origin


@dataclass(frozen=True, slots=True)
class Paths:
    """The network at the origin in the coordinates z: all of the local proof that does not depend on the level."""

    layers: tuple[_Layer, ...]
    slope: Array | None  # of the last layer's tanh, (m,); None with squash `identity`


def paths(problem: Problem, T: Array) -> Paths:
    """Follow T and every tanh's output through the network's linearisation at the origin.

    Raises
    ------
    InputError : the network is larger than the checker's local rule allows.
    """
    network = problem.loop.network
    n, squash, columns, products = network.n, network.squash == "tanh", network.n, 0
    for W in network.weights[1:]:
        products += len(W) * columns * W.shape[1]
        columns += W.shape[1]
        products += len(W) * columns * n**2
        if columns * (len(W) + n**2) > _MOST_NUMBERS or products > _MOST_PRODUCTS:
            raise InputError("The network is too large for the local proof: use fewer or narrower layers.")
    h, X = np.zeros(n), T
    layers = []
    for number, (W, b) in enumerate(zip(network.weights, network.biases, strict=True)):
        last = number == len(network.weights) - 1
        y, X = W @ h + b, W @ X
        if number:
            X = np.concatenate([X, W], axis=1)
        if last and squash:
            y = network.squashed_at_origin(y, problem.loop.u_eq)
        h = np.tanh(y)
        slope = 1 - h**2
        layers.append(_Layer(X, -h * slope))
        X = slope[:, None] * X
    return Paths(tuple(layers), slope if squash else None)


def local_margin(problem: Problem, T: Array, level: float, known: Paths) -> float:
    """Share of the decay that the remainder leaves on {V <= level}; positive means Vdot < 0.

    T : (n, n), the coordinates x = T z; `known` are the `paths` in them.
    """
    loop, P = problem.loop, problem.V.P
    system = loop.system
    n = system.n
    S = T.T @ P @ T
    least = float(np.min(2 * np.diag(S) - np.abs(S).sum(axis=1)))
    if not least > 0:
        return -math.inf
    rho = math.sqrt(level / least)
    nothing = np.zeros((n, n))
    states = [_Jet(0.0, row, nothing, nothing) for row in rho * T]
    each = zip(loop.u_eq, loop.network.scale, *_policy(known, rho, n), strict=True)
    inputs = [_Jet(float(u), float(s) * a, float(s) * Q, abs(float(s)) * E) for u, s, a, Q, E in each]
    if loop.network.clip is not None:  # which has no second derivative at its corners
        for jet, lo, hi in zip(inputs, *loop.network.clip, strict=True):
            if not (lo < jet.c - (1 + _MARGIN) * jet.radius and jet.c + (1 + _MARGIN) * jet.radius < hi):
                return -math.inf
    if not bounded_by_form(loop.network, system.input_bounds):
        for jet, (lo, hi) in zip(inputs, system.input_bounds, strict=True):
            if not (float(lo) < jet.c - jet.radius and jet.c + jet.radius < float(hi)):
                return -math.inf
    values = dict(zip((*system.states, *system.inputs), (*states, *inputs), strict=True))
    jets, shared = _Jets(n), dict[Any, _Jet]()
    F = [evaluate(e, values, jets, shared) for e in system.exact_dynamics()]
    PT = P @ T
    B = PT.T @ np.array([v.a for v in F])
    C = np.tensordot(PT.T, np.array([v.Q for v in F]), 1)
    E = np.tensordot(np.linalg.norm(PT, axis=1), np.array([v.E for v in F]), 1)
    M = -(B + B.T) / 2
    if not (np.all(np.isfinite(M - E)) and np.all(np.diag(M) > 0)):
        return -math.inf
    D = 1 / np.sqrt(np.diag(M))
    W, N = C * D[:, None] * D, D[:, None] * (M - E) * D
    return 1 - float(np.linalg.norm(np.eye(n) - N, 2) + np.linalg.norm(W.reshape(n, -1), 2))


def prove_local(problem: Problem, T: Array, limit: float) -> float | None:
    """The largest level up to `limit` that the local proof reaches, within 2 %; None if there is none.

    Raises
    ------
    InputError : the network is larger than the checker's local rule allows.
    """
    known = paths(problem, T)

    def good(level: float) -> bool:
        return local_margin(problem, T, level, known) > _MARGIN

    if good(limit):
        return limit
    high, low = limit, limit
    while not good(low):
        high, low = low, low * 1e-2
        if low <= 1e-30 * limit or low < _LEAST:
            return None
    while high > 1.02 * low:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if good(middle) else (low, middle)
    return low


def _policy(known: Paths, rho: float, n: int) -> tuple[Array, Array, Array]:
    """Gradients (m, n), half Hessians and remainders (m, n, n) of the outputs on z = rho d, before scaling."""
    quad, rest = np.zeros((n, n * n)), np.zeros((n, n * n))
    eye = np.eye(n).ravel()
    for layer in known.layers:
        G = rho * layer.X[:, :n]
        Q, E = layer.X @ quad, np.abs(layer.X) @ rest
        bend = np.linalg.norm(Q, axis=1)
        length, curve = np.linalg.norm(G, axis=1), bend + np.linalg.norm(E, axis=1)
        cubic = (length + curve) / 3
        spread = (np.abs(layer.half) + cubic) * (2 * length + curve)
        outer = (G[:, :, None] * G[:, None, :]).reshape(len(G), -1)
        added = layer.half[:, None] * outer
        beyond = spread[:, None] * E + cubic[:, None] * outer + (spread * bend)[:, None] * eye
        quad, rest = np.concatenate([quad, added]), np.concatenate([rest, beyond])
    if known.slope is not None:
        s = known.slope[:, None]
        G, Q, E = s * G, s * Q + added, s * E + beyond
    return G, Q.reshape(-1, n, n), E.reshape(-1, n, n)
