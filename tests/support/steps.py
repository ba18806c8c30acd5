"""Documents of version 6 for loops with steps, written by hand: discrete time, inputs that are held, a rate, a level.

As in `balls.py` what is chosen are hints: multipliers from the models that the reference finds, and a tree that its own
leaf rule grows. They decide whether something is accepted and never whether it is true.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from flint import ctx

from certify.reference.balls import PRECISION
from certify.reference.document import read
from certify.reference.evidence import Tree
from certify.reference.flow import steps_on
from certify.reference.leaves import LEAF, Box, Leaves
from certify.reference.local import cells
from certify.reference.loop import Loop
from certify.reference.refusal import Refused
from tests.support.balls import around, ball, square
from tests.support.certificates import Document, dump, edited, encode, make
from tests.support.reference import judge

TINY = 2.0**-60


def stepping(
    dynamics: Sequence[Any],
    layers: Sequence[tuple[Any, Any]],
    P: Any,
    levels: Sequence[float],
    *,
    discrete: bool = False,
    sample: tuple[str, str] | None = None,
    rate: float = 0.0,
    order: int = 1,
    edge: float | None = 0.0,
    leaves: int = 400,
    **more: Any,
) -> Document:
    """Three levels are those of claim `practical`, whose ball has this edge, or is not there for None.

    The tree is grown if there is something between the ball and the outer level.
    """
    *floor, inner, outer = levels
    P = np.atleast_2d(np.asarray(P, dtype=float))
    P = (P + P.T) / 2
    T = np.linalg.inv(np.linalg.cholesky(P)).T
    options: dict[str, Any] = {"squash": "identity", "centre": "none", "scale": [1.0], "T": T, **more}
    data = make(dynamics, layers, P, (inner, outer), **options)
    data["plant"]["time"] = "discrete" if discrete else "continuous"
    data["claim"] |= {"rate": rate.hex(), "sample": sample and list(sample)}
    data["evidence"]["order"] = order if sample else 1
    if floor:
        data["claim"]["kind"] = "practical"
        data["levels"]["floor"] = floor[0].hex()
    if floor and edge is None:
        data["evidence"]["local"] = None
    else:
        data = with_ball(data, order if sample else 1, edge or 0.0)
    between = inner < outer or data["evidence"]["local"] is None
    return grown(data, leaves) if between else data


def with_ball(data: Document, order: int, edge: float) -> Document:
    """The least ball around {V <= c1}, nearly, and multipliers that balance the two sides of each inequality."""
    P, c1 = square(data["lyapunov"]["P"]), float.fromhex(data["levels"]["local"])
    J, n = around(P / c1), len(P)
    more = {"edge": edge.hex(), "order": order}
    data = edited(data, "evidence.local", ball(J, np.ones((3, n))) | more)
    try:
        with ctx.workprec(PRECISION):
            c = read(dump(data))
            h, loop = float(Fraction(str(c.step))), Loop(c)
            if not isinstance(c.evidence, Tree) or c.evidence.ball is None:
                raise TypeError("a ball was expected")
            steps = steps_on(loop, loop.known(c.evidence.ball.J, "local", "ball"), c.evidence.ball, "ball")
            G = steps.change(next(cells(c.plant.ranges, c.evidence.cells)), "local", "ball")
    except Refused:
        return data
    a, Q, E = (np.array([[float(v.mid()) for v in getattr(g, part).entries()] for g in G.components]) for part in "aQE")
    Q, E = Q.reshape(n, n, n), E.reshape(n, n, n)
    b = (J + h * a).T @ P
    rate = 2 * float.fromhex(data["claim"]["rate"])
    left = -(J.T @ P @ a + a.T @ P @ J + h * a.T @ P @ a + rate * J.T @ P @ J)
    if not np.linalg.eigvalsh(left)[0] > 0:
        return data
    with np.errstate(all="ignore"):
        inverse = np.linalg.inv(left)
        along = np.einsum("ji,jk,ki->i", b, inverse, b)
        sizes = [np.sqrt(np.einsum("iab,bc,iac->i", A, inverse, A) / along) for A in (E, Q)]
        alpha = np.where(E.any((1, 2)) & np.isfinite(sizes[0]), sizes[0], 0.0)
        least = TINY / np.where(along > 0, along, 1.0)
        beta = np.where(Q.any((1, 2)) & np.isfinite(sizes[1]) & (sizes[1] > 0), sizes[1], least)
    return edited(data, "evidence.local", ball(J, np.stack([alpha, beta, np.ones(n)]), inverse) | more)


def grown(data: Document, leaves: int) -> Document:
    """Leaves that are not accepted are halved on their widest axis, as long as there are few."""
    with ctx.workprec(PRECISION):
        c = read(dump(data))
        if not isinstance(c.evidence, Tree):
            raise TypeError("a tree was expected")
        rule = Leaves(c, c.evidence.T, c.evidence.T.transpose() * c.P * c.evidence.T)
        root, tree, count = np.array(c.evidence.root), bytearray(), 0
        stack = [(-root, root)]
        while stack:
            lo, hi = stack.pop()
            if count + len(stack) >= leaves or good(rule, lo, hi):
                tree.append(LEAF)
                count += 1
                continue
            axis = int(np.argmax((hi - lo) / root))
            tree.append(axis)
            middle = 0.5 * lo[axis] + 0.5 * hi[axis]
            below, above = hi.copy(), lo.copy()
            below[axis] = above[axis] = middle
            stack += [(above, hi), (lo, below)]
    return edited(data, "evidence.tree", base64.b64encode(bytes(tree)).decode())


def good(rule: Leaves, lo: np.ndarray, hi: np.ndarray) -> bool:
    box = Box(0, lo.tolist(), hi.tolist())
    if rule.is_outside(box) or (rule.is_inside(box) and not rule.alone):
        return True
    (leaf,) = rule.enclose([box])
    try:
        within = None if rule.c.sample is None else rule.reached(leaf)
        if rule.is_inside(box) and not rule.steps:
            return bool(rule.F(leaf))
        return rule.decreases(leaf, within)
    except Refused:
        return False


def at_level(data: Document, **levels: float) -> Document:
    """Another level or two, the root box as it must be, and the ball around the new one."""
    result = edited(data, "levels", lambda old: old | {key: value.hex() for key, value in levels.items()})
    P, T = square(data["lyapunov"]["P"]), square(data["evidence"]["T"])
    most = float.fromhex(result["levels"]["roa"])
    root = np.sqrt(most * np.diag(np.linalg.inv(T.T @ P @ T))) * (1 + 1e-12)
    result = edited(result, "evidence.root", encode(root))
    old = result["evidence"]["local"]
    return result if old is None else with_ball(result, old["order"], float.fromhex(old["edge"]))


def accepted(data: Document) -> bool:
    return judge(data) is None
