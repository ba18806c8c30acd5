"""Exact maxima of quadratic functions on the box [-1, 1]^n, and functions whose maximum lies anywhere in it."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import numpy as np
from flint import fmpq, fmpq_mat

Rows = list[list[Fraction]]


def pairs(n: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(n) for j in range(i, n)]


def value(g: list[Fraction], Q: Rows, d: list[Fraction]) -> Fraction:
    n = range(len(g))
    return sum((g[i] * d[i] for i in n), Fraction(0)) + sum((Q[i][j] * d[i] * d[j] for i in n for j in n), Fraction(0))


def largest(g: list[Fraction], Q: Rows) -> Fraction:
    """The exact maximum of g.d + d'Qd on the box: on each face the stationary point, where there is a single one.

    Where there are many on a face they reach its boundary with the same value.
    """
    found = []
    for signs in product((-1, 0, 1), repeat=len(g)):
        free = [i for i, s in enumerate(signs) if s == 0]
        d = [Fraction(s) for s in signs]
        if free:
            A = fmpq_mat([[rational(2 * Q[i][j]) for j in free] for i in free])
            right = [[rational(-g[i] - 2 * sum(Q[i][j] * d[j] for j in range(len(g))))] for i in free]
            if A.det() == 0:
                continue
            for i, v in zip(free, A.solve(fmpq_mat(right)).entries(), strict=True):
                d[i] = Fraction(int(v.p), int(v.q))
        if all(abs(v) <= 1 for v in d):
            found.append(value(g, Q, d))
    return max(found)


def rational(v: Fraction) -> fmpq:
    return fmpq(v.numerator, v.denominator)


def drawn(generator: np.random.Generator, n: int, kind: str) -> tuple[list[Fraction], Rows]:
    """Models whose maximum is inside, on a face, at a corner, or at several corners at once."""
    size = {"steep": 8, "level": 1, "flat": 0}[kind]
    g = [Fraction(int(v), 4) for v in generator.integers(-4 * size, 4 * size + 1, n)]
    Q = [[Fraction(0)] * n for _ in range(n)]
    for i, j in pairs(n):
        Q[i][j] = Q[j][i] = Fraction(int(generator.integers(-8, 9)), 4) * int(generator.integers(0, 2))
    return g, Q
