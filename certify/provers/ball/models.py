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
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from certify.certificates.limits import numbers_of_a_jet
from certify.errors import InputError
from certify.loop.activations import CERTAIN
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, evaluate, nodes
from certify.loop.networks import Affine, Algebra, Clip, Concat, Map, Network, Observe, Product, Sum
from certify.loop.networks.floats import evaluated, jacobian
from certify.loop.plants import kept_constraints
from certify.loop.policies import bounded_by_form
from certify.provers.ball.jets import Jet, Jets, basis, beyond_tangent, observed, product_beyond, remainder, sizes
from certify.provers.ball.kinks import ALL, Cone, Kinks, OnCone
from certify.provers.ball.ranged import RangedJet

Array = NDArray[np.float64]
_CALL, _EACH, _ENTRY = 3e5, 1e5, 0.12  # operations of a layer, of one of the equations, of an entry of a product
_MOST_NUMBERS, _MOST_PRODUCTS = 2**25, 2**33  # size of the sums over paths
_MARGIN = 1e-3  # share of an input's range, left to the checker's rounding where a clip begins
_AT_CORNER = 1e-12  # what a unit reads, so near 0 that no ball of any use is free of its corner
AT_CORNERS = 6  # uncertain quantities of which the checker decides every corner
_UNIT = 2.0**-51  # twice what a checker counts for each term of a sum, relative to the sum's size
_ROUNDED = 2.0**-49  # and for anything else that it computes
_MUCH = 1e-9  # share of a gradient, from which on its roundings count beside the decay
_WIDER, _BEYOND = 1 + 1e-9, 1e-12  # of a constraint's radius, and of its middle, for the checker's rounding


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
    the domain over a sampling period; `rounding` (n,) is about what a checker does not know of f for its roundings, and
    `slack` (n,) of A, where that is much.
    `others` are y beside those of `spread` that have no corners, `moves` and `turns` as there; see `with_others`.
    `kinks` are those among the units, on the `cone`; None if none is allowed.
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
    slack: Array
    spread: Spread | None = None
    stays: bool = True
    others: tuple[Array, Array] | None = None
    kinks: Kinks | None = None
    cone: Cone = ALL

    def with_others(self, P: Array) -> Models:
        """The same without those y that move neither f nor A, and of more than AT_CORNERS with those of the least
        effect as `others`, as the checker has it for P (n, n)."""
        if self.spread is None or not len(self.spread.moves):
            return self
        moves, turns, roots = self.spread.moves, self.spread.turns, np.sqrt(np.abs(np.diag(P)))
        size = np.linalg.norm(turns, axis=2) @ roots
        some = np.flatnonzero((size > 0) | np.any(moves != 0, axis=1))
        some = some[np.lexsort((-size[some], ~np.any(moves[some] != 0, axis=1)))]
        first, last = some[:AT_CORNERS], some[AT_CORNERS:]
        spread = replace(self.spread, moves=moves[first], turns=turns[first])
        return replace(self, spread=spread, others=(moves[last], turns[last]) if len(last) else None)

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
class _Vector:
    """A vector of the network, `y + X [x - m, A]`: A stacks what every unit so far adds to its tangent at m. If it has
    units of its `own`, their columns are the identity and come last, not in X. `wrong` is about what a checker does not
    know of y for its roundings, `blur` the same of gradients on a ball of J over ||J||: it bounds the roundings of a
    layer by norms, which is much where states have units of very different sizes."""

    y: Array
    X: Array
    wrong: Array
    own: bool = False
    blur: float = 0.0

    def among(self, columns: int) -> Array:
        """X with the columns of its own units, and of zeros up to so many."""
        X = np.concatenate([self.X, np.eye(len(self.y))], axis=1) if self.own else self.X
        return np.pad(X, ((0, 0), (0, columns - X.shape[1]))) if X.shape[1] < columns else X

    @property
    def columns(self) -> int:
        """The number of columns, those of its own units among them."""
        return int(self.X.shape[1]) + (len(self.y) if self.own else 0)


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
    which are `shares` (m, N) of those that R (N, k, k) bounds; `curve` and `room` as `Inputs` has them. A checker does
    not know the inputs by their `rounding`, nor their gradients by their `slack`, (m,) each.
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
    slack: Array
    kinks: Kinks | None = None
    cone: Cone = ALL

    def models(
        self, F: Sequence[Jet | RangedJet], number: int, spread: Spread | None = None, stays: bool = True
    ) -> Models:
        """The models with these components, which are of several balls, on the ball of this number."""
        form, B = basis(self.G.shape[1]), np.concatenate([v.B for v in F])
        a, Q, K, E = (np.array([getattr(v, part)[number] for v in F]) for part in ("a", "Q", "K", "E"))
        inputs = Inputs(self.G, form.matrices(self.Q), form.forms(self.K), self.curve, self.room, B)
        parts = form.matrices(Q), form.forms(K), form.matrices(E)
        f = np.array([v.c for v in F])
        wrong, slack = np.abs(B) @ self.rounding, np.abs(B) @ self.slack
        found = Models(f, a, *parts, B @ self.shares, self.R, self.squares, inputs, wrong, slack, spread, stays)
        return found if self.kinks is None else replace(found, kinks=self.kinks, cone=self.cone)

    @property
    def tilts(self) -> Array:
        """The most that kinks add to each input, over ||d||."""
        none: Array = np.zeros(len(self.shares))
        return none if self.kinks is None else np.abs(self.shares) @ self.kinks.rho


def of_all(driven: Sequence[Driven]) -> tuple[list[tuple[Array, Array, Array]], Array]:
    """For jets on several balls: for each input its model's rows but for its value, and the `errors` of all inputs."""
    G, Q, K = (np.array([getattr(one, part) for one in driven]) for part in ("G", "Q", "K"))
    models = [(G[:, j], Q[:, j], K[:, j]) for j in range(G.shape[1])]
    return models, np.concatenate([one.errors for one in driven], axis=1)


def tilts_of_all(driven: Sequence[Driven]) -> Array:
    """For each input what kinks add to it on each ball, (m, N)."""
    return np.array([one.tilts for one in driven]).T


@dataclass(frozen=True, slots=True)
class Paths:
    """The closed loop at a state `middle`, (n,): all of its models that does not depend on the ball around it.

    `u` are the inputs there, before a clip, and `rounding` (m,) is about what a checker does not know of them for its
    roundings, `blur` (m,) of their gradients on a ball of J, over ||J||.
    """

    loop: ClosedLoop
    middle: Array
    u: Array
    rounding: Array
    blur: Array
    network: Network
    vectors: tuple[_Vector, ...]

    @property
    def operations(self) -> float:
        """Operations of models on a ball, about, as an `Effort` counts them."""
        n, found = self.loop.system.n, 0.0
        second, numbers = n * (n + 1) / 2, float(numbers_of_a_jet(n))
        for rows, columns, before in shapes(self.network):
            found += _CALL + _ENTRY * rows * (columns * numbers + before * second + 8 * numbers)
        equations = sum(1 for _ in nodes(*self.loop.dynamics)) + self.network.operations
        return found + equations * (_EACH + 32 * numbers)

    def models(self, J: Array) -> Models:
        """F on the ball x = middle + J d, ||d|| <= 1; J is (n, k)."""
        return self.models_on(J[None])[0]

    def models_on(self, balls: Array) -> list[Models]:
        """The same on several balls, (N, n, k); if one has no finite models, none has."""
        driven = [self.driven(J) for J in balls]
        F = self._of(self.loop.dynamics, balls, driven)
        return [one.models(F, number) for number, one in enumerate(driven)]

    def keeps(self, J: Array) -> bool:
        """True if every constraint holds on such a ball."""
        keep = tuple(kept_constraints(self.loop.system).values())
        found = self._of(keep, J[None], [self.driven(J)]) if keep else []
        return all(bool(np.all(g.c + _WIDER * g.radius < -_BEYOND * abs(g.c))) for g in found)

    def _of(self, expressions: Sequence[Expression], balls: Array, driven: Sequence[Driven]) -> list[Jet]:
        """Expressions in states and inputs on balls."""
        system, (models, errors) = self.loop.system, of_all(driven)
        algebra = Jets(len(balls), balls.shape[2], errors)
        states = [algebra.state(float(m), balls[:, i]) for i, m in enumerate(self.middle)]
        inputs = [algebra.input(j, float(u), *models[j]) for j, u in enumerate(self.u)]
        values = dict(zip((*system.states, *system.inputs), (*states, *inputs), strict=True))
        shared = dict[Any, Jet]()
        return [evaluate(e, values, algebra, shared) for e in expressions]

    def driven(self, J: Array, cone: Cone | None = None) -> Driven:
        """The inputs on that ball; with kinks for d in a cone."""
        (policy, kinks), loop = (self._policy(J), None) if cone is None else self._on_cone(J, cone), self.loop
        scale, form = loop.network.scale[:, None], basis(J.shape[1])
        G, Q, K, each = scale * policy.G, scale * policy.Q, scale * policy.K, scale * policy.shares
        errors, R = np.abs(each) @ policy.R, form.matrices(policy.R)
        curve = sizes(G, Q, K, errors).curve
        slack = self.blur * np.linalg.norm(J)
        slack = np.where(slack > _MUCH * np.linalg.norm(G, axis=1), slack, 0.0)
        found = Driven(G, Q, K, errors, each, R, R @ R, curve, _room(loop, self.u), self.rounding, slack)
        if kinks is None or cone is None:
            return found
        return replace(found, curve=curve + np.abs(each) @ kinks.rho, kinks=kinks, cone=cone)

    def _on_cone(self, J: Array, cone: Cone) -> tuple[_Policy, Kinks]:
        ball = OnCone(J, cone)
        v = ball.run(self.network, ball.argument(self.middle))
        L, *_ = ball.reached(v)
        return _Policy(v.G, v.Q, v.K, L, ball.R), ball.kinks

    def _policy(self, J: Array) -> _Policy:
        ball = _OnBall(self, J)
        return ball.policy(ball.run(self.network, ball.argument()))


class _Part(NamedTuple):
    """A vector on a ball: what it is along all paths, and its Q and K, rows in their basis."""

    at: _Vector
    Q: Array
    K: Array


class _OnBall(Algebra[_Part]):
    """The network on a ball x = middle + J d. R has the remainders of all units so far, a row each."""

    def __init__(self, known: Paths, J: Array) -> None:
        self.J, self.form, self.R = J, basis(J.shape[1]), np.zeros((0, len(basis(J.shape[1]).eye)))
        self._vectors = iter(known.vectors)

    def argument(self) -> _Part:
        """The states."""
        n = len(self.J)
        return _Part(next(self._vectors), np.zeros((n, len(self.form.eye))), np.zeros((n, len(self.form.scale3))))

    def policy(self, v: _Part) -> _Policy:
        """The models of the network's value."""
        G, M, _ = self._reached(v)
        return _Policy(G, v.Q, v.K, np.pad(M, ((0, 0), (0, len(self.R) - M.shape[1]))), self.R)

    def _reached(self, v: _Part) -> tuple[Array, Array, Array]:
        """A vector's gradients, the numbers M with which units reach it, and the bound E of their errors there."""
        X, n = v.at.among(0), len(self.J)
        M = X[:, n:]
        return X[:, :n] @ self.J, M, np.abs(M) @ self.R[: M.shape[1]]

    def affine(self, step: Affine, v: _Part) -> _Part:
        return _Part(next(self._vectors), step.weight @ v.Q, step.weight @ v.K)

    def map(self, step: Map, v: _Part) -> _Part:
        G, _, E = self._reached(v)
        size = sizes(G, v.Q, v.K, E)
        _, slope, second, third, fourth = step.phi.around(v.at.y, size.radius)
        if step.function == "relu":  # at its corner itself there is no tangent
            fourth = np.where(np.abs(v.at.y) <= _AT_CORNER, np.nan, fourth)
        squares = self.form.square(G)
        H, cubic = beyond_tangent(G, squares, v.Q, v.K, second, third)
        rest = remainder(squares, size, E, np.abs(second), np.abs(third), fourth)
        self.R = np.concatenate([self.R, rest])
        return _Part(next(self._vectors), slope[:, None] * v.Q + H, slope[:, None] * v.K + cubic)

    def clip(self, step: Clip, v: _Part) -> _Part:
        """Entries that are certainly not clipped stay, those that certainly are become constant, others NaN."""
        G, _, E = self._reached(v)
        reach = sizes(G, v.Q, v.K, E).radius * CERTAIN
        lo, hi = v.at.y - reach, v.at.y + reach
        constant = (hi < step.lo) | (lo > step.hi)
        slope = np.where((lo > step.lo) & (hi < step.hi), 1.0, np.where(constant, 0.0, np.nan))
        return _Part(next(self._vectors), slope[:, None] * v.Q, slope[:, None] * v.K)

    def sum(self, step: Sum, *vectors: _Part) -> _Part:
        Q, K = (np.sum([getattr(v, part) for v in vectors], axis=0) for part in ("Q", "K"))
        return _Part(next(self._vectors), Q, K)

    def concat(self, step: Concat, *vectors: _Part) -> _Part:
        Q, K = (np.concatenate([getattr(v, part) for v in vectors]) for part in ("Q", "K"))
        return _Part(next(self._vectors), Q, K)

    def product(self, step: Product, v: _Part, w: _Part) -> _Part:
        """The product of what both add to their values at the middle is that of a unit."""
        first, second = (self._beyond(part) for part in (v, w))
        H, cubic, rest = product_beyond(*first, *second)
        self.R = np.concatenate([self.R, rest])
        y, z = v.at.y[:, None], w.at.y[:, None]
        return _Part(next(self._vectors), y * w.Q + z * v.Q + H, y * w.K + z * v.K + cubic)

    def _beyond(self, v: _Part) -> tuple[Array, Array, Array, Array]:
        """The rows of all that a vector adds to its value at the middle."""
        G, _, E = self._reached(v)
        return G, v.Q, v.K, E

    def observe(self, step: Observe, v: _Part) -> _Part:
        """Jets of the expressions, whose terms beyond their tangents become those of units."""
        G, _, E = self._reached(v)
        _, _, Q, K, rest = observed(step, v.at.y, G, v.Q, v.K, E)
        self.R = np.concatenate([self.R, rest])
        return _Part(next(self._vectors), Q, K)


class _Along(Algebra[_Vector]):
    """The network's linearisation at a state; `vectors` are all that it made."""

    def __init__(self, n: int, at: Array) -> None:
        self.n = n
        self.vectors = [_Vector(at, np.eye(n), np.zeros(n))]

    def _made(self, y: Array, X: Array, wrong: Array, blur: float, own: bool = False) -> _Vector:
        self.vectors.append(_Vector(y, X, wrong, own, blur))
        return self.vectors[-1]

    def affine(self, step: Affine, v: _Vector) -> _Vector:
        W, b = step.weight, step.bias
        y, X = W @ v.y + b, W @ v.X
        terms = _UNIT * (W.shape[1] + 2) * np.linalg.norm(W, axis=1) * np.linalg.norm(v.y)
        wrong = np.abs(W) @ v.wrong + terms + _ROUNDED * (np.abs(y) + np.abs(b))
        blur = float(np.linalg.norm(W, 2)) * v.blur
        if v is self.vectors[0]:
            blur += _UNIT * W.shape[1] * float(np.linalg.norm(W))
        return self._made(y, np.concatenate([X, W], axis=1) if v.own else X, wrong, blur)

    def map(self, step: Map, v: _Vector) -> _Vector:
        y, slope = step.phi.pair(v.y)
        X = slope[:, None] * self._all(v)
        steepest = step.phi.steepest
        return self._made(y, X, steepest * v.wrong + _ROUNDED * np.abs(y), steepest * v.blur, own=True)

    def clip(self, step: Clip, v: _Vector) -> _Vector:
        inside = (v.y > step.lo) & (v.y < step.hi)
        y = np.minimum(np.maximum(v.y, step.lo), step.hi)
        return self._made(y, np.where(inside[:, None], self._all(v), 0.0), v.wrong, v.blur)

    def sum(self, step: Sum, *vectors: _Vector) -> _Vector:
        most = max(v.columns for v in vectors)
        y, wrong = (np.sum([getattr(v, part) for v in vectors], axis=0) for part in ("y", "wrong"))
        size = np.sum([np.abs(v.y) for v in vectors], axis=0)
        X, blur = np.sum([v.among(most) for v in vectors], axis=0), sum(v.blur for v in vectors)
        return self._made(y, X, wrong + _ROUNDED * size, blur)

    def concat(self, step: Concat, *vectors: _Vector) -> _Vector:
        most = max(v.columns for v in vectors)
        y, wrong = (np.concatenate([getattr(v, part) for v in vectors]) for part in ("y", "wrong"))
        X, blur = np.concatenate([v.among(most) for v in vectors]), math.hypot(*(v.blur for v in vectors))
        return self._made(y, X, wrong, blur)

    def product(self, step: Product, v: _Vector, w: _Vector) -> _Vector:
        y, X = v.y * w.y, v.y[:, None] * self._all(w) + w.y[:, None] * self._all(v)
        wrong = np.abs(v.y) * w.wrong + np.abs(w.y) * v.wrong + _ROUNDED * np.abs(y)
        blur = float(np.max(np.abs(v.y))) * w.blur + float(np.max(np.abs(w.y))) * v.blur
        return self._made(y, X, wrong, blur, own=True)

    def observe(self, step: Observe, v: _Vector) -> _Vector:
        D, y = jacobian(step, v.y), evaluated(step.expressions, step.symbols, v.y)
        X = np.zeros((len(y), self._units))
        X[:, : self.n] = D @ v.X[:, : self.n]
        wrong = np.abs(D) @ v.wrong + _ROUNDED * (np.abs(y) + np.abs(D) @ np.abs(v.y))
        return self._made(y, X, wrong, float(np.linalg.norm(D, 2)) * v.blur, own=True)

    def _all(self, v: _Vector) -> Array:
        """X among all units so far, so that those of the next step are the next ones."""
        return v.among(self._units)

    @property
    def _units(self) -> int:
        """The number of columns that all units so far take."""
        return max(v.columns for v in self.vectors)


def shapes(network: Network) -> list[tuple[int, int, int]]:
    """The rows of each step that takes time, the columns that it has of its own, and the units before it."""
    found, before = list[tuple[int, int, int]](), 0
    for k, step in enumerate(network.steps):
        rows = network.sizes[k + 1]
        if isinstance(step, Affine):
            found.append((rows, step.weight.shape[1], before))
        elif not (isinstance(step, Map) and step.of == (k,) and k and isinstance(network.steps[k - 1], Affine)):
            found.append((rows, len(step.of), before))
        before += rows if isinstance(step, Map | Clip | Product | Observe) else 0
    return found


@np.errstate(all="ignore")  # infinities and NaN are answers, which nothing is proved with
def paths(loop: ClosedLoop, at: Array | None = None, resting: bool = True) -> Paths:
    """Follow the states and every unit's output through the network's linearisation at a state, (n,), the origin if
    none is given; if that is not `resting`, the inputs there are what the policy says, else u_eq.

    Raises
    ------
    InputError : the network is too large.
    """
    folded, n = loop.folded, loop.network.n
    network = folded.network
    if folded.squash == "tanh":
        network = Network(n, (*network.steps, Map((len(network.steps),), "tanh")))
    _require_small(network, n if at is None else n + 1)
    middle = np.zeros(n) if at is None else at
    along = _Along(n, middle)
    value = along.run(network, along.vectors[0])
    u = np.array([float(q) for q in loop.u_eq])
    wrong = np.abs(folded.scale) * value.wrong
    if at is not None or (not resting and loop.network.centre == "none"):
        u = folded.scale * value.y + folded.offset
    else:
        wrong = np.zeros_like(u)
    rounding = np.zeros_like(u) if resting else wrong + _ROUNDED * (np.abs(u) + np.abs(folded.offset))
    return Paths(loop, middle, u, rounding, np.abs(folded.scale) * value.blur, network, tuple(along.vectors))


def _require_small(network: Network, k: int) -> None:
    numbers, products = numbers_of_a_jet(k), 0
    for rows, width, before in shapes(network):
        columns = k + before
        products += rows * columns * (width + numbers) if before else 0
        if before and (columns * (rows + numbers) > _MOST_NUMBERS or products > _MOST_PRODUCTS):
            raise InputError("The network is too large for the local proof: use fewer or narrower layers.")


def meets_corner(known: Paths) -> bool:
    """True if a relu has its corner at the paths' middle itself: around that *kinks* alone have models."""
    relus = (step for step in known.network.steps if isinstance(step, Map) and step.function == "relu")
    return any(np.any(np.abs(known.vectors[step.of[0]].y) <= _AT_CORNER) for step in relus)


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
