"""Second-order models of the closed loop on a ball, in floats: what rules `local` and `tube` bound.

On the ball x = m + J d, ||d|| <= 1, every quantity is written `v(0) + a.d + d'Q d + r(d)` with |r(d)| <= d'E d and E
positive semidefinite, for all d in the ball, so the bound holds for every smaller radius too and leaves no hole at its
middle m. What each tanh adds to its tangent reaches the output through the products of weights and slopes at m,
`Paths`, in which it cancels as it does in truth; they do not depend on the ball. d may have more entries than x: along
a path its last is the motion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.closed_loop import ClosedLoop
from certify.enclosures.taylor import EXP_END
from certify.errors import InputError
from certify.expressions import Algebra, evaluate
from certify.policies import bounded_by_form

Array = NDArray[np.float64]
_MOST_NUMBERS, _MOST_PRODUCTS = 2**25, 2**33  # of the sums over paths: the checker refuses more
_MARGIN = 1e-3  # of an input's range, left to the checker's rounding where a clip begins


@dataclass(frozen=True, slots=True)
class Models:
    """The components of F on a ball: values f (n,) at its middle, gradients A (n, k), half Hessians Q and remainders
    E (n, k, k), k the entries of d.

    `admitted` says that every input is certain to lie in its bounds and inside its clip.
    """

    f: Array
    A: Array
    Q: Array
    E: Array
    admitted: bool

    @property
    def finite(self) -> bool:
        """Whether F has a finite model on the ball."""
        return bool(np.all(np.isfinite(self.A)) and np.all(np.isfinite(self.Q)) and np.all(np.isfinite(self.E)))


@dataclass(frozen=True, slots=True)
class Jet:
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

    def __add__(self, other: Jet) -> Jet:
        return Jet(self.c + other.c, self.a + other.a, self.Q + other.Q, self.E + other.E)

    def __mul__(self, other: Jet) -> Jet:
        x, y = self, other
        outer = np.outer(x.a, y.a)
        Q = x.c * y.Q + y.c * x.Q + (outer + outer.T) / 2
        E = (abs(x.c) + x.radius) * y.E + (abs(y.c) + y.slope) * x.E
        return Jet(x.c * y.c, x.c * y.a + y.c * x.a, Q, E + (x.radius * y.bend + y.slope * x.bend) * np.eye(len(x.a)))

    def compose(self, f0: float, f1: float, f2: float, third: float) -> Jet:
        """A function's value and derivatives at c, and the largest third derivative on the range."""
        cubic, outer = third * self.radius / 6, np.outer(self.a, self.a)
        spread = (abs(f2) / 2 + cubic) * (2 * self.slope + self.curve)
        E = (abs(f1) + spread) * self.E + cubic * outer + spread * self.bend * np.eye(len(self.a))
        return Jet(f0, f1 * self.a, f1 * self.Q + f2 / 2 * outer, E)

    def inverse(self) -> Jet:
        least = abs(self.c) - self.radius
        if not least > 0:
            return Jet(math.nan, self.a, self.Q, self.E + math.inf)
        return self.compose(1 / self.c, -1 / self.c**2, 2 / self.c**3, 6 / least**4)

    def sqrt(self) -> Jet:
        least = self.c - self.radius
        if not least > 0:
            return Jet(math.nan, self.a, self.Q, self.E + math.inf)
        s, w = math.sqrt(self.c), math.sqrt(least)
        third = 6 * (3 * s + w) / (8 * s**3 * (s + w) ** 3)  # the remainder's own factor, as for 1/v
        return self.compose(s, 1 / (2 * s), -1 / (4 * s**3), third)

    def exp(self) -> Jet:
        if not self.c + self.radius < EXP_END:
            return Jet(math.nan, self.a, self.Q, self.E + math.inf)
        e = math.exp(self.c)
        return self.compose(e, e, e, math.exp(self.c + self.radius))

    def tanh(self) -> Jet:
        t = math.tanh(self.c)
        return self.compose(t, 1 - t * t, -2 * t * (1 - t * t), 2.0)

    def atan(self) -> Jet:
        slope = 1 / (1 + self.c**2)
        return self.compose(math.atan(self.c), slope, -2 * self.c * slope**2, 2.0)

    def sin(self) -> Jet:
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(s, c, -s, min(1.0, abs(c) + self.radius))

    def cos(self) -> Jet:
        s, c = math.sin(self.c), math.cos(self.c)
        return self.compose(c, -s, -c, min(1.0, abs(s) + self.radius))


class Jets(Algebra[Jet]):
    def __init__(self, k: int) -> None:
        self.k = k

    def constant(self, q: Fraction) -> Jet:
        nothing = np.zeros((self.k, self.k))
        return Jet(float(q), np.zeros(self.k), nothing, nothing)


@dataclass(frozen=True, slots=True)
class _Layer:
    """`y = y(m) + X [x - m, A]`: A stacks what every tanh before this layer adds to its tangent at m."""

    X: Array
    half: Array  # half of this layer's tanh's second derivative at m


@dataclass(frozen=True, slots=True)
class Paths:
    """The closed loop at a state `middle`, (n,): all of its models that does not depend on the ball around it.

    `u` are the inputs there, before a clip; `slope` is that of the last layer's tanh, (m,), None with squash
    `identity`.
    """

    loop: ClosedLoop
    middle: Array
    u: Array
    layers: tuple[_Layer, ...]
    slope: Array | None

    def models(self, J: Array) -> Models:
        """F on the ball x = middle + J d, ||d|| <= 1; J is (n, k)."""
        loop, k = self.loop, J.shape[1]
        system, nothing = loop.system, np.zeros((k, k))
        states = [Jet(float(m), row, nothing, nothing) for m, row in zip(self.middle, J, strict=True)]
        each = zip(self.u, loop.network.scale, *self._policy(J), strict=True)
        inputs = [Jet(float(u), float(s) * a, float(s) * Q, abs(float(s)) * E) for u, s, a, Q, E in each]
        values = dict(zip((*system.states, *system.inputs), (*states, *inputs), strict=True))
        algebra, shared = Jets(k), dict[Any, Jet]()
        F = [evaluate(e, values, algebra, shared) for e in system.exact_dynamics()]
        f, A, Q, E = (np.array([getattr(v, part) for v in F]) for part in ("c", "a", "Q", "E"))
        return Models(f, A, Q, E, _are_admitted(loop, inputs))

    def _policy(self, J: Array) -> tuple[Array, Array, Array]:
        """Gradients (m, k), half Hessians and remainders (m, k, k) of the outputs on the ball, before scaling."""
        n, k = J.shape
        quad, rest = np.zeros((0, k * k)), np.zeros((0, k * k))
        eye = np.eye(k).ravel()
        for layer in self.layers:
            G, M = layer.X[:, :n] @ J, layer.X[:, n:]
            Q, E = M @ quad, np.abs(M) @ rest
            bend = np.linalg.norm(Q, axis=1)
            length, curve = np.linalg.norm(G, axis=1), bend + np.linalg.norm(E, axis=1)
            cubic = (length + curve) / 3
            spread = (np.abs(layer.half) + cubic) * (2 * length + curve)
            outer = (G[:, :, None] * G[:, None, :]).reshape(len(G), -1)
            added = layer.half[:, None] * outer
            beyond = spread[:, None] * E + cubic[:, None] * outer + (spread * bend)[:, None] * eye
            quad, rest = np.concatenate([quad, added]), np.concatenate([rest, beyond])
        if self.slope is not None:
            s = self.slope[:, None]
            G, Q, E = s * G, s * Q + added, s * E + beyond
        return G, Q.reshape(-1, k, k), E.reshape(-1, k, k)


def paths(loop: ClosedLoop, at: Array | None = None) -> Paths:
    """Follow the states and every tanh's output through the network's linearisation at a state, (n,), the origin if
    none is given.

    Raises
    ------
    InputError : the network is larger than the checker's rules allow.
    """
    network = loop.network
    n, squash, columns, products = network.n, network.squash == "tanh", network.n, 0
    for W in network.weights[1:]:
        products += len(W) * columns * W.shape[1]
        columns += W.shape[1]
        products += len(W) * columns * n**2
        if columns * (len(W) + n**2) > _MOST_NUMBERS or products > _MOST_PRODUCTS:
            raise InputError("The network is too large for the local proof: use fewer or narrower layers.")
    folded, middle = loop.folded, np.zeros(n) if at is None else at
    h, X = middle, np.eye(n)
    layers = []
    for number, (W, b) in enumerate(zip(folded.weights, folded.biases, strict=True)):
        y, X = W @ h + b, W @ X
        if number:
            X = np.concatenate([X, W], axis=1)
        h = np.tanh(y)
        slope = 1 - h**2
        layers.append(_Layer(X, -h * slope))
        X = slope[:, None] * X
    u = np.array([float(q) for q in loop.u_eq])
    if at is not None:
        u = folded.scale * (h if squash else y) + folded.offset
    return Paths(loop, middle, u, tuple(layers), slope if squash else None)


def _are_admitted(loop: ClosedLoop, inputs: list[Jet]) -> bool:
    """Inside the clip, which has no second derivative at its corners, and within the bounds."""
    network, bounds = loop.network, loop.system.input_bounds
    if network.clip is not None:
        for jet, lo, hi in zip(inputs, *network.clip, strict=True):
            if not (lo < jet.c - (1 + _MARGIN) * jet.radius and jet.c + (1 + _MARGIN) * jet.radius < hi):
                return False
    if bounded_by_form(network, bounds):
        return True
    each = zip(inputs, bounds, strict=True)
    return all(float(lo) < jet.c - jet.radius and jet.c + jet.radius < float(hi) for jet, (lo, hi) in each)
