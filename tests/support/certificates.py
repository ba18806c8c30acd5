"""Certificates for the checker's tests, written by hand: plain dictionaries in the format of the file.

The partition tree is grown with the checker's own leaf rule, so that what is tested is whether a certificate is
accepted and never how clever a producer is. Nothing here depends on the producer.
"""

from __future__ import annotations

import base64
import copy
import hashlib
import json
import math
import struct
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from certify.checker import document, exact, rules
from certify.checker.case import Case
from certify.checker.document import Certificate
from certify.checker.errors import Rejected
from certify.checker.outer import Beyond
from certify.checker.ring import Ring
from tests.support.earlier import earlier, newer

Document = dict[str, Any]
LEAF = 255
AROUND_A_LEVEL = ("practical", "nearby")
ASYMPTOTIC: Document = {"kind": "asymptotic", "rate": (0.0).hex(), "sample": None, "outer": None}


def encode(array: Any) -> str:
    """A float64 array as base64 of little-endian bytes."""
    return base64.b64encode(np.asarray(array, dtype="<f8").tobytes()).decode("ascii")


def decode(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").copy()


def policy_hash(policy: Document) -> str:
    """The hash that FORMAT.md defines, written down a second time."""
    digest = hashlib.sha256(b"certify-policy/1\0" + f"{policy['squash']}\0{policy['centre']}\0".encode())
    for layer in policy["layers"]:
        rows, columns = layer["shape"]
        digest.update(struct.pack("<3Q", 2, rows, columns) + base64.b64decode(layer["weight"]))
        digest.update(struct.pack("<2Q", 1, rows) + base64.b64decode(layer["bias"]))
    for text in (policy["scale"], policy["offset"], *(policy["clip"] or ())):
        raw = base64.b64decode(text)
        digest.update(struct.pack("<2Q", 1, len(raw) // 8) + raw)
    return digest.hexdigest()


def rehash(data: Document) -> Document:
    """The document, of format 8 or 9, with the hash of its policy, whose network has layers."""
    data["policy"]["sha256"] = policy_hash(earlier(data)["policy"])
    return data


def make(
    dynamics: Sequence[Any],
    layers: Sequence[tuple[Any, Any]],
    P: Any,
    levels: Sequence[float],
    *,
    states: Sequence[str] = ("x",),
    inputs: Sequence[str] = ("u",),
    u_eq: Sequence[str] = ("0",),
    domain: Sequence[tuple[str, str]] = (("-3", "3"),),
    input_bounds: Sequence[tuple[str, str]] = (("-1", "1"),),
    squash: str = "tanh",
    centre: str = "preactivation",
    scale: Sequence[float] = (-1.0,),
    offset: Sequence[float] = (0.0,),
    clip: tuple[Sequence[float], Sequence[float]] | None = None,
    origin: Sequence[float] | None = None,
    T: Any = None,
    root: Any = None,
    tree: bytes = bytes([LEAF]),
    claim: str = "asymptotic",
    uncertain: Sequence[tuple[str, str, str]] = (),
    cells: Sequence[int] | None = None,
    time: str = "continuous",
    rate: float = 0.0,
    sample: tuple[str, str] | None = None,
    order: int = 1,
) -> Document:
    """A certificate's document; the root box is the least one that binary64 can name, unless it is given.

    `uncertain` has a name and the two ends of each range, of which a single cell is made unless `cells` says more.
    `levels` are c1 and c2, under a practical claim without a ball c0 and c2, with one c0, c1 and c2. `order` is that of
    the series on leaves.
    """
    P = np.atleast_2d(np.asarray(P, dtype=np.float64))
    T = np.eye(len(P)) if T is None else np.atleast_2d(np.asarray(T, dtype=np.float64))
    if root is None:
        root = least_root(P, T, levels[-1])
    edges = ("floor", "local", "roa")[claim not in AROUND_A_LEVEL :]
    if claim in AROUND_A_LEVEL and len(levels) == 2:
        levels = (levels[0], *levels)
    arrays = [(np.atleast_2d(np.asarray(W, dtype=np.float64)), np.atleast_1d(b)) for W, b in layers]
    from tests.support.balls import with_ball

    return with_ball(rehash({
        "schema": "certify-certificate/8",
        "claim": {"kind": claim, "rate": float(rate).hex(), "sample": sample and list(sample), "outer": None},
        "plant": {
            "name": "plant",
            "time": time,
            "states": list(states),
            "inputs": list(inputs),
            "uncertain": [{"name": name, "range": [lo, hi]} for name, lo, hi in uncertain],
            "dynamics": list(dynamics),
            "u_eq": list(u_eq),
            "domain": [list(pair) for pair in domain],
            "input_bounds": [list(pair) for pair in input_bounds],
        },
        "policy": {
            "layers": [{"shape": list(W.shape), "weight": encode(W), "bias": encode(b)} for W, b in arrays],
            "squash": squash,
            "centre": centre,
            "scale": encode(scale),
            "offset": encode(offset),
            "clip": clip and [encode(end) for end in clip],
            "origin": encode(np.zeros(len(P)) if origin is None else origin),
            "sha256": "",
        },
        "lyapunov": {"kind": "quadratic", "P": encode(P)},
        "levels": {name: float(level).hex() for name, level in zip(edges, levels, strict=True)},
        "evidence": {
            "kind": "partition-tree",
            "T": encode(T),
            "root": encode(root),
            "tree": base64.b64encode(tree).decode("ascii"),
            "order": order,
            "cells": [1] * len(uncertain) if cells is None else list(cells),
            "local": None,
            "contraction": None,
            "tube": [],
            "outer": None,
        },
        "provenance": {"tool": "written by hand"},
    }))  # fmt: skip


def least_root(P: np.ndarray, T: np.ndarray, level: float) -> np.ndarray:
    """Half-widths of the smallest binary64 box in z around {V <= level}."""
    S = exact.exactly(T).transpose() * exact.exactly(P) * exact.exactly(T)
    inverse = exact.inverse_diagonal(S)
    if not inverse:
        raise ValueError("T'PT must be positive definite")
    root = []
    for s in inverse:
        square = Fraction(level) * s
        shift = (square.denominator.bit_length() - square.numerator.bit_length()) // 2 + 64
        b = float(Fraction(math.isqrt(int(square * Fraction(4) ** shift)), 1) / Fraction(2) ** shift)
        while Fraction(b) ** 2 < square:
            b = float(np.nextafter(b, np.inf))
        root.append(b)
    return np.array(root)


def dump(data: Document) -> bytes:
    """The file's bytes; documents are written in format 8 here, and become ones of today."""
    return json.dumps(newer(data)).encode("ascii")


def parse(data: Document) -> Certificate:
    """The document as the checker reads it, through JSON text."""
    return document.certificate(json.loads(dump(data)), "0" * 64)


def verdict(data: Document) -> str:
    """`ACCEPTED`, or the name of the rule that failed."""
    try:
        rules.check(parse(data))
    except Rejected as no:
        return no.rule
    return "ACCEPTED"


def grow(data: Document, max_leaves: int = 5000, depth: int = 40) -> Document:
    """`data` with a tree: every leaf that the checker's rule does not accept is halved on its widest axis.

    Leaves that are still not accepted at `depth` or at `max_leaves` stay, and the certificate is then rejected.
    """
    c = parse(data)
    with np.errstate(all="ignore"):
        ring = Ring.of(Case(c))
        return with_tree(data, halved(c.evidence.root, lambda *box: passes(ring, *box), max_leaves, depth))


def halved(root: Any, holds: Callable[..., np.ndarray], max_leaves: int, depth: int, lowest: Any = None) -> bytes:
    """A tree of the box from `lowest`, which is -root unless it is given, to `root`: boxes of which `holds`, for
    corners (n, B), does not say so are halved on their widest axis."""
    root = np.asarray(root)
    lowest = -root if lowest is None else np.asarray(lowest)
    widths = np.where(root > lowest, root - lowest, np.inf)
    axes: dict[tuple[int, ...], int] = {}  # path from the root (0 lower, 1 upper) -> axis of the split
    boxes = [((), lowest.copy(), root.copy())]
    for _ in range(depth):
        if not boxes or len(axes) + len(boxes) > max_leaves:
            break
        lows, highs = (np.stack([box[k] for box in boxes], 1) for k in (1, 2))
        halves = []
        for (path, lo, hi), done in zip(boxes, holds(lows, highs), strict=True):
            if not done and np.isfinite(widths).any():
                axis = axes[path] = int(np.argmax((hi - lo) / widths))
                middle = 0.5 * lo[axis] + 0.5 * hi[axis]
                left, right = hi.copy(), lo.copy()
                left[axis] = right[axis] = middle
                halves += [((*path, 0), lo, left), ((*path, 1), right, hi)]
        boxes = halves
    tree, stack = bytearray(), [()]
    while stack:
        path = stack.pop()
        tree.append(axes.get(path, LEAF))
        if path in axes:
            stack += [(*path, 1), (*path, 0)]
    return bytes(tree)


def passes(boxes: Ring | Beyond, lo: np.ndarray, hi: np.ndarray) -> np.ndarray:
    """The rules for a leaf, box by box, lo and hi (n, B)."""
    leaves = boxes.examine(0, lo, hi)
    good = np.ones(lo.shape[1], dtype=bool)
    good[leaves.numbers] = leaves.hold
    good[leaves.numbers] &= np.all(leaves.inputs, axis=0)
    return good


def tree_of(data: Document) -> bytes:
    return base64.b64decode(data["evidence"]["tree"])


def with_tree(data: Document, tree: bytes) -> Document:
    return edited(data, "evidence.tree", base64.b64encode(tree).decode("ascii"))


def edited(data: Document, path: str, value: Any) -> Document:
    """A deep copy with the entry at `path` (dots and list indices) replaced by a value, or by value(old)."""
    result = copy.deepcopy(data)
    *parents, last = [int(p) if p.isdigit() else p for p in path.split(".")]
    at: Any = result
    for key in parents:
        at = at[key]
    at[last] = value(at[last]) if isinstance(value, Callable) else value  # type: ignore[arg-type]
    return result


def write(data: Document | bytes, folder: Path) -> Path:
    path = folder / "certificate.json"
    path.write_bytes(data if isinstance(data, bytes) else dump(data))
    return path
