"""Models of the reference that somebody writes down, and what they say at a point of their ball."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from flint import arb, arb_mat, fmpq_mat

from certify.reference.document import Certificate
from certify.reference.loop import Field, Loop
from certify.reference.model import Model
from certify.reference.tangents import Units

ORDERS = {1: 1, 2: 3, 3: 6}  # of three indices, by how many of them differ


def triples(k: int) -> list[tuple[int, int, int]]:
    return list(combinations_with_replacement(range(k), 3))


def matrix(values: Any) -> arb_mat:
    return arb_mat([[arb(float(v)) for v in row] for row in np.atleast_2d(values)])


def model(
    v: float, a: Any, Q: Any, E: Any, K: Any = None, B: Sequence[float] = (), errors: Sequence[arb_mat] = ()
) -> Model:
    """K has the entries h <= i <= j of a symmetric form; without it there is none."""
    third = np.zeros(len(triples(len(a)))) if K is None else K
    column = arb_mat([[arb(float(value))] for value in a])
    return Model(arb(v), column, matrix(Q), matrix(third), matrix(E), tuple(map(arb, B)), tuple(errors))


def units(L: Any, R: Any) -> Units:
    """L (m, q) and R (q, k, k)."""
    n, (m, q) = np.shape(R)[1], np.shape(L)
    halves = [[arb(float(R_q[i][j])) for i in range(n) for j in range(i, n)] for R_q in R]
    return Units(n, arb_mat(m, q, [arb(float(v)) for v in np.ravel(L)]), halves)


def field(F: Sequence[Model], behind: Units | None = None) -> Field:
    """Without units the inputs have no errors."""
    inputs = max(1, len(F[0].B))
    none = units(np.zeros((inputs, 0)), np.zeros((0, len(F[0].a.entries()), len(F[0].a.entries()))))
    return Field(list(F), none if behind is None else behind)


def inputs_on(c: Certificate, J: fmpq_mat, centre: fmpq_mat | None = None) -> list[Model]:
    """The policy's models on a ball, before its clip; without a centre it is the origin."""
    loop = Loop(c)
    return loop.policy.on(loop.states(J, centre), centre is None)[0]


def form(A: arb_mat, d: Sequence[Any]) -> arb:
    """d'Ad."""
    column = arb_mat([[arb(v)] for v in d])
    return (column.transpose() * A * column)[0, 0]


def linear(v: Model, d: Sequence[Any]) -> arb:
    return sum((x * y for x, y in zip(v.a.entries(), map(arb, d), strict=True)), v.v)


def curved(v: Model, d: Sequence[Any]) -> arb:
    """d'Qd + K[d]."""
    value = form(v.Q, d)
    for each, entry in zip(triples(len(d)), v.K.entries(), strict=True):
        term = ORDERS[len(set(each))] * entry
        for i in each:
            term *= arb(d[i])
        value += term
    return value


def beyond(value: arb, v: Model, d: Sequence[Any]) -> arb:
    """What the model leaves of a value as a part of the bound for it: at most 1 if v is a model of the value."""
    bound = form(v.whole, d)
    if not bound >= 0:
        raise ValueError("no bound of a magnitude is negative")
    return abs(value - linear(v, d) - curved(v, d)) / (bound * (1 + arb(2) ** -50) + arb(2) ** -130)


def may_be(v: Model, true: arb, d: Sequence[Any]) -> bool:
    """Whether a value at d is not certainly outside; each number of the model is a ball, of which no more is known."""
    length = sum((arb(x) ** 2 for x in d), arb(0)).sqrt()
    rest = form(v.whole, d) + v.doubt + v.turn * length
    return bool((true - linear(v, d) - curved(v, d)).overlaps(rest.union(-rest)))


def numbers(part: arb_mat) -> np.ndarray:
    return np.array([float(v) for v in part.entries()]).reshape(part.nrows(), part.ncols())


def curves(v: Model, d: np.ndarray) -> np.ndarray:
    """d'Qd + K[d] in floats, d (k, b)."""
    result: np.ndarray = np.einsum("ib,ij,jb->b", d, numbers(v.Q), d)
    for each, entry in zip(triples(len(d)), numbers(v.K).ravel(), strict=True):
        result = result + ORDERS[len(set(each))] * entry * np.prod(d[list(each)], axis=0)
    return result
