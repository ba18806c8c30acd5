"""The table of activations: each row against Arb, torch, the checker's table, and through every file of a policy."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import flint
import numpy as np
import pytest
import torch

from certify.checker.activations import add as add_activations
from certify.checker.document import Policy as Stated
from certify.checker.functions import FUNCTIONS
from certify.checker.networks import FUNCTIONS as OF_MAPS
from certify.checker.networks import Affine, Map, Network
from certify.checker.smooth import add as add_smooth
from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS, Activation
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Symbol, sqrt
from certify.loop.networks import Affine as Layer
from certify.loop.networks import Map as Function
from certify.loop.networks import Network as Program
from certify.loop.networks import Observe
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, save_policy
from certify.loop.policies.exact import raw_at_origin
from certify.loop.policies.importers import ImportOptions, import_policy
from certify.loop.policies.importers.memory import import_module, import_state_dict
from certify.loop.rigorous import ball, policy_at, precision
from tests.support.loops import pendulum_network

add_activations()
add_smooth()


NEW = [name for name in ACTIVATIONS if name != "tanh"]
PLANT = get_system("pendulum")
SAID = ImportOptions(states=("theta", "theta_dot"), normaliser="none", action_scale=(Fraction(1),))
POINTS = np.concatenate([np.linspace(-12, 12, 97), [-700.0, -90.0, -41.0, 41.0, 90.0, 700.0], 0.3 * np.arange(-5, 6)])


def network(name: str, **changes: Any) -> PolicyNetwork:
    return pendulum_network((6, 5)).with_layers(activation=name, **changes)


def derivatives(row: Activation, v: float) -> list[float]:
    """phi^(j)/j! from Arb's series, j to 4, on the side of v."""
    at = flint.arb(v)
    if row.name == "relu":
        return [max(v, 0.0), float(v > 0), 0.0, 0.0, 0.0]
    if row.name == "elu":
        series = flint.arb_series([at, 1], prec=5) if v >= 0 else flint.arb_series([at, 1], prec=5).exp() - 1
    elif row.name == "softsign":
        x = flint.arb_series([at, 1], prec=5)
        series = x / (1 + x) if v >= 0 else x / (1 - x)
    elif row.name == "tanh":
        series = 1 - 2 / ((2 * flint.arb_series([at, 1], prec=5)).exp() + 1)
    else:
        series = row.formula(flint.arb_series([at, 1], prec=5))
    return [float(series[j].mid()) for j in range(5)]


def test_the_table_has_what_the_checker_reads() -> None:
    assert set(NEW) == set(OF_MAPS) - {"sin", "cos", "tanh", "exp", "atan", "sqrt"}


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_derivatives_are_those_of_arb(name: str) -> None:
    row = ACTIVATIONS[name]
    with precision(400), np.errstate(all="ignore"):
        points = [v for v in POINTS.tolist() if v != 0 or row.is_smooth]
        true = np.array([derivatives(row, v) for v in points]).T
    y = np.array(points)
    found = row.series(y)
    for j, (a, b) in enumerate(zip(found, true, strict=True)):
        assert np.all(np.abs(a - b) <= 1e-13 * (1 + np.abs(y) * (j == 0) + np.abs(b)) * (1 + 40 * (j > 2))), j
    value, slope = row.pair(y)
    assert np.allclose(value, true[0], rtol=1e-13, atol=1e-14) and np.allclose(slope, true[1], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_bounds_hold_and_are_not_below_the_checkers(name: str) -> None:
    row, other = ACTIVATIONS[name], FUNCTIONS[name]
    y = np.linspace(-15, 15, 200_001)[1:]
    y = y[np.abs(y) > 1e-3]
    f = row.series(y)
    assert np.all(np.abs(f[1]) <= row.steepest) and np.all(np.abs(f[2]) <= row.bend * (1 + 1e-12))
    assert np.all(np.abs(f[4]) <= row.fourth * (1 + 1e-12))
    if name in ("silu", "gelu", "softplus", "mish"):
        sup = [float(bound.top) for bound in other.polynomials.sup]  # type: ignore[attr-defined]
        for bound, theirs in ((row.bend, sup[2]), (row.fourth, sup[4]), (row.fifth, sup[5])):
            assert theirs <= bound <= 1.002 * theirs


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_the_fourth_order_bound_holds_around_a_point(name: str) -> None:
    row, generator = ACTIVATIONS[name], np.random.default_rng(1)
    y, radius = generator.normal(size=400) * 3, 10.0 ** generator.uniform(-4, 1, 400)
    f0, f1, f2, f3, bound = row.around(y, radius)
    cut = (np.abs(y) <= 1.001 * radius) & (not row.is_smooth)
    assert np.all(np.isfinite(bound)) and not f2[cut].any() and not f3[cut].any()
    for share in np.linspace(-1, 1, 21):
        D = share * radius
        fourth = np.abs(row.series(y + D)[4])
        assert np.all((fourth <= bound * (1 + 1e-9) + 1e-15) | cut)
        left = np.abs(row.pair(y + D)[0] - f0 - f1 * D)
        assert np.all((left <= bound * radius**2 * D**2 + 1e-14 * (np.abs(y) + radius)) | ~cut)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_torch_gives_the_same_values(name: str) -> None:
    y = POINTS[np.abs(POINTS) < 30]
    found = ACTIVATIONS[name](torch.tensor(y)).numpy()
    assert np.allclose(found, ACTIVATIONS[name](y), rtol=1e-13, atol=1e-14)
    module = getattr(torch.nn, ACTIVATIONS[name].module)()
    assert np.allclose(module(torch.tensor(y)).numpy(), found, rtol=1e-13, atol=3e-9)


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_balls_hold_values_and_slopes(name: str) -> None:
    row, generator = ACTIVATIONS[name], np.random.default_rng(2)
    with precision():
        for _ in range(60):
            c, r = generator.normal() * 3, 10.0 ** generator.uniform(-8, 0.7)
            wide = flint.arb(c, r)
            value, slope = row.in_arb(wide), row.slope_in_arb(wide)
            for v in np.clip(c + r * np.linspace(-0.999, 0.999, 9), None, None).tolist():
                f = row.series(np.array([v]))
                assert value.overlaps(flint.arb(float(f[0][0]), 1e-12))
                assert slope.overlaps(flint.arb(float(f[1][0]), 1e-12))
            if name != "tanh":
                assert float(value.rad()) <= 1.2 * r + 1e-9


@pytest.mark.parametrize("name", NEW)
def test_exact_values_are_those_of_the_checker(name: str) -> None:
    for q in (Fraction(0), Fraction(1, 3), Fraction(-2, 5)):
        assert ACTIVATIONS[name].exact(q) == FUNCTIONS[name].exact(q)


def test_pi_at_0_of_a_relu_policy_is_a_rational() -> None:
    policy = network("relu", squash="identity", centre="none")
    (value,) = raw_at_origin(policy)
    assert value is not None and float(value) == pytest.approx(policy(np.zeros(2), (Fraction(0),))[0], abs=1e-12)
    assert raw_at_origin(network("silu", squash="identity", centre="none")) == (None,)


@pytest.mark.parametrize("name", ACTIVATIONS)
@pytest.mark.parametrize("widths", [(6,), (6, 5)])
def test_the_hash_is_the_checkers(name: str, widths: tuple[int, ...]) -> None:
    ours = pendulum_network(widths).with_layers(activation=name)
    steps: list[Any] = []
    for W, b in zip(ours.weights, ours.biases, strict=True):
        if steps:
            steps.append(Map((len(steps),), steps[-1].size, name))
        steps.append(Affine((len(steps),), len(b), W, b))
    stated = Stated(
        Network("policy", 2, tuple(steps)), ours.scale, ours.offset, ours.squash, ours.centre, ours.clip, None
    )
    assert ours.sha256() == stated.sha256()


def test_one_layer_has_no_activation() -> None:
    law = PolicyNetwork.of_layers(
        (np.ones((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none", activation="elu"
    )
    assert law.activation == "tanh"
    with pytest.raises(InputError, match="`activation` must be one of tanh, relu"):
        network("selu")


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_policy_files_keep_it(name: str, tmp_path: Path) -> None:
    save_policy(tmp_path / "p.pt", Policy(network(name), "pendulum"))
    raw = torch.load(tmp_path / "p.pt", weights_only=True)
    assert raw["format"] == ("certify-policy/1" if name == "tanh" else "certify-policy/3")
    found = load_policy(tmp_path / "p.pt").network
    assert found.sha256() == network(name).sha256() and found.activation == name
    clip = (np.array([-1.0]), np.array([2.0]))
    save_policy(tmp_path / "q.pt", Policy(network(name, clip=clip), "pendulum"))
    assert load_policy(tmp_path / "q.pt").network.sha256() == network(name, clip=clip).sha256()


@pytest.mark.parametrize("said", ["tanh", "selu", None, 1])
def test_a_file_of_version_3_has_another_activation(said: Any, tmp_path: Path) -> None:
    save_policy(tmp_path / "p.pt", Policy(network("relu"), "pendulum"))
    raw = torch.load(tmp_path / "p.pt", weights_only=True)
    torch.save({**raw, "activation": said}, tmp_path / "p.pt")
    with pytest.raises(InputError, match="`activation` of certify-policy/3 must be one of relu"):
        load_policy(tmp_path / "p.pt")


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_the_jacobian_at_the_origin(name: str) -> None:
    policy, u_eq = network(name), (Fraction(0),)
    step = 1e-6 * np.eye(2)
    by_differences = (policy(step, u_eq) - policy(-step, u_eq)) / 2e-6
    assert np.allclose(policy.jacobian_at_origin(u_eq), by_differences.T, rtol=1e-6, atol=1e-8)


# ------------------------------------------------------------------------------------------------------------- imports


def module(name: str) -> torch.nn.Module:
    torch.manual_seed(0)
    kind = getattr(torch.nn, ACTIVATIONS[name].module)
    return torch.nn.Sequential(torch.nn.Linear(2, 8), kind(), torch.nn.Linear(8, 6), kind(), torch.nn.Linear(6, 1))


@pytest.mark.parametrize("name", NEW)
def test_a_module_is_read(name: str) -> None:
    found = import_module(module(name), PLANT, SAID)
    assert found.policy.network.activation == name and found.difference.in_double < 1e-12


@pytest.mark.parametrize("name", NEW)
def test_a_state_dict_is_read(name: str) -> None:
    options = replace(SAID, activation=name, squash="identity")
    found = import_state_dict(module(name).state_dict(), PLANT, options).policy.network
    x = np.random.default_rng(0).normal(size=(50, 2))
    theirs = module(name).double()(torch.tensor(x)).detach().numpy()
    assert found.activation == name and np.allclose(found(x, (Fraction(0),)), theirs, atol=1e-7)


@pytest.mark.parametrize("name", NEW)
def test_an_onnx_graph_is_read(name: str, tmp_path: Path) -> None:
    onnx = pytest.importorskip("onnx")
    helper, tensors = onnx.helper, dict[str, Any]()
    nodes, at = [], "x"
    layers = [layer for layer in module(name) if isinstance(layer, torch.nn.Linear)]
    for k, layer in enumerate(layers):
        tensors |= {f"W{k}": layer.weight.detach().numpy(), f"b{k}": layer.bias.detach().numpy()}
        nodes.append(helper.make_node("Gemm", [at, f"W{k}", f"b{k}"], [f"y{k}"], transB=1))
        at = f"y{k}"
        if k == len(layers) - 1:
            break
        if name == "silu":
            nodes.append(helper.make_node("Sigmoid", [at], [f"s{k}"]))
            nodes.append(helper.make_node("Mul", [at, f"s{k}"], [f"h{k}"]))
        elif name == "mish":
            nodes.append(helper.make_node("Softplus", [at], [f"p{k}"]))
            nodes.append(helper.make_node("Tanh", [f"p{k}"], [f"s{k}"]))
            nodes.append(helper.make_node("Mul", [at, f"s{k}"], [f"h{k}"]))
        else:
            words = {"relu": "Relu", "elu": "Elu", "gelu": "Gelu"}
            nodes.append(helper.make_node(words.get(name, name.capitalize()), [at], [f"h{k}"]))
        at = f"h{k}"
    value = helper.make_tensor_value_info
    kind = onnx.TensorProto.FLOAT
    graph = helper.make_graph(
        nodes,
        "policy",
        [value("x", kind, [1, 2])],
        [value(at, kind, [1, 1])],
        [onnx.numpy_helper.from_array(v, k) for k, v in tensors.items()],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9), tmp_path / "p.onnx")
    found = import_policy(tmp_path / "p.onnx", PLANT, SAID)
    most = 1e-6 if name == "gelu" else 1e-12  # the onnx package's own has constants of single precision
    assert found.policy.network.activation == name and found.difference.in_double < most


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_no_number_stays_none_in_arb(name: str) -> None:
    row = ACTIVATIONS[name]
    with precision():
        assert not row.in_arb(flint.arb.nan()).is_finite()
        row.slope_in_arb(flint.arb.nan())  # of no number any slope


def test_a_policy_without_a_value_has_none_behind_a_relu() -> None:
    """sqrt(theta - 1/3) at a theta that floats take for 1/3."""
    s = Symbol("theta"), Symbol("theta_dot")
    root = Observe((0,), s, (sqrt(s[0] - Fraction(1, 3)),))
    one = np.ones((1, 1)), np.zeros(1)
    policy = PolicyNetwork(
        Program(2, (root, Layer((1,), *one), Function((2,), "relu"), Layer((3,), *one))),
        np.ones(1),
        np.zeros(1),
        "tanh",
        "none",
    )
    with precision():
        for off, known in ((Fraction(1, 10**30), True), (Fraction(-1, 10**30), False)):
            (u,) = policy_at(ClosedLoop(PLANT, policy), [ball(Fraction(1, 3) + off), ball(Fraction(0))])
            assert u.is_finite() is known
