"""The reference on networks of all kinds of steps: its forms and models hold the values of random ones.

The networks are those of the checker's tests; values are computed in floats, with none of either program's bounds.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flint import arb, arb_mat, ctx, fmpq

from certify.checker import networks as theirs
from certify.checker import wiring
from certify.reference.affine import OnBoxes, called
from certify.reference.balls import PRECISION
from certify.reference.document import read as read_certificate
from certify.reference.expressions import equations
from certify.reference.function import InRows, Models, net_at_0
from certify.reference.model import Model
from certify.reference.networks import Network, read_network
from certify.reference.rational import Exact, Exactly
from certify.reference.refusal import Refused
from certify.reference.tangents import OnBall
from certify.reference.taylor import Taylor, constant
from tests.checker.test_networks import SEEDS, Numbers, a_network, has_corners, hash_of
from tests.support.certificates import dump, encode, make
from tests.support.earlier import newer
from tests.support.models import curved, form, linear
from tests.support.reference import judge_bytes

Array = Any


def described(step: theirs.Step) -> dict[str, Any]:
    kind = type(step).__name__.lower()
    result: dict[str, Any] = {"kind": kind, "of": list(step.of)}
    match step:
        case theirs.Affine():
            shape = list(step.weight.shape)
            result |= {"shape": shape, "weight": encode(step.weight), "bias": encode(step.bias)}
        case theirs.Map():
            result |= {"function": step.function}
        case wiring.Clip():
            result |= {"lo": encode(step.lo), "hi": encode(step.hi)}
        case wiring.Observe():
            result |= {"names": list(step.names), "expressions": list(step.tape.trees)}
    return result


def read(net: theirs.Network) -> Network:
    steps = [described(step) for step in net.steps]
    return read_network(json.loads(json.dumps({"name": "net", "reads": net.reads, "steps": steps})), "here")


def floats(values: Sequence[arb]) -> Array:
    return np.array([float(v) for v in values])


def upper(v: arb) -> float:
    return float(v.upper()) if v.is_finite() else np.inf


@pytest.mark.parametrize("seed", SEEDS)
def test_a_value_lies_within_its_forms_on_boxes(seed: int) -> None:
    rng = np.random.default_rng(1000 + seed)
    net, radius = a_network(seed, 3, 2), 10.0 ** rng.uniform(-6, 0.5, 4)
    x = np.concatenate([rng.normal(size=(1, 3, 4)), rng.normal(size=(4, 3, 4)) * radius])
    doubt = np.abs(rng.normal(size=(3, 4))) * radius * 0.1
    with ctx.workprec(PRECISION):
        algebra = OnBoxes(4)
        rows = [[arb(float(x[k, i, b])) for b in range(4) for k in range(5)] for i in range(3)]
        first = algebra.given(rows, [[arb(float(v)) for v in row] for row in doubt])
        forms = algebra.forms(read(net).run(algebra, first), [1, 0, 1])
    for _ in range(40):
        d = np.sign(rng.normal(size=(4, 4))) * rng.random((4, 4)) ** rng.choice([0.0, 0.2, 1.0])
        at = x[0] + np.einsum("kb,knb->nb", d, x[1:]) + doubt * np.sign(rng.normal(size=(3, 4)))
        value = Numbers().run(net, at)[[1, 0, 1]]
        for each, row in zip(forms, value, strict=True):
            for b, (mid, slopes, error) in enumerate(each):
                off = abs(row[b] - float(mid) - floats(slopes) @ d[:, b])
                assert not off > upper(error) + 1e-12 * (1 + abs(row[b]))


@pytest.mark.parametrize("seed", SEEDS)
def test_a_call_on_a_leaf_is_one_with_its_value(seed: int) -> None:
    """Within the magnitude of its own symbol's coefficient, and the others' are as they would be."""
    rng = np.random.default_rng(2000 + seed)
    net, radius = a_network(seed, 2, 2), 10.0 ** rng.uniform(-6, -0.5)
    tree = ["+", ["network", "net", 1, ["*", "x", "y"], "y"], ["network", "net", 0, "y", "2/3"]]
    f, centre = equations([tree], {"x", "y"}, "here", {"net": read(net)}), rng.normal(size=2)
    symbols = 2 + f.entries
    with ctx.workprec(PRECISION):
        wide = [[arb(radius) if i == k else arb(0) for k in range(symbols)] for i in range(2)]
        x, y = (Taylor(arb(float(v)), arb_mat([row])) for v, row in zip(centre, wide, strict=True))
        (model,) = f.evaluate({"x": x, "y": y}, constant, lambda call, given: called(call, given, symbols, 2))
    g = floats(model.slopes(symbols))
    for _ in range(40):
        d = rng.uniform(-1, 1, 2)
        at = centre + radius * d
        one, two = (Numbers().run(net, np.array(v)[:, None])[:, 0] for v in ([at[0] * at[1], at[1]], [at[1], 2 / 3]))
        off = abs(one[1] + two[0] - float(model.c) - g[:2] @ d)
        assert not off > np.abs(g[2:]).sum() + upper(model.r) + 1e-12 * (1 + abs(one[1]) + abs(two[0]))


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("unsure", [False, True])
def test_a_value_lies_within_its_model_on_a_ball(seed: int, unsure: bool) -> None:
    """Of arguments with terms of every order; with numbers and gradients that are not known exactly, too."""
    rng = np.random.default_rng(3000 + seed)
    scale, net = 10.0 ** rng.uniform(-4, -0.7), a_network(seed, 3, 2)
    c, a = rng.normal(size=3), rng.normal(size=(3, 3)) * scale
    off, slack = (scale * 0.1 * rng.random(2)) if unsure else np.zeros(2)
    with ctx.workprec(PRECISION):
        given = [
            Model.affine(arb(float(v)), [arb(float(t)) for t in row], lip=arb(0)) for v, row in zip(c, a, strict=True)
        ]
        if seed % 2:
            given = [v * v + v.function("sin") for v in given]
        doubted = [doubt(v, float(off), float(slack)) for v in given]
        algebra = OnBall(doubted)
        try:
            models, units = algebra.results(read(net).run(algebra, algebra.first), [1, 0])
        except Refused:
            assert has_corners(net) or seed % 3 == 0
            return
        assert units.L.nrows() == 2
    for _ in range(30):
        d = rng.normal(size=(3, 2))
        d *= rng.random(2) ** rng.choice([0.0, 0.3]) / np.linalg.norm(d, axis=0)
        wrong, turned = rng.uniform(-off, off, 3), rng.normal(size=(3, 3))
        turned *= slack / np.linalg.norm(turned, axis=1)[:, None]
        at = c[:, None] + a @ d
        at = at**2 + np.sin(at) if seed % 2 else at
        values = Numbers().run(net, at + wrong[:, None] + turned @ d)[[1, 0]]
        for model, value in zip(models, values, strict=True):
            rests = [left_over(model, float(v), d[:, k].tolist()) for k, v in enumerate(value)]
            if not unsure and model.lip is not None and model.lip.is_finite():
                apart = float(np.linalg.norm(d[:, 0] - d[:, 1]))
                assert not abs(rests[0] - rests[1]) > upper(model.lip) * apart + 1e-11


def doubt(v: Model, off: float, slack: float) -> Model:
    return replace(v, off=v.off + arb(off), slack=v.slack + arb(slack))


def left_over(v: Model, value: float, d: list[float]) -> float:
    """The value beyond what is written down, which is less than is stated."""
    known = float(linear(v, d)) + float(curved(v, d))
    length = float(np.linalg.norm(d))
    bound = upper(form(v.whole, d)) + upper(v.off) + upper(v.slack) * length
    assert not abs(value - known) > bound + 1e-12 * (1 + abs(value))
    return value - known


@pytest.mark.parametrize("seed", SEEDS)
def test_models_in_rows_hold_values_and_their_rates(seed: int) -> None:
    rng = np.random.default_rng(4000 + seed)
    net, radius = a_network(seed, 2, 1, "affine map sum concat observe"), 10.0 ** rng.uniform(-5, -0.5)
    tree, centre, F = ["*", "x", ["network", "net", 0, "x", ["+", "x", "y"]]], rng.normal(size=2), rng.normal(size=2)
    N = equations([tree], {"x", "y"}, "here", {"net": read(net)})

    class Claimed:
        expression, level = N, 0.0

    with ctx.workprec(PRECISION):
        x = [
            Taylor(arb(float(centre[i])), arb_mat([[arb(radius) if i == k else arb(0) for k in range(2)]]))
            for i in (0, 1)
        ]
        models = Models(Claimed(), ("x", "y"))  # type: ignore[arg-type]
        alone, lined, rate = models.value(x), models.by_forms(x), None
        value = alone
        try:
            value, rate = models.moving(x, [Taylor(arb(float(v))) for v in F])
        except Refused:
            assert has_corners(net)
    for _ in range(30):
        d = rng.uniform(-1, 1, 2)

        def true(at: Array) -> float:
            return float(at[0] * Numbers().run(net, np.array([[at[0]], [at[0] + at[1]]]))[0, 0])

        at = centre + radius * d
        assert (
            holds(value, d, true(at), 1e-12) and holds(alone, d, true(at), 1e-12) and holds(lined, d, true(at), 1e-12)
        )
        assert rate is None or holds(rate, d, (true(at + 1e-6 * F) - true(at - 1e-6 * F)) / 2e-6, 1e-7)


def holds(model: Taylor, d: Array, value: float, tolerance: float) -> bool:
    """True unless the value is certainly outside; further symbols may be anything."""
    n, more = len(d), model.symbols
    known, loose = float(model.c), upper(model.r)
    g = floats(model.slopes(more))
    known, loose = known + g[:n] @ d[: len(g[:n])], loose + np.abs(g[n:]).sum()
    if model.Q is not None:
        Q = np.array([[float(v) for v in row] for row in model.Q.tolist()])
        known += d @ Q[:n, :n] @ d
        loose += np.abs(Q).sum() - np.abs(Q[:n, :n]).sum()
    return not abs(value - known) > loose + tolerance * (1 + abs(value))


@pytest.mark.parametrize("seed", SEEDS)
def test_exact_values_are_the_networks(seed: int) -> None:
    net = a_network(seed, 2, 2, "affine clip sum concat affine map observe")
    plain = Numbers().run(net, np.array([[0.0], [0.375]]))[:, 0]
    try:
        value = read(net).run(Exactly(), [Exact(fmpq(0)), Exact(fmpq(3, 8))])
    except Refused:
        return
    each = zip(value, plain, strict=True)
    assert all(q.value is None or abs(int(q.value.p) / int(q.value.q) - p) < 1e-9 * (1 + abs(p)) for q, p in each)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_value_of_numbers_is_the_networks(seed: int) -> None:
    net = a_network(seed, 2, 2)
    with ctx.workprec(PRECISION):
        value = read(net).run(InRows(), [Taylor(arb(0.25)), Taylor(arb(-0.5))])
    plain = Numbers().run(net, np.array([[0.25], [-0.5]]))[:, 0]
    assert all(
        v.g is None and abs(float(v.c) - p) <= upper(v.r) + 1e-9 * (1 + abs(p))
        for v, p in zip(value, plain, strict=True)
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_old_errors_are_as_long_as_they_are_said_to_be(seed: int) -> None:
    """Rotations turn a square of errors: none of its corners gets out of any box that is stated behind them."""
    rng = np.random.default_rng(6000 + seed)
    angles = rng.uniform(0, 2 * np.pi, int(rng.integers(2, 5)))
    turns = [np.array([[np.cos(t), np.sin(t)], [-np.sin(t), np.cos(t)]]) for t in angles]
    steps = tuple(theirs.Affine((k,), 2, W, np.zeros(2)) for k, W in enumerate(turns))
    with ctx.workprec(PRECISION):
        algebra = OnBoxes(1)
        last = read(theirs.Network("net", 2, steps)).run(algebra, algebra.given([[arb(0)] * 3] * 2, [[arb(1)]] * 2))
        stated = np.array([upper(error) for (error,) in (last.error or [])])
    corners = np.linalg.multi_dot([*reversed(turns), np.array([[1.0, 1.0], [1.0, -1.0]])])
    assert np.all(np.abs(corners).max(1) <= stated + 1e-12) and np.all(stated < 1.5)


@pytest.mark.parametrize("seed", SEEDS)
def test_corners_of_equations_lie_in_their_models(seed: int) -> None:
    """On boxes always, on balls where signs are certain; and there is a model of the least balls."""
    rng = np.random.default_rng(5000 + seed)
    tree = [
        "+",
        ["abs", ["-", "x", ["*", "y", "y"]]],
        ["*", "y", ["clip", "x", "-1/2", "1/3"]],
        ["min", "x", "y", "1/5"],
    ]
    f = equations([tree, ["max", "x", ["sin", "y"]]], {"x", "y"}, "here")
    centre, radius = rng.normal(size=2), 10.0 ** rng.uniform(-6, 0.3)
    a = rng.normal(size=(2, 2)) * radius

    def true(x: float, y: float) -> list[float]:
        return [
            abs(x - y * y) + y * min(max(x, -1 / 2), 1 / 3) + min(x, y, 1 / 5),
            max(x, float(np.sin(y))),
        ]

    with ctx.workprec(PRECISION):
        middle = [arb(float(v)) for v in centre]
        rows = [[arb(radius) if i == k else arb(0) for k in range(2)] for i in range(2)]
        x, y = (Taylor(v, arb_mat([row])) for v, row in zip(middle, rows, strict=True))
        on_box = f.evaluate({"x": x, "y": y}, constant)
        p, q = (Model.affine(v, [arb(float(t)) for t in row]) for v, row in zip(middle, a, strict=True))
        try:
            on_ball = f.evaluate({"x": p, "y": q}, lambda v: Model.affine(arb(v), [arb(0)] * 2))
        except Refused:
            on_ball = []
            assert radius > 1e-5
    for k in range(40):
        d = np.sign(rng.normal(size=2)) if k < 8 else rng.uniform(-1, 1, 2)
        for model, value in zip(on_box, true(*(centre + radius * d)), strict=True):
            assert model.is_finite() and holds(model, d, value, 1e-12)
        d /= max(1.0, float(np.linalg.norm(d)) * (1 + 1e-12))
        for v, value in zip(on_ball, true(*(centre + a @ d)), strict=bool(on_ball)):
            left_over(v, value, d.tolist())


@pytest.mark.parametrize("undefined", [False, True])
def test_the_value_at_0_has_all_that_is_not_known_of_it(undefined: bool) -> None:
    """|3 tanh / 3 - tanh| is 0, of which balls only know that it is near; and the root of -1 is no number."""
    data = newer(make([["-", "x"]], [([[1.0]], [1.0])], [[1.0]], (0.25, 0.5), squash="identity", centre="output"))
    two = {"shape": [2, 1], "weight": encode([1.0, 3.0]), "bias": encode([0.0, 0.0])}
    expression = ["sqrt", ["-", ["*", "a", "b"], "9"]] if undefined else ["abs", ["-", "a", ["*", "1/3", "b"]]]
    data["networks"][0]["steps"] += [
        {"kind": "map", "of": [1], "function": "tanh"},
        {"kind": "affine", "of": [2], **two},
        {"kind": "observe", "of": [3], "names": ["a", "b"], "expressions": [expression]},
    ]
    data["policy"]["sha256"] = hash_of(data)
    with ctx.workprec(PRECISION):
        (value,) = net_at_0(read_certificate(dump(data)))
    assert not value.is_finite() if undefined else value.contains(0)
    assert judge_bytes(dump(data)) == ("inputs" if undefined else "ring")  # "ring" without these steps too
