"""Flattening of policies with other units than tanh: what stays at the origin, what falls, and corners."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.activations import ACTIVATIONS
from certify.loop.networks import Affine, Map, Network, Sum
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, require_centred
from controllers.evaluation.corners import nearest_corner
from controllers.evaluation.curvature import nonlinearity_on
from controllers.flattening.contraction import contracted, with_value_at_origin
from controllers.flattening.flattening import flatten
from controllers.flattening.options import FlattenOptions
from controllers.training.departure import departure_of

PENDULUM = get_system("pendulum")
ORIGIN = PENDULUM.exact_u_eq()
OTHERS = [name for name in ACTIVATIONS if name != "tanh"]
GAIN = np.array([[0.9, 0.35]])  # of net, before 6 tanh(.): a stable loop
QUICK = FlattenOptions(steps=80, batch=64, states=20)
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


@pytest.mark.parametrize("name", ["relu", "elu", "silu"])
def test_it_is_easier_to_prove_and_within_its_bounds(name):
    network = _curved(name)
    result = flatten(Policy(network, "pendulum"), replace(QUICK, max_cost_change=0.2))
    new = result.policy.network
    assert result.after.departure < 0.2 * result.before.departure
    assert result.after.settled >= result.before.settled and result.after.cost <= 1.2 * result.before.cost
    assert result.gain_change < 0.05 and new.activation == name
    assert nearest_corner(new, PENDULUM) >= min(1.0, nearest_corner(network, PENDULUM))
    require_centred(new, ORIGIN)


def test_other_steps_than_layers_are_refused():
    steps = (Affine((0,), np.eye(2), np.zeros(2)), Map((1,), "tanh"), Sum((0, 2)), Affine((3,), -GAIN, np.zeros(1)))
    policy = Policy(PolicyNetwork(Network(2, steps), np.ones(1), np.zeros(1)), "pendulum")
    with pytest.raises(InputError, match="flattening needs a policy of layers that read the states"):
        flatten(policy, QUICK)
