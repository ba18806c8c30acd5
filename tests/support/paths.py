"""Tubes around a path for documents that are written by hand.

As in `balls.py`, what is chosen here are hints: J nearly the least ball around a slab's ellipsoids and its motion, and
multipliers from the models that the reference finds on it. They decide whether something is accepted and never whether
it is true.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from flint import ctx, fmpq, fmpq_mat

from certify.reference.balls import PRECISION
from certify.reference.document import read
from certify.reference.loop import Loop
from certify.reference.refusal import Refused
from tests.support.balls import TINY, around, ball, exactly, reached_from, slab_of
from tests.support.certificates import Document, dump, edited, encode

GRID = np.geomspace(1e-4, 1e4, 65)  # of edge, and of motion as a part of edge / share^2
SHARE = 0.5


def follow(
    data: Document,
    centres: Sequence[np.ndarray],
    nodes: Sequence[np.ndarray],
    durations: Sequence[float],
    share: float = SHARE,
) -> Document:
    """The claim `reached` from the first node around the first centre, with a slab to each of the others."""
    with ctx.workprec(PRECISION):
        loop = Loop(read(dump(data)))
        slabs = [
            along(loop, centres[k : k + 2], (nodes[k], (nodes[k] + nodes[k + 1]) / 2, nodes[k + 1]), h, share)
            for k, h in enumerate(durations)
        ]
    data = edited(data, "claim", reached_from(nodes[0], centres[0]))
    return edited(data, "evidence.tube", slabs)


def along(
    loop: Loop, centres: Sequence[np.ndarray], shapes: Sequence[np.ndarray], h: float, share: float = SHARE
) -> Document:
    """A slab from the first centre to the second, with its first node, its middle and its last node."""
    J = around(*shapes) / np.sqrt(1 - share**2)
    rows, edge, motion = hints(loop, centres, shapes, h, J, share)
    path = {
        "centre": encode(centres[1]),
        "share": share.hex(),
        "edge": edge.hex(),
        "motion": motion.hex(),
        "joint": (1.0).hex(),
    }
    return slab_of(shapes[1], shapes[2], h) | ball(J, rows, np.eye(len(J) + 1)) | {"path": path}


def hints(
    loop: Loop, centres: Sequence[np.ndarray], shapes: Sequence[np.ndarray], h: float, J: np.ndarray, share: float
) -> tuple[np.ndarray, float, float]:
    """Rows of multipliers, edge and motion: of all on a grid those that leave most. Ones without a model."""
    n, step = len(J), centres[1] - centres[0]
    wide = np.column_stack([J, step / (2 * share)])
    middle = fmpq_mat(n, 1, [fmpq(*float(v).as_integer_ratio()) for v in (centres[0] + centres[1]) / 2])
    try:
        F = loop.within(loop.known(exactly(wide), "tube", "slab", middle), (), "tube", "slab")
    except Refused:
        return np.ones((3, n)), 1.0, 1.0
    f = np.array([float(each.v) for each in F.components]) - step / h
    a, Q, E = (
        np.array([[float(v) for v in getattr(each, part).entries()] for each in F.components]).reshape(n, *shape)
        for part, shape in (("a", (n + 1,)), ("Q", (n + 1, n + 1)), ("E", (n + 1, n + 1)))
    )
    sizes = np.linalg.norm(J.T @ shapes[1], axis=0)
    alpha, beta = (np.linalg.norm(A, axis=(1, 2)) / sizes for A in (E, Q))
    beta = np.maximum(beta, TINY)
    rates = (2 * (shapes[1] - shapes[0]) / h, (shapes[2] - shapes[0]) / h, 2 * (shapes[2] - shapes[1]) / h)
    least = np.full((len(GRID), len(GRID)), np.inf)
    edge = GRID[:, None]
    motion = GRID[None, :] * edge / share**2
    for P, R in zip(shapes, rates, strict=True):
        b = np.vstack([J.T @ P, np.zeros(n)])
        form = np.zeros((len(GRID), len(GRID), n + 2, n + 2))
        form[..., 0, 1:] = form[..., 1:, 0] = b @ f
        form[..., 1:, 1:] = b @ a + (b @ a).T
        form[..., 1:-1, 1:-1] += J.T @ R @ J + edge[..., None, None] * (J.T @ P @ J)
        form[..., 0, 0] = motion * share**2 - edge
        form[..., -1, -1] -= motion
        for i in range(n):
            outer = np.outer(b[:, i], b[:, i])
            form[..., 1:, 1:] += alpha[i] * outer + E[i] @ E[i] / max(alpha[i], TINY)
            form[..., 1:, 1:] += beta[i] * outer + Q[i] @ Q[i] / beta[i]
        least = np.minimum(least, np.linalg.eigvalsh(-form)[..., 0])
    i, j = np.unravel_index(int(np.argmax(least)), least.shape)
    return np.stack([alpha, beta, np.ones(n)]), float(edge[i, 0]), float(motion[i, j])
