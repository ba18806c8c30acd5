"""Bounds of sums of products 2 |p_q.d| ||T_q d|| by one quadratic form: a thousand terms, too dear in rationals.

For any tau > 0 each is at most tau (p_q.d)^2 + ||T_q d||^2 / tau. A weight says which tau is good, and no bound depends
on it. The sums are taken in binary64 after p and T are divided by powers of two that bring them to 1, so that nothing
overflows and what underflows does not count, and come back as rationals.
"""

from __future__ import annotations

import numpy as np
from flint import fmpq, fmpq_mat

from .exact import exactly, fraction
from .float64 import EPS, Array, frobenius, gamma, norm, total, up

_FARTHEST = 2.0**100  # of the root of tau from 1


def bound_of_pairs(p: Array, wrong: Array, T: Array, wrong_T: Array, weight: Array) -> fmpq_mat:
    """S, symmetric, with sum_q 2 |p_q.d| ||T_q d|| <= d'S d for ||d|| <= 1, all p_q within `wrong` (N,) of p (N, k) in
    the 2-norm and all T_q within `wrong_T` (N,) of T (N, r, k) in the Frobenius norm. Sums of squares are finite."""
    (p, wrong), by_p = _near_one(p, wrong)
    (T, wrong_T), by_T = _near_one(T, wrong_T)
    kept = np.any(p, axis=1) & np.any(T, axis=(1, 2))
    p_length, T_size = norm(p, 1), frobenius(T)
    lost = total(wrong * up(T_size + wrong_T) + p_length * wrong_T, 0)
    p, T = p[kept], T[kept]
    tau = np.sum((T @ weight) * T, axis=(1, 2)) / np.sum((p @ weight) * p, axis=1)
    t = np.clip(np.sqrt(np.sqrt(np.where((tau > 0) & (tau < np.inf), tau, 1.0))), 1 / _FARTHEST, _FARTHEST)
    Y, X = t[:, None] * p, (T / t[:, None, None]).reshape(-1, p.shape[1])
    count = len(X) + len(Y)
    size = up(total(norm(Y, 1) ** 2, 0) + total(norm(X, 1) ** 2, 0))
    S = Y.T @ Y + X.T @ X + up(2 * lost + (gamma(count) + EPS) * size) * np.eye(p.shape[1])
    whole = exactly(S) * fmpq(2) ** (by_p + by_T)
    return (whole + whole.transpose()) / 2


def _near_one(array: Array, wrong: Array) -> tuple[tuple[Array, Array], int]:
    """Both over a power of two, so that no entry exceeds 1; what underflows is added to the errors by `up`."""
    most = max(np.max(np.abs(array), initial=0.0), np.max(wrong, initial=0.0))
    by = int(np.frexp(most)[1])
    return (np.ldexp(array, -by), up(np.ldexp(wrong, -by))), by


def in_binary64(A: fmpq_mat) -> tuple[Array, int]:
    """(a, e): A is within u |a| of a 2^e, but for what underflows, and no entry of a exceeds 1 in magnitude."""
    entries = [fraction(v) for v in A.entries()]
    by = max((v.numerator.bit_length() - v.denominator.bit_length() + 1 for v in entries if v), default=0)
    scale = fraction(fmpq(2) ** by)
    return np.array([float(v / scale) for v in entries]).reshape(A.nrows(), A.ncols()), by
