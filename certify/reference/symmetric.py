"""Symmetric matrices and cubic forms without what they say twice.

A cubic form in a dozen variables has 1,728 coefficients of which 364 differ. A network has a thousand of them, added up
with a thousand weights in every layer: a form that is one row of numbers makes that one product of matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import combinations_with_replacement, permutations, product

from flint import arb, arb_mat


@cache
def pairs(n: int) -> tuple[tuple[int, int], ...]:
    return tuple(combinations_with_replacement(range(n), 2))


@cache
def triples(n: int) -> tuple[tuple[int, int, int], ...]:
    return tuple(combinations_with_replacement(range(n), 3))


@cache
def orders(n: int) -> tuple[int, ...]:
    """The number of times each of `triples` occurs in a full symmetric cubic form."""
    return tuple(len(set(permutations(each))) for each in triples(n))


@cache
def places(n: int) -> tuple[int, ...]:
    """For each h, i, j, the last fastest, which of `triples` it is in some order."""
    number = {each: k for k, each in enumerate(triples(n))}
    return tuple(number[tuple(sorted(each))] for each in product(range(n), repeat=3))  # type: ignore[index]


def half(A: arb_mat) -> list[arb]:
    """A symmetric matrix without what stands below its diagonal: one number for each of `pairs`."""
    entries, n = A.entries(), A.nrows()
    return [entries[i * n + j] for i, j in pairs(n)]


def whole(values: Sequence[arb], n: int) -> arb_mat:
    """The matrix of such a half."""
    rows = [[arb(0)] * n for _ in range(n)]
    for (i, j), v in zip(pairs(n), values, strict=True):
        rows[i][j] = rows[j][i] = v
    return arb_mat(rows)


@cache
def splits(n: int) -> tuple[tuple[int, int, int], ...]:
    """For each of `triples`, where the products of one index with the other two stand: those two before the one."""
    return tuple(((i * n + j) * n + h, (h * n + j) * n + i, (h * n + i) * n + j) for h, i, j in triples(n))


def no_form(n: int) -> arb_mat:
    """The cubic form 0."""
    return arb_mat(1, len(triples(n)))


def linear_times_square(a: arb_mat, Q: arb_mat) -> arb_mat:
    """(a.d)(d'Qd) as a cubic form, a row: the mean over all orders of the indices; a is a column, Q symmetric."""
    n = Q.nrows()
    at = (arb_mat(n * n, 1, Q.entries()) * a.transpose()).entries()
    return arb_mat(1, len(triples(n)), [at[x] + at[y] + at[z] for x, y, z in splits(n)]) / 3


def squared_norm(K: arb_mat, n: int) -> arb:
    """The sum of the squares of a cubic form's coefficients, in all orders."""
    values = K.entries()
    counted = arb_mat(1, len(values), [count * v for count, v in zip(orders(n), values, strict=True)])
    return (counted * K.transpose())[0, 0]
