"""Elu and softsign of what may be 0 in the middle of a ball, where they have a tangent: attacks on both programs.

Networks and equations lie in their models, at sampled d, in 300 bits; and loops that are false because of the corner
are refused beyond the level where they turn.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from flint import arb, fmpq

from certify.checker import ball, document
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.functions import FUNCTIONS
from certify.checker.jets import Units
from certify.checker.kinks import Cone, OnCone
from certify.checker.near import Above, Near
from certify.checker.networks import Affine, Map, Network, Step
from certify.checker.ranges import Swayed, uncertain
from certify.checker.wiring import Sum
from tests.checker.test_attack_activations import (
    DEFINITIONS,
    PROGRAMS,
    ZERO,
    Array,
    Values,
    behind,
    closer,
    contracts,
    directions,
    is_limited,
    length,
    lies_in_the_checkers,
    lies_in_the_references,
    many_digits,
    mapped,
    of_the_reference,
    on_a_ball,
    polynomial,
    sampled,
    written,
)  # fmt: skip
from tests.checker.test_attack_networks import affine, call, linear
from tests.checker.test_networks import a_jet, hash_of
from tests.support.certificates import Document, encode, make
from tests.support.earlier import newer
from tests.support.kinked import with_directions
from tests.support.marks import slow_after

__all__ = ["many_digits"]
NAMES = ("elu", "softsign")


# -------------------------------------------------------------------------------------------------------------- models


def cornered(rng: Any, reads: int, middle: Array, relus: bool) -> Network:
    """Layers whose preactivations at the ball's middle are 0 up to rounding, or a little beside it."""
    steps, at = list[Step](), [middle]
    for _ in range(int(rng.integers(1, 4))):
        i, rows = len(at) - 1, int(rng.integers(1, 5))
        W = rng.normal(size=(rows, len(at[i])))
        beside = rng.choice([-1.0, 1.0], rows) * rng.choice([0.0, 1e-300, 1e-17, 1e-16, 1e-9], rows)
        b = np.zeros(rows) if not np.any(at[i]) and rng.random() < 0.6 else beside - W @ at[i]
        name = "relu" if relus and rng.random() < 0.4 else str(rng.choice(NAMES))
        steps += [Affine((i,), rows, W, b), Map((len(at),), rows, name)]
        v = W @ at[i] + b
        at += [v, {"relu": np.maximum(v, 0), "elu": np.expm1(np.minimum(v, 0)) + np.maximum(v, 0)}.get(
            name, v / (1 + np.abs(v)))]  # fmt: skip
        if rng.random() < 0.3:
            steps.append(Map((len(at) - 1,), rows, str(rng.choice(NAMES))))
            at.append(at[-1])
            steps.append(Sum((len(at) - 1, len(at) - 2), rows))
            at.append(2 * at[-1])
    steps.append(Affine((len(at) - 1,), 2, rng.normal(size=(2, len(at[-1]))), rng.normal(size=2)))
    return Network("net", reads, tuple(steps))


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("relus", [False, True])
@pytest.mark.parametrize("seed", slow_after(12, range(60)))
def test_a_network_at_its_corners_lies_in_its_model(seed: int, relus: bool) -> None:
    """With relus beside them, which have kinks, on the cone of all d: at d on the ball, shorter ones too."""
    rng = np.random.default_rng([seed, relus])
    scale, none = 10.0 ** rng.uniform(-6, 0.3), Units(np.zeros((2, 2, 0)), np.zeros((0, 0)))
    given = [a_jet(rng, 2, scale, none)[0] for _ in range(2)]
    if rng.random() < 0.6:
        given = [replace(v, c=Near(np.float64(0.0))) for v in given]
    network = cornered(rng, 2, np.array([float(v.c.value) for v in given]), relus)
    with np.errstate(all="ignore"):
        h = (OnCone(2, Cone()) if relus else ball.OnBall(2)).value(network, given)
        slack = h.slack.top + h.units.tilt(h.B.size).top * np.ones(2)
    M = h.remainder + np.tensordot(h.units.U, np.abs(h.B.value), 1)
    assert np.all(np.isfinite(M)) and np.all(np.isfinite(slack)) and np.all(np.isfinite(h.v0.size.top))
    start = Values().run(network, [arb(float(v.c.value)) for v in given])
    for v, c, e in zip(start, h.c.value.tolist(), h.c.error.top.tolist(), strict=True):
        assert not abs(v - arb(c)) > arb(e)
    for d in directions(rng, 10):
        true = Values().run(network, [arb(float(v.c.value)) + linear(v.a.value, d) for v in given])
        for j in range(2):
            a = [arb(float(v)) for v in h.a.value[:, j]]
            rest = true[j] - start[j] - polynomial(a, h.Q.value[..., j], h.K.value[:, j], d)
            most = linear(M[..., j].ravel(), [x * y for x in d for y in d])
            assert not abs(rest) > most * (1 + 2.0**-50) + arb(float(slack[j])) * length(d)


def equations_at_corners(seed: int) -> tuple[Document, Array]:
    """Two states, a policy and a network that the equations call, of elu and softsign units whose arguments a quantity
    moves from one side of 0 to the other."""
    rng = np.random.default_rng(seed)
    scale, at = 10.0 ** rng.uniform(-5, -0.3), rng.normal(size=2)
    reach = scale * float(rng.choice([1e-9, 1e-3, 0.05, 1.0]))
    data = newer(make(
        [["+", "x", "u"], ["+", "y", "v"]], [(np.zeros((2, 2)), np.zeros(2))], np.eye(2), (1.0, 1.0), states=("x", "y"),
        inputs=("u", "v"), u_eq=("0", "0"), domain=[("-9", "9")] * 2, input_bounds=[("-999", "999")] * 2,
        squash=str(rng.choice(["tanh", "identity"])), centre="none", scale=[1.5, -0.7], offset=[0.1, 0.2],
        claim="nearby", time=str(rng.choice(["discrete", "continuous"])),
        uncertain=[("q", str(Fraction(-reach)), str(Fraction(reach)))],
    ))  # fmt: skip
    data["networks"] = [
        {"name": name, "reads": 2, "steps": [written(step) for step in cornered(rng, 2, middle, False).steps]}
        for name, middle in {"policy": at, "f": np.zeros(2)}.items()
    ]
    f = ["+", "x", "q"], ["+", ["*", "x", "y"], ["*", str(rng.choice(["0", "1"])), "q"]]
    data["plant"]["dynamics"] = [
        ["+", call("f", *f), ["*", "u", "q"]],
        ["-", "v", ["*", ["network", "f", 1, *f], ["/", "1", ["+", "5", "q", ["*", "y", "y"]]]]],
    ]
    J = rng.normal(size=(2, 2)) * scale
    data["policy"].update(network="policy", origin=encode(at))
    data["evidence"]["contraction"] = {"J": encode(J), "weights": encode([1.0, 1.0]), "weight": encode(np.eye(2))}
    data["policy"]["sha256"] = hash_of(data)
    return data, J


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("seed", slow_after(10, range(50)))
def test_equations_at_corners_lie_in_the_models_of_both_programs(seed: int) -> None:
    """For each q of the cell, values at d = 0 and on the ball, wherever q has moved the corner."""
    rng, (data, J) = np.random.default_rng(seed), equations_at_corners(700 + seed)
    c = document.certificate(json.loads(json.dumps(data)), "")
    with np.errstate(all="ignore"):
        G = Ball(Case(c), J, "here").change(c.ranges)
        assert all(np.all(np.isfinite(part)) for g in G for part in (g.v0.size.top, g.remainder, g.slack.top))
    theirs = of_the_reference(data, J, c.ranges[0])
    assert theirs is not None
    for share, j, start, own in sampled(c, J, rng, 5):
        lies_in_the_checkers(G[j], share, start, own)
        lies_in_the_references(theirs[j].where([share]), start, own)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize(("lo", "hi"), [("-1", "1"), ("-1/4", "1"), ("-1", "1/4"), ("1/4", "1"), ("-2", "-1")])
def test_a_quantity_that_crosses_a_corner_is_no_line(name: str, lo: str, hi: str) -> None:
    """phi of a quantity's own jet, which no equation can ask for, has what phi is away from its tangent, or nothing."""
    a, b = Fraction(lo), Fraction(hi)
    with np.errstate(all="ignore"):
        jet = uncertain(a, b, Units(np.zeros((1, 1, 0))), 0, 1).function(name)
        error = float(jet.error.top)
    assert isinstance(jet, Swayed) and np.isfinite(error) is np.bool_(a > 0 or b < 0)
    for q in (a, b, (a + b) / 2):
        y = arb(fmpq(*((2 * q - a - b) / (b - a)).as_integer_ratio()))
        true = DEFINITIONS[name](arb(fmpq(*q.as_integer_ratio())))
        assert not abs(true - arb(float(jet.c.value)) - y * arb(float(jet.c_y.value[0]))) > arb(error)


@pytest.mark.usefixtures("many_digits")
@pytest.mark.parametrize("name", NAMES)
def test_around_a_corner_there_is_a_tangent_and_no_more(name: str) -> None:
    """At all v0 of a range over 0; no Lipschitz constant of what it leaves, and no derivative of phi'."""
    rng = np.random.default_rng(5)
    for _ in range(40):
        c, r = rng.normal() * 10.0 ** rng.uniform(-12, 0.5), 10.0 ** rng.uniform(-9, 1)
        error = abs(c) * float(rng.choice([1.0, 1.5, 100.0]))
        e = FUNCTIONS[name].expansion(Near(np.float64(c), Above(error)), Above(r))
        with np.errstate(all="ignore"):
            f0, f1, half, sixth = e.f
            rest = float((e.fourth * Above(r) * Above(r)).top)
            assert half.size.top < 1e-300 > sixth.size.top and np.isnan(e.last.top)
            assert all(np.isnan(v.error.top) for v in e.derivative.stored)
        for v0 in (c - error, c, c + error, 0.0):
            y = arb(v0)
            slope = y.min(ZERO).exp() if name == "elu" else 1 / (1 + abs(y)) ** 2
            value = DEFINITIONS[name](y)
            assert not abs(value - arb(float(f0.value))) > arb(float(f0.error.top)) * (1 + 2.0**-50)
            assert not abs(slope - arb(float(f1.value))) > arb(float(f1.error.top)) * (1 + 2.0**-50)
            for D in (-r, r, -v0, -1.5 * v0, -r / 3):
                if abs(D) <= r:
                    left = DEFINITIONS[name](y + arb(D)) - value - slope * arb(D)
                    assert not abs(left) > arb(rest) * arb(D) ** 2 * (1 + 2.0**-50)


# ------------------------------------------------------------------ loops that are false because of what bends at 0


def bent(name: str, k: str, more: Any = 0) -> Any:
    """k (x - phi(x)) - x and more: x - phi(x) is about x^2/2 left of 0 with elu, x |x| with softsign."""
    return ["-", ["+", ["*", k, ["-", "x", call("f", "x")]], str(more)], "x"]


def around_a_level(r: float) -> bytes:
    """With a push to the right by 1/256, and 2 x F + (x^2 - c0)/2 < 0 on the ball."""
    data = json.loads(on_a_ball(bent("elu", "16", "1/256"), r, behind("elu", shift=0.0)))
    data["claim"]["kind"] = "practical"
    data["levels"]["floor"] = (0.0004).hex()
    data["evidence"]["local"]["edge"] = (0.5).hex()
    return json.dumps(data).encode()


def a_corner_that_moves(r: float) -> bytes:
    """x (elu(x + q) - 1), the largest at q = 1/8."""
    moved: Any = [{"name": "q", "range": ["-1/8", "1/8"]}]
    tree = ["*", "x", ["-", call("f", ["+", "x", "q"]), "1"]]
    data = json.loads(on_a_ball(tree, r, behind("elu", shift=0.0), uncertain=moved))
    data["evidence"]["local"]["multipliers"] = encode([[0.0], [1.0], [1.0]])
    return json.dumps(data).encode()


def beside_a_relu(r: float) -> bytes:
    """u = -8 elu(x) + 8 relu(x) - 8 relu(-x) is 8 (x - elu(x)), with directions for the relus."""
    steps = [
        affine(0, [[1.0]]), mapped(1, "elu"), affine(0, [[1.0], [-1.0]], [0.0, 0.0]), mapped(3, "relu"),
        {"kind": "concat", "of": [2, 4]}, affine(5, [[-8.0, 8.0, -8.0]]),
    ]  # fmt: skip
    return json.dumps(with_directions(json.loads(on_a_ball(["-", "u", "x"], r, policy=steps)), HALVES)).encode()


def of_a_relu(r: float) -> bytes:
    """u = 8 (relu(x) - relu(-x) - elu(relu(x) - relu(-x))): the argument of elu is kinks, and x all the same."""
    steps = [
        affine(0, [[1.0], [-1.0]], [0.0, 0.0]), mapped(1, "relu"), affine(2, [[1.0, -1.0]]), mapped(3, "elu"),
        {"kind": "concat", "of": [3, 4]}, affine(5, [[8.0, -8.0]]),
    ]  # fmt: skip
    return json.dumps(with_directions(json.loads(on_a_ball(["-", "u", "x"], r, policy=steps)), HALVES)).encode()


HALVES, LIMIT = ["/w==", "/w=="], 0.2733
GAIN: Any = [{"name": "q", "range": ["0", "16"]}]
HELD: Any = {"sample": ["1/4", "1/2"]}
DOUBLE: Any = [
    affine(0, [[1.0]]), mapped(1, "softsign"), {"kind": "concat", "of": [0, 2]}, affine(3, [[8.0, -9.0]]),
]  # fmt: skip
CLAIMS: dict[str, tuple[Callable[[float], bytes], float, float]] = {  # up to which r it is true, and what is shown
    "elu": (lambda r: on_a_ball(bent("elu", "16"), r, behind("elu", shift=0.0)), 0.1305, 0.95),
    "softsign": (lambda r: on_a_ball(bent("softsign", "9"), r, behind("softsign", shift=0.0)), 0.125, 0.85),
    "elu of softsign": (
        lambda r: on_a_ball(bent("", "9"), r, behind("softsign", "elu", shift=0.0, more=0.0)), 0.083, 0.85,
    ),
    "any gain": (
        lambda r: on_a_ball(bent("elu", "q"), r, behind("elu", shift=0.0), uncertain=GAIN), 0.1305, 0.9,
    ),
    "a corner that moves": (a_corner_that_moves, 0.875, 0.5),
    "around a level": (around_a_level, 0.1345, 0.6),
    "discrete time": (
        lambda r: on_a_ball(["+", bent("softsign", "9"), "x"], r, behind("softsign", shift=0.0), time="discrete"),
        0.125, 0.8,
    ),
    "a held input": (lambda r: on_a_ball("u", r, claim=HELD, policy=DOUBLE), 0.125, 0.5),
    "beside a relu": (beside_a_relu, LIMIT, 0.9),
    "of a relu": (of_a_relu, LIMIT, 0.9),
}  # fmt: skip


@PROGRAMS
@pytest.mark.parametrize("name", CLAIMS)
def test_what_bends_at_the_corner_limits_a_ball(name: str, program: Callable[[bytes], str | None]) -> None:
    """The tangent alone would show any level."""
    is_limited(program, *CLAIMS[name])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("time", ["continuous", "discrete"])
def test_contraction_has_no_constant_at_a_corner(name: str, time: str) -> None:
    tree = ["*", "1/8", call("f", "x")] if time == "discrete" else ["-", ["*", "1/8", call("f", "x")], "x"]
    for r in (1e-9, 0.1):
        assert not contracts(closer(tree, behind(name, shift=0.0), r, time, 1e-3))
    assert contracts(closer(tree, behind(name, shift=1.0), 0.1, time, 1e-3)) == {"checker", "reference"}
