"""Directions that measurements leave open, and the noise that they allow, for people: by linear programs.

Rows of the last box, `alpha + slopes.(errors, d)` within a slack of 0, bound a polytope of the parameters' symbols d in
[-1, 1]. It holds every consistent parameter, so that what it excludes is excluded; nothing here is a part of a proof.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from certify.provers.data import Identified

Array = NDArray[np.float64]
_TURNS = 3  # of the search for the widest direction, from each axis
_SHOWN = 3  # transitions that are named for a parameter
_SAFE = 1e-6  # by which a factor is rounded down
_DONE = 0  # the solver's answer


@dataclass(frozen=True, slots=True)
class Direction:
    """A direction in the space of parameters, in half-widths of their priors, the largest entry 1.

    `share` is the width of what is left along it, as a share of the priors; `telling` is the transition that says most
    about it, by its number.
    """

    entries: Mapping[str, float]
    share: float
    telling: int


@dataclass(frozen=True, slots=True)
class Polytope:
    """The parameters that rows leave: |alpha + g.d| <= 1, d in [-1, 1], for each row (M,), in units of its bound.

    Parameters
    ----------
    g : (M, K).
    error : the share of the bound that grows with the noise, (M,).
    transition : the number of each row's, (M,).
    scale : half-widths of the box relative to those of the priors, (K,).
    """

    names: tuple[str, ...]
    alpha: Array
    g: Array
    error: Array
    transition: NDArray[np.intp]
    scale: Array

    def least_noise(self) -> float | None:
        """A factor: with noise that is smaller by it or more the measurements contradict one another, whatever the
        parameters are; None if it was not found."""
        if not np.any(self.error > 0):
            return None
        K = len(self.names)
        A = np.vstack([np.column_stack([self.g, -self.error]), np.column_stack([-self.g, -self.error])])
        slack = 1 - self.error
        b = np.concatenate([slack - self.alpha, slack + self.alpha])
        bounds = [(-1.0, 1.0)] * K + [(0.0, None)]
        answer = linprog(np.eye(K + 1)[-1], A_ub=A, b_ub=b, bounds=bounds, method="highs")
        return max(0.0, float(answer.fun) * (1 - _SAFE)) if answer.status == _DONE else None

    def least_determined(self) -> Direction | None:
        """The direction in which most is left; None if linear programs do not find it."""
        if not len(self.alpha):
            return None
        found = [self._widest(k) for k in range(len(self.names))]
        known = [one for one in found if one is not None]
        if not known:
            return None
        direction = max(known, key=lambda one: float(np.linalg.norm(one)))
        axis = direction / np.linalg.norm(direction)
        size = np.abs(self.g @ (axis / self.scale))
        entries = axis / axis[np.argmax(np.abs(axis))]
        share = float(np.linalg.norm(direction)) / 2
        telling = int(self.transition[np.argmax(size)])
        return Direction(dict(zip(self.names, entries.tolist(), strict=True)), share, telling)

    def _widest(self, k: int) -> Array | None:
        """The difference (K,) of two points far apart, in half-widths of priors, from the search along an axis."""
        axis = np.eye(len(self.names))[k]
        for _ in range(_TURNS):
            ends = self._farthest(axis), self._farthest(-axis)
            if ends[0] is None or ends[1] is None:
                return None
            difference: Array = ends[0] - ends[1]
            length = float(np.linalg.norm(difference))
            if not length > 0:
                return difference
            axis = difference / length
        return difference

    def extreme(self, count: int) -> Array | None:
        """So many points (count, K) farthest along random directions, in half-widths of the box; None if linear
        programs do not find them."""
        found = [self._least(a) for a in np.random.default_rng(0).standard_normal((count, len(self.names)))]
        return np.array(found) if all(one is not None for one in found) else None

    def least(self, a: Array) -> float | None:
        """The least value of a.d; None if it was not found."""
        found = self._least(a)
        return None if found is None else float(a @ found)

    def _farthest(self, axis: Array) -> Array | None:
        """The point farthest along an axis, in half-widths of priors."""
        found = self._least(-axis * self.scale)
        return None if found is None else found * self.scale

    def _least(self, a: Array) -> Array | None:
        """A point d (K,) with the least a.d."""
        open_ = np.abs(self.alpha) + np.abs(self.g).sum(1) > 1  # others hold everywhere
        g, alpha = self.g[open_], self.alpha[open_]
        A, b = np.vstack([g, -g]), np.concatenate([1 - alpha, 1 + alpha])
        answer = linprog(a, A_ub=A, b_ub=b, bounds=(-1.0, 1.0), method="highs")
        return answer.x if answer.status == _DONE else None


def polytope_of(found: Identified) -> Polytope:
    """The parameters that are left, by what all transitions say of the last box."""
    rows, data = found.rows, found.measurements
    n, good = rows.alpha.shape[0], np.flatnonzero(rows.exist)
    kept = rows.at(good)
    noise = np.array([float(w) for w in data.noise])
    error = np.abs(kept.slopes[:, :n]).sum(1) + noise[:, None]
    unit = (kept.slack + error).ravel()
    widths = [float(hi - lo) for lo, hi in found.ranges.values()]
    priors = [float(hi - lo) for lo, hi in data.priors.values()]
    return Polytope(
        tuple(data.priors),
        kept.alpha.ravel() / unit,
        kept.slopes[:, n:].swapaxes(1, 2).reshape(kept.alpha.size, len(data.priors)) / unit[:, None],
        error.ravel() / unit,
        np.tile(good, n),
        np.maximum(np.array(widths) / np.array(priors), np.finfo(np.float64).tiny),
    )


def showing(found: Identified) -> dict[str, tuple[int, ...]]:
    """The transitions, by their numbers, that count most in the last round that moved an end of each parameter's range.

    A range that comes from a partition of the priors alone has none.
    """
    at, names = np.flatnonzero(found.used), list(found.ranges)
    chosen = dict[str, tuple[int, ...]]()
    for k, name in enumerate(names):
        total = np.zeros(len(at))
        for side in (0, 1):
            last = next((each for each in reversed(found.bounds.rounds) if np.any(each.weights[side, k])), None)
            if last is not None:
                weights = np.abs(last.weights[side, k]).sum(1)
                total += weights / weights.sum()
        order = np.argsort(-total, kind="stable")[:_SHOWN]
        chosen[name] = tuple(int(at[t]) for t in order if total[t] > 0)
    return chosen
