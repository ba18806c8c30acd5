"""Kinks on a ball: honest certificates, loops that diverge at a kink, models against sampled states, forgeries."""

from __future__ import annotations

import base64
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from certify.checker import kinks
from certify.checker.case import Case
from certify.checker.jets import Units, constant, unpacked
from certify.checker.near import Vector
from certify.checker.networks import Affine, Map, Network
from certify.checker.wiring import Clip
from tests.checker.test_contraction_in_steps import JUDGES
from tests.support.certificates import LEAF, Document, edited, encode, parse, verdict
from tests.support.kinked import even, kinked, mirrored, pi
from tests.support.marks import slow_after
from tests.support.network_loops import affine, hashed, joined, mapped, with_policy
from tests.support.reference import judge

ONE = [["+", ["/", "x0", "2"], "u"]]
TWO, P2 = ["x1", "u"], [[1.5, 0.5], [0.5, 1.0]]


def relu(gain: float, into: float = 1.0) -> Any:
    """u = gain relu(into x)."""
    return [(np.array([[into]]), np.zeros(1)), (np.array([[gain]]), np.zeros(1))]


HONEST: dict[str, Callable[[], Document]] = {
    "two halves of a line": lambda: kinked(ONE, mirrored([[-2.0]]), 1.0, 1.0, even(1, 0)),
    "a slope in a sector, without cones": lambda: kinked([["-", "u", "x0"]], relu(0.9), 1.0, 1.0, []),
    "the same on half lines": lambda: kinked([["-", "u", "x0"]], relu(0.9), 1.0, 1.0, even(1, 0)),
    "a plane": lambda: kinked(TWO, mirrored([[-1.0, -1.5]]), P2, 1.0, even(2, 3)),
    "discrete": lambda: kinked(["u"], mirrored([[0.5]]), 1.0, 1.0, even(1, 0), time="discrete"),
    "discrete, in a sector": lambda: kinked(["u"], relu(-0.9), 1.0, 1.0, [], time="discrete"),
}  # fmt: skip


@pytest.mark.parametrize("name", HONEST)
def test_honest_certificates_are_accepted(name: str) -> None:
    data = HONEST[name]()
    assert verdict(data) == "ACCEPTED" and judge(data) is None


@pytest.mark.parametrize("name", HONEST)
def test_without_directions_a_kink_at_the_origin_has_no_model(name: str) -> None:
    data = HONEST[name]()
    del data["evidence"]["local"]["directions"]
    assert verdict(data) in ("local", "inputs")  # inputs come first


DIVERGING: dict[str, Callable[[], Document]] = {
    "to the left": lambda: kinked(ONE, relu(-2.0), 1.0, 1.0, even(1, 0)),
    "to the right": lambda: kinked(ONE, relu(2.0, -1.0), 1.0, 1.0, even(1, 0)),
    "just": lambda: kinked([["-", "u", "x0"]], relu(1.0 + 2.0**-40), 1.0, 1.0, even(1, 0)),
    "not at all, but it stands still": lambda: kinked([["-", "u", "x0"]], relu(1.0), 1.0, 1.0, even(1, 0)),
    "just, in a sector": lambda: kinked([["-", "u", "x0"]], relu(1.0 + 2.0**-40), 1.0, 1.0, []),
    "on one side of a plane": lambda: kinked(TWO, relu_of([-1.0, -1.5]), P2, 1.0, even(2, 4)),
    "discrete": lambda: kinked(["u"], relu(-1.0 - 2.0**-40), 1.0, 1.0, even(1, 0), time="discrete"),
    "discrete, in a sector": lambda: kinked(["u"], relu(-1.0 - 2.0**-40), 1.0, 1.0, [], time="discrete"),
    "a kink at a distance": lambda: kinked(ONE, shifted(-2.0, 0.5), 1.0, 4.1, []),
    "a kink times an uncertain argument": lambda: times_an_argument("5/2"),
    "held inputs, with no enclosure on the cones": lambda: held("16/5"),
    "a kink under a tanh whose place rounding hides": lambda: under_a_tanh("1/10"),
}  # fmt: skip


def times_an_argument(gain: str) -> Document:
    """x' = q relu(x) - gain x, q in [0, 3], the product by a network that equations call."""
    tree = [["+", ["*", f"-{gain}", "x0"], ["network", "N", 0, "x0", "q"], "u"]]
    more: Any = {"uncertain": [("q", "0", "3")], "cells": [1]}
    data = kinked(tree, [(np.zeros((1, 1)), np.zeros(1))], 1.0, 1.0, [], **more)
    steps = [affine(0, [[1.0, 0.0]]), mapped(1, "relu"), affine(0, [[0.0, 1.0]]), joined("product", 2, 3)]
    data["networks"].append({"name": "N", "reads": 2, "steps": steps})
    return hashed(data)


def held(gain: str) -> Document:
    """x1' = 18/25 (x1 - gain u), u = x1 held for a time of 1: x1 is multiplied by e^.72 - gain (e^.72 - 1) < -1, though
    a straight step would shrink it. The search for the a-priori enclosure finds one on the ball, and none on cones.
    """
    slow = ["+", ["*", "-1/50", "x0"], ["*", "1/10", ["-", "x1", "u"]]]
    tree = ["*", "18/25", ["-", "x1", ["*", gain, "u"]]]
    return kinked([slow, tree], mirrored([[0.0, 1.0]]), np.eye(2), 0.0625, even(2, 6), sample=("1", "1"))


def under_a_tanh(gain: str) -> Document:
    """x' = tanh(|x|/2) - gain x on a small ball; in binary64 the tanh reads a number near -4 at 0 instead of 0."""
    tree = [["+", ["*", f"-{gain}", "x0"], "u"]]
    data = kinked(tree, [(np.zeros((1, 1)), np.zeros(1))], 2.0**60, 1.0, [], squash="tanh")
    first = affine(0, np.eye(10, 1), [0.0, 2.0**53, *np.ones(8)])
    last = affine(3, [[-0.5, *np.ones(10)]], [-(2.0**53 + 8)])
    return with_policy(data, [first, mapped(1, "relu"), joined("concat", 0, 2), last])


def relu_of(K: Any) -> Any:
    return [(np.array([K]), np.zeros(1)), (np.array([[1.0]]), np.zeros(1))]


def shifted(gain: float, at: float) -> Any:
    """u = gain (relu(x + at) - at): of x' = x/2 + u V falls for x > 2 gain at alone."""
    return [(np.array([[1.0]]), np.array([at])), (np.array([[gain]]), np.array([-gain * at]))]


@pytest.mark.parametrize("name", DIVERGING)
def test_a_loop_that_diverges_on_one_side_is_refused(name: str) -> None:
    data = DIVERGING[name]()
    assert verdict(data) == judge(data) == "local"


@pytest.mark.parametrize(("level", "found"), [(0.24, "ACCEPTED"), (3.99, "ACCEPTED"), (4.01, "local"), (9.0, "local")])
def test_a_kink_at_a_distance_ends_the_set_where_the_chord_does(level: float, found: str) -> None:
    """x' = x/2 - 2 (relu(x + 1/2) - 1/2) falls for x > -2."""
    assert verdict(kinked(ONE, shifted(-2.0, 0.5), 1.0, level, even(1, 0))) == found


# ------------------------------------------------------------------------------------------------------------- sampling


def random_network(rng: np.random.Generator, n: int) -> tuple[Network, Callable[..., np.ndarray], Any]:
    """A network of two hidden layers of relu, clip or tanh, some without biases, and the same in numpy."""
    sizes, steps, parts, last = [n, 5, 4, 2], list[Any](), list[Any](), 0
    free = rng.random() < 0.5
    for i, (a, b) in enumerate(pairwise(sizes)):
        W, bias = rng.normal(size=(b, a)), rng.normal(size=b) * (0.0 if free else 0.3)
        steps.append(Affine((last,), b, W, bias))
        last += 1
        parts.append(lambda x, W=W, bias=bias: x @ W.T + bias)
        if i == 2:
            break
        kind = rng.choice(["relu", "clip", "tanh"], p=[0.6, 0.25, 0.15])
        if kind == "clip":
            lo, hi = -rng.uniform(0, 0.5, b), rng.uniform(0.01, 0.5, b)
            steps.append(Clip((last,), b, lo, hi))
            parts.append(lambda x, lo=lo, hi=hi: np.clip(x, lo, hi))
        else:
            steps.append(Map((last,), b, str(kind)))
            parts.append((lambda x: np.maximum(x, 0)) if kind == "relu" else np.tanh)
        last += 1

    def f(x: np.ndarray, count: int | None = None) -> np.ndarray:
        """The value, or a vector before it."""
        for part in parts[:count]:
            x = part(x)
        return x

    return Network("net", n, tuple(steps)), f, sizes


def directions_in(cone: kinks.Cone, rng: np.random.Generator, n: int, count: int) -> np.ndarray:
    """Points of the ball in a cone, many of them near its edge."""
    d = rng.normal(size=(count, n))
    if cone.narrow:
        square, wide = (float(v) for v in cone.squares)
        c, sine = cone.c / np.sqrt(square), np.sqrt(wide / square)
        side = d - np.outer(d @ c, c)
        length = np.linalg.norm(side, axis=1, keepdims=True)
        side = np.divide(side, length, out=np.zeros_like(side), where=length > 0)
        angle = np.arcsin(sine) * np.minimum(1.2 * rng.random((count, 1)), 1.0) * (1 - 1e-12)
        d = np.cos(angle) * c + np.sin(angle) * side
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return np.asarray(d * np.minimum(1.3 * rng.random((count, 1)), 1.0))


def cones_of(rng: np.random.Generator, n: int, close: bool) -> list[kinks.Cone]:
    if rng.random() < 0.2:
        return [kinks.Cone(close=close)]
    trees = [base64.b64decode(tree) for tree in even(n, int(rng.integers(0, 4 if n < 3 else 3)))]
    every = list(kinks.cones(trees, n, close))
    return [every[i] for i in rng.choice(len(every), min(len(every), 4), replace=False)]


@pytest.mark.parametrize("seed", slow_after(12, range(40)))
@pytest.mark.parametrize("close", [False, True])
def test_models_hold_what_a_network_does_on_a_cone(seed: int, close: bool) -> None:
    """Of the value less what is known, at each d; with `close` of its difference at any two d as well."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 4))
    network, f, _ = random_network(rng, n)
    J = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-3, 0.5)
    nothing = constant(0, Units(np.zeros((n, n, 0))))
    x = [replace(nothing, a=Vector(row)) for row in J]
    with np.errstate(all="ignore"):
        for cone in cones_of(rng, n, close):
            y = kinks.OnCone(n, cone).value(network, x)
            d = directions_in(cone, rng, n, 400)
            left = beyond(f, y, J, d)
            size = np.linalg.norm(d, axis=1)
            whole = y.E.majorant + y.shares.majorant
            quadratic = np.einsum("ti,ijm,tj->tm", d, whole, d)
            doubt = y.slack.top + y.units.tilt(y.B.size).top
            assert np.all(left <= quadratic + size[:, None] * doubt + 1e-12)
            if close:
                e = directions_in(cone, rng, n, 400)
                gap = np.abs(beyond(f, y, J, d, True) - beyond(f, y, J, e, True))
                lip = y.lipschitz.top + doubt
                assert np.all(gap <= np.linalg.norm(d - e, axis=1)[:, None] * lip + 1e-12)


@pytest.mark.parametrize("seed", slow_after(12, range(40)))
@pytest.mark.parametrize("close", [False, True])
def test_a_kink_is_within_its_sector(seed: int, close: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """|e| <= |alpha.d| + beta ||d|| and <= rho ||d||, and with `close` so for differences."""
    rng, seen, found = np.random.default_rng(seed), list[Any](), kinks.Cone.bent
    monkeypatch.setattr(kinks.Cone, "bent", lambda *args: seen.append(found(*args)) or seen[-1])
    n = int(rng.integers(1, 4))
    network, f, _ = random_network(rng, n)
    J = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-3, 0.5)
    x = [replace(constant(0, Units(np.zeros((n, n, 0)))), a=Vector(row)) for row in J]
    for cone in cones_of(rng, n, close):
        seen.clear()
        with np.errstate(all="ignore"):
            kinks.OnCone(n, cone).value(network, x)
        d, e = directions_in(cone, rng, n, 400), directions_in(cone, rng, n, 400) * float(close)
        bent = [
            k
            for k, step in enumerate(network.steps)
            if isinstance(step, Clip) or getattr(step, "function", "") == "relu"
        ]
        for k, one in zip(bent, seen, strict=True):
            (v, y), (v0, y0) = ((f(at @ J.T, k), f(at @ J.T, k + 1)) for at in (d, e))
            left, gap = np.abs(y - y0 - one.slope * (v - v0)), d - e
            size = np.linalg.norm(gap, axis=1)[:, None]
            assert np.all(left <= np.abs(gap @ one.first.alpha) + one.first.beta * size + 1e-13)
            assert np.all(left <= one.first.rho * size + 1e-13)


def beyond(f: Callable[..., np.ndarray], y: Any, J: np.ndarray, d: np.ndarray, signed: bool = False) -> Any:
    """The distance of the value at d from y(0) + a.d + d'Q d + K[d]."""
    K = unpacked(np.moveaxis(y.K.value, 0, -1), d.shape[1])
    known = d @ y.a.value + np.einsum("ti,ijm,tj->tm", d, y.Q.value, d) + np.einsum("mhij,th,ti,tj->tm", K, d, d, d)
    found = f(d @ J.T) - f(np.zeros((1, d.shape[1]))) - known
    return found if signed else np.abs(found)


@pytest.mark.parametrize("seed", slow_after(8, range(60)))
def test_nothing_is_shown_that_samples_refute(seed: int) -> None:
    """Random loops near the edge of what holds: where all inequalities hold on all cones, V falls at all samples."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 3))
    width = int(rng.integers(1, 6))
    biases = rng.normal(size=width) * rng.choice([0.0, 0.3])
    W, v = rng.normal(size=(width, n)), rng.normal(size=(1, width)) * 0.5
    layers = [(W, biases), (v, -np.maximum(biases, 0.0) @ v.T)]
    A = rng.normal(size=(n, n)) - rng.uniform(0.5, 3) * np.eye(n)
    terms = [["+", *[["*", str(int(64 * a)) + "/64", f"x{j}"] for j, a in enumerate(row)], "u"] for row in A]
    A = np.trunc(64 * A) / 64
    data = kinked(terms, layers, np.eye(n), float(rng.uniform(0.1, 2)), even(n, int(rng.integers(0, 5))))
    case = Case(parse(data))
    for tree in range(3):
        if verdict(data) == "ACCEPTED":
            break
        data = edited(data, "evidence.local.directions", even(n, 4 + tree))
    shown = verdict(data) == "ACCEPTED"
    x = directions_in(kinks.Cone(), rng, n, 4000) * np.sqrt(case.c.c1)
    rise = np.sum(x * (x @ A.T + pi(layers, x)), axis=1)
    if shown:
        assert np.max(rise) < 0


@pytest.mark.slow
def test_enough_of_the_random_loops_are_shown() -> None:
    """The test above would hold of a rule that shows nothing."""
    rng, shown = np.random.default_rng(5), 0
    for _ in range(10):
        W = rng.normal(size=(4, 2))
        layers = [(W, np.zeros(4)), (rng.normal(size=(1, 4)) * 0.1, np.zeros(1))]
        data = kinked([["-", "u", "x0"], ["-", "u", "x1"]], layers, np.eye(2), 1.0, even(2, 3))
        shown += verdict(data) == "ACCEPTED"
    assert shown >= 5


# ------------------------------------------------------------------------------------------------------------ forgeries

PLANE = HONEST["a plane"]
Edit = Callable[[list[str]], Any]


def bytes_of(tree: str) -> bytes:
    return base64.b64decode(tree)


def text_of(tree: bytes) -> str:
    return base64.b64encode(tree).decode()


def first(change: Callable[[bytes], bytes]) -> Edit:
    return lambda trees: [text_of(change(bytes_of(trees[0]))), *trees[1:]]


FORGED: list[tuple[str, str, Edit]] = [
    ("format", "a tree less", lambda trees: trees[:-1]),
    ("format", "a tree more", lambda trees: [*trees, trees[0]]),
    ("format", "an object", lambda trees: dict.fromkeys("abcd", trees[0])),
    ("format", "null", lambda trees: None),
    ("format", "bytes that are none", lambda trees: [*trees[:-1], "!"]),
    ("format", "numbers", lambda trees: [255] * 4),
    ("local", "nothing of a tree", first(lambda tree: b"")),
    ("local", "a byte less", first(lambda tree: tree[:-1])),
    ("local", "a byte more", first(lambda tree: tree + bytes([LEAF]))),
    ("local", "an axis that there is not", first(lambda tree: bytes([2]) + tree[1:])),
    ("local", "the face's own axis", first(lambda tree: bytes([0]) + tree[1:])),
    ("local", "a whole face for a cone", first(lambda tree: bytes([LEAF]))),
    ("local", "halves of a face", first(lambda tree: bytes([1, LEAF, LEAF]))),
    ("local", "one cone", lambda trees: []),
    ("local", "faces in another order", lambda trees: [trees[2], trees[3], trees[0], trees[1]]),
    ("local", "a tree that is too deep", first(lambda tree: bytes([1]) * 3000 + bytes([LEAF]) * 3001)),
]


@pytest.mark.parametrize(("rule", "name", "change"), FORGED, ids=[name for _, name, _ in FORGED])
def test_a_forged_tree_of_directions_is_refused(rule: str, name: str, change: Edit) -> None:
    data = edited(PLANE(), "evidence.local.directions", change)
    assert verdict(data) == rule
    assert judge(data) == rule


def test_a_bias_that_is_nearly_0_is_not_0() -> None:
    """For |x| below 2^-61 the input is 0, and x' = x/2."""
    layers = mirrored([[-2.0]])
    layers = [(layers[0][0], np.array([-(2.0**-60), -(2.0**-60)])), layers[1]]
    assert verdict(kinked(ONE, layers, 1.0, 1.0, even(1, 0))) == "local"


@pytest.mark.parametrize(
    ("after", "found"),
    [
        ([affine(2, 0.1, [1.0]), mapped(3, "sqrt"), affine(4, 1.0, [-1.0])], "ACCEPTED"),
        ([mapped(2, "sqrt")], "inputs"),
        ([{"kind": "observe", "of": [2], "names": ["a"], "expressions": [["/", "1", "a"]]}], "inputs"),
        ([{"kind": "observe", "of": [2], "names": ["a"], "expressions": [["sqrt", "a"]]}], "inputs"),
    ],
)
def test_what_is_not_defined_at_0_is_refused_and_stops_no_checker(after: list[Document], found: str) -> None:
    """Of expressions that are asked whether they are 0 at d = 0; a root of 1 is defined."""
    tree = [["+", ["*", "-3", "x0"], ["/", "u", "8"]]]
    data = kinked(tree, relu(0.1), 1.0, 1.0, even(1, 0), centre="output")
    assert verdict(with_policy(data, [affine(0, 1.0), mapped(1, "relu"), *after])) == found


def test_an_input_that_a_clip_may_cut_is_refused() -> None:
    data = kinked(ONE, mirrored([[-2.0]]), 1.0, 1.0, even(1, 0), clip=([-1.5], [1.5]))
    assert verdict(data) == "local"


@pytest.mark.parametrize(("bound", "found"), [("9/5", "inputs"), ("11/5", "ACCEPTED")])
def test_inputs_are_bounded_with_all_that_kinks_may_add(bound: str, found: str) -> None:
    data = kinked(ONE, mirrored([[-2.0]]), 1.0, 1.0, even(1, 0), input_bounds=[("-" + bound, bound)])
    assert verdict(data) in (found, "inputs")


def nearby(gain: float, directions: Any, time: str = "continuous") -> Document:
    """x' = u - x + 1/100 or x+ = u + 1/100, u = gain relu(x), which may be held over 1/10, around the level 1/25."""
    term = ["+", "u", "1/100", *([["-", "x0"]] if time != "discrete" else [])]
    more: dict[str, Any] = {"sample": ("1/10", "1/10")} if time == "held" else {"time": time}
    data = kinked([term], relu(gain), 1.0, 1.0, None, claim="nearby", levels=(0.04, 0.04), **more)
    data["evidence"]["contraction"] = {
        "J": encode(0.2 * (1 + 1e-9)), "weights": encode([2.0**-40]), "weight": encode(2.0**-40),
        "directions": directions, **({"order": 4} if time == "held" else {}),
    }  # fmt: skip
    data["evidence"]["local"] = None
    return grow_small(data)


def grow_small(data: Document) -> Document:
    """With leaves of a line, where c0 = c1 = c2 is asked of all."""
    tree = bytes([0, 0, LEAF, LEAF, 0, LEAF, LEAF])
    for _ in range(5):
        if verdict(data) not in ("ring", "inputs"):
            break
        data["evidence"]["tree"] = text_of(tree)
        tree = bytes([0]) + tree + tree
    return data


@pytest.mark.parametrize("time", ["continuous", "discrete", "held"])
@pytest.mark.parametrize("directions", [[], even(1, 0)], ids=["one cone", "half lines"])
def test_two_trajectories_come_closer_across_a_kink(time: str, directions: Any) -> None:
    assert verdict(nearby(0.7, directions, time)) == "ACCEPTED"
    without = nearby(0.7, directions, time)
    del without["evidence"]["contraction"]["directions"]
    assert verdict(without) == "contraction"


@pytest.mark.parametrize(
    ("time", "gain"),
    [("continuous", 1.01), ("discrete", 1.01), ("discrete", -1.01), ("held", 1.01), ("held", -20.5)],
)
@pytest.mark.parametrize("directions", [[], even(1, 0)], ids=["one cone", "half lines"])
def test_trajectories_that_part_are_refused(time: str, gain: float, directions: Any) -> None:
    assert verdict(nearby(gain, directions, time)) in ("contraction", "ring")


@pytest.mark.parametrize("passes", JUDGES)
@pytest.mark.parametrize("directions", [[], even(1, 0)], ids=["one cone", "half lines"])
def test_the_limits_of_the_gain_are_those_of_the_plant(passes: Callable[[Document], bool], directions: Any) -> None:
    """A period multiplies x > 0 by e + (1 - e) gain, e = exp(-h), and x < 0 by e; a step of a map by gain, or 0."""
    e = np.exp(-0.1)
    for time, least in (("continuous", -np.inf), ("discrete", -1.0), ("held", -(1 + e) / (1 - e))):
        for gain in (0.999, least + 0.02 if least > -np.inf else -30.0):
            assert passes(nearby(gain, directions, time))
        for gain in (1.001, *([least - 0.02] if least > -np.inf else [])):
            assert not passes(nearby(gain, directions, time))
