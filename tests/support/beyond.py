"""Small accepted certificates with an outer set, for what is said of one: their trees are uniform.

Both plants have x' = -x + x^3, whose trajectories run away from |x| > 1; N is chosen so that it falls where |x| < 1.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.support.certificates import LEAF, Document, encode, make

X = ["+", ["-", "x"], ["*", "x", "x", "x"], "u"]
SQUARES = ["+", ["*", "x", "x"], ["*", "1/4", "y", "y"]]


def uniform(depth: int, axes: Sequence[int]) -> bytes:
    """Every box is halved `depth` times, along the axes in turn."""
    if depth == 0:
        return bytes([LEAF])
    return bytes([axes[0]]) + 2 * uniform(depth - 1, [*axes[1:], axes[0]])


def well(x: float) -> float:
    """tanh(x - 1) - tanh(x + 1): least at 0, and rising with |x|."""
    return math.tanh(x - 1) - math.tanh(x + 1)


def wells(n: int) -> list[Document]:
    """The layers of the sum of `well` over n states."""
    W = np.kron(np.eye(n), [[1.0], [1.0]])
    first = {"shape": [2 * n, n], "weight": encode(W), "bias": encode([-1.0, 1.0] * n)}
    return [first, {"shape": [1, 2 * n], "weight": encode([1.0, -1.0] * n), "bias": encode([0.0])}]


def with_outer(data: Document, function: Document, level: float, depth: int, faces: int = 0) -> Document:
    """`data` with {N <= level}; every domain is [-2, 2]."""
    n = len(data["plant"]["states"])
    data["claim"]["outer"] = function | {"level": float(level).hex()}
    others = [[j for j in range(n) if j != k // 2] for k in range(2 * n)]
    trees = [uniform(depth, range(n)), *(uniform(faces, axes) for axes in others)]
    tree, *ends = (base64.b64encode(nodes).decode() for nodes in trees)
    data["evidence"]["outer"] = {"T": encode(np.eye(n)), "root": encode([2.0] * n), "tree": tree, "faces": ends}
    return data


def line(level: float = 0.9, **more: Any) -> Document:
    """x' = -x + x^3 with V = x^2 <= 1/4 and N = x^2."""
    data = make([X], [([[0.0]], [0.0])], [[1.0]], (0.0625, 0.25), domain=(("-2", "2"),), tree=uniform(6, [0]), **more)
    return with_outer(data, {"kind": "expression", "expression": ["*", "x", "x"]}, level, 8)


def plane(level: float = 0.9, function: Document | None = None, **more: Any) -> Document:
    """The same with y' = -y, V = x^2 + y^2 <= 1/4 and N = x^2 + y^2/4, or another function."""
    data = make(
        [X, ["-", "y"]],
        [([[0.0, 0.0]], [0.0])],
        np.eye(2),
        (0.0625, 0.25),
        states=("x", "y"),
        domain=(("-2", "2"), ("-2", "2")),
        tree=uniform(8, [0, 1]),
        **more,
    )
    return with_outer(data, function or {"kind": "expression", "expression": SQUARES}, level, 12, 3)


def network(level: float = -2.55, **more: Any) -> Document:
    """The plane with N a network, {N <= level} within |x| < 0.97."""
    return plane(level, {"kind": "network", "layers": wells(2)}, **more)
