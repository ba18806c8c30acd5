"""The loop for learning a set that is never left: runs end where trajectories of the domain end up.

The states there are those of long runs at their ends: an equilibrium, a limit cycle, whatever a loop does in the long
run. About them lies the *home*, a union of balls in scaled states, which takes the part of the inner ellipsoid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from certify.effort import UNLIMITED, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants.ode import rk4_step
from certify.lyapunov.function import Quadratic
from certify.lyapunov.learning.flow import LearningFlow

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_RUNS, _LAST = 400, 40  # runs, and states of each that are taken at its end
_RADIUS = 0.08  # of a ball, in the domain's half-widths
_APART = 0.4  # of a radius: closer states count once
_QUERY = 300.0  # operations, to find the nearest of them
_FEWEST = 8  # runs that stay


class StayingFlow(LearningFlow):
    """The loop on its domain, with the states around which simulated runs end up.

    Raises
    ------
    InputError : hardly any simulated run stays in the domain and keeps what is to be kept.
    """

    collar = 0.25

    def __init__(self, loop: ClosedLoop, generator: np.random.Generator, effort: Effort = UNLIMITED) -> None:
        super().__init__(loop, Quadratic(np.eye(loop.system.n)), 0.0, effort)
        self.half = (self.high - self.low) / 2
        self.ends = self._ends(generator)
        self.near = cKDTree(self.ends / self.half)

    def _slowest(self) -> float:
        """0: the origin need not be where anything decays to."""
        return 0.0

    def _ends(self, generator: np.random.Generator) -> Array:
        """The last states of long runs, (K, n)."""
        x = self.uniform(_RUNS, generator)
        with np.errstate(all="ignore"):
            for _ in range(self.steps):
                x = x[self.inside(x)]
                self.effort.charge(2e5 + 5 * len(x) * self.loop.operations)
                x = rk4_step(self.rate, x, self.step)
            x = x[self.inside(x)]
            if len(x) < _FEWEST:
                raise InputError(
                    f"at least {_FEWEST} of {_RUNS} simulated runs must stay in the domain and keep constraints and "
                    f"input bounds to learn from; {len(x)} do. Choose another domain, or give a function with "
                    "--lyapunov."
                )
            found = [x]
            for _ in range(_LAST):
                found.append(rk4_step(self.rate, found[-1], self.step))
        ends = np.concatenate(found)
        ends = ends[self.inside(ends)]
        _, some = np.unique(np.round(ends / self.half / (_APART * _RADIUS)), axis=0, return_index=True)
        return np.asarray(ends[some])

    def is_home(self, x: Array) -> Mask:
        """True for each state near one at which runs end up, (B,)."""
        found = np.zeros(len(x), dtype=bool)
        finite = np.all(np.isfinite(x), axis=-1)
        self.effort.charge(_QUERY * len(x))
        found[finite] = self.near.query(x[finite] / self.half, distance_upper_bound=_RADIUS)[0] < _RADIUS
        return found

    def homes(self, count: int, generator: np.random.Generator) -> Array:
        """States (count, n) in these balls."""
        return self._around(count, generator.random((count, 1)) ** (1 / self.n), generator)

    def shell(self, count: int, generator: np.random.Generator) -> Array:
        """States (count, n) at the boundaries of these balls, which may lie in others."""
        return self._around(count, np.ones((count, 1)), generator)

    def _around(self, count: int, share: Array, generator: np.random.Generator) -> Array:
        way = generator.normal(size=(count, self.n))
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        at = self.ends[generator.integers(len(self.ends), size=count)]
        return np.asarray(at + _RADIUS * share * way * self.half)
