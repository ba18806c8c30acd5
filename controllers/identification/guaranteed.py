"""Ranges of A and B from transitions, guaranteed for a finite number of them: errors are bounded, not random.

Of the true plant `x+ = A x + B v + r` a row of A and B is a vector a with `|y - X a| <= s` at each transition: y is the
measured next state, X has the measured state and the input, and s bounds r, the error of y and the row's sum of |A_ij|
times the errors of the states. For any weights l of the transitions

    a_j = l'X a + (e_j - l'X) a  lies within  |l|'s + |e_j - l'X| |a|  of  l'y,

e_j the unit vector. Those of least squares, the pseudo-inverse, bound a at first: |a| <= c + M |a| entry by entry, and
so |a| <= z for any z > 0 with c + M z < z (the spectral radius of M >= 0 is below 1 then). The multipliers of a linear
program are the best ones. Nothing rests on the solver: each bound is evaluated in Arb, with the weights that it found.
"""

from __future__ import annotations

from collections.abc import Sequence

import flint
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from certify.errors import InputError
from certify.loop.expressions import Expression, Symbol
from certify.loop.rigorous import evaluate_arb, matrix, precision, rounded_up
from controllers.identification.enclosed_gain import Box

Array = NDArray[np.float64]
_OPTIMAL, _WIDER, _ROUNDS = 0, 1.01, 2
_PRECISION = 128  # bits
_UP = 1 + 2.0**-36  # more than all rounding of a sum of some ten thousand positive numbers


def residual_bounds(terms: Sequence[Expression], names: Sequence[str], z: Array, errors: Array) -> Array:
    """Upper bounds (N,) of `sum_k |term_k|` at states and inputs z (N, n + m) with errors (n + m,)."""
    symbols = [Symbol(name) for name in names]
    with precision(_PRECISION):
        reach = [flint.arb(0, w) for w in errors.tolist()]
        found = np.zeros(len(z))
        for k, row in enumerate(z.tolist()):
            at = {s: flint.arb(v) + w for s, v, w in zip(symbols, row, reach, strict=True)}
            total = sum((evaluate_arb(term, at).abs_upper() for term in terms), flint.arb(0))
            found[k] = rounded_up(total.upper())
    return found


def guaranteed_ranges(x: Array, v: Array, x_next: Array, beyond: Array, noise: Array) -> tuple[Box, Box, Array]:
    """Boxes of A and B that hold those of the true plant, and by state the least share of its bounds that data allow.

    Parameters
    ----------
    x, v, x_next : measured transitions, (N, n), (N, m) and (N, n).
    beyond : bounds (N, n) of what each true next state has beyond A x + B v.
    noise : bounds (n,) of the errors of measured states, positive.

    Raises
    ------
    InputError : transitions do not determine a row.
    """
    X, n = np.hstack([x, v]), x.shape[1]
    w = np.concatenate([noise, np.zeros(v.shape[1])])
    rows, shares = [], np.zeros(n)
    with precision(_PRECISION):
        for i in range(n):
            row = _Row(X, x_next[:, i], np.nextafter(noise[i] + beyond[:, i], np.inf), w)
            for _ in range(_ROUNDS):
                shares[i] = row.narrow()
            rows.append(row)
    lo, hi = (np.array([getattr(row, end) for row in rows]) for end in ("lo", "hi"))
    return Box(lo[:, :n], hi[:, :n]), Box(lo[:, n:], hi[:, n:]), shares


class _Row:
    """The range [lo, hi] of a row a (p,) of A and B."""

    def __init__(self, X: Array, y: Array, e: Array, w: Array) -> None:
        self.X, self.y, self.e, self.w = X, y, e, w
        weights: Array = np.asarray(np.linalg.pinv(X), dtype=np.float64)
        off = _absolute(matrix(np.eye(len(weights))) - matrix(weights) * matrix(X))
        size = _absolute(matrix(weights))
        M = off + np.outer(size.sum(1), w)
        c = _absolute(matrix(weights) * matrix(y[:, None]))[:, 0] + size @ e
        try:
            z = _WIDER * np.linalg.solve(np.eye(len(c)) - M, c) + np.finfo(np.float64).tiny
        except np.linalg.LinAlgError:
            z = np.full_like(c, np.nan)
        if not (np.isfinite(z).all() and (z > 0).all() and (_UP * (c + M @ z) < z).all()):
            raise InputError("the transitions do not determine A and B: collect more of them, or with less noise.")
        self.lo, self.hi = -z, z

    def narrow(self) -> float:
        """Narrow the range by linear programs; return the least share of the bounds at which any row is left."""
        box = Box(self.lo, self.hi)
        size = np.maximum(-self.lo, self.hi)
        s = np.nextafter(self.e * _UP + (self.w @ size) * _UP, np.inf)
        middle, reach = box.middle, box.reach
        G, b = self.X * reach / s[:, None], (self.y - self.X @ middle) / s
        share, rows, sides = self._share(G, b), np.vstack([G, -G]), np.concatenate([1 + b, 1 - b])
        for j in range(len(middle)):
            for sign in (1.0, -1.0):
                cost = np.zeros(len(middle))
                cost[j] = -sign
                answer = linprog(cost, A_ub=rows, b_ub=sides, bounds=(-1.0, 1.0), method="highs")
                if answer.status != _OPTIMAL:
                    continue  # the range as it is
                above, below = np.split(-answer.ineqlin.marginals, 2)
                lo, hi = self._bound(j, sign * reach[j] * (above - below) / s, s, middle, reach)
                self.lo[j], self.hi[j] = max(self.lo[j], lo), min(self.hi[j], hi)
        return share

    def _share(self, G: Array, b: Array) -> float:
        """The least t with `|b - G d| <= t` for some d in the box."""
        one = np.ones((len(b), 1))
        A = np.vstack([np.hstack([G, -one]), np.hstack([-G, -one])])
        ends = [(-1.0, 1.0)] * G.shape[1] + [(0.0, None)]
        answer = linprog(np.eye(G.shape[1] + 1)[-1], A_ub=A, b_ub=np.concatenate([b, -b]), bounds=ends, method="highs")
        return float(answer.fun) if answer.status == _OPTIMAL else float("nan")

    def _bound(self, j: int, weights: Array, s: Array, middle: Array, reach: Array) -> tuple[float, float]:
        """The interval of a_j that weights of the transitions show."""
        used = np.flatnonzero(weights)
        if not len(used):
            return -np.inf, np.inf
        of, X = matrix(weights[None, used]), matrix(self.X[used])
        left = matrix(np.eye(len(middle))[j : j + 1]) - of * X
        at = (of * matrix(self.y[used, None]) + left * matrix(middle[:, None]))[0, 0]
        most = _size(of) * matrix(s[used, None]) + _size(left) * matrix(reach[:, None])
        found = at + flint.arb(0, 1) * most[0, 0].upper()
        return float(np.nextafter(float(found.lower()), -np.inf)), float(np.nextafter(float(found.upper()), np.inf))


def _size(M: flint.arb_mat) -> flint.arb_mat:
    return flint.arb_mat([[v.abs_upper() for v in row] for row in M.table()])


def _absolute(M: flint.arb_mat) -> Array:
    """Upper bounds of the sizes of all entries."""
    return np.array([[rounded_up(v.abs_upper()) for v in row] for row in M.table()])
