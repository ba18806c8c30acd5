"""The loop at the corners of its ranges: linearisations, and the rate of a step at the corner where V grows most.

Sampling at the nominal values alone chooses a V that decreases nowhere else: where a mass is known to 20 %, the set
that is then proved is some hundred times smaller than that of a V that decreases at every corner (Boyd, El Ghaoui,
Feron, Balakrishnan, section 5.1: quadratic stability of a polytope of linear loops).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from certify.errors import BackendError, InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import at_values, corners, mean_rate
from certify.lyapunov.candidates import increment_matrix, slowest_decay
from certify.lyapunov.programs import smallest_trace

Array = NDArray[np.float64]
_ALIKE, _AT_REST = 1e-9, 1e-9  # relative difference of linearisations that count as one; a rate that counts as none
_SHARES = (0.5, 0.3, 0.2, 0.1, 0.05, 0.02, 0.005)  # of the slowest decay of all corners, that V is to have
_TOLERANCE = 1e-8  # of the solver


class Corners:
    """A closed loop at the corners of its ranges, or with nominal values alone if it has none, or does not rest at the
    origin at every corner: near there no V decreases then.

    `rates` are its different linearisations L (n, n), G = L x to first order.
    """

    def __init__(self, loop: ClosedLoop) -> None:
        self.loop, self.step = loop, loop.step
        at = corners(loop.system) if loop.system.ranges else ()
        self.nominal, self.f = loop.system.function(), loop.system.uncertain_function()
        at = at if all(self._rests(list(map(float, corner.values()))) for corner in at) else ()
        self.values = [[float(q) for q in corner.values()] for corner in at]
        self.rates = [loop.mean_rate()]
        for corner in at:
            L = ClosedLoop(at_values(loop.system, corner), loop.network).mean_rate()
            if all(np.abs(L - other).max() > _ALIKE * np.abs(L).max() for other in self.rates):
                self.rates.append(L)

    @property
    def operations(self) -> float:
        """Operations of `worst` at one state, as an `Effort` counts them: the policy's once, f's at every corner."""
        return self.loop.operations + max(0, len(self.values) - 1) * self.loop.of_equations

    @property
    def slowest(self) -> float:
        """The slowest decay of all linearisations, in 1/time; not positive if one is not stable."""
        return min(slowest_decay(L, self.step) for L in self.rates)

    def worst(self, x: Array, u: Array, P: Array | None) -> Array:
        """G (..., n) at the corner where x'Px grows most; nominal values count where P is not given."""
        system, h = self.loop.system, self.step
        if P is None or not self.values:
            return np.asarray(mean_rate(system, self.nominal, x, u, h))
        found = most = None
        for values in self.values:
            G = np.asarray(mean_rate(system, partial(self._at, values), x, u, h))
            grows = ((x @ P) * (2 * G) + h * (G @ P) * G).sum(-1)
            grows = np.where(np.isfinite(grows), grows, np.inf)
            if found is None or most is None:
                found, most = G, grows
            else:
                take = grows > most
                found, most = np.where(take[..., None], G, found), np.where(take, grows, most)
        return found if found is not None else np.zeros_like(x)

    def _rests(self, values: Sequence[float]) -> bool:
        """True if the loop rests at the origin with these values, up to rounding."""
        x = np.zeros(self.loop.system.n)
        away = np.abs(mean_rate(self.loop.system, partial(self._at, values), x, self.loop.policy(x), self.step))
        return bool(np.max(away) <= _AT_REST)

    def _at(self, values: Sequence[float], x: Array, u: Array) -> Array:
        return np.asarray(self.f(x, u, values))

    def decrease(self, P: Array) -> bool:
        """True if x'Px decreases along all linearisations."""
        return all(np.all(np.linalg.eigvalsh(increment_matrix(P, L, self.step)) < 0) for L in self.rates)

    def common(self, start: Array) -> Array:
        """The start if it decreases along all linearisations, else a P (n, n) that does, of small condition.

        Raises
        ------
        BackendError : a corner is not stable, or no common P is found.
        """
        if self.decrease(start):
            return start
        if not self.slowest > 0:
            raise BackendError("the loop must be stable at every corner of the ranges; it is not.")
        half = np.array([float(min(-lo, hi)) for lo, hi in self.loop.system.domain])
        scaled = [L * half[None] / half[:, None] for L in self.rates]
        for share in _SHARES:
            M = self._solved(scaled, share * self.slowest)
            if M is not None:
                P = M / half[:, None] / half[None]
                P = np.asarray((P + P.T) / 2)
                if self.decrease(P):  # the solver knows this to its tolerance only
                    return P
        raise BackendError("no quadratic V is found that decreases at all corners of the ranges near the origin.")

    def _solved(self, rates: list[Array], decay: float) -> Array | None:
        n = len(rates[0])

        def falls(L: Array, M: Array) -> Array:
            twice = M @ L + np.swapaxes(M @ L, -1, -2) + self.step * (L.T @ M @ L)
            return np.asarray(-(twice + 2 * decay * M))

        matrices = [(lambda M: M, np.eye(n)), *((lambda M, L=L: falls(L, M), np.zeros((n, n))) for L in rates)]
        rows = np.eye(n)[None] / n  # a condition that always holds: the trace is at least 1
        try:
            return smallest_trace(matrices, rows, np.ones(1), _TOLERANCE)
        except InputError:
            return None
