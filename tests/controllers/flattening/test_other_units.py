"""Flattening of policies with other units than tanh: what stays at the origin, what falls, and corners."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.networks import Affine, Map, Network, Sum, tangent_at
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, require_centred
from controllers.evaluation.corners import nearest_corner
from controllers.evaluation.curvature import nonlinearity_on
from controllers.flattening.contraction import contracted, with_value_at_origin
from controllers.flattening.flattening import flatten
from controllers.flattening.options import FlattenOptions
from controllers.training.departure import departure_of
from tests.support.marks import slow_after

PENDULUM = get_system("pendulum")
ORIGIN = PENDULUM.exact_u_eq()
OTHERS = [name for name in ACTIVATIONS if name != "tanh"]
GAIN = np.array([[0.9, 0.35]])  # of net, before 6 tanh(.): a stable loop
QUICK = FlattenOptions(steps=40, batch=64, states=20)
BOX = np.array([1.5, 2.0])


def _curved(name: str, seed: int = 2) -> PolicyNetwork:
    """A 2-12-12-1 policy with bent units whose outputs are fitted to -gain x."""
    generator, phi = np.random.default_rng(seed), ACTIVATIONS[name]
    weights = [generator.normal(size=(b, a)) / np.sqrt(a) for a, b in pairwise((2, 12, 12))]
    biases = [generator.choice([-1.0, 1.0], 12) * generator.uniform(0.4, 1.0, 12) for _ in weights]
    x = np.concatenate([np.zeros((1, 2)), generator.uniform(-1, 1, (400, 2)) * [1.5, 4.0]])
    h = x
    for W, b in zip(weights, biases, strict=True):
        h = phi.pair(h @ W.T + b)[0]
    last = np.linalg.lstsq(h[1:] - h[0], -x[1:] @ GAIN.T, rcond=1e-4)[0].T
    rounded = [a.astype(np.float32).astype(float) for a in (*weights, last, *biases, -last @ h[0])]
    return PolicyNetwork.of_layers(rounded[:3], rounded[3:], np.array([6.0]), np.zeros(1), activation=name)


@pytest.mark.parametrize("name", OTHERS)
def test_contraction_keeps_value_and_jacobian_and_leads_to_the_linearisation(name):
    network = _curved(name)
    J, at_0 = network.jacobian_at_origin(ORIGIN), network.net(np.zeros(2))
    same, new, flat = (contracted(network, factor) for factor in (1.0, 1 / 16, 1 / 256))
    x = np.random.default_rng(0).uniform(-BOX, BOX, (50, 2))
    np.testing.assert_allclose(same(x, ORIGIN), network(x, ORIGIN), atol=1e-4)
    np.testing.assert_allclose(new.jacobian_at_origin(ORIGIN), J, atol=1e-4 * np.abs(J).max())
    np.testing.assert_allclose(new.net(np.zeros(2)), at_0, atol=1e-4)
    assert new.activation == name and new.layers == network.layers
    assert departure_of(new, BOX.tolist()) < 0.2 * departure_of(network, BOX.tolist())
    new_bend, old_bend = (nonlinearity_on(each, ORIGIN, BOX).bend for each in (flat, network))
    assert new_bend < 0.02 * old_bend + 1e-4
    assert nearest_corner(new, PENDULUM) >= nearest_corner(network, PENDULUM)


def test_a_relu_beyond_its_corner_is_its_linearisation():
    network = _curved("relu")
    flat = contracted(network, 2.0**-6)
    assert nearest_corner(flat, PENDULUM) > 1 > nearest_corner(network, PENDULUM)
    assert departure_of(flat, BOX.tolist()) == pytest.approx(0.0, abs=1e-9)


def test_the_value_at_the_origin_is_set_for_other_units_too():
    wanted = np.array([0.25])
    np.testing.assert_allclose(with_value_at_origin(_curved("silu"), wanted).net(np.zeros(2)), wanted, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_after(1, ["relu", "elu", "silu"]))
def test_it_is_easier_to_prove_and_within_its_bounds(name):
    network = _curved(name)
    result = flatten(Policy(network, "pendulum"), replace(QUICK, max_cost_change=0.2))
    new = result.policy.network
    assert result.after.departure < 0.2 * result.before.departure
    assert result.after.settled >= result.before.settled and result.after.cost <= 1.2 * result.before.cost
    assert result.gain_change < 0.05 and new.activation == name
    assert nearest_corner(new, PENDULUM) >= min(1.0, nearest_corner(network, PENDULUM))
    require_centred(new, ORIGIN)


def _skipping(name: str = "tanh") -> PolicyNetwork:
    """A policy with two skip connections, one around a hidden layer and one around all, whose J(0) is -GAIN."""
    generator = np.random.default_rng(5)
    W0, W1, W2 = (generator.normal(size=shape) for shape in ((12, 2), (12, 12), (1, 12)))
    b0, b1 = generator.uniform(0.4, 1.0, (2, 12))
    steps = [
        Affine((0,), W0, b0), Map((1,), name), Affine((2,), W1 / 3, b1), Map((3,), name), Sum((2, 4)),
        Affine((5,), 0.2 * W2, np.zeros(1)), Affine((0,), np.zeros((1, 2)), np.zeros(1)), Sum((6, 7)),
    ]  # fmt: skip
    around = -GAIN - tangent_at(Network(2, tuple(steps)), np.zeros(2)).J
    steps[6] = Affine((0,), around, np.array([0.125]))
    return PolicyNetwork(Network(2, tuple(steps)), np.array([6.0]), np.zeros(1))


@pytest.mark.parametrize("name", ["tanh", "relu", "silu"])
def test_contraction_of_skip_connections_keeps_value_and_jacobian(name):
    network = _skipping(name)
    J, at_0 = network.jacobian_at_origin(ORIGIN), network.net(np.zeros(2))
    flat = contracted(network, 2.0**-6)
    np.testing.assert_allclose(flat.jacobian_at_origin(ORIGIN), J, atol=1e-4 * np.abs(J).max())
    np.testing.assert_allclose(flat.net(np.zeros(2)), at_0, atol=1e-4)
    assert [step.kind for step in flat.network.steps] == [step.kind for step in network.network.steps]
    new, old = (nonlinearity_on(each, ORIGIN, BOX).bend for each in (flat, network))
    assert old > 0.05 and new < 0.05 * old + 1e-4
    assert departure_of(flat, BOX.tolist()) < 0.1 * departure_of(network, BOX.tolist())


def test_the_departure_of_skip_connections_is_that_of_the_units_beside_the_linear_part():
    """One unit beside a linear path: lines leave half of what a tangent leaves of a parabola."""
    y, W = 0.3, np.array([[0.5, -0.25]])
    steps = (Affine((0,), W, np.array([y])), Map((1,), "tanh"), Affine((0,), -GAIN, np.zeros(1)), Sum((2, 3)))
    network = PolicyNetwork(Network(2, steps), np.ones(1), np.zeros(1))
    box = np.array([1e-2, 1e-2])
    v, slope = np.abs(W) @ box, 1 - np.tanh(y) ** 2
    second = abs(np.tanh(y + v) + np.tanh(y - v) - 2 * np.tanh(y)) / 4
    linear = np.abs(slope * W - GAIN) @ box
    assert departure_of(network, box.tolist()) == pytest.approx((second / linear).item(), rel=1e-2)


def test_skip_connections_are_flattened():
    network = _skipping()
    result = flatten(Policy(network, "pendulum"), replace(QUICK, max_cost_change=0.2))
    new = result.policy.network
    assert result.after.departure < 0.2 * result.before.departure and result.gain_change < 0.05
    assert [step.of for step in new.network.steps] == [step.of for step in network.network.steps]
    require_centred(new, ORIGIN)


def test_another_gain_needs_layers():
    with pytest.raises(InputError, match="another gain needs a policy of layers that read the states"):
        flatten(Policy(_skipping(), "pendulum"), replace(QUICK, gain="lqr"))


def test_the_value_at_the_origin_of_skip_connections_is_set():
    wanted = np.array([0.5])
    np.testing.assert_allclose(with_value_at_origin(_skipping(), wanted).net(np.zeros(2)), wanted, atol=1e-6)
