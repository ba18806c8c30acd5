"""Balls and tubes for documents that are written by hand.

`with_ball` gives a document its ball, and `enlarge` a tube. J is the least ball around the ellipsoids, or nearly, and
the multipliers are chosen from the models that the checker itself finds on that ball: they are hints, which only
decide whether something is accepted and never whether it is true.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from flint import fmpq, fmpq_mat

from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.errors import Rejected
from tests.support.certificates import ASYMPTOTIC, Document, decode, edited, encode, parse
from tests.support.jets import seen

MARGIN, TINY = 1e-6, 2.0**-60
AT_REST: Document = {"edge": (0.0).hex(), "order": 1}  # what the ball of the section `local` has besides


def with_ball(data: Document) -> Document:
    """The document with a ball for its levels, P, plant and policy, where its claim has one."""
    if "floor" in data["levels"] and data["levels"]["floor"] == data["levels"]["local"]:
        return data
    return edited(data, "evidence.local", local_ball(data))


def square(text: str) -> np.ndarray:
    values = decode(text)
    return values.reshape(2 * [int(len(values) ** 0.5)])


def local_ball(data: Document) -> Document:
    """The least ball around {V <= c1}, nearly; any ball where the document does not tell."""
    n = len(data["plant"]["states"])
    try:
        P, c1 = square(data["lyapunov"]["P"]), float.fromhex(data["levels"]["local"])
        with np.errstate(all="ignore"):
            J = around(P / c1)
    except (TypeError, ValueError, OverflowError, np.linalg.LinAlgError):
        return centred(np.eye(n), ones(n))
    if not np.isfinite(J).all():
        return centred(np.eye(n), ones(n))
    return centred(J, multipliers(edited(data, "evidence.local", centred(J, ones(n))), J, [P], np.zeros((n, n))))


def around(*nodes: np.ndarray) -> np.ndarray:
    """J of a ball that contains {x'Px <= 1} for one P or for both."""
    least = nodes[0]
    for other in nodes[1:]:
        L = np.linalg.cholesky(least)
        w, U = np.linalg.eigh(np.linalg.solve(L, np.linalg.solve(L, other).T))
        least = L @ U @ np.diag(np.minimum(w, 1)) @ U.T @ L.T
    result: np.ndarray = np.linalg.inv(np.linalg.cholesky((least + least.T) / 2)).T * (1 + MARGIN)
    return result


def ones(n: int) -> np.ndarray:
    return np.ones((3, n))


def ball(J: Any, rows: Any, weight: Any = None) -> Document:
    """With a weight that has no preference, unless it is given: on a slab with a path it is larger by one."""
    indifferent = np.eye(len(np.atleast_2d(J)))
    return {
        "J": encode(J), "multipliers": encode(rows), "weight": encode(indifferent if weight is None else weight),
    }  # fmt: skip


def centred(J: Any, rows: Any, weight: Any = None, edge: float = 0.0, order: int = 1) -> Document:
    """The ball of the section `local`."""
    return ball(J, rows, weight) | {"edge": float(edge).hex(), "order": order}


def exactly(A: np.ndarray) -> fmpq_mat:
    return fmpq_mat([[fmpq(*float(v).as_integer_ratio()) for v in row] for row in A])


def multipliers(data: Document, J: np.ndarray, nodes: Sequence[np.ndarray], R: np.ndarray) -> np.ndarray:
    """Alpha and beta that balance the two sides of each inequality where the first-order part decreases; no joint part.

    Ones where the checker finds no model, or nothing decreases.
    """
    n = len(J)
    try:
        with np.errstate(all="ignore"):
            case = Case(parse(data))
            F = seen(Ball(case, np.array(J, float), "ball").F(case.c.ranges))
    except Rejected:
        return ones(n)
    a, Q, E = (np.array([getattr(f, part) for f in F]) for part in ("a", "Q", "E"))
    P = sum(nodes[1:], nodes[0]) / len(nodes)
    if not all(np.isfinite(part).all() for part in (a, Q, E)):
        return ones(n)
    with np.errstate(all="ignore"):
        b = J.T @ P
        left = -(J.T @ R @ J + b @ a + a.T @ b.T)
        if not (np.isfinite(left).all() and np.linalg.eigvalsh(left)[0] > 0):
            return ones(n)
        inverse = np.linalg.inv(left)
        along = np.einsum("ji,jk,ki->i", b, inverse, b)
        sizes = [np.sqrt(np.einsum("iab,bc,iac->i", A, inverse, A) / along) for A in (E, Q)]
    alpha = np.where(E.any((1, 2)) & np.isfinite(sizes[0]), sizes[0], 0.0)
    least = TINY / np.where(along > 0, along, 1.0)  # as good as nothing, and positive: no component is taken jointly
    beta = np.where(Q.any((1, 2)) & np.isfinite(sizes[1]) & (sizes[1] > 0), sizes[1], least)
    return np.stack([alpha, beta, np.ones(n)])


def slab_of(middle: np.ndarray, end: np.ndarray, duration: float) -> Document:
    return {"middle": encode(middle), "end": encode(end), "duration": float(duration).hex(), "path": None}


def enlarged_from(start: Any) -> Document:
    return ASYMPTOTIC | {"kind": "enlarged", "start": encode(start)}


def reached_from(start: Any, centre: Any) -> Document:
    return enlarged_from(start) | {"kind": "reached", "centre": encode(centre)}


def enlarge(data: Document, nodes: Sequence[np.ndarray], durations: Sequence[float]) -> Document:
    """The enlarged claim from the first node, with a slab to each of the others."""
    data = edited(data, "claim", enlarged_from(nodes[0]))
    slabs = []
    data["evidence"]["tube"] = [slab_of(nodes[-1], nodes[-1], 1.0) | ball(nodes[-1], ones(len(nodes[0])))]
    for (before, after), h in zip(pairwise(nodes), durations, strict=True):
        J = around(before, after)
        hints = multipliers(data, J, [before, after], (after - before) / h)
        slabs.append(slab_of((before + after) / 2, after, h) | ball(J, hints))
    data["evidence"]["tube"] = slabs
    return data
