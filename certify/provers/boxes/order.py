"""The order of the series in time on boxes, where an input is held: a few points decide it.

A longer series costs more for each box and leaves a smaller remainder, which no splitting takes away. The distance of
D' from 0 by the bound at a point counts, because boxes must be as small as it allows: their number grows about as its
power -n/2. Most boxes lie where that is worst, and so those places are looked for. Costs are fixed numbers and not
measured, so that a run gives the same certificate each time.

A state that passes a corner of abs, min, max or clip within a period has no series: there the mean of f on all of the
period, order 1, is all that is known, and it is taken if that suffices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from certify.certificates.claims import Problem
from certify.loop.expressions import cornered
from certify.provers.boxes.rule import VdotBound

Array = NDArray[np.float64]
_COSTS = {2: 1.0, 3: 1.5, 4: 2.1}  # cost of a box relative to order 2, by the order
_POINTS, _WORST, _ROUNDS = 64, 8, 4  # points of a round, and how many of them the next one starts from
_MANY = 10_000  # points that are looked at for corners, which few points may miss
_LEAST = 1e-2  # share of the decay by the longest series: below it a point cannot be had at any price


def choose_order(problem: Problem, T: Array, inner: float, outer: float) -> int:
    """The order with which a ring, in coordinates x = T z, probably costs least; 1 where no input is held."""
    if problem.loop.system.sample is None:
        return 1
    n = problem.loop.system.n
    generator = np.random.default_rng(0)
    rules = {order: VdotBound(problem, T, order=order) for order in _COSTS}
    z = generator.standard_normal((n, _POINTS))
    z *= np.sqrt(inner * (outer / inner) ** generator.random(_POINTS)) / np.linalg.norm(z, axis=0)
    shares: dict[int, list[Array]] = {order: [] for order in _COSTS}
    for k in range(_ROUNDS):
        bounds = {order: rule.at_points(z, outer) for order, rule in rules.items()}
        longest = bounds[max(_COSTS)]
        for order, bound in bounds.items():
            shares[order].append((np.minimum(bound, 0.0) / longest)[longest < 0].clip(_LEAST, 1.0))
        worst = np.argsort(-bounds[min(_COSTS)] / (z * z).sum(0), kind="stable")[:_WORST]
        z = np.repeat(z[:, worst], _POINTS // _WORST, axis=1)
        size = np.linalg.norm(z, axis=0)
        z = z + 0.3 * 0.5**k * size / n**0.5 * generator.standard_normal(z.shape)
        z *= size / np.linalg.norm(z, axis=0)

    def cost(order: int) -> float:
        found = np.concatenate(shares[order])
        return _COSTS[order] * float(np.mean(found ** (-n / 2))) if len(found) else _COSTS[order]

    if any(cornered(*problem.loop.system.dynamics)) and _needs_the_mean(problem, T, inner, outer):
        return 1
    return min(_COSTS, key=cost)


def _needs_the_mean(problem: Problem, T: Array, inner: float, outer: float) -> bool:
    """True if the mean of f shows more points of the ring than the shortest series does."""
    n, generator = problem.loop.system.n, np.random.default_rng(1)
    z = generator.standard_normal((n, _MANY))
    z *= np.sqrt(inner + (outer - inner) * generator.random(_MANY)) / np.linalg.norm(z, axis=0)
    mean, series = (VdotBound(problem, T, order=order).at_points(z, outer) < 0 for order in (1, min(_COSTS)))
    return int(mean.sum()) > int(series.sum())
