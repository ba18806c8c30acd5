"""Certificates whose constraints reach beyond {V <= c2}: an outer set, a tube around the origin and one around a path;
and constraints that are violated by a given distance somewhere in them, by geometry.

The loop is x' = -x + y/2, y' = -y - x/2 + u/4, u = tanh(-y), so that x^2 + y^2 falls everywhere.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from certify import certify_roa
from certify.loop.expressions import Expression, Number
from certify.loop.plants.system import System
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import Symbolic
from tests.support.certificates import Document, decode
from tests.support.staying import RADIUS, U, X, Y, plant, policy

Array = np.ndarray
SIZE, INNER = 0.3, 0.3  # radii of an obstacle, and of {V <= c2}
CENTRE = (1.2, 0.4)  # from which the path leads
ASKED: dict[str, dict[str, Any]] = {
    "outer": {"lyapunov": Symbolic(RADIUS, (X, Y)), "lyapunov_level": 1.0},
    "tube": {"box": {"x": 0.8, "y": 0.6}, "effort": 0.1},
    "path": {"reach_from": {"x": Fraction(6, 5), "y": Fraction(2, 5)}, "box": {"x": 0.2, "y": 0.1}, "effort": 0.1},
}


def loop(*keep: Expression) -> tuple[System, PolicyNetwork]:
    """The loop with constraints."""
    return plant([-X + Y / 2, -Y - X / 2 + U / 4], ["2", "2"], keep), policy([0.0, -1.0])


def certified(kind: str, folder: Path, *keep: Expression, level: float = INNER**2) -> Any:
    """The run's result for the claim of a kind about this loop."""
    return certify_roa(*loop(*keep), folder, level=level, P=[[1.0, 0.0], [0.0, 1.0]], **ASKED[kind])


@cache
def _made(kind: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        raw = certified(kind, Path(folder), X - 3).raw
    assert raw is not None
    return str(raw.decode())


def base(kind: str) -> Document:
    """An honest certificate with the constraint x < 3, which all of the domain keeps."""
    data: Document = json.loads(_made(kind))
    return data


def away_from(point: Array, by: float) -> list[Any]:
    """g of a round obstacle around a point, whose radius is 0.3 and so much."""
    far = [["**", ["-", name, str(Fraction(float(v)))], 2] for name, v in zip("xy", point, strict=True)]
    return ["-", str(Fraction(SIZE + by) ** 2), ["+", *far]]


def ellipsoids(data: Document) -> list[tuple[Array, Array]]:
    """(P, c) of sets that trajectories of the claim fill: the outer set, or the nodes of the tube."""
    if data["claim"].get("outer"):
        return [(np.eye(2), np.zeros(2))]
    nodes = [(data["claim"]["start"], data["claim"].get("centre"))]
    for slab in data["evidence"]["tube"][:-1]:
        nodes.append((slab["end"], None if slab["path"] is None else slab["path"]["centre"]))
    return [(decode(P).reshape(2, 2), np.zeros(2) if c is None else decode(c)) for P, c in nodes]


def touching(data: Document, angles: int, by: float) -> Iterator[list[Any]]:
    """Obstacles that reach so far into one of these sets, and not into {V <= c2}: each touches its ellipse from
    outside, along the normal."""
    sets = ellipsoids(data)
    for node in sorted({0, len(sets) // 8, len(sets) // 4}):
        P, c = sets[node]
        for angle in 0.1 + 2 * np.pi * np.arange(angles) / angles:
            way = np.array([np.cos(angle), np.sin(angle)])
            at = way / np.sqrt(way @ P @ way)
            normal = P @ at / np.linalg.norm(P @ at)
            middle = c + at + SIZE * normal
            if np.linalg.norm(middle) > 0.9:  # nearer ones are not shown on the ball of {V <= c2} either
                yield away_from(middle, by)


def widest(data: Document, axis: int) -> float:
    """The largest value of a state on the balls of all slabs, by their matrices."""
    found, before = [], np.array(decode(data["claim"]["centre"]) if "centre" in data["claim"] else [0.0, 0.0])
    for slab in data["evidence"]["tube"]:
        J, path = decode(slab["J"]).reshape(2, 2), slab["path"]
        after = before if path is None else decode(path["centre"])
        share = 1.0 if path is None else float.fromhex(path["share"])
        w = (after - before) / (2 * share)
        found.append(float((before + after)[axis] / 2 + np.hypot(np.linalg.norm(J[axis]), w[axis])))
        before = after
    return max(found)


def number(value: float) -> Number:
    """A binary64 number as it stands."""
    return Number(Fraction(float(value)))
