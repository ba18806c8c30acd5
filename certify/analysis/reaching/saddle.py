"""Saddles of a loop in steps, and states that stay beside one for ever, shown in Arb.

In coordinates x = x* + V w, the first of which grows, let N be the set |w_1| <= r, |(w_2, ...)| <= r. If a step takes
the sides w_1 = -r and w_1 = r beyond w_1 = -r and w_1 = r, or beyond each other's, and all of N to |(w_2, ...)| < r,
then each curve in N from side to side has a part that a step takes to such a curve. So has each part of that, and the
states that they have in common stay in N for ever (covering relations: Zgliczynski and Gidea 2004).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import flint
import numpy as np
from numpy.typing import NDArray

from certify.loop.closed_loop import ClosedLoop
from certify.loop.rigorous import Balls, matrix, points, step_on

Array = NDArray[np.float64]
_SIZES = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6)  # of N, in units of the coordinates
_APART = 1e9  # condition of the coordinates
_INSIDE, _BEYOND = 0.8, 1.05  # of N: what floats ask of a curve that crosses it


@dataclass(frozen=True, slots=True)
class Saddle:
    """N around a saddle: its middle `x` (n,), V (n, n), r, and the balls X that hold N."""

    x: Array
    V: Array
    r: float

    @property
    def X(self) -> Balls:
        """Balls that hold N."""
        reach = matrix(np.abs(self.V)) * flint.arb_mat([[flint.arb(self.r)]] * len(self.x))
        return [v + flint.arb(0, 1) * reach[i, 0] for i, v in enumerate(points(self.x))]

    def crossed_after(self, course: Array) -> int | None:
        """The number of steps, at least one, after which the line between two runs, (N, 2, n) in floats, crosses N."""
        w = np.linalg.solve(self.V, (course - self.x).reshape(-1, len(self.x)).T).T.reshape(course.shape) / self.r
        apart = (w[:, :, 0].min(1) < -_BEYOND) & (w[:, :, 0].max(1) > _BEYOND)
        found = np.flatnonzero((apart & (np.linalg.norm(w[:, :, 1:], axis=2).max(1) < _INSIDE))[1:])
        return 1 + int(found[0]) if len(found) else None

    def is_crossed(self, m: Balls, D: Balls) -> bool:
        """True if the curve m + D t, -1 <= t <= 1, whose D may depend on t, crosses N from side to side."""
        L = matrix(self.V).inv()
        middle = L * flint.arb_mat([[a - b] for a, b in zip(m, points(self.x), strict=True)])
        along = L * flint.arb_mat([[v] for v in D])
        r = flint.arb(self.r)
        one, other = (middle[0, 0] + sign * along[0, 0] for sign in (1, -1))
        apart = (one > r and other < -r) or (one < -r and other > r)
        beside = _norm([middle[i, 0] + flint.arb(0, 1) * along[i, 0] for i in range(1, len(m))])
        return bool(apart) and bool(beside < r)


def saddle_at(loop: ClosedLoop, x: Array, widths: Array) -> Saddle | None:
    """The largest N around x, about a state that rests, that a step takes across itself; None if there is none. The
    coordinates have units in which the `widths` (n,) of the domain are about 1."""
    _, J = step_on(loop, points(x))
    A = np.array([[float(v.mid()) for v in row] for row in J.tolist()])
    if not np.all(np.isfinite(A)):
        return None
    values, vectors = np.linalg.eig(A)
    order = np.argsort(-np.abs(values), kind="stable")
    if np.abs(values[order[0]]) <= 1 or np.any(np.abs(values[order[1:]]) >= 1):
        return None
    columns = list[Array]()
    for value, vector in zip(values[order], vectors.T[order], strict=True):
        size = float((np.abs(vector) / widths).max())
        if value.imag >= 0:  # of a pair the real and the imaginary part, which turn
            columns += [vector.real / size] if value.imag == 0 else [vector.real / size, vector.imag / size]
    V = np.array(columns).T
    if V.shape != A.shape or not np.linalg.cond(V / widths[:, None]) < _APART:
        return None
    each = (Saddle(x, V, r) for r in _SIZES)
    return next((saddle for saddle in each if _covers_itself(loop, saddle)), None)


def _covers_itself(loop: ClosedLoop, saddle: Saddle) -> bool:
    """True if a step takes N across itself.

    A step takes x* + V w to x* + V (e + M w), M one of the matrices L J V, L the inverse of V, by the mean value
    theorem.
    """
    V, r = matrix(saddle.V), flint.arb(saddle.r)
    L, start = V.inv(), points(saddle.x)
    after, _ = step_on(loop, start)
    within, J = step_on(loop, saddle.X)
    M, e = L * J * V, L * flint.arb_mat([[a - b] for a, b in zip(after, start, strict=True)])
    if not all(v.is_finite() for v in (*within, *M.entries(), *e.entries())):
        return False
    n = len(start)
    side = flint.arb(M[0, 0].abs_lower()) * r - _norm([M[0, j] for j in range(1, n)]) * r - abs(e[0, 0])
    inner = flint.arb_mat(n - 1, n - 1, [M[i, j] for i in range(1, n) for j in range(1, n)])
    most = (_norm([M[i, 0] for i in range(1, n)]) + _spectral(inner)) * r + _norm([e[i, 0] for i in range(1, n)])
    return bool(side > r) and bool(most < r)


def _norm(v: Sequence[flint.arb]) -> flint.arb:
    """The Euclidean norm."""
    return flint.arb(sum((a.abs_upper() ** 2 for a in v), flint.arb(0)).sqrt().abs_upper())


def _spectral(M: flint.arb_mat) -> flint.arb:
    """A bound of the spectral norm: of M'M the largest sum of a row is one of its square."""
    rows = [sum(map(abs, row), flint.arb(0)) for row in (M.transpose() * M).tolist()]
    return reduce(flint.arb.max, rows, flint.arb(0)).sqrt()
