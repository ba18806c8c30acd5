"""Policies with a narrow bump of two or three units that pushes one state of {V <= c2} away from the origin, or nearly.

The bump is phi(z + 1) - phi(z - 1) or phi(z + 1) - 2 phi(z) + phi(z - 1), z = w'(x - p)/width, p the state. Its height
is a share of that at which Vdot vanishes at p: above 1 the claim is false, which Arb shows at p.
"""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from flint import arb, ctx

from certify.checker.document import certificate
from tests.checker.test_attack_networks import Truths
from tests.checker.test_networks import FUNCTIONS, Numbers
from tests.support.certificates import Document, decode
from tests.support.earlier import newer
from tests.support.network_loops import ACTIVATIONS, FORMS, affine, hashed, joined, leaves, mapped, planar, scalar
from tests.support.stepped_loops import fitted

FLAT = ("sigmoid", "softsign")  # of which a difference is a bump


@dataclass(frozen=True)
class Planted:
    """A loop with a bump of a height at p."""

    document: Document
    p: np.ndarray

    @property
    def certificate(self) -> Document:
        """With hints as good as they are found: leaves are halved around p as long as they are not accepted."""
        return leaves(self.document if self.document["evidence"]["local"] is None else fitted(self.document))

    @property
    def rise(self) -> arb:
        """Vdot at p, in many digits."""
        with ctx.workprec(300):
            x, n = [arb(float(v)) for v in self.p], len(self.p)
            net = certificate(json.loads(json.dumps(self.document)), "").policy.network
            u = Truths().run(net, x)[0] - Truths().run(net, [arb(0)] * n)[0]
            F = [x[0] / 2 + x[0] ** 3 + u] if n == 1 else [x[1], u]
            P = decode(self.document["lyapunov"]["P"]).reshape(n, n).tolist()
            return 2 * sum((x[i] * arb(P[i][j]) * F[j] for i in range(n) for j in range(n)), arb(0))


def planted(name: str, seed: int, share: float | None = None) -> Planted:
    """One of many: in the ball or in the ring, with a ball or without, of two states at each fourth seed.

    `share` is one above 1 by default.
    """
    rng = np.random.default_rng([ACTIVATIONS.index(name), seed])
    form = FORMS[seed % len(FORMS)]
    form = "chain" if form == "clip" else form
    data = newer(planar(name, form) if seed % 4 == 3 else scalar(name, form, (0.01, 0.1)))
    P = decode(data["lyapunov"]["P"])
    n = round(len(P) ** 0.5)
    P = P.reshape(n, n)
    c1, c2 = (float.fromhex(data["levels"][key]) for key in ("local", "roa"))
    in_ring = rng.random() < 0.75
    level = rng.uniform(1.1 * c1, 0.999 * c2) if in_ring else rng.uniform(0.05, 0.95) * c1
    if in_ring and rng.random() < 0.7:  # a ball asks for more than the truth of units that are steep
        data["claim"]["kind"], data["evidence"]["local"] = "practical", None
        data["levels"]["floor"] = data["levels"]["local"]
    d = np.linalg.inv(np.linalg.cholesky(P)).T @ direction(rng, n)
    p = np.sqrt(level) * d
    w = rng.normal(size=n)
    w /= np.linalg.norm(w)
    width = float(np.sqrt(level) * 10.0 ** rng.uniform(-3, -0.5))
    share = 1 + 10.0 ** rng.uniform(-4, 0.3) if share is None else share
    shifts, weights = ([1, -1], [1.0, -1.0]) if name in FLAT else ([1, 0, -1], [1.0, -2.0, 1.0])
    W, b = np.tile(w / width, (len(shifts), 1)), np.array(shifts) - w @ p / width
    phi = FUNCTIONS[name]
    with np.errstate(over="ignore"):
        bump = float(weights @ (phi(W @ p + b) - phi(b)))
    height = -share * vdot(data, p, P) / (2 * (P @ p)[-1] * bump)
    own = data["networks"][0]["steps"]
    count = len(own)
    branch = [affine(0, W, b), mapped(count + 1, name), affine(count + 2, height * np.array(weights))]
    made = copy.deepcopy(data)
    made["networks"][0]["steps"] = [*own, *branch, joined("sum", count, count + 3)]
    made["plant"]["input_bounds"] = [["-1000000", "1000000"]]
    return Planted(hashed(made), p)


def direction(rng: Any, n: int) -> np.ndarray:
    """Of length 1, and one in which the input has its part in Vdot: that is the last entry of Px, L'^-1 d being x."""
    if n == 1:
        return np.array([float(rng.choice([-1.0, 1.0]))])
    turn = rng.uniform(-0.9, 0.9) + np.pi / 2 * float(rng.choice([-1.0, 1.0]))
    return np.array([np.cos(turn), np.sin(turn)])


def vdot(data: Document, p: np.ndarray, P: np.ndarray) -> float:
    """Without the bump, in floats."""
    net = certificate(json.loads(json.dumps(data)), "").policy.network
    u = float((Numbers().run(net, p[:, None]) - Numbers().run(net, 0 * p[:, None]))[0, 0])
    F = np.array([p[0] / 2 + p[0] ** 3 + u]) if len(p) == 1 else np.array([p[1], u])
    return float(2 * p @ P @ F)
