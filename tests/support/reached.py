"""Claims `reached` for the checker's tests: a hand-written document, and a tube that the engine finds around a path.

The engine is a producer like any other: what it finds is a hint, and whether it is true is for the tests to say, by
`rate_outwards`, which writes condition 7' of docs/mathematics/tube.md down a second time, in ball arithmetic.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb

from certify.certificates import parse_certificate
from certify.checker.document import Certificate
from certify.checker.sections import Slab
from certify.effort import UNIT, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.provers.tube.path import find_path
from tests.support.balls import reached_from, with_ball
from tests.support.certificates import Document, decode, dump, edited, encode, verdict
from tests.support.oracle import ball, policies_in_arb, value_of

Array = np.ndarray


def attracted(data: Document, level: float = 1.0, tries: int = 40) -> Document:
    """An asymptotic claim with c1 = c2, as large as the local rule alone shows, starting at `level` and halving."""
    for _ in range(tries):
        found = edited(data, "levels", {"local": level.hex(), "roa": level.hex()})
        found = with_ball(edited(found, "evidence.root", encode(root_of(found, level))))
        if verdict(found) == "ACCEPTED":
            return found
        level /= 2
    raise ValueError("the local rule must show some level of this loop; it shows none.")


def root_of(data: Document, level: float) -> Array:
    """A box around {V <= level}, x = T z."""
    n = len(data["plant"]["states"])
    T, P = decode(data["evidence"]["T"]).reshape(n, n), decode(data["lyapunov"]["P"]).reshape(n, n)
    return np.asarray(np.sqrt(level * np.diag(np.linalg.inv(T.T @ P @ T))) * 1.01)


def loop_of(data: Document) -> ClosedLoop:
    """The producer's own reading of plant and policy."""
    found = parse_certificate(dump(data), "document")
    return ClosedLoop(found.system, found.network)


def surrounded(data: Document, centre: Sequence[float], start: Any, units: float = 20.0) -> Document | None:
    """The claim `reached` from {(x - c)'P(x - c) <= 1}, P = start; None where the engine finds no tube.

    Parameters
    ----------
    data : an asymptotic claim.
    centre, start : (n,) and (n, n).
    """
    n = len(centre)
    P, c2 = decode(data["lyapunov"]["P"]).reshape(n, n), float.fromhex(data["levels"]["roa"])
    c, P_0 = np.array(centre, dtype=np.float64), np.array(start, dtype=np.float64).reshape(n, n)
    tube, _ = find_path(loop_of(data), c, P_0, P / c2, Effort(units * UNIT))
    if tube is None:
        return None
    result = edited(data, "claim", reached_from(P_0, c))
    result["evidence"]["tube"] = [
        {"middle": encode(slab.middle), "end": encode(slab.end), "duration": float(slab.duration).hex(),
         "J": encode(slab.J), "multipliers": encode(slab.multipliers), "weight": encode(slab.weight),
         "path": {"centre": encode(slab.path.centre)}
         | {key: float(getattr(slab.path, key)).hex() for key in ("share", "edge", "motion", "joint")}}
        for slab in tube.slabs if slab.path is not None
    ]  # fmt: skip
    return json.loads(json.dumps(result))  # type: ignore[no-any-return]


# ------------------------------------------------------------------------------------------------- the conditions again


def field_in_arb(c: Certificate, states: Sequence[Sequence[arb]]) -> list[list[arb]]:
    """F at each of the states."""
    results = []
    for x, u in zip(states, policies_in_arb(c.policy, c.u_eq, states), strict=True):
        names = dict(zip((*c.states, *c.inputs), (*x, *u), strict=True))
        results.append([value_of(tree, names) for tree in c.dynamics.trees])
    return results


def dot(p: Sequence[arb], q: Sequence[arb]) -> arb:
    return sum((v * w for v, w in zip(p, q, strict=True)), arb(0))


def times(A: Array, p: Sequence[arb]) -> list[arb]:
    return [dot([arb(v) for v in row], p) for row in A.tolist()]


def rates_outwards(
    c: Certificate, before: tuple[Array, Array], slab: Slab, s: Fraction, directions: Array
) -> list[tuple[arb, list[arb]]]:
    """dW/dt and x where W = 1 at the instant s in [0, 1] of a slab, along these directions (K, n)."""
    (P_0, c_0), s_ = before, ball(s)
    if slab.path is None:
        raise TypeError("this slab has no path")
    h, c_1 = arb(slab.duration), slab.path.centre
    nodes = (P_0, slab.middle, slab.end)
    at = [(1 - s_) ** 2, 2 * s_ * (1 - s_), s_**2]
    rate = [-2 * (1 - s_), 2 - 4 * s_, 2 * s_]
    moved = [(arb(q) - arb(p)) / h for p, q in zip(c_0.tolist(), c_1.tolist(), strict=True)]
    middle = [(1 - s_) * arb(p) + s_ * arb(q) for p, q in zip(c_0.tolist(), c_1.tolist(), strict=True)]

    def mean(weights: Sequence[arb], e: Sequence[arb]) -> list[arb]:
        parts = [times(P, e) for P in nodes]
        return [dot(weights, each) for each in zip(*parts, strict=True)]

    edges = []
    for direction in directions.tolist():
        d = [arb(v) for v in direction]
        length = dot(d, mean(at, d)).sqrt()
        edges.append([v / length for v in d])
    points = [[p + q for p, q in zip(middle, e, strict=True)] for e in edges]
    results = []
    for e, x, F in zip(edges, points, field_in_arb(c, points), strict=True):
        away = [f - v for f, v in zip(F, moved, strict=True)]
        results.append((dot(e, mean(rate, e)) / h + 2 * dot(mean(at, e), away), x))
    return results


def nodes_before(c: Certificate) -> list[tuple[Array, Array]]:
    """Matrix and centre of the node before each slab."""
    slabs = c.tube.slabs  # type: ignore[union-attr]
    ends = [(slab.end, slab.path.centre) for slab in slabs if slab.path is not None]
    return [(c.tube.start, c.tube.centre), *ends[:-1]]  # type: ignore[list-item, union-attr]
