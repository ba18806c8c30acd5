"""A candidate whose sublevel set is as large as sampling can make it: a sequence of small linear matrix inequalities.

For a fixed state x, V(x) and `g(x) = D(x) + 2 alpha V(x)` are linear in P, D being Vdot, or V's increment over a step
by time, `2 x'P G + h G'P G` with the mean rate G of the step. If the ray through x crosses g = 0 near
x, the level at which it does is, to first order, `V(x) - mu g(x)`, with mu the ratio of the slopes of V and g along the
ray. And whatever mu >= 0 is, keeping this at 1 or more forbids `g > 0` at x inside `{V < 1}` (the S-procedure, state by
state). Each round samples the closed loop, remembers the states that limit the set, and minimises the linearised
`log det P` in a trust region subject to them: a convex problem of the size of P, in coordinates in which the present
set is a ball. Nothing is proved here: the engines prove the resulting binary64 matrix.

A state that violates a constraint of the plant has mu = 0: whatever P is, it must lie outside. So an obstacle shapes V,
and its mirror image with it. A constraint that is a half-space a'x < b is a matrix inequality, a'P^-1 a <= b^2.

The margin alpha is asked for, not only the sign, because a proof needs many boxes where Vdot nearly vanishes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.errors import BackendError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import Constraints
from certify.lyapunov.candidates import increment_matrix, solve_lyapunov
from certify.lyapunov.corners import Corners
from certify.lyapunov.level_sets import domain_limit, volume
from certify.lyapunov.programs import Inequality, smallest_trace

Array = NDArray[np.float64]
_RADII = np.linspace(0.1, 1.1, 12)  # of the samples on a ray, where 1 is the edge of the present set
_FRESH, _NEAR = 400, 300  # new rays of a search: in any direction, and near those that limit the set
_TOUCHING, _LINEARISED = 16, 12  # rays from which states are looked for that violate a constraint, in so many steps
_KEEP = 200  # rays of a search that are remembered for their crossing, and for their worst state
_ROWS = 500  # states that each margin hands to the solver
_ROUNDS = 30
DECAYS, FURTHER = (0.2, 0.02), (0.05,)  # the latter for rounds after the first where ranges take part of the margin
FIRM = (0.3,)  # of every round, for a set of which boxes prove more
_REPEATS, _WORTH = 12, 1.05  # of the whole search, and growth of the volume that is worth another
_SMALL = 0.01  # growth of the log of the volume, or trust radius, at which to stop
_STEP = 1e-4  # relative, of the difference quotient along a ray
_TOLERANCE = 1e-6  # of the solver
_SLACK = 1e-4  # by which a state may violate its row: the next search rescales P
_CALL, _SOLVER, _CONE = 2e5, 8e6, 60.0  # operations of few states at once, of a program, and for each of its products
_LINEAR, _SCORED = 1.3, 0.5  # shares of alpha: what the linearisation must keep, and what a sample must


def optimise_candidate(
    loop: ClosedLoop,
    start: Array,
    decays: tuple[float, ...] = DECAYS,
    seed: int = 0,
    effort: Effort = UNLIMITED,
    known: Array | None = None,
) -> Array:
    """Choose P for a large sampled set `{x'Px <= 1}` inside the domain with `Vdot <= -alpha V` (and inputs in bounds).

    Parameters
    ----------
    loop : the closed loop; its linearisation A is Hurwitz, or the linear map of a step is stable.
    start : (n, n), symmetric positive definite with `A'P + PA < 0`, or its like over a step, such as a solution of
        the Lyapunov equation.
    decays : alpha over the slowest decay rate of A, each between 0 and 0.7; the first that beats `start` is taken.
    seed : of the samples; equal seeds give equal results.
    effort : where it ends, the present P is taken.
    known : (N, n), states that sampling may miss, such as violations that a proof came upon.

    Returns
    -------
    Array : P, (n, n), scaled so that the sampled limit, with the margin, is 1.

    Raises
    ------
    BackendError : Clarabel is missing or gave no usable answer, or the sampled set is not larger than start's.

    Notes
    -----
    A local optimum. Boyd, El Ghaoui, Feron, Balakrishnan, Linear Matrix Inequalities in System and Control Theory, SIAM
    1994: section 2.6.3 (S-procedure), chapter 5 (invariant ellipsoids of extreme volume).
    """
    return _optimise(loop, start, decays, seed, effort, known)[0]


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def _optimise(
    loop: ClosedLoop, start: Array, decays: tuple[float, ...], seed: int, effort: Effort, known: Array | None
) -> tuple[Array, float]:
    """P, and the ratio of its sampled volume and the start's; levels that sink to 0 overflow and are refused."""
    corners = Corners(loop)
    start, slowest = corners.common(start), corners.slowest
    found = given = 0.0
    for decay in decays:
        samples = _Samples(corners, 1e-3 * decay * slowest, np.random.default_rng(seed), effort)
        if known is not None:
            samples.remember(known)
        P = _enlarge(samples, start, decay * slowest)
        if not (np.all(np.linalg.eigvalsh(P) > 0) and corners.decrease(P)):
            raise BackendError(
                "the optimised P must satisfy P > 0 and A'P + PA + h A'PA < 0; it does not. Use 'lyapunov'."
            )
        found, given = (volume(samples.fit(candidate, 0.0), 1.0) for candidate in (P, start))
        if found > given:
            return P, found / given
    raise BackendError(
        f"the optimised candidate must be larger than its start; sampled, its volume is {found:.6g} and the "
        f"start's {given:.6g}. Use the candidate 'lyapunov'."
    )


def optimise_repeatedly(
    loop: ClosedLoop,
    start: Array,
    effort: Effort = UNLIMITED,
    known: Array | None = None,
    decays: tuple[float, ...] | None = None,
) -> Array:
    """`optimise_candidate` from its own result again, with other samples, while that gains volume and effort is left.

    A trust region that has shrunk around one optimum opens again: on a planar quadrotor three rounds enlarge the
    sampled set of the first 30-fold. `decays` are those of every round, if not the usual ones.

    Raises
    ------
    BackendError : of the first round.
    """
    P, _ = _optimise(loop, start, decays or DECAYS, 0, effort, known)
    decays = decays or (FURTHER if loop.system.ranges else DECAYS)
    for seed in range(1, _REPEATS):
        if effort.over:
            break
        try:
            P, growth = _optimise(loop, P, decays, seed, effort, known)
        except BackendError:  # no larger one
            break
        if growth < _WORTH:
            break
    return P


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def largest_sampled(loop: ClosedLoop, candidates: Sequence[Array], seed: int = 0, effort: Effort = UNLIMITED) -> Array:
    """The P, (n, n), of those given whose set inside the domain without a sampled violation has the largest volume;
    where the effort ends, fewer samples tell."""
    corners = Corners(loop)
    samples = _Samples(corners, 1e-3 * corners.slowest, np.random.default_rng(seed), effort)
    return max(candidates, key=lambda P: volume(samples.fit(P, 0.0), 1.0))


def _enlarge(samples: _Samples, start: Array, alpha: float) -> Array:
    """Rounds of sampling and solving, from `start` to P with its margin."""
    h, rates = samples.loop.step, samples.corners.rates
    P = start
    if len(rates) == 1:
        Q = -increment_matrix(start, rates[0], h)
        # The linearisation of this P keeps `D <= -2 lambda V`: its equation is the one of A + lambda I.
        P = solve_lyapunov(rates[0], (Q + Q.T) / 2, h, _LINEAR * alpha)
    P = samples.fit(P, _SCORED * alpha)
    radius, answers = 0.4, 0
    for _ in range(_ROUNDS):
        if answers and samples.effort.over:
            break
        new = _solve(samples, P, alpha, radius)
        if new is None:
            radius /= 2
            continue
        answers += 1
        hoped = (_log_det(P) - _log_det(new)) / 2
        new = samples.rescale(new, _SCORED * alpha)
        P = P / min(1.0, samples.known(P, _SCORED * alpha))  # both are scored on the same samples
        gain = (_log_det(P) - _log_det(new)) / 2
        P = new if gain > 0 else P
        radius = radius / 2 if gain < 0.3 * hoped else min(0.5, 1.3 * radius)
        if hoped < _SMALL or radius < _SMALL:
            before = _log_det(P)
            P = samples.rescale(P, _SCORED * alpha, searches=4)
            if _log_det(P) - before < 2 * _SMALL:
                break
            radius = 0.1
    if answers == 0:
        raise BackendError("the solver found no optimised candidate. Use the candidate 'lyapunov'.")
    return P


class _Samples:
    """States that limit sublevel sets of the closed loop, remembered from search to search.

    x, G(x), (dG/dx) x : (N, n), G being the mean rate of a step, F in continuous time, at the corner of ranges where V
    grows most. outside : (N,), the input leaves its bounds at x, a constraint is violated, or G has a pole there.
    Where the effort has ended, one search does for several.
    """

    def __init__(self, corners: Corners, least: float, generator: np.random.Generator, effort: Effort) -> None:
        self.corners, self.least, self.generator, self.effort = corners, least, generator, effort
        self.loop, self.step = corners.loop, corners.step
        self.P: Array | None = None  # of the V that grows most
        loop = self.loop
        self.bounds = np.array([[float(v) for v in b] for b in loop.system.input_bounds]).T
        self.constraints = Constraints(loop) if loop.system.constraints else None
        self.x, self.F, self.dF = (np.zeros((0, loop.system.n)) for _ in range(3))
        self.outside = np.zeros(0, dtype=bool)

    def field(self, x: Array) -> tuple[Array, NDArray[np.bool_]]:
        """G and `outside` at x, shapes (..., n) and (...)."""
        self.effort.charge(_CALL + x.size / self.loop.system.n * self.corners.operations)
        # One matrix product for all states: numpy would make one for each leading index.
        u = self.loop.policy(x.reshape(-1, x.shape[-1])).reshape(*x.shape[:-1], self.loop.system.m)
        with np.errstate(all="ignore"):
            F = self.corners.worst(x, u, self.P)
        outside: NDArray[np.bool_] = np.logical_not(np.all(np.isfinite(F), axis=-1))
        F = np.where(outside[..., None], 0.0, F)
        outside |= np.any((u < self.bounds[0]) | (u > self.bounds[1]), axis=-1)
        return F, outside if self.constraints is None else outside | np.any(self.constraints.at(x, u) >= 0, axis=-1)

    def limit(self, P: Array) -> float:
        """The level at which {x'Px <= level} meets a side of the domain, or a constraint that is a half-space."""
        found = domain_limit(P, self.loop.system.domain)
        planes = [] if self.constraints is None else self.constraints.planes
        return min([found, *(b * b / float(a @ np.linalg.solve(P, a)) for a, b in planes)])

    def known(self, P: Array, alpha: float) -> float:
        """The lowest level of a remembered violation of `D + 2 alpha V < 0`, inf if there is none."""
        bad = ~(_g(P, self.x, self.F, alpha, self.step) < 0) | self.outside
        return float(np.min(_form(P, self.x[bad], self.x[bad]), initial=np.inf))

    def crossings(self, P: Array, alpha: float) -> tuple[Array, Array]:
        """`V - mu g` and mu of the remembered states, (N,) each; mu = 0 where P cannot change the violation."""
        V, g = _form(P, self.x, self.x), _g(P, self.x, self.F, alpha, self.step)
        slope = 2 * _form(P, self.x, self.F + self.dF) + 4 * alpha * V
        if self.step:
            slope += 2 * self.step * _form(P, self.F, self.dF)
        mu = np.where(self.outside, 0.0, 2 * V / np.maximum(slope, self.least * V))
        return V - mu * g, mu

    def fit(self, P: Array, alpha: float) -> Array:
        """`rescale` from the domain's limit downwards."""
        return self.rescale(P / self.limit(P), alpha, searches=4)

    def rescale(self, P: Array, alpha: float, searches: int = 1) -> Array:
        """P scaled so that {V <= 1} lies in the domain and holds no violation that the searches found."""
        for k in range(searches + 10):
            self.search(P, alpha)
            level = self.known(P, alpha)
            P = P / min(level, self.limit(P), float(_RADII[-1]) ** 2)
            if not np.all(np.isfinite(P)):  # as where the loop does not rest at the origin
                raise BackendError("V falls on no sampled set around the origin. Use the candidate 'lyapunov'.")
            if k + 1 >= searches and level > 0.5:  # a lower level leaves the set too coarsely sampled
                break
            if self.effort.over:
                break
        return P

    def search(self, P: Array, alpha: float) -> None:
        """Sample rays across {V <= 1.2}; remember where the first of them cross `g = 0`, and their worst states."""
        L, self.P = np.linalg.cholesky(P), P
        n = len(P)
        z = self.generator.standard_normal((_FRESH, n))
        self.effort.charge(2 * _CALL + 4 * n * n * len(self.x))
        if len(self.x):
            lowest = np.argsort(self.crossings(P, alpha)[0], kind="stable")[:100]
            limiting = _unit(self.x[lowest] @ L)
            size = 10 ** self.generator.uniform(-2.5, 0, (_NEAR, 1)) / math.sqrt(n)
            near = limiting[self.generator.integers(0, len(limiting), _NEAR)]
            z = np.concatenate([z, limiting, near + size * self.generator.standard_normal((_NEAR, n))])
        rays = _unit(z) @ np.linalg.inv(L)
        x = _RADII[:, None] * rays[:, None, :]
        F, outside = self.field(x)
        g = _g(P, x, F, alpha, self.step)
        bad = ~(g < 0) | outside
        first = np.where(bad.any(axis=1), bad.argmax(axis=1), len(_RADII))
        share = np.where(np.arange(len(_RADII)) < first[:, None], g / _RADII**2, -np.inf)
        worst = np.argsort(-share.max(axis=1), kind="stable")[:_KEEP]
        worst = worst[first[worst] > 0]
        crossed = np.argsort(first, kind="stable")[:_KEEP]
        crossed = crossed[first[crossed] < len(_RADII)]
        high = _RADII[first[crossed]]
        low = np.where(first[crossed] > 0, _RADII[first[crossed] - 1], 0.0)
        for _ in range(8):
            middle = (low + high) / 2
            state = middle[:, None] * rays[crossed]
            F, outside = self.field(state)
            bad = ~(_g(P, state, F, alpha, self.step) < 0) | outside
            low, high = np.where(bad, low, middle), np.where(bad, middle, high)
        found = [x[worst, share[worst].argmax(axis=1)], high[:, None] * rays[crossed]]
        if self.constraints is not None:  # where they are first violated, which rays may miss
            T, most = np.linalg.inv(L).T, float(_RADII[-1]) ** 2
            self.effort.charge(self.constraints.operations(n, _TOUCHING, _LINEARISED))
            found.append(self.constraints.touching(T, most, _unit(z[:_TOUCHING]), _LINEARISED) @ T.T)
        self.remember(np.concatenate(found))

    def remember(self, x: Array) -> None:
        """Add states, (N, n)."""
        F, outside = self.field(x)
        dF = (self.field(x * (1 + _STEP))[0] - F) / _STEP
        self.x, self.F, self.dF = (np.concatenate(p) for p in ((self.x, x), (self.F, F), (self.dF, dF)))
        self.outside = np.concatenate([self.outside, outside])


def _solve(samples: _Samples, P: Array, alpha: float, radius: float) -> Array | None:
    """The next P, (n, n), which is `L M L'` for the present `P = LL'`; None if the solver does not solve for it."""
    n = len(P)
    L = np.linalg.cholesky(P)
    inverse = np.linalg.inv(L)
    h = samples.step

    def falls(M: Array, A: Array) -> Array:
        along = L.T @ A @ inverse.T
        rate = M @ along
        twice = rate + np.swapaxes(rate, -1, -2) + (h * _between(M, along) if h else 0.0)
        return np.asarray(-(twice + 2 * _LINEAR * alpha * M))

    matrices: list[Inequality] = [
        (lambda M: M, (1 - radius) * np.eye(n)),
        (lambda M: -M, -(1 + radius) * np.eye(n)),
        *((partial(falls, A=A), np.zeros((n, n))) for A in samples.corners.rates),
    ]
    for (lo, hi), column in zip(samples.loop.system.domain, inverse.T, strict=True):
        e = column / min(float(-lo), float(hi))
        matrices.append((lambda M: M, np.outer(e, e)))  # (P^-1)_ii <= d_i^2
    for a, b in [] if samples.constraints is None else samples.constraints.planes:
        e = inverse @ a / b
        matrices.append((lambda M: M, np.outer(e, e)))  # a'P^-1 a <= b^2
    held, least = list[Array](), list[Array]()
    for margin in (_SCORED * alpha, alpha):
        level, mu = samples.crossings(P, margin)
        inside = np.flatnonzero(_form(P, samples.x, samples.x) * (1 - radius) < 1)  # the others cannot come in
        rows = inside[np.argsort(level[inside], kind="stable")[:_ROWS]]
        z = samples.x[rows] @ L
        w = z - 2 * mu[rows, None] * ((samples.F[rows] + margin * samples.x[rows]) @ L)
        G = (z[:, :, None] * w[:, None, :] + w[:, :, None] * z[:, None, :]) / 2
        if h:
            v = samples.F[rows] @ L
            G = G - h * mu[rows, None, None] * v[:, :, None] * v[:, None, :]
        size = np.linalg.norm(G.reshape(len(rows), n * n), axis=1)
        held.append(G / size[:, None, None])
        least.append((np.minimum(1.0, level[rows]) - _SLACK) / size)
    entries = n * (n + 1) / 2
    samples.effort.charge(_SOLVER + _CONE * entries**2 * (sum(map(len, held)) + len(matrices) * entries))
    M = smallest_trace(matrices, np.concatenate(held), np.concatenate(least), _TOLERANCE)
    if M is None:
        return None
    new = L @ M @ L.T
    return np.asarray((new + new.T) / 2)


def _between(M: Array, B: Array) -> Array:
    """`B'MB` for each M (..., n, n), each product rounded before it is added: `@` rounds as the processor likes."""
    left = (B.T[:, :, None] * M[..., None, :, :]).sum(-2)
    return np.asarray((left[..., None] * B).sum(-2))


def _unit(z: Array) -> Array:
    return np.asarray(z / np.linalg.norm(z, axis=-1, keepdims=True))


def _form(P: Array, x: Array, y: Array) -> Array:
    return np.asarray(((x @ P) * y).sum(axis=-1))


def _g(P: Array, x: Array, F: Array, alpha: float, step: float) -> Array:
    """`D + 2 alpha V`."""
    value = 2 * _form(P, x, F + alpha * x)
    return value + step * _form(P, F, F) if step else value


def _log_det(P: Array) -> float:
    return float(np.linalg.slogdet(P)[1])
