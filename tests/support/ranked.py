"""Certificates with boxes of ranks, as JSON by hand: small loops with a small network, and a search for ranks.

Nothing here depends on a checker. The search follows boxes in floats, whose images it widens by a hair.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import Any

Document = dict[str, Any]
Interval = tuple[float, float]
Image = Callable[[Sequence[Interval], int], Sequence[Interval]]  # of a box, after so many steps
UNRANKED, HAIR, TURN = 65_535, 1e-7, 2 * math.pi


def encode(*values: float) -> str:
    return raw(struct.pack(f"<{len(values)}d", *values))


def raw(data: bytes) -> str:
    return base64.b64encode(data).decode()


def affine(rows: Sequence[Sequence[float]], bias: Sequence[float] | None = None, of: int = 0) -> Document:
    flat, shifts = [w for row in rows for w in row], list(bias or [0.0] * len(rows))
    shape = [len(rows), len(rows[0])]
    return {"kind": "affine", "of": [of], "shape": shape, "weight": encode(*flat), "bias": encode(*shifts)}


def mapped(function: str, of: int) -> Document:
    return {"kind": "map", "of": [of], "function": function}


def hashed(policy: Document, steps: Sequence[Document]) -> str:
    """The hash of FORMAT.md, for steps that are `affine`, `map` or `clip`."""
    digest = hashlib.sha256(f"certify-policy/1\0{policy['squash']}\0{policy['centre']}\0".encode())

    def add(text: str, *axes: int) -> None:
        digest.update(struct.pack(f"<{1 + len(axes)}Q", len(axes), *axes) + base64.b64decode(text))

    for step in steps:
        if step["kind"] == "affine":
            add(step["weight"], *step["shape"])
            add(step["bias"], step["shape"][0])
        if step["kind"] == "clip":
            for end in ("lo", "hi"):
                add(step[end], len(base64.b64decode(step[end])) // 8)
    for text in (policy["scale"], policy["offset"], *(policy["clip"] or ())):
        add(text, len(base64.b64decode(text)) // 8)
    words = [step.get("function", "affine") for step in steps]
    if words != (["affine", "tanh"] * len(steps))[: len(steps)] or len(steps) % 2 == 0:
        for step in steps:
            named = f"{step['kind']} {' '.join(map(str, step['of']))}"
            digest.update(f"{named}{' ' + step['function'] if step['kind'] == 'map' else ''}\0".encode())
    return digest.hexdigest()


@dataclass
class Loop:
    """A loop, its claim and what is known of it; time is discrete unless there is a `sample`."""

    dynamics: list[Any]
    network: list[Document]
    target: list[Any] | None
    states: tuple[str, ...] = ("x",)
    sample: tuple[str, str] | None = None
    order: int = 1
    uncertain: list[tuple[str, str, str]] = field(default_factory=list)
    angles: tuple[str, ...] = ()
    keep: list[Any] | None = None
    domain: tuple[str, str] = ("-9", "9")
    bound: str = "9"
    most: int = 1000
    squash: str = "identity"
    frame: list[list[float]] | None = None
    memory: int | None = None
    moving: bool = False

    def document(self, lo: Sequence[float], hi: Sequence[float], tree: bytes, ranks: bytes, steps: bytes) -> Document:
        n = len(self.states)
        policy: Document = {
            "network": "pi", "squash": self.squash, "centre": "none", "scale": encode(1.0), "offset": encode(0.0),
            "clip": None, "origin": encode(*[0.0] * n), "sha256": "",
        }  # fmt: skip
        policy["sha256"] = hashed(policy, self.network)
        claim: Document = {
            "kind": "reaches", "sample": self.sample and list(self.sample), "target": self.target,
            "ranks": {"angles": list(self.angles), "steps": self.most},
        }  # fmt: skip
        ranking = {"lo": encode(*lo), "hi": encode(*hi), "tree": raw(tree), "ranks": raw(ranks), "steps": raw(steps)}
        ranking |= {} if self.frame is None else {"frame": encode(*[v for row in self.frame for v in row])}
        ranking |= {} if self.memory is None else {"memory": self.memory}
        ranking |= {"moving": True} if self.moving else {}
        return {
            "schema": "certify-certificate/9",
            "claim": claim | ({} if self.keep is None else {"keep": self.keep}),
            "networks": [{"name": "pi", "reads": n, "steps": self.network}],
            "plant": {
                "name": "plant", "time": "continuous" if self.sample else "discrete", "states": list(self.states),
                "inputs": ["u"], "uncertain": [{"name": q, "range": [a, b]} for q, a, b in self.uncertain],
                "dynamics": self.dynamics, "u_eq": ["0"], "domain": [list(self.domain)] * n,
                "input_bounds": [[f"-{self.bound}", self.bound]],
            },
            "policy": policy,
            "lyapunov": None,
            "levels": {},
            "evidence": {"kind": "ranks", "order": self.order, "ranks": ranking},
            "provenance": {},
        }  # fmt: skip


def around_level(data: Document, P: float, level: float) -> Document:
    """The same with V = P x^2 and an asymptotic claim for {V <= level}, which one ball shows: one state."""
    claim = {k: v for k, v in data["claim"].items() if k not in ("kind", "target")}
    wide = encode(1.01 * math.sqrt(level / P))
    ball = {
        "J": wide, "multipliers": encode(2.0**-40, 2.0**-40, 2.0**-20),
        "weight": encode(1.0), "edge": (0.0).hex(), "order": data["evidence"]["order"],
    }  # fmt: skip
    return data | {
        "claim": {"kind": "asymptotic", "rate": (0.0).hex(), "outer": None} | claim,
        "lyapunov": {"kind": "quadratic", "P": encode(P)},
        "levels": {"local": level.hex(), "roa": level.hex()},
        "evidence": {
            "kind": "partition-tree", "T": encode(1.0), "root": wide, "tree": raw(b"\xff"),
            "order": data["evidence"]["order"], "cells": [1] * len(data["plant"]["uncertain"]), "local": ball,
            "contraction": None, "tube": [], "outer": None, "ranks": data["evidence"]["ranks"],
        },
    }  # fmt: skip


def uniform(lo: Sequence[float], hi: Sequence[float], depth: int) -> tuple[bytes, list[list[Interval]]]:
    """The tree that halves all axes in turn, 2^depth leaves, and their boxes in its order."""

    def cut(box: list[Interval], level: int) -> tuple[bytes, list[list[Interval]]]:
        if level == depth:
            return b"\xff", [box]
        axis = level % len(lo)
        a, b = box[axis]
        middle = 0.5 * a + 0.5 * b
        parts = [cut([*box[:axis], end, *box[axis + 1 :]], level + 1) for end in ((a, middle), (middle, b))]
        return bytes([axis]) + parts[0][0] + parts[1][0], parts[0][1] + parts[1][1]

    return cut(list(zip(lo, hi, strict=True)), 0)


def places(part: Interval, lo: float, hi: float) -> list[Interval]:
    """An interval of an angle in [lo, hi]."""
    a, b = part
    w = round(((a + b) - (lo + hi)) / 2 / TURN)
    a, b = a - w * TURN, b - w * TURN
    if lo <= a and b <= hi:
        return [(a, b)]
    parts = [(lo, b), (a + TURN, hi)] if a < lo else [(a, hi), (lo, b - TURN)]
    return parts if all(lo <= p <= q <= hi for p, q in parts) else [(lo, hi)]


def ranked(
    leaves: Sequence[Sequence[Interval]],
    image: Image,
    in_target: Callable[[Sequence[Interval]], bool],
    longest: int = 1,
    angles: Sequence[int] = (),
) -> tuple[list[int], list[int]]:
    """The least ranks, and their steps, that images of leaves in floats allow; UNRANKED where there are none."""
    n = len(leaves[0])
    lo, hi = [min(box[i][0] for box in leaves) for i in range(n)], [max(box[i][1] for box in leaves) for i in range(n)]
    after = list[list[Sequence[int] | None]]()  # for each leaf and number of steps the leaves that it meets
    for box in leaves:
        met = list[Sequence[int] | None]()
        for k in range(1, longest + 1):
            now = [(a - HAIR, b + HAIR) for a, b in image(box, k)]
            met.append(() if in_target(now) else meets(leaves, now, lo, hi, angles))
        after.append(met)
    return least_ranks([in_target(box) for box in leaves], after)


def least_ranks(there: Sequence[bool], after: Sequence[Sequence[Sequence[int] | None]]) -> tuple[list[int], list[int]]:
    """The least ranks of leaves, and their steps: 0 for those that are in the target; `after` has for each leaf and
    number of steps the leaves that it meets, None where it must not be followed."""
    ranks, steps, changed = [0 if here else UNRANKED for here in there], [0] * len(there), True
    while changed:
        changed = False
        for i, met in enumerate(after):
            for k, some in enumerate(met, 1):
                if some is None or any(ranks[j] == UNRANKED for j in some):
                    continue
                rank = k + max((ranks[j] for j in some), default=0)
                if rank < ranks[i]:
                    ranks[i], steps[i], changed = rank, k, True
    return ranks, steps


def meets(
    leaves: Sequence[Sequence[Interval]], box: Sequence[Interval], lo: Any, hi: Any, angles: Sequence[int]
) -> Sequence[int] | None:
    """The leaves that a box meets, or None if it leaves all of them."""
    parts = [places(part, lo[i], hi[i]) if i in angles else [part] for i, part in enumerate(box)]
    found = set[int]()
    for each in product(*parts):
        if any(a < lo[i] or b > hi[i] for i, (a, b) in enumerate(each)):
            return None
        found |= {
            j
            for j, leaf in enumerate(leaves)
            if all(a <= q and p <= b for (a, b), (p, q) in zip(each, leaf, strict=True))
        }
    return sorted(found)


def two_bytes(ranks: Sequence[int]) -> bytes:
    return struct.pack(f"<{len(ranks)}H", *ranks)


def dumped(data: Document) -> bytes:
    return json.dumps(data).encode()
