"""The closed loop for learning: rates in floats, at the nominal plant and at the corners of the ranges.

A run reports its fate and integrals along its path. It converges if it enters the inner ellipsoid; it is lost if it
leaves the domain, violates a constraint, or its input leaves the bounds, because no set of a claim may contain such
states.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from certify.effort import UNLIMITED, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import keeping
from certify.loop.plants import corners
from certify.loop.plants.ode import DOUBLINGS, eigenvalues_of, fastest_at, lengthened, rk4_step
from certify.loop.policies import bounded_by_form
from certify.lyapunov.function import Quadratic

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_STEP = 0.5  # of the time constant of the fastest eigenvalue
_HORIZON = 12.0  # time constants of the slowest
_MAX_STEPS, _FEWEST_STEPS = 3000, 100
_RATE_SAMPLES = 300
_TRIED = 200  # runs by which the time is found that they last
_OFTEN = 4  # steps of a run after which its step is chosen anew
_SHELL = 0.75  # of c, inside of which nothing is asked
_NEAR = 0.93  # of a domain's half-width: from here on its faces are near

_CALL = 2e5  # operations of evaluating few states at once


class Fate(IntEnum):
    """The end of a run within the horizon."""

    UNDECIDED = 0
    CONVERGED = 1
    LOST = 2


@dataclass(frozen=True, slots=True)
class Runs:
    """Results of the runs from B states.

    Parameters
    ----------
    fate : each run's `Fate`, (B,).
    length : length of its path to the inner ellipsoid, in scaled states, (B,).
    nearness : the largest nearness to the domain's faces on its path, from 0 (not near) to 1 (on one), (B,).
    """

    fate: NDArray[np.int64]
    length: Array
    nearness: Array

    @property
    def converged(self) -> Mask:
        """True for each run that entered the inner ellipsoid, (B,)."""
        return np.asarray(self.fate == Fate.CONVERGED)


class LearningFlow:
    """The loop on its domain, with the inner ellipsoid {V <= c}.

    Parameters
    ----------
    loop : in continuous time, its input following the state at once.
    inner, c : matrix and level of the ellipsoid.
    """

    collar = 1.0  # of the values below that of the boundary, for which the function has to fall

    def __init__(self, loop: ClosedLoop, inner: Quadratic, c: float, effort: Effort = UNLIMITED) -> None:
        system = loop.system
        self.loop, self.V, self.c, self.n, self.effort = loop, inner, c, system.n, effort
        self.low, self.high = np.array([[float(end) for end in pair] for pair in system.domain]).T
        nominal, general = system.function(), system.uncertain_function()
        folded, u_eq = loop.folded, loop.u_eq  # once, not in every step
        policy: Callable[[Array], Array] = lambda x: np.asarray(folded(x, u_eq))  # noqa: E731
        self.policy = policy
        self.rate: Callable[[Array], Array] = lambda x: np.asarray(nominal(x, policy(x)))
        self._general, self._corners = general, [list(map(float, at.values())) for at in corners(system)]
        self._kept, self._limits = keeping(loop), None
        if not bounded_by_form(loop.network, system.input_bounds):
            self._limits = np.array([[float(end) for end in pair] for pair in system.input_bounds]).T
        generator = np.random.default_rng(0)
        rates = eigenvalues_of(self.rate, self.uniform(_RATE_SAMPLES, generator), self.high - self.low)
        self.step = _STEP / float(np.max(np.abs(rates), initial=1e-9))
        slowest = self._slowest()
        self._last(_HORIZON / max(slowest, 1e-9), slowest > 0)
        if slowest > 0:
            self._lengthen(self.uniform(_TRIED, generator))

    def _last(self, horizon: float, decays: bool = True) -> None:
        """Let runs last so long."""
        self.horizon, self.steps = horizon, min(_MAX_STEPS, math.ceil(horizon / self.step))
        self.by_state = decays and self.steps * self.step < horizon  # one step for all does not come so far

    def _lengthen(self, x: Array) -> None:
        """Let runs last as long as more of those from x (B, n) converge."""
        once = self.horizon

        def runs(at: NDArray[np.int64], k: int) -> tuple[Mask, Mask]:
            self._last(2**k * once)
            fate = self.run(x[at], np.ones(self.n)).fate
            return fate == Fate.CONVERGED, fate == Fate.UNDECIDED

        self._last(2 ** lengthened(*runs(np.arange(len(x)), 0), runs, DOUBLINGS) * once)

    def _slowest(self) -> float:
        """The rate at which the slowest motion about the origin decays; not positive if one does not."""
        at_rest = eigenvalues_of(self.rate, np.zeros((1, self.n)), self.high - self.low)
        return float(np.min(-at_rest.real, initial=math.inf))

    def uniform(self, count: int, generator: np.random.Generator) -> Array:
        """States of the domain, (count, n)."""
        return generator.uniform(self.low, self.high, (count, self.n))

    def faces(self, count: int, generator: np.random.Generator) -> Array:
        """States of the domain's faces, (count, n), as many of each."""
        x, each = self.uniform(count, generator), np.arange(count)
        axis = each % self.n
        x[each, axis] = np.where(each // self.n % 2 == 0, self.low[axis], self.high[axis])
        return x

    def inside(self, x: Array) -> Mask:
        """True for each state of the domain with its input within bounds and no constraint violated, (B,)."""
        within = np.all((x >= self.low) & (x <= self.high), axis=-1)
        if self._limits is not None:
            u = self.policy(x)
            within &= np.all((u >= self._limits[0]) & (u <= self._limits[1]), axis=-1)
        if self._kept is not None:
            within &= self._kept(x)
        return np.asarray(within)

    def directions(self, x: Array, scale: Array) -> Array:
        """Unit vectors of the rates in z = x / scale at each corner of what is uncertain, (C, B, n)."""
        self.effort.charge(_CALL + len(self._corners) * len(x) * self.loop.operations)
        u = self.policy(x)
        rates = np.stack([np.asarray(self._general(x, u, values)) for values in self._corners]) / scale
        return np.asarray(rates / (np.linalg.norm(rates, axis=-1, keepdims=True) + 1e-12))

    def is_home(self, x: Array) -> Mask:
        """True for each state from which nothing is asked any more, (B,)."""
        return np.asarray(self.V(x) <= self.c)

    def homes(self, count: int, generator: np.random.Generator) -> Array:
        """States (count, n), uniform in the inner ellipsoid."""
        x = generator.normal(size=(count, self.n))
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        x = x * generator.random((count, 1)) ** (1 / self.n)
        return np.asarray(x @ np.linalg.inv(np.linalg.cholesky(self.V.P / self.c)))

    def shell(self, count: int, generator: np.random.Generator) -> Array:
        """States (count, n) of the inner ellipsoid near its boundary."""
        y = generator.normal(size=(count, self.n))
        y *= np.sqrt(generator.uniform(_SHELL, 1.0, (count, 1))) / np.linalg.norm(y, axis=1, keepdims=True)
        return np.asarray(y @ np.linalg.inv(np.linalg.cholesky(self.V.P / self.c)))

    def run(self, starts: Array, scale: Array) -> Runs:
        """Simulate from states (B, n)."""
        middle, half = (self.low + self.high) / 2, (self.high - self.low) / 2
        fate = np.full(len(starts), Fate.UNDECIDED, dtype=np.int64)
        length, nearness, time = np.zeros((3, len(starts)))
        x, alive, step = starts, np.arange(len(starts)), np.full(len(starts), self.step)
        with np.errstate(all="ignore"):
            for k in range(self.steps):
                home, kept = self.is_home(x), self.inside(x)
                fate[alive[home & kept]], fate[alive[~kept]] = Fate.CONVERGED, Fate.LOST
                on = kept & ~home & (time[alive] < self.horizon)
                x, alive, step = x[on], alive[on], step[on]
                if not alive.size:
                    break
                relative = np.max(np.abs((x - middle) / half), axis=-1)
                close = np.clip((relative - _NEAR) / (1 - _NEAR), 0.0, 1.0) ** 2
                nearness[alive] = np.maximum(nearness[alive], close)
                self.effort.charge(_CALL + 5 * len(x) * self.loop.operations)
                step = self._steps_at(x) if self.by_state and k % _OFTEN == 0 else step
                after = rk4_step(self.rate, x, step[:, None])
                time[alive] += step
                length[alive] += np.linalg.norm((after - x) / scale, axis=-1)
                x = after
        return Runs(fate, length, nearness)

    def _steps_at(self, x: Array) -> Array:
        """A step for each state (B,), by the fastest eigenvalue there."""
        self.effort.charge(_CALL + 2 * self.n * len(x) * self.loop.operations)
        fastest = np.minimum(fastest_at(self.rate, x, self.high - self.low), _STEP / self.step)
        return np.asarray(np.minimum(_STEP / np.maximum(fastest, 1e-9), self.horizon / _FEWEST_STEPS))
