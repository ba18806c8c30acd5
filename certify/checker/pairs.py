"""Bounds of sums of products 2 |p_q.d| ||T_q d|| by one quadratic form: a thousand terms, too dear in rationals.

For any t > 0 each is at most (t p_q.d)^2 + ||T_q d / t||^2. A weight says which t is good, and no bound depends on it.
The sums are taken in binary64 after p and T are divided by powers of two that bring them to 1, so that nothing
overflows, and come back as rationals.
"""

from __future__ import annotations

import numpy as np
from flint import fmpq, fmpq_mat

from .exact import exactly, near_matrix
from .near import Array, Near, Square, Tensor, Vector, gram, near_one

_FARTHEST = 2.0**100  # of t from 1


def bound_of_pairs(p: Vector, T: Tensor, weight: Array) -> fmpq_mat:
    """S, symmetric, with sum_q 2 |p_q.d| ||T_q d|| <= d'S d for ||d|| <= 1: p (k, N), T (k, r, N), the index that meets
    d being the first."""
    (p, by_p), (T, by_T) = near_one(p), near_one(T)
    lost = (p.error * T.size + p.stored * T.error).sum() * 2
    kept = np.any(p.value, axis=0) & np.any(T.value, axis=(0, 1))
    rows, whole = p.value[:, kept], T.value[:, :, kept]
    tau = np.einsum("irq,ij,jrq->q", whole, weight, whole) / np.einsum("iq,ij,jq->q", rows, weight, rows)
    t = np.clip(np.sqrt(np.sqrt(np.where((tau >= 0) & (tau < np.inf), tau, 1.0))), 1 / _FARTHEST, _FARTHEST)
    k = len(rows)
    S: Square = gram(Near(rows) * Near(t)) + gram(Near(whole.reshape(k, -1)).over(np.tile(t, whole.shape[1])))
    found = exactly(S.wider(lost).majorant) * fmpq(2) ** (by_p + by_T)
    return (found + found.transpose()) / 2


def in_binary64(A: fmpq_mat) -> tuple[Near, int]:
    """(a, e): A is a 2^e, and no entry of a exceeds 1 in magnitude."""
    by = max((v.p.bit_length() - v.q.bit_length() + 1 for v in A.entries() if v), default=0)
    return near_matrix(A / fmpq(2) ** by), by
