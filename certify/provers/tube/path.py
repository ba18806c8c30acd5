"""A tube of ellipsoids around one trajectory into the certified set: that a state, with what lies around it, converges.

W(t, x) = e'P(t)e, e = x - c(t), must decrease along every trajectory where it is 1. The centre c(t) is a simulated
trajectory, joined by lines; whatever it misses by, and whatever the models' remainders ask for, widens the ellipsoid.
As in tube.py errors keep their direction. The motion of the centre on a slab is one more symbol of the models, so that
they hold for the whole slab at once.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from certify.certificates import Slab, Waypoint
from certify.effort import UNLIMITED, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants.ode import rk4_step
from certify.provers.ball.decrease import Multipliers, decay_of, multipliers_for, rest_of, short
from certify.provers.ball.models import Models, paths
from certify.provers.tube.tube import (
    INSIDE,
    MOST_SLABS,
    MOST_WORK,
    SHORTENINGS,
    WIDER,
    Tube,
    first_duration,
    is_definite,
    look,
    nodes_of,
    root,
)

Array = NDArray[np.float64]
Flow = Callable[[Array], Array]
_SHARE = 0.25  # share of a slab's ball that the motion of its middle takes
_ROOM = 1 / (1 - _SHARE**2)
_FIRST, _LONGEST, _LONGER = 0.02, 0.5, 1.5  # units of time of a slab; growth from one to the next
_SHORTEST = 1e-3  # units of time of a slab, with less of which the tube may be on its way into a constraint
_STEPS = 8  # steps of the simulation for each slab
_MOST_TIME = 1000.0  # units of time, after which a path that has not arrived is given up
_GROWN = 12.0  # logarithm of a volume, relative to the start, at which a tube is given up


def find_path(
    loop: ClosedLoop, centre: Array, start: Array, goal: Array, effort: Effort = UNLIMITED
) -> tuple[Tube | None, str]:
    """A tube from {(x - c)'P(x - c) <= 1}, P = start, c = centre, into {x'Px <= 1}, P = goal; None and why there is
    none.

    Parameters
    ----------
    centre : (n,), the state from which the path goes.
    start, goal : (n, n), positive definite.
    """
    f = loop.system.function()

    def flow(x: Array) -> Array:
        return np.asarray(f(x, loop.policy(x)))

    slabs: list[Slab] = []
    P, c, rate, duration = start, centre, None, _FIRST
    begin, most = np.linalg.slogdet(start)[1], min(MOST_SLABS, MOST_WORK // len(start) ** 4)
    spent = 0.0
    with np.errstate(all="ignore"):  # an overflow shows nothing
        while not slabs or not _has_arrived(P, c, goal):
            if effort.over:
                return None, f"the effort ended after {len(slabs)} slabs, which take {spent:.3g} units of time"
            if len(slabs) == most or spent > _MOST_TIME:
                return None, f"the path has not arrived after {spent:.3g} units of time and {len(slabs)} slabs"
            if not _is_in_domain(loop, P, c):
                return None, f"the tube leaves the domain after {spent:.3g} units of time"
            try:
                slab = _slab(loop, flow, P, c, rate, goal, duration, effort)
            except np.linalg.LinAlgError:  # numbers that have no finite model, or an ellipsoid without extent
                slab = None
            shortest = _SHORTEST if loop.system.constraints else 0.0
            if slab is None or slab.duration < shortest:
                wide = WIDER * math.sqrt(_ROOM) * root(P) / (1 - _SHARE)
                if shortest and not paths(loop, c).keeps(wide):
                    return None, f"the tube may violate a constraint after {spent:.3g} units of time"
            if slab is None or slab.path is None or begin - np.linalg.slogdet(slab.end)[1] > 2 * _GROWN:
                return None, f"the tube cannot be continued after {spent:.3g} units of time"
            around = [(Q, x) for Q in (P, slab.middle, slab.end) for x in (c, slab.path.centre)]
            if not all(_is_in_domain(loop, Q, x) for Q, x in around):
                return None, f"the tube leaves the domain after {spent:.3g} units of time"
            slabs.append(slab)
            spent += slab.duration
            rate = 2 * (slab.end - slab.middle) / slab.duration
            P, c, duration = slab.end, slab.path.centre, min(_LONGEST, _LONGER * slab.duration)
    return Tube(start, tuple(slabs), tuple(centre.tolist())), ""


def after(flow: Flow, x: Array, duration: float) -> Array:
    """The simulated state after that time, (n,)."""
    for _ in range(_STEPS):
        x = rk4_step(flow, x, duration / _STEPS)
    return x


@dataclass(frozen=True, slots=True)
class _Along:
    """The models on a slab's ball, z = J^-1 e and the motion being their symbols, and what widens its ellipsoids.

    W grows by at most e'(G + rate) e where it is 1, G the growth.
    """

    models: Models
    J: Array
    moved: Array  # F - v at the middle, (n,)
    multipliers: Multipliers
    edge: float
    motion: float

    def growth(self, P: Array) -> Array:
        """G (n, n) of `nodes_of`; infinite where the motion's part does not leave any."""
        n, whole, linear = self._parts(P)
        room, last = self.edge - self.motion * _SHARE**2, self.motion - whole[n, n]
        if not (room > 0 and last > 0):
            return np.full((n, n), math.inf)
        coupled = whole[:n, n]
        inner = whole[:n, :n] + self.edge * self.J.T @ P @ self.J
        return np.asarray(inner + np.outer(linear, linear) / room + np.outer(coupled, coupled) / last)

    def balanced(self, P: Array, weight: Array) -> _Along:
        """With the multipliers of edge and motion that widen {e'Pe <= 1} least, as `weight` (n, n), in z, measures."""
        n, whole, linear = self._parts(P)
        by_edge, coupled = float(np.trace(weight @ self.J.T @ P @ self.J)), whole[:n, n]
        room = math.sqrt(float(linear @ weight @ linear) / by_edge)
        last = math.sqrt(float(coupled @ weight @ coupled) / by_edge) / _SHARE
        least = 1e-9 * (room + last) + 1e-15 * float(np.abs(whole).max())
        motion = float(short(np.array(1.05 * max(whole[n, n], 0.0) + max(last, least))))
        edge = float(short(np.array(max(room, least) * 1.02 + motion * _SHARE**2 * 1.06)))
        return _Along(self.models, self.J, self.moved, self.multipliers, edge, motion)

    def _parts(self, P: Array) -> tuple[int, Array, Array]:
        """n, and what W grows by over z and the motion: its form (n + 1, n + 1), and half its linear part (n,)."""
        n, b = len(P), np.append(P @ self.J, np.zeros((len(P), 1)), axis=1)
        whole = rest_of(self.models, b, self.multipliers) - decay_of(self.models, self.J, b)
        return n, whole, self.moved @ b[:, :n]


def _slab(
    loop: ClosedLoop, flow: Flow, P: Array, c: Array, rate: Array | None, goal: Array, duration: float, effort: Effort
) -> Slab | None:
    """One slab from {e'Pe <= 1} around c on, of at most that duration; `rate` is a guess of that of P."""
    if rate is not None:
        duration = min(duration, first_duration(P, rate))
    for _ in range(SHORTENINGS):
        middle = P if rate is None else P + duration / 2 * rate
        end = after(flow, c, duration)
        if is_definite(middle) and np.all(np.isfinite(end)):
            J = WIDER * math.sqrt(_ROOM) * root(middle)
            known = paths(loop, (c + end) / 2)
            effort.charge(2 * look(known))
            ball = np.append(J, ((end - c) / (2 * _SHARE))[:, None], axis=1)
            models = known.models(ball)
            if models.finite and models.admitted and known.keeps(ball):
                along = _multipliers(models, J, models.f - (end - c) / duration, middle, J.T @ goal @ J)
                nodes = nodes_of(along.growth, J, P, duration, _ROOM)
                if nodes is not None:
                    rows, weight = along.multipliers.rows, along.multipliers.weight
                    way = Waypoint(end, _SHARE, along.edge, along.motion, float(rows[2, -1]))
                    return Slab(*nodes, duration, J, rows[:, :-1], weight, way)
        duration *= 0.6
    return None


def _multipliers(models: Models, J: Array, moved: Array, P: Array, weight: Array) -> _Along:
    """The multipliers with the least trace of weight times the terms that widen the ellipsoid.

    The motion costs its share of the edge, by which the motion's own direction is weighed.
    """
    n = len(P)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n] = weight
    whole[n, n] = float(np.trace(weight @ J.T @ P @ J)) * _SHARE**2
    b = np.append(P @ J, np.zeros((n, 1)), axis=1)
    along = _Along(models, J, moved, multipliers_for(models, b, whole), 0.0, 0.0)
    return along.balanced(P, weight)


def _has_arrived(P: Array, c: Array, goal: Array) -> bool:
    left = 1 - math.sqrt(float(c @ goal @ c))
    return left > 0 and bool(np.linalg.eigvalsh(P * INSIDE - goal / left**2)[0] > 0)


def _is_in_domain(loop: ClosedLoop, P: Array, c: Array) -> bool:
    reach = np.sqrt(np.diag(np.linalg.inv(P))) / INSIDE
    domain = np.array([[float(lo), float(hi)] for lo, hi in loop.system.domain])
    return bool(np.all(domain[:, 0] < c - reach) and np.all(c + reach < domain[:, 1]))
