"""Third-order models of the closed loop on a ball, in floats, which rules `local` and `tube` bound.

On the ball x = m + J d, ||d|| <= 1, the components of F are jets (jets.py), and the bounds hold for every smaller
radius too and leave no hole at its middle m. The terms that each unit adds to its tangent reach the output through the
products of weights and slopes at m, `Paths`, and cancel there as they do in truth; the products do not depend on the
ball. The remainder of each unit beyond its third order, e_q, stays apart to the end: F has all of them in a linear
combination that is known exactly, and so they keep the directions that they have in x. d may have more entries than x:
along a path its last is the motion. A unit that is not smooth at 0 has its tangent alone on a
ball that meets its corner, which leaves the more the closer the corner is to the middle.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.certificates.limits import numbers_of_a_jet
from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS, Activation
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import evaluate, nodes
from certify.loop.policies import bounded_by_form
from certify.provers.ball.jets import Jet, Jets, basis, beyond_tangent, remainder, sizes
from certify.provers.ball.ranged import RangedJet

Array = NDArray[np.float64]
_CALL, _EACH, _ENTRY = 3e5, 1e5, 0.12  # operations of a layer, of one of the equations, of an entry of a product
_MOST_NUMBERS, _MOST_PRODUCTS = 2**25, 2**33  # size of the sums over paths: the checker refuses more
_MARGIN = 1e-3  # share of an input's range, left to the checker's rounding where a clip begins
_AT_CORNER = 1e-12  # what a unit reads, so near 0 that no ball of any use is free of its corner
_UNIT = 2.0**-51  # twice what a checker counts for each term of a sum, relative to the sum's size
_ROUNDED = 2.0**-49  # and for anything else that it computes


@dataclass(frozen=True, slots=True)
class Inputs:
    """The inputs on a ball: gradients A (m, k), half Hessians Q (m, k, k), forms of third order K (m, k, k, k).

    `curve` (m,) bounds all that they have beyond their gradients, `room` (m,) is how far they may move within their
    bounds and clips, infinite without any, and `drive` (n, m) are the derivatives of F at the middle by them.
    """

    A: Array
    Q: Array
    K: Array
    curve: Array
    room: Array
    drive: Array


@dataclass(frozen=True, slots=True)
class Spread:
    """The motion of f and A of models with y, N numbers in [-1, 1]: f + moves.y within `error` (n,), A + turns.y
    within `slack` (n,), a norm for each row; `moves` (N, n), `turns` (N, n, k)."""

    moves: Array
    turns: Array
    error: Array
    slack: Array


@dataclass(frozen=True, slots=True)
class Models:
    """The components of F on a ball: values f (n,) at its middle, gradients A (n, k), half Hessians Q (n, k, k), forms
    of third order K (n, k, k, k) and remainders E (n, k, k) beyond those of the units, k the entries of d.

    Those are N numbers |e_q| <= d'R_q d, R (N, k, k), which enter F as `shares` (n, N) times e; `squares` are R_q'R_q.
    `spread` says what is uncertain of f and A, None that nothing is; `stays` whether the states are certain to stay in
    the domain over a sampling period; `rounding` (n,) is about what a checker does not know of f for its roundings.
    """

    f: Array
    A: Array
    Q: Array
    K: Array
    E: Array
    shares: Array
    R: Array
    squares: Array
    inputs: Inputs
    rounding: Array
    spread: Spread | None = None
    stays: bool = True

    @property
    def corners(self) -> list[tuple[Array, Array]]:
        """f and A at each corner of the cell."""
        if self.spread is None:
            return [(self.f, self.A)]
        moves, turns = self.spread.moves, self.spread.turns
        signs = (np.array(y) for y in itertools.product((-1.0, 1.0), repeat=len(moves)))
        return [(self.f + y @ moves, self.A + np.tensordot(y, turns, 1)) for y in signs]

    @property
    def finite(self) -> bool:
        """True if F has a finite model on the ball."""
        s = self.spread
        of_spread = () if s is None else (s.moves, s.turns, s.error, s.slack)
        parts = (self.f, self.A, self.Q, self.K, self.E, self.squares, *of_spread)
        return all(bool(np.all(np.isfinite(part))) for part in parts)

    @property
    def admitted(self) -> bool:
        """True if every input is certain to lie in its bounds and inside its clip, and the states in the domain."""
        return self.stays and bool(np.all(np.linalg.norm(self.inputs.A, axis=1) + self.inputs.curve < self.inputs.room))


@dataclass(frozen=True, slots=True)
class _Layer:
    """`y = y(m) + X [x - m, A]`: A stacks what every unit before this layer adds to its tangent at m. `phi` is the
    function behind the layer, None behind the last of a policy without a squash."""

    y: Array
    X: Array
    W: Array  # the last columns of X, those of the layer just before
    phi: Activation | None


@dataclass(frozen=True, slots=True)
class _Policy:
    """The outputs before scaling: gradients (m, k), Q and K in their basis; their errors are `shares` (m, N) of the
    errors that R, N rows, bounds."""

    G: Array
    Q: Array
    K: Array
    shares: Array
    R: Array


@dataclass(frozen=True, slots=True)
class Driven:
    """The inputs on a ball as rows in their basis: gradients G (m, k), Q and K, and `errors` (m, ...) of what is left,
    which are `shares` (m, N) of those that R (N, k, k) bounds; `curve` and `room` as `Inputs` has them.
    """

    G: Array
    Q: Array
    K: Array
    errors: Array
    shares: Array
    R: Array
    squares: Array
    curve: Array
    room: Array
    rounding: Array

    def models(
        self, F: Sequence[Jet | RangedJet], number: int, spread: Spread | None = None, stays: bool = True
    ) -> Models:
        """The models with these components, which are of several balls, on the ball of this number."""
        form, B = basis(self.G.shape[1]), np.concatenate([v.B for v in F])
        a, Q, K, E = (np.array([getattr(v, part)[number] for v in F]) for part in ("a", "Q", "K", "E"))
        inputs = Inputs(self.G, form.matrices(self.Q), form.forms(self.K), self.curve, self.room, B)
        parts = form.matrices(Q), form.forms(K), form.matrices(E)
        f = np.array([v.c for v in F])
        wrong = np.abs(B) @ self.rounding
        return Models(f, a, *parts, B @ self.shares, self.R, self.squares, inputs, wrong, spread, stays)


def of_all(driven: Sequence[Driven]) -> tuple[list[tuple[Array, Array, Array]], Array]:
    """For jets on several balls: for each input its model's rows but for its value, and the `errors` of all inputs."""
    G, Q, K = (np.array([getattr(one, part) for one in driven]) for part in ("G", "Q", "K"))
    models = [(G[:, j], Q[:, j], K[:, j]) for j in range(G.shape[1])]
    return models, np.concatenate([one.errors for one in driven], axis=1)


@dataclass(frozen=True, slots=True)
class Paths:
    """The closed loop at a state `middle`, (n,): all of its models that does not depend on the ball around it.

    `u` are the inputs there, before a clip, and `rounding` (m,) is about what a checker does not know of them for its
    roundings.
    """

    loop: ClosedLoop
    middle: Array
    u: Array
    rounding: Array
    layers: tuple[_Layer, ...]

    @property
    def operations(self) -> float:
        """Operations of models on a ball, about, as an `Effort` counts them."""
        n, found, before = self.loop.system.n, _CALL * len(self.layers), 0
        second, numbers = n * (n + 1) / 2, float(numbers_of_a_jet(n))
        for layer in self.layers:
            rows, columns = layer.W.shape
            found += _ENTRY * rows * (columns * numbers + before * second + 8 * numbers)
            before += rows
        return found + sum(1 for _ in nodes(*self.loop.dynamics)) * (_EACH + 32 * numbers)

    def models(self, J: Array) -> Models:
        """F on the ball x = middle + J d, ||d|| <= 1; J is (n, k)."""
        return self.models_on(J[None])[0]

    def models_on(self, balls: Array) -> list[Models]:
        """The same on several balls, (N, n, k); if one has no finite models, none has."""
        driven, loop = [self.driven(J) for J in balls], self.loop
        models, errors = of_all(driven)
        algebra = Jets(len(balls), balls.shape[2], errors)
        states = [algebra.state(float(m), balls[:, i]) for i, m in enumerate(self.middle)]
        inputs = [algebra.input(j, float(u), *models[j]) for j, u in enumerate(self.u)]
        values = dict(zip((*loop.system.states, *loop.system.inputs), (*states, *inputs), strict=True))
        shared = dict[Any, Jet]()
        F = [evaluate(e, values, algebra, shared) for e in loop.dynamics]
        return [one.models(F, number) for number, one in enumerate(driven)]

    def driven(self, J: Array) -> Driven:
        """The inputs on that ball."""
        policy, loop = self._policy(J), self.loop
        scale, form = loop.network.scale[:, None], basis(J.shape[1])
        G, Q, K, each = scale * policy.G, scale * policy.Q, scale * policy.K, scale * policy.shares
        errors, R = np.abs(each) @ policy.R, form.matrices(policy.R)
        curve = sizes(G, Q, K, errors).curve
        return Driven(G, Q, K, errors, each, R, R @ R, curve, _room(loop, self.u), self.rounding)

    def _policy(self, J: Array) -> _Policy:
        n, k = J.shape
        form = basis(k)
        Q, K, R = (np.zeros((rows, len(of))) for rows, of in ((n, form.eye), (n, form.scale3), (0, form.eye)))
        for layer in self.layers:
            G, M = layer.X[:, :n] @ J, layer.X[:, n:]
            Q, K = layer.W @ Q, layer.W @ K
            if layer.phi is None:
                return _Policy(G, Q, K, M, R)
            E = np.abs(M) @ R
            size = sizes(G, Q, K, E)
            _, slope, second, third, fourth = layer.phi.around(layer.y, size.radius)
            squares = form.square(G)
            H, cubic = beyond_tangent(G, squares, Q, K, second, third)
            rest = remainder(squares, size, E, np.abs(second), np.abs(third), fourth)
            R = np.concatenate([R, rest])
            Q, K = slope[:, None] * Q + H, slope[:, None] * K + cubic
        return _Policy(slope[:, None] * G, Q, K, np.concatenate([slope[:, None] * M, np.eye(len(G))], axis=1), R)


def paths(loop: ClosedLoop, at: Array | None = None, resting: bool = True) -> Paths:
    """Follow the states and every unit's output through the network's linearisation at a state, (n,), the origin if
    none is given; if that is not `resting`, the inputs there are what the policy says, else u_eq.

    Raises
    ------
    InputError : the network is larger than the checker's rules allow.
    """
    network = loop.network
    n, last = network.n, len(network.weights) - 1
    columns = k = n if at is None else n + 1
    numbers, products = numbers_of_a_jet(k), 0
    for W in network.weights[1:]:
        columns += W.shape[1]
        products += len(W) * columns * (numbers + W.shape[1])
        if columns * (len(W) + numbers) > _MOST_NUMBERS or products > _MOST_PRODUCTS:
            raise InputError("The network is too large for the local proof: use fewer or narrower layers.")
    folded, middle = loop.folded, np.zeros(n) if at is None else at
    h, X, wrong = middle, np.eye(n), np.zeros(n)
    layers = []
    for number, (W, b) in enumerate(zip(folded.weights, folded.biases, strict=True)):
        y, X = W @ h + b, W @ X
        terms = _UNIT * (W.shape[1] + 2) * np.linalg.norm(W, axis=1) * np.linalg.norm(h)
        wrong = np.abs(W) @ wrong + terms + _ROUNDED * (np.abs(y) + np.abs(b))
        if number:
            X = np.concatenate([X, W], axis=1)
        phi = network.phi if number < last else ACTIVATIONS["tanh"] if network.squash == "tanh" else None
        layers.append(_Layer(y, X, W, phi))
        h = y
        if phi is not None:
            h, slope = phi.pair(y)
            X, wrong = slope[:, None] * X, phi.steepest * wrong + _ROUNDED * np.abs(h)
    u = np.array([float(q) for q in loop.u_eq])
    wrong = np.abs(folded.scale) * wrong
    if at is not None or (not resting and network.centre == "none"):
        u = folded.scale * h + folded.offset
    else:
        wrong = np.zeros_like(u)
    rounding = np.zeros_like(u) if resting else wrong + _ROUNDED * (np.abs(u) + np.abs(folded.offset))
    return Paths(loop, middle, u, rounding, tuple(layers))


def corner_of(known: Paths) -> str | None:
    """The activation with a corner at the paths' middle itself, where no ball around that has a model; or None."""
    for layer in known.layers:
        if layer.phi is not None and not layer.phi.is_smooth and np.any(np.abs(layer.y) <= _AT_CORNER):
            return layer.phi.name
    return None


def _room(loop: ClosedLoop, u: Array) -> Array:
    """The distance that inputs may move from u inside the clip, which has no second derivative at its corners, and
    within the bounds."""
    network, bounds = loop.network, loop.system.input_bounds
    room = np.full(len(u), np.inf)
    if network.clip is not None:
        lo, hi = network.clip
        room = np.minimum(room, np.minimum(u - lo, hi - u) / (1 + _MARGIN))
    if not bounded_by_form(network, bounds):
        lo, hi = np.array([[float(end) for end in pair] for pair in bounds]).T
        room = np.minimum(room, np.minimum(u - lo, hi - u))
    return np.asarray(room)
