"""Policies of the pendulum whose networks are more than layers, by what they have."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from certify.loop.expressions import Number, cos, exp, sin, sqrt, symbols, tanh
from certify.loop.networks import Affine, Clip, Concat, Map, Network, Observe, Step, Sum, layered
from certify.loop.policies import PolicyNetwork

THETA, SPEED = symbols("theta theta_dot")
K = np.array([[20.0, 5.0]]) / 6


def _layers(reads: int, function: str, behind: int, seed: int) -> tuple[Step, ...]:
    """Small layers that end in one number, which is nearly 0."""
    generator = np.random.default_rng(seed)
    W, b = generator.normal(size=(8, reads)) / np.sqrt(reads), generator.normal(size=8) / 2
    return layered([W, generator.normal(size=(1, 8)) / 40], [b, np.zeros(1)], function, behind=behind)


def _linear(of: int, width: int = 2) -> Affine:
    return Affine((of,), -K if width == 2 else np.hstack([np.zeros((1, 1)), -K]), np.zeros(1))


def observed() -> Network:
    """cos, sin and the speed, and a layer."""
    first = Observe((0,), (THETA, SPEED), (cos(THETA), sin(THETA), SPEED))
    generator = np.random.default_rng(7)
    W, b = generator.normal(size=(8, 3)), generator.normal(size=8) / 2
    slopes = (W * (1 - np.tanh(W @ [1.0, 0.0, 0.0] + b) ** 2)[:, None])[:, 1:]
    last = -np.linalg.lstsq(slopes.T, K[0], rcond=None)[0][None]
    return Network(2, (first, *layered([W, last], [b, np.zeros(1)], behind=1)))


def skip() -> Network:
    """A gain beside a small network."""
    layers = _layers(2, "elu", 0, 1)
    return Network(2, (*layers, _linear(0), Sum((3, 4))))


def residual() -> Network:
    """A hidden skip connection, with relu."""
    generator = np.random.default_rng(2)
    W, V = generator.normal(size=(2, 2)) / 4, generator.normal(size=(2, 2)) / 4
    steps = (
        *(Affine((0,), W, np.array([0.5, -0.7])), Map((1,), "relu"), Affine((2,), V, np.zeros(2)), Sum((0, 3))),
        *(_linear(4), Clip((5,), np.array([-3.0]), np.array([2.5]))),
    )
    return Network(2, steps)


def branches() -> Network:
    """Two branches of other functions, one behind the other, and a state beside them."""
    steps = (
        *(
            Affine((0,), np.eye(2) / 2, np.array([0.4, -0.3])),
            Map((1,), "sigmoid"),
            Map((1,), "softsign"),
            Concat((2, 3, 0)),
        ),
        Affine((4,), np.hstack([np.array([[0.1, -0.1, 0.2, -0.3]]), -K]), np.zeros(1)),
    )
    return Network(2, steps)


def late() -> Network:
    """An observation of what a layer makes, beside the gain."""
    a, b = symbols("a b")
    odd = Observe((1,), (a, b), (a * b / 10, sqrt(a * a + 1), exp(-b * b) + tanh(a) / 2, Number(1) / (2 + cos(b))))
    steps = (
        *(Affine((0,), np.array([[0.3, 0.1], [-0.2, 0.2]]), np.array([0.1, 0.0])), odd),
        *(Affine((2,), np.full((1, 4), 0.05), np.zeros(1)), _linear(0), Sum((3, 4))),
    )
    return Network(2, steps)


PROGRAMS: Mapping[str, Callable[[], Network]] = {
    "observed": observed,
    "skip": skip,
    "residual": residual,
    "branches": branches,
    "late": late,
}


def policy(name: str, squash: str = "tanh", centre: str = "preactivation") -> PolicyNetwork:
    """One that stabilises the pendulum."""
    return PolicyNetwork(PROGRAMS[name](), np.array([6.0]), np.zeros(1), squash, centre)  # type: ignore[arg-type]
