"""Loops whose policy has kinks at the origin or near it, with hand-made evidence: trees of directions, and truth by
sampling the loop itself."""

from __future__ import annotations

import base64
import copy
from collections.abc import Sequence
from typing import Any

import numpy as np

from tests.support.balls import around, centred
from tests.support.certificates import LEAF, Document, encode, make
from tests.support.network_loops import affine, mapped, with_policy

PLAIN: dict[str, Any] = {"squash": "identity", "centre": "none", "scale": [1.0], "input_bounds": [("-99", "99")]}
Layers = Sequence[tuple[np.ndarray, np.ndarray]]


def even(n: int, depth: int) -> list[str]:
    """Trees of all faces of the cube, each halved `depth` times along each of its axes."""

    def tree(axes: list[int], left: int) -> bytes:
        if not axes or left == 0:
            return bytes([LEAF])
        first, *others = axes * left
        return split([first, *others])

    def split(axes: list[int]) -> bytes:
        return bytes([axes[0]]) + 2 * split(axes[1:]) if axes else bytes([LEAF])

    return [base64.b64encode(tree([j for j in range(n) if j != k // 2], depth)).decode() for k in range(2 * n)]


def steps_of(layers: Layers, clip: tuple[Any, Any] | None = None) -> list[Document]:
    """A relu network's steps; with a clip its first hidden layer is clipped instead."""
    steps, last = list[Document](), 0
    for W, b in layers[:-1]:
        steps += [affine(last, W, b)]
        bent = mapped(len(steps), "relu")
        if clip is not None:
            ends = {"lo": encode(np.full(len(W), clip[0])), "hi": encode(np.full(len(W), clip[1]))}
            bent = {"kind": "clip", "of": [len(steps)], **ends}
        steps.append(bent)
        last = len(steps)
    return [*steps, affine(last, *layers[-1])]


def pi(layers: Layers, x: np.ndarray) -> np.ndarray:
    """The relu network at states (N, n), in floats."""
    for W, b in layers[:-1]:
        x = np.maximum(x @ W.T + b, 0.0)
    return x @ layers[-1][0].T + layers[-1][1]


def kinked(dynamics: Sequence[Any], layers: Layers, P: Any, level: float, directions: Any, **more: Any) -> Document:
    """A claim that {V <= level} is attracted, by a ball alone (c1 = c2); without directions there is none."""
    P = np.atleast_2d(np.asarray(P, dtype=float))
    n = len(P)
    names = [f"x{i}" for i in range(n)]
    settings = {"states": names, "domain": [("-9", "9")] * n, **PLAIN, **more}
    reads = layers[0][0].shape[1]
    levels = settings.pop("levels", (level, level))
    data = make(dynamics, [(np.zeros((1, reads)), [0.0])], P, levels, **settings)
    data = with_policy(data, steps_of(layers))
    if directions is None:
        return data
    data["evidence"]["local"] = centred(around(P / level), np.vstack([np.zeros((2, n)), np.full((1, n), 2.0**-20)]))
    return with_directions(data, directions)


def with_directions(data: Document, directions: Any, part: str = "local") -> Document:
    data = copy.deepcopy(data)
    data["evidence"][part]["directions"] = directions
    return data


def mirrored(K: Any) -> Layers:
    """u = K x by pairs of relus, without biases."""
    K = np.atleast_2d(np.asarray(K, dtype=float))
    W = np.vstack([K, -K])
    return [(W, np.zeros(len(W))), (np.hstack([np.eye(len(K)), -np.eye(len(K))]), np.zeros(len(K)))]
