"""Loops whose policy has any activation in any step of a network, with a certificate of each kind of claim.

One state, x' = x/2 + x^3 + u, or two, x' = y, y' = u; the policy's slope at the origin is that of a gain. Balls, trees
and tubes are hints, as in `balls.py`.
"""

from __future__ import annotations

import base64
import copy
import json
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import numpy as np

from tests.checker.test_networks import FUNCTIONS, hash_of
from tests.support.balls import enlarge, with_ball
from tests.support.beyond import uniform
from tests.support.certificates import Document, edited, encode, grow, make
from tests.support.earlier import newer
from tests.support.paths import follow
from tests.support.stepped_loops import fitted

ACTIVATIONS = ("relu", "elu", "sigmoid", "silu", "gelu", "softplus", "mish", "softsign")
FORMS = ("chain", "clip", "sum", "concat", "observe")
KINDS = (
    *("asymptotic", "rate", "practical", "nearby", "sampled", "discrete", "ranges"),
    *("enlarged", "reached", "outer"),
)
GAIN, REACH = 1.5, 0.6  # of the policy; of the sets {N <= n2}
WAYS = np.array([[1.0], [-1.0], [0.5], [-0.5]])
Steps = list[Document]


def slope(name: str, v: float) -> float:
    """phi'(v), v not being a corner."""
    return float((at(name, v + 1e-6) - at(name, v - 1e-6)) / 2e-6)


def at(name: str, v: float) -> Any:
    return FUNCTIONS[name](np.float64(v))


def affine(of: int, W: Any, b: Any = None) -> Document:
    W = np.atleast_2d(np.asarray(W, dtype=float))
    b = np.zeros(len(W)) if b is None else b
    return {"kind": "affine", "of": [of], "shape": list(W.shape), "weight": encode(W), "bias": encode(b)}


def mapped(of: int, name: str) -> Document:
    return {"kind": "map", "of": [of], "function": name}


def joined(kind: str, *of: int) -> Document:
    return {"kind": kind, "of": list(of)}


def policy(form: str, name: str, W: Any, b: Any, v: Any, K: Any) -> Steps:
    """Steps of a policy whose gradient at the origin is K, which is v'phi(W x + b) there too."""
    W, b, v, K = (np.asarray(part, dtype=float) for part in (W, b, v, K))
    match form:
        case "chain":
            return [affine(0, W, b), mapped(1, name), affine(2, v)]
        case "clip":
            middle = FUNCTIONS[name](b)
            clip = {"kind": "clip", "of": [2], "lo": encode(middle - 0.25), "hi": encode(middle + 0.25)}
            return [affine(0, W, b), mapped(1, name), clip, affine(3, v)]
        case "sum":
            return [affine(0, K / 2), affine(0, W, b), mapped(2, name), affine(3, v / 2), joined("sum", 1, 4)]
        case "concat":
            return [affine(0, W, b), mapped(1, name), joined("concat", 0, 2), affine(3, np.append(K / 2, v / 2))]
    names = ["x", "y"][: W.shape[1]]
    root = ["-", ["sqrt", ["+", "1", ["*", str(len(names)), "x"]]], "1"]  # of slope 1/2, or 1
    seen = [["sin", "x"], ["*", names[-1], ["cos", "x"]], root]
    mixed = np.column_stack([W[:, 0] / 2, W[:, 0] / 4 if len(names) == 1 else W[:, 1], W[:, 0] / 2])
    observe = {"kind": "observe", "of": [0], "names": names, "expressions": seen}
    return [observe, affine(1, mixed, b), mapped(2, name), affine(3, v)]


def biases(name: str) -> np.ndarray:
    b = 0.7 if name == "relu" else 0.4
    return np.array([b, b, b / 2, b / 2])


def with_policy(data: Document, steps: Steps) -> Document:
    """A document of format 9 with this policy, under its own hash."""
    data = copy.deepcopy(newer(data))
    data["networks"][0]["steps"] = steps
    return hashed(data)


def hashed(data: Document) -> Document:
    data["policy"]["sha256"] = hash_of(data)
    return data


PLAIN: dict[str, Any] = {"squash": "identity", "centre": "output", "scale": [1.0], "input_bounds": [("-9", "9")]}
X: list[Any] = ["+", ["/", "x", "2"], ["**", "x", 3], "u"]


def scalar(
    name: str, form: str, levels: Sequence[float], gain: float = GAIN, b: Any = None, tree: Any = X, **more: Any
) -> Document:
    """x' = x/2 + x^3 + u, or another equation, without a ball and a tree."""
    b = biases(name) if b is None else np.asarray(b, dtype=float)
    steep = np.array([slope(name, v) for v in b])
    v = -gain * WAYS[:, 0] / (WAYS[:, 0] ** 2 @ steep)
    data = make([tree], [([[0.0]], [0.0])], [[1.0]], levels, **(PLAIN | {"domain": [("-9/10", "9/10")]} | more))
    return with_policy(data, policy(form, name, WAYS, b, v, [-gain]))


def planar(name: str, form: str) -> Document:
    """x' = y, y' = u with the gradient -(1, 1.6)."""
    generator = np.random.default_rng(len(name))
    W, b = generator.normal(size=(6, 2)), generator.choice([-1, 1], 6) * generator.uniform(0.6, 1.0, 6)
    b[:4] = abs(b[:4])
    K = np.array([-1.0, -1.6])
    v = K @ np.linalg.pinv(np.array([slope(name, each) for each in b])[:, None] * W)
    data = make(
        ["y", "u"], [(np.zeros((1, 2)), [0.0])], [[1.8, 0.5], [0.5, 0.9]], (0.005, 0.02),
        states="xy", **PLAIN, domain=[("-3", "3")] * 2,
    )  # fmt: skip
    return with_policy(data, policy(form, name, W, b, v, K))


# ------------------------------------------------------------------------------------------------ kinds of certificates


def claim(name: str, form: str, kind: str) -> Document:
    """An honest certificate of one state."""
    match kind:
        case "asymptotic":
            return proved(scalar(name, form, (0.01, 0.1)))
        case "rate":
            return leaves(fitted(scalar(name, form, (0.01, 0.1), rate=0.25)))
        case "practical":
            return leaves(fitted(disturbed(name, form), edge=1.0))
        case "nearby":
            ball = {"J": encode([0.11]), "weights": encode([0.005]), "weight": encode([1.0])}
            data = edited(disturbed(name, form, "nearby"), "evidence.contraction", ball)
            return leaves(fitted(data, edge=1.0))
        case "sampled":
            data = scalar(name, form, (0.01, 0.1), sample=("1/16", "1/8"), order=3)
            return leaves(fitted(data, order=3))
        case "discrete":
            return leaves(fitted(scalar(name, form, (0.01, 0.1), tree=["+", "x", ["/", X, "4"]], time="discrete")))
        case "ranges":
            tree = ["+", ["*", "q", "x"], *X[2:]]
            return proved(scalar(name, form, (0.01, 0.1), tree=tree, uncertain=[("q", "1/4", "3/4")], cells=[2]))
        case "enlarged":
            data = with_ball(scalar(name, form, (0.02, 0.02)))
            return enlarge(data, [np.eye(1) / c for c in np.geomspace(0.05, 0.0199, 9)], [0.125] * 8)
        case "reached":
            data = with_ball(scalar(name, form, (0.02, 0.02)))
            return follow(data, path(name, form, 0.3, 28), [np.eye(1) * 400.0] * 29, [1 / 16] * 28)
    return beyond(with_ball(scalar(name, form, (0.05, 0.05))), name)


def disturbed(name: str, form: str, kind: str = "practical") -> Document:
    """With |w| <= 1/64 besides."""
    return scalar(
        name, form, (0.01, 0.02, 0.1), tree=[*X, "w"], claim=kind, uncertain=[("w", "-1/64", "1/64")], cells=[1]
    )  # fmt: skip


def path(name: str, form: str, start: float, count: int) -> list[np.ndarray]:
    """States on a trajectory, 1/16 apart."""
    u, h = inputs(scalar(name, form, (0.02, 0.02))), 1 / 256

    def F(x: float) -> float:
        return x / 2 + x**3 + u(x)

    found, x = [np.array([start])], start
    for k in range(1, 16 * count + 1):
        x += h * F(x + h / 2 * F(x))
        found += [np.array([x])] if k % 16 == 0 else []
    return found


def inputs(data: Document) -> Callable[[float], float]:
    """The policy in floats, less its value at 0."""
    from certify.checker.document import certificate
    from tests.checker.test_networks import Numbers

    net = certificate(json.loads(json.dumps(data)), "").policy.network
    start = float(Numbers().run(net, np.zeros((net.reads, 1)))[0, 0])
    return lambda x: float(Numbers().run(net, np.array([[x]]))[0, 0]) - start


def wells(name: str) -> tuple[Steps, Callable[[float], float]]:
    """A network N that rises with |x|, and it in floats; its corners lie inside the ellipsoid or outside the domain."""
    a = 1.0 if name in ("sigmoid", "softsign", "tanh") else 0.0
    phi = FUNCTIONS[name]
    steps = [affine(0, [[1.0], [-1.0]], [-a, -a]), mapped(1, name), affine(2, [[1.0, 1.0]])]
    return steps, lambda x: float(phi(np.float64(x - a)) + phi(np.float64(-x - a)))


def beyond(data: Document, name: str) -> Document:
    """With {N <= n2} up to |x| = 0.6."""
    steps, N = wells(name)
    data = copy.deepcopy(data)
    data["networks"].append({"name": "N", "reads": 1, "steps": steps})
    data["claim"]["outer"] = {"expression": ["network", "N", 0, "x"], "level": N(REACH).hex()}
    tree, leaf = (base64.b64encode(uniform(depth, [0])).decode() for depth in (9, 0))
    data["evidence"]["outer"] = {"T": encode([1.0]), "root": encode([0.9375]), "tree": tree, "faces": [leaf, leaf]}
    return data


def leaves(data: Document) -> Document:
    return grow(data, max_leaves=600, depth=18)


def proved(data: Document) -> Document:
    return leaves(with_ball(data))


@cache
def honest(name: str, form: str = "chain", kind: str = "asymptotic") -> Document:
    """Shared between tests, which edit copies only."""
    return proved(planar(name, form)) if kind == "planar" else claim(name, form, kind)


def raw(data: Document) -> bytes:
    return json.dumps(newer(data)).encode()
