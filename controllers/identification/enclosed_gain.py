"""The gains of all plants in a box: bounds of the gain of the discrete Riccati equation, rigorous.

For each (A, B) in the box let `F(P) = A'PA - A'PB (R + B'PB)^-1 B'PA - P + Q`, with the gain
`K(P) = (R + B'PB)^-1 B'PA` and the loop `A - B K(P)`. P0 and K0 are nearly those of the middle of the box, L is the
loop of K0 there, and `S D = L'DL - D`, whose inverse is computed.

*Existence.* For symmetric P1, P2 with gains K1, K2 and loops L1, L2 one has `F(P1) = L1'P1 L2 + K1'R K2 - P1 + Q`,
since `B'P1 L1 = R K1`. With L0 and L+ for the loops of P0 and P0 + D therefore

    F(P0 + D) = F(P0) + L0'D L+ - D.

The map `T(D) = D - S^-1 F(P0 + D) = -S^-1 [F(P0) + (L0 - L)'D L+ + L'D (L+ - L)]` is continuous. If it takes the
symmetric matrices whose entries are in intervals to such matrices, then it has a fixed point among them (Brouwer), at
which F(P0 + D) = 0.

*It is the stabilising solution.* If P = P0 + D is positive definite for all these D, and Q > 0, then
`P - L+'P L+ = Q + K'R K > 0`: P is a Lyapunov function of the loop, which is stable, and there is but one such P.

*Width.* F is the least value over K of `(A - BK)'P (A - BK) + K'RK - P + Q`, so that its derivative by an entry of
(A, B) is `E'P L0 + L0'P E`, E that of A - B K with K held (the envelope theorem). By the mean value theorem F(P0) is
its value at the middle and, with derivatives enclosed over the box, a sum over entries. S^-1, and the derivatives of K,
multiply each of these terms before absolute values are taken: all that is lost is of second order.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable
from dataclasses import dataclass
from functools import reduce

import flint
import numpy as np
from numpy.typing import NDArray

from certify.errors import OptionError
from certify.loop.rigorous import is_definite, matrix, precision, rounded_up

Array = NDArray[np.float64]
_ROUNDS, _WIDER = 20, 1.05  # of the search for intervals
_SHARE, _TURNS, _LITTLE = 0.6, 6, 1e-4  # of the loop's decay that gamma is; of the search for coordinates


@dataclass(frozen=True, slots=True)
class Box:
    """Matrices between two others, entry by entry.

    Parameters
    ----------
    lo, hi : of the same shape.
    """

    lo: Array
    hi: Array

    @property
    def middle(self) -> Array:
        return np.asarray(self.lo / 2 + self.hi / 2)

    @property
    def reach(self) -> Array:
        """No less than the distance of any entry from the middle's."""
        return np.nextafter(np.maximum(self.hi - self.middle, self.middle - self.lo), np.inf)


def enclosed_gain(A: Box, B: Box, Q: Array, R: Array) -> Box | None:
    """Bounds of K for `u = -K x`, as `riccati_gain` has it, for every A and B in their boxes; None where none is found.

    Parameters
    ----------
    Q, R : shapes (n, n) and (m, m), symmetric and positive definite.

    Raises
    ------
    InputError : Q or R is not positive definite.
    """
    with precision():
        if not (is_definite(matrix(Q)) and is_definite(matrix(R))):
            raise OptionError("`state_weights` and `input_weights` must be positive, to bound the gain.")
        try:
            return _Riccati(A, B, Q, R).gain()
        except (np.linalg.LinAlgError, ValueError, ZeroDivisionError):
            return None


class _Riccati:
    """The equation over a box, and its solution at the middle; names as in the module's text."""

    def __init__(self, A: Box, B: Box, Q: Array, R: Array) -> None:
        from scipy.linalg import solve_discrete_are

        a, b = A.middle, B.middle
        P = solve_discrete_are(a, b, Q, R)
        P = (P + P.T) / 2
        K = np.linalg.solve(R + b.T @ P @ b, b.T @ P @ a)
        new, old = _coordinates(a - b @ K, K, A.reach, B.reach)
        (self.n, self.m), self.reach = b.shape, [*A.reach.ravel(), *B.reach.ravel()]
        self.into, self.back = new, old
        self.A_mid, self.B_mid = new * matrix(a) * old, new * matrix(b)
        self.A = self.A_mid + new * _within(A.reach) * old
        self.B = self.B_mid + new * _within(B.reach)
        self.P, self.Q = (old.transpose() * matrix(M) * old for M in (P, Q))
        self.K, self.R = matrix(K) * old, matrix(R)
        self.L = self.A_mid - self.B_mid * self.K
        self.inverse = (_kronecker(self.L.transpose()) - _identity(self.n**2)).inv()

    def gain(self) -> Box | None:
        """Bounds of K, or None."""
        slopes, at_middle = self._slopes(), self._at_middle()
        first = at_middle + _sum(D * flint.arb(0, reach) for D, reach in zip(slopes, self.reach, strict=True))
        reach = np.zeros((self.n, self.n))
        for _ in range(_ROUNDS):
            D = first + _within(reach)
            beyond = self._beyond(D)
            found = np.array([[rounded_up(v.abs_upper()) for v in row] for row in beyond.table()])
            if not np.isfinite(found).all():
                return None
            if (found <= reach).all():
                return self._bounds(slopes, at_middle + beyond, D)
            reach = _WIDER * found
        return None

    def _near(self, P: flint.arb_mat) -> flint.arb_mat:
        """K(P) - K0 for all of the box: `(R + B'PB)^-1 [B'P(A - B K0) - R K0]`."""
        B, M = self.B, self.A - self.B * self.K
        return (self.R + B.transpose() * P * B).solve(B.transpose() * P * M - self.R * self.K)

    def _at_middle(self) -> flint.arb_mat:
        """-S^-1 F(P0) at the middle."""
        a, b, P = self.A_mid, self.B_mid, self.P
        K = (self.R + b.transpose() * P * b).solve(b.transpose() * P * a)
        return self._solved([a.transpose() * P * (a - b * K) - P + self.Q])[0]

    def _slopes(self) -> list[flint.arb_mat]:
        """-S^-1 of the derivative of F(P0) by each entry of A, then of B, row by row, over the box."""
        dK = self._near(self.P)
        PL = self.P * (self.A - self.B * (self.K + dK))
        found = (row.transpose() * (column.transpose() * PL) for column, row in self._moves(self.K + dK))
        return self._solved([Z + Z.transpose() for Z in found])

    def _moves(self, K: flint.arb_mat) -> list[tuple[flint.arb_mat, flint.arb_mat]]:
        """The derivative of A - B K by each entry, K held, as a column times a row."""
        columns = [row.transpose() for row in _rows(self.into.transpose())]
        return [(c, row) for rows in (_rows(self.back), _rows(-K)) for c in columns for row in rows]

    def _beyond(self, D: flint.arb_mat) -> flint.arb_mat:
        """-S^-1 [(L0 - L)'D L+ + L'D (L+ - L)]."""
        M = self.A - self.B * self.K - self.L
        left, right = M - self.B * self._near(self.P), M - self.B * self._near(self.P + D)
        return self._solved([left.transpose() * D * (self.L + right) + self.L.transpose() * D * right])[0]

    def _solved(self, many: list[flint.arb_mat]) -> list[flint.arb_mat]:
        """-S^-1 Y of each."""
        n, found = self.n, -self.inverse * flint.arb_mat([Y.entries() for Y in many]).transpose()
        return [flint.arb_mat(n, n, column.entries()) for column in _rows(found.transpose())]

    def _bounds(self, slopes: list[flint.arb_mat], off: flint.arb_mat, D: flint.arb_mat) -> Box | None:
        """K0 + R0^-1 [r - (R + B'PB - R0)(K - K0)], R0 = R + B'PB at the middle, and r = B'P(A - B K0) - R K0, which
        has a term for each entry of A and B.

        Parameters
        ----------
        off : P - P0 beside the sum of the slopes.
        D : all of it.
        """
        B, b, M, P = self.B, self.B_mid, self.A - self.B * self.K, self.P
        if not is_definite(P + D):
            return None
        middle, PM, bP = self.R + b.transpose() * P * b, P * M, b.transpose() * P
        units = [row.transpose() for row in _rows(_identity(self.m))]
        total = flint.arb_mat(self.m, self.n)
        for j, ((column, row), dP, reach) in enumerate(zip(self._moves(self.K), slopes, self.reach, strict=True)):
            term = (bP * column) * row + B.transpose() * dP * M
            if j >= self.n**2:  # an entry of B stands in B' as well
                term += units[(j - self.n**2) % self.m] * (column.transpose() * PM)
            total += (middle.solve(term) * self.into) * flint.arb(0, reach)
        change = B.transpose() * (P + D) * B - b.transpose() * P * b
        rest = bP * self.L - self.R * self.K + B.transpose() * off * M - change * self._near(P + D)
        found = (self.K + middle.solve(rest)) * self.into + total
        ends = [(float(v.lower()), float(v.upper())) for v in found.entries()]
        lo, hi = np.array(ends).T.reshape(2, self.m, self.n)
        return Box(np.nextafter(lo, -np.inf), np.nextafter(hi, np.inf))


def _coordinates(loop: Array, K: Array, A: Array, B: Array) -> tuple[flint.arb_mat, flint.arb_mat]:
    """C and C^-1 of the coordinates C x.

    Any would do. In those of `W = L'WL / (1 - gamma) + sum E'W E`, the sum over all entries of A and B, each as large
    as its range (A and B have half-widths here), the ranges move the loop little beside its decay.
    """
    from scipy.linalg import solve_discrete_lyapunov

    A, B = A / A.max(), B / A.max()  # no half-width is 0
    gamma = _SHARE * (1 - float(np.abs(np.linalg.eigvals(loop)).max()) ** 2)
    W, few = np.eye(len(loop)), _LITTLE * np.eye(len(loop))
    for _ in range(_TURNS):
        heights = np.diag(W)
        moved = np.diag((A**2).T @ heights) + K.T @ np.diag((B**2).T @ heights) @ K
        W = solve_discrete_lyapunov(loop.T / np.sqrt(1 - gamma), moved / np.trace(moved) + few)
    C = matrix(np.asarray(np.linalg.cholesky(W).T, dtype=np.float64))
    return C, C.inv()


def _kronecker(M: flint.arb_mat) -> flint.arb_mat:
    """The matrix of D -> M D M' on the rows of D, one after the other."""
    n, of = range(M.nrows()), M.table()
    return flint.arb_mat([[of[i][k] * of[j][h] for k in n for h in n] for i in n for j in n])


def _identity(n: int) -> flint.arb_mat:
    return matrix(np.eye(n))


def _rows(M: flint.arb_mat) -> list[flint.arb_mat]:
    return [flint.arb_mat([row]) for row in M.table()]


def _sum(matrices: Iterable[flint.arb_mat]) -> flint.arb_mat:
    return reduce(operator.add, matrices)


def _within(reach: Array) -> flint.arb_mat:
    """All matrices whose entries are no larger than these."""
    return flint.arb_mat([[flint.arb(0, r) for r in row] for row in reach.tolist()])
