"""The candidate `economical`: P for the largest set that a given number of boxes is forecast to prove.

A policy that bends much is enclosed with an error that falls with the square of a box's size, and where V decreases
little the boxes must be small. Let e_j be the error of input j on a box of the share r of its distance from the
origin, in coordinates in which {V <= 1} is a ball. Of such a box `m = -Vdot / sum_j |dVdot/du_j| e_j` says how much
larger the error could be, so that one of the share r sqrt(m) is proved, and {V <= c} takes about the integral of
m^(-n/2) boxes, which samples estimate. Halvings that overshoot, boxes that stick out of the set, and those that are
divided themselves multiply that by a factor, which is measured. For fixed states m is a quotient of a linear and of a
convex function of P, and does not depend on P's scale: each round minimises the forecast over P in a trust region, and
then takes the level that the boxes reach. Where time goes in steps, the mean rate of V over a step stands for Vdot.

Directions in which V decreases little, or grows, may be too few for samples. So the slowest decrease of the linear
part, of a V of length 1, is kept above a share of the slowest mode's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import mean_rate
from certify.lyapunov import diagonalising_coordinates, domain_limit, increment_matrix, slowest_decay, volume
from certify.provers.bounds import operations_of_policy, policy_enclosure

Array = NDArray[np.float64]
STATES, FEW_STATES = 2000, 500  # for a candidate, and for a comparison of some
NEAREST = 0.1  # distance from the origin, of 1, from which on they are sampled
OVERHEAD = 8.0  # boxes for each that is forecast, times 2^(n/2)
LEAST = 1e-2  # m, of where nothing would be proved
_SHARE = 0.1  # the size of their boxes
_FLOW = 8  # evaluations of f for a period in which the input is held
_SLOW = 0.2  # share of the slowest mode's decrease, below which no direction is to fall
_HARD = 100.0  # the price of a direction without decrease
_ROUNDS, _TRUST, _MOST_TRUST, _LEAST_TRUST = 12, 0.15, 0.3, 0.01  # of the entries of X, P = L (1 + X) L'
_STEPS = 60  # of a minimisation
_SCALINGS, _CORRECTIONS = 6, 2  # of a level from the domain's limit, and from one near by
_BELOW = 1 - 1e-9  # share of the domain's limit


@dataclass(frozen=True)
class _Sampled:
    """The mean rate G of a step from each state, (N, n), and how much G changes with each input's error on its box,
    (N, m, n). V changes by 2 middle'P G, `middle` being halfway to the step's `end`, (N, n) each; a small change of G
    changes that by 2 end'P times it."""

    G: Array
    errors: Array
    middle: Array
    end: Array

    def margins(self, P: Array) -> Array:
        """m of each state, (N,)."""
        asked = np.abs((self.errors * (2 * self.end @ P)[:, None]).sum(-1)).sum(-1)
        with np.errstate(all="ignore"):
            found = -(2 * self.middle @ P * self.G).sum(-1) / asked
        return np.asarray(np.where(np.isfinite(found), found, 0.0))


class Forecast:
    """A forecast of the boxes that {x'Px <= level} takes, from the same directions for every P.

    Parameters
    ----------
    loop : with ranges, a forecast takes a corner of them for each sample.
    effort : to which the samples are charged.
    states, seed : how many are sampled, and the seed of their directions.
    """

    def __init__(self, loop: ClosedLoop, effort: Effort = UNLIMITED, states: int = STATES, seed: int = 0) -> None:
        generator, self.loop, self.effort, n = np.random.default_rng(seed), loop, effort, loop.system.n
        z = generator.standard_normal((states, n))
        self.radii = np.exp(generator.uniform(math.log(NEAREST), 0.0, states))
        self.z = z / np.linalg.norm(z, axis=1, keepdims=True) * self.radii[:, None]
        ranges = [np.array([float(end) for end in ends]) for _, ends in loop.system.uncertain]
        values, f = [ends[generator.integers(2, size=states)] for ends in ranges], loop.system.uncertain_function()
        self.enclosure, self.f = policy_enclosure(loop), lambda x, u: f(x, u, values)
        sphere = 2 * math.pi ** (n / 2) / math.gamma(n / 2)
        alike = sphere * -math.log(NEAREST) / (2 * _SHARE) ** n  # boxes of this share between the radii
        self.unit = OVERHEAD * 2 ** (n / 2) * alike
        self.A = loop.mean_rate()
        self.slow = _SLOW * slowest_decay(self.A, loop.step)

    def sampled(self, P: Array, level: float) -> _Sampled:
        """The states of {x'Px <= level}, each with the errors on its box."""
        loop, n, m, h = self.loop, self.loop.system.n, self.loop.system.m, self.loop.step
        steps = (m + 1) * (_FLOW if loop.system.sample else 1)
        self.effort.charge(len(self.z) * (operations_of_policy(loop.network) + steps * loop.operations))
        T = diagonalising_coordinates(P, self.A, loop.step)
        T = T / np.sqrt(np.diag(T.T @ P @ T))
        x = math.sqrt(level) * np.linalg.solve(np.linalg.cholesky(P).T, self.z.T).T
        reach = math.sqrt(level) * _SHARE * self.radii
        boxes = np.concatenate([x.T[:, None], T[:, :, None] * reach], 1)
        wide = self.enclosure(boxes, np.zeros((n, len(self.z))))[2]
        u = loop.policy(x)
        G = mean_rate(loop.system, self.f, x, u, h)
        moved = [
            mean_rate(loop.system, self.f, x, u + wide[j][:, None] * one, h) - G for j, one in enumerate(np.eye(m))
        ]
        return _Sampled(G, np.stack(moved, 1), x + h / 2 * G, x + h * G)

    def boxes(self, P: Array, level: float) -> float:
        """The number of boxes."""
        return self._count(self.sampled(P, level).margins(P))

    def _count(self, margins: Array) -> float:
        """The number of boxes by the samples' m."""
        return float(self.unit * np.mean(np.maximum(margins, LEAST) ** (-self.loop.system.n / 2)))

    def level(self, P: Array, boxes: float, about: float = math.inf) -> float:
        """The level inside the domain that about so many boxes prove, near that which it is `about`."""
        most = domain_limit(P, self.loop.system.domain) * _BELOW
        level = min(most, about)
        for _ in range(_SCALINGS if about == math.inf else _CORRECTIONS):
            factor = (boxes / self.boxes(P, level)) ** (2 / self.loop.system.n)
            if factor >= 1 and level == most:
                break
            level = min(most, level * min(max(factor, 0.1), 4.0))
        return level

    def easier(self, P: Array, level: float, trust: float) -> Array:
        """P (n, n) of the same determinant for which the present states need the fewest boxes, near the present one."""
        n, found, L = len(P), self.sampled(P, level), np.linalg.cholesky(P)
        slow = min(self.slow, 0.999 * self.decrease(P))
        A, h = L.T @ self.A @ np.linalg.inv(L.T), self.loop.step
        rows = np.triu_indices(n)
        along = _products(found.middle @ L, found.G @ L)
        asked = _products((found.end @ L)[:, None], found.errors @ L)
        often = np.where(rows[0] == rows[1], 1.0, 2.0)

        def forecast(v: Array) -> tuple[float, Array]:
            """The logarithm of the forecast and its gradient."""
            M = _symmetric(v, rows, n)
            fall, each = -np.einsum("kij,ij->k", along, M), np.einsum("kuij,ij->ku", asked, M)
            size = np.abs(each).sum(1)
            m = fall / size
            inside = m > LEAST
            weight = np.maximum(m, LEAST) ** (-n / 2)
            total = weight.sum()
            by = np.where(inside, -n / 2 * weight / np.maximum(m, LEAST), 0.0) / total - ~inside
            gradient = np.einsum("k,kij->ij", -by / size, along)
            gradient -= np.einsum("ku,kuij->ij", (by * m / size)[:, None] * np.sign(each), asked)
            value = math.log(total) + np.maximum(LEAST - m, 0.0).sum()
            if slow > 0:
                values, vectors = np.linalg.eigh(-increment_matrix(M, A, h) - 2 * slow * M)
                short = _HARD * np.maximum(2 - values / slow, 0.0)
                value += (short**2).sum() / (2 * _HARD)
                along_short = (vectors * short) @ vectors.T
                gradient += (increment_matrix(along_short, A.T, h) + 2 * slow * along_short) / slow
            return float(value), gradient[rows] * often

        from scipy.optimize import minimize  # which a proof that asks no forecast does not load

        with np.errstate(all="ignore"):
            start = np.eye(n)[rows]
            bounds = [(v - trust, v + trust) for v in start]
            options = {"maxiter": _STEPS}
            v = minimize(forecast, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options).x
        values, vectors = np.linalg.eigh(_symmetric(np.asarray(v), rows, n))
        M = (vectors * np.maximum(values, 1 - 2 * trust)) @ vectors.T
        new = L @ M @ L.T / np.linalg.det(M) ** (1 / n)
        new = (new + new.T) / 2
        while slow > 0 and self.decrease(new) < slow:  # which P has, and so have all in some part of the way to it
            new = (P + new) / 2
        return np.asarray(new / np.linalg.det(new) ** (1 / n) * np.linalg.det(P) ** (1 / n))

    def decrease(self, P: Array) -> float:
        """The largest r for which V of the linear part falls at least as `exp(-2 r t)` does at first."""
        half = np.linalg.solve(L := np.linalg.cholesky(P), increment_matrix(P, self.A, self.loop.step))
        return float(-np.linalg.eigvalsh(np.linalg.solve(L, half.T)).max() / 2)


def economical_candidate(loop: ClosedLoop, starts: Sequence[Array], boxes: float, effort: Effort = UNLIMITED) -> Array:
    """P (n, n), scaled so that about {x'Px <= 1} is proved by this number of boxes, for the largest such set found.

    Parameters
    ----------
    loop : a closed loop.
    starts : (n, n) each, of which the best is improved.
    """
    rough, forecast = Forecast(loop, effort, FEW_STATES), Forecast(loop, effort)
    levels = [rough.level(P, boxes) for P in starts]
    P, level = max(zip(starts, levels, strict=True), key=lambda one: volume(*one))
    level = forecast.level(P, boxes, level)
    trust = _TRUST
    for _ in range(_ROUNDS):
        if effort.over or trust < _LEAST_TRUST:
            break
        new = forecast.easier(P, level, trust)
        reached = forecast.level(new, boxes, level)
        trust = min(_MOST_TRUST, 1.3 * trust) if reached > level else trust / 2
        if reached > level:
            P, level = new, reached
    return P / level


def _products(x: Array, y: Array) -> Array:
    """x y' + y x' of vectors (..., n), (..., n, n)."""
    return np.asarray(x[..., :, None] * y[..., None, :] + y[..., :, None] * x[..., None, :])


def _symmetric(v: Array, rows: Any, n: int) -> Array:
    M = np.zeros((n, n))
    M[rows] = v
    return np.asarray(M + M.T - np.diag(np.diag(M)))
