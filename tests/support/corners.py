"""Random expressions with corners, and plants of one state that have them."""

from __future__ import annotations

import random
from fractions import Fraction

import numpy as np

from certify.loop.expressions import Expression, Number, Operation, Symbol, function, nodes, sin, symbols, tanh
from certify.loop.plants import System
from certify.loop.plants.equations import parse_expression
from certify.loop.policies import PolicyNetwork
from tests.support.loops import box

X, Y, U = symbols("x y u")


def tree(rng: random.Random, depth: int, leaves: tuple[Symbol, ...] = (X, Y)) -> Expression:
    """A random expression with abs, min, max and clip among other nodes."""
    if depth == 0:
        return rng.choice([*leaves, Number(Fraction(rng.randint(-8, 8), rng.choice([1, 3, 4])))])
    parts = [tree(rng, depth - 1, leaves) for _ in range(3)]
    a, b, c = parts
    kind = rng.choice(["abs", "min", "min3", "max", "max3", "clip", "+", "*", "-", "sin", "tanh", "**"])
    if kind in ("min", "max"):
        return function(kind, a, b)
    if kind in ("min3", "max3"):
        return function(kind[:3], a, b, c)
    if kind == "clip":
        ends = sorted(Fraction(rng.randint(-6, 6), 4) for _ in "ab")
        return function("clip", a, *(ends if rng.random() < 0.7 else (b, c)))
    return {
        "abs": lambda: abs(a),
        "+": lambda: a + b,
        "*": lambda: a * b,
        "-": lambda: a - b,
        "sin": lambda: sin(a),
        "tanh": lambda: tanh(a),
        "**": lambda: a**2,
    }[kind]()


def value(expression: Expression, at: dict[Symbol, np.ndarray]) -> np.ndarray:
    """Its values by numpy's own minimum, maximum and clip; shares nothing with the project's walks."""
    found: dict[Expression, np.ndarray] = {}
    for node in nodes(expression):
        if isinstance(node, Symbol):
            found[node] = at[node]
        elif isinstance(node, Number):
            found[node] = np.full_like(next(iter(at.values())), float(node.value))
        elif isinstance(node, Operation):
            v = [found[e] for e in node.operands]
            found[node] = {
                "abs": lambda v=v: np.abs(v[0]),
                "min": lambda v=v: np.min(v, axis=0),
                "max": lambda v=v: np.max(v, axis=0),
                "clip": lambda v=v: np.minimum(np.maximum(v[0], v[1]), v[2]),
                "+": lambda v=v: sum(v[1:], v[0]),
                "*": lambda v=v: np.prod(v, axis=0),
                "-": lambda v=v: -v[0],
                "/": lambda v=v: v[0] / v[1],
                "sin": lambda v=v: np.sin(v[0]),
                "tanh": lambda v=v: np.tanh(v[0]),
                "**": lambda v=v: v[0] ** v[1],
            }[node.operator]()
    return found[expression]


def plant(states: str, *equations: str, half: float | str = 3, bound: float = 4, **more: object) -> System:
    """A plant with the input u, from text."""
    known = {s: Symbol(s) for s in [*states.split(), "u", *(str(w) for w in more.get("ranges", {}))]}  # type: ignore[attr-defined]
    dynamics = tuple(parse_expression(e, known) for e in equations)
    halves = [half] * len(dynamics)
    return System(
        "cornered", tuple(known[s] for s in states.split()), (U,), {}, dynamics, (Number(0),), box(*halves), box(bound),
        disturbances=tuple(known[str(w)] for w in more.get("ranges", {})), **more,  # type: ignore[attr-defined, arg-type]
    )  # fmt: skip


def regulator(*gain: float, scale: float = 4.0) -> PolicyNetwork:
    """u = -scale tanh(gain.x / scale)."""
    layer = -np.array([gain]) / scale
    return PolicyNetwork.of_layers((layer,), (np.zeros(1),), np.array([scale]), np.zeros(1), "tanh", "none")
