"""A tube of ellipsoids from a large set into the certified one, in any dimension.

V(t, x) = x'P(t)x, P(t) of degree 2 in t on each slab, must decrease along every trajectory with V <= 1. P moves at the
rate at which the closed loop moves the ellipsoid, and faster by what the models' remainders ask for: the matrix
inequality of rule `local`, with P's rate in it. Errors keep their direction, so that an ellipsoid is widened only where
the nonlinearity can widen it. The idea is set propagation with ellipsoids; no set is ever covered by many.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from certify.certificates import Slab
from certify.effort import UNLIMITED, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import kept_constraints
from certify.lyapunov import leaves_domain
from certify.provers.ball.cells import cut
from certify.provers.ball.decrease import Multipliers, corners_of, multipliers_for, rests_of
from certify.provers.ball.models import AT_CORNERS, Models, Paths, paths
from certify.provers.ball.steps import Cell, Steps, steps_of

Array = NDArray[np.float64]
Growth = Callable[[Array], Array]
WIDER = 1.05  # size of a slab's ball relative to the ellipsoid halfway: so far may the ends differ from that
_FILLED = 0.9  # share of what `WIDER` allows that the first guess of a slab's duration fills
_LONGEST = 0.5  # units of time of a slab
_SURPLUS = 1e-3  # decrease of V per unit of time that is left to the checker's rounding
_CORRECTIONS, SHORTENINGS = 5, 12  # corrections of a slab's rate, shortenings of its duration
MOST_SLABS, MOST_WORK = 4000, 2**26  # the second over n^4
_GROWTHS = 6  # growths of V that a slab asks for
_GROWN = 8.0  # logarithm of a volume, relative to the start, at which a tube is given up
KEPT = 1 - 1e-9  # share of a constraint's value at rest that it may gain on a ball
INSIDE = 1 - 1e-6  # share of the goal, beyond all rounding


@dataclass(frozen=True, slots=True)
class Tube:
    """From {(x - c)'P(x - c) <= 1}, P = `start` (n, n), c = `centre` (n,), through the slabs; None at rest, c = 0."""

    start: Array
    slabs: tuple[Slab, ...]
    centre: tuple[float, ...] | None = None

    @property
    def duration(self) -> float:
        """Units of time."""
        return math.fsum(slab.duration for slab in self.slabs)


@dataclass(frozen=True, slots=True)
class Around:
    """The closed loop on balls around the origin, in each cell of what is uncertain."""

    steps: Steps
    cells: Sequence[Cell]

    @staticmethod
    def of(loop: ClosedLoop, cuts: tuple[int, ...]) -> Around:
        """The loop whose ranges are cut into so many parts each."""
        return Around(steps_of(paths(loop), True, 1), cut(list(loop.system.ranges.values()), cuts))

    @property
    def loop(self) -> ClosedLoop:
        """The loop."""
        return self.steps.known.loop

    @property
    def operations(self) -> float:
        """Operations of models on a ball, about, as an `Effort` counts them."""
        return len(self.cells) * self.steps.known.operations

    @property
    def corners(self) -> int:
        """The inequalities that a coefficient of P asks for, at most."""
        return len(self.cells) << min(len(self.loop.system.ranges), AT_CORNERS)

    def models(self, J: Array) -> list[Models] | None:
        """F on the ball x = J d in each cell; None if one is not finite, or inputs are not certain to be in bounds."""
        found = self.steps.models(J, self.cells, np.zeros(len(J)))
        return found if all(one.finite and one.admitted for one in found) else None

    def keeps(self, J: Array) -> bool:
        """True if every constraint holds on such a ball."""
        keep = tuple(kept_constraints(self.loop.system).values())
        found = self.steps.largest(J[None], keep, self.cells) if keep else (np.zeros(0), np.zeros((1, 0)))
        return found is not None and bool(np.all(found[1] < -KEPT * found[0]))


def find_tube(known: Around, start: Array, goal: Array, effort: Effort = UNLIMITED) -> Tube | None:
    """A tube from {x'Px <= 1}, P = start, into that of `goal`; None if there is none to be had with the effort.

    Parameters
    ----------
    known : the closed loop at the origin.
    start, goal : (n, n), positive definite.
    """
    slabs: list[Slab] = []
    P, rate = start, None
    begin, domain = np.linalg.slogdet(start)[1], known.loop.system.domain
    most = min(MOST_SLABS, MOST_WORK // len(start) ** 4)
    with np.errstate(all="ignore"):  # an overflow shows nothing
        while not np.linalg.eigvalsh(P * INSIDE - goal)[0] > 0 or not slabs:
            if effort.over or len(slabs) == most or leaves_domain(P, 1.0, domain):
                return None
            try:
                made = _slab(known, P, rate, goal, effort)
            except np.linalg.LinAlgError:  # numbers that have no finite model, or an ellipsoid without extent
                return None
            if made is None or begin - np.linalg.slogdet(made.end)[1] > 2 * _GROWN:
                return None
            slabs.append(made)
            P, rate = made.end, 2 * (made.end - made.middle) / made.duration
    return Tube(start, tuple(slabs))


def _slab(known: Around, P: Array, rate: Array | None, weight: Array, effort: Effort) -> Slab | None:
    """One slab from {x'Px <= 1} on; `rate` is a guess of that of P.

    The multipliers are best where it counts, in the directions in which `weight` (n, n) is large.
    """
    if rate is None:
        J = WIDER * root(P)
        effort.charge(look(known))
        models = known.models(J)
        if models is None:
            return None
        rate = _back(-_growth(models, J, _multipliers(models, J, P, weight), P), J)
    duration = first_duration(P, rate)
    for _ in range(SHORTENINGS):
        middle = P + duration / 2 * rate
        if is_definite(middle):
            J = WIDER * root(middle)
            effort.charge(look(known))
            models = known.models(J)
            if models is not None and known.keeps(J):
                multipliers = _multipliers(models, J, P, weight)
                nodes = nodes_of(partial(_growth, models, J, multipliers), J, P, duration)
                if nodes is not None:
                    return Slab(*nodes, duration, J, multipliers.rows, multipliers.weight)
        duration *= 0.6
    return None


def nodes_of(growth: Growth, J: Array, P: Array, duration: float, room: float = 1.0) -> tuple[Array, Array] | None:
    """Middle and end after `duration`: V decreases on the slab, and its ball contains the three ellipsoids.

    `growth` gives for P the G (n, n) with 2 x'PF <= d'G d on the ball of J, and `room` is the level of the ellipsoids
    that the ball has to contain.

    P leaves its start at the rate that decrease asks for there, and reaches its end at one that is enough there and,
    with the first, halfway. To second order in the duration the two demands agree.
    """
    ball = J.T @ P @ J
    surplus, first = _SURPLUS * ball, growth(P)
    start_rate = -first - surplus
    middle = _symmetric(P + duration / 2 * _back(start_rate, J))
    if not (_contains(J, P, room) and _contains(J, middle, room)):
        return None
    halfway = growth(middle)
    asked = 2 * halfway + start_rate
    worst = asked
    for _ in range(_CORRECTIONS):
        end = _symmetric(middle + duration / 2 * _back(-worst - surplus, J))
        if not _contains(J, end, room):
            return None
        last = growth(end)
        rates = (2 * (middle - P), end - P, 2 * (end - middle))
        growths = (first, halfway, last)
        if all(np.linalg.eigvalsh(J.T @ r @ J / duration + g)[-1] < 0 for r, g in zip(rates, growths, strict=True)):
            return middle, end
        values, vectors = np.linalg.eigh(last - asked)  # the larger of both, in the sense of matrices
        worst = asked + 1.05 * (vectors * np.maximum(values, 0)) @ vectors.T
    return None


def _growth(models: Sequence[Models], J: Array, multipliers: Multipliers, P: Array) -> Array:
    """No less than that of any corner, in the sense of matrices."""
    corners = [corner for each in models for corner in corners_of(each, J, P)]
    first, *others = (rest - corner.decay for corner, rest in zip(corners, rests_of(corners, multipliers), strict=True))
    for growth in others:
        values, vectors = np.linalg.eigh(growth - first)
        first = first + (vectors * np.maximum(values, 0)) @ vectors.T
    return first


def _multipliers(models: Sequence[Models], J: Array, P: Array, weight: Array) -> Multipliers:
    return multipliers_for(models[0], P @ J, J.T @ weight @ J)


def first_duration(P: Array, rate: Array) -> float:
    """After which the ends differ from the ellipsoid halfway by what a ball allows."""
    from scipy.linalg import eigh

    fastest = float(np.max(np.abs(eigh(rate, P, eigvals_only=True))))
    return min(_LONGEST, 2 * _FILLED * (1 - WIDER**-2) / fastest) if fastest > 0 else _LONGEST


def _back(G: Array, J: Array) -> Array:
    """The matrix in x of the quadratic form d'G d, x = J d."""
    inverse = np.linalg.inv(J)
    return _symmetric(inverse.T @ G @ inverse)


def _symmetric(X: Array) -> Array:
    return np.asarray((X + X.T) / 2)


def _contains(J: Array, P: Array, room: float) -> bool:
    """True if {x'Px <= room} lies in {J d : ||d|| <= 1}."""
    return bool(np.linalg.eigvalsh(J.T @ P @ J)[0] > room / INSIDE)


def look(known: Paths | Around) -> float:
    """Operations to try one slab, about, as an `Effort` counts them."""
    corners = known.corners if isinstance(known, Around) else 1
    n, units = known.loop.system.n, known.loop.network.network.units
    return known.operations + corners * _GROWTHS * (3e5 + 30.0 * units * n**2 + 15.0 * n**5)


def root(P: Array) -> Array:
    """L with L L' = P^-1: {x'Px <= 1} is {L d : ||d|| <= 1}."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(P)).T)


def is_definite(P: Array) -> bool:
    return bool(np.linalg.eigvalsh(P)[0] > 0)
