"""Between a policy and its linearisation: what stays, and how fast the rest falls."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.policies import PolicyNetwork, load_policy, require_centred
from controllers.evaluation.curvature import nonlinearity_on
from controllers.flattening.contraction import contracted, with_value_at_origin
from controllers.training.departure import departure_of

U_EQ = (Fraction(1, 3), Fraction(-1, 5))


def _network(squash="tanh", centre="preactivation", bias=0.7, clip=None) -> PolicyNetwork:
    generator = np.random.default_rng(4)
    layers = (3, 7, 6, 5, 2)
    weights = tuple(generator.normal(size=(b, a)) for a, b in pairwise(layers))
    biases = tuple(bias * generator.normal(size=len(W)) for W in weights)
    return PolicyNetwork.of_layers(weights, biases, np.array([2.0, 3.0]), np.array([0.1, 0.0]), squash, centre, clip)


@pytest.mark.parametrize(
    ("squash", "centre"),
    [("tanh", "preactivation"), ("tanh", "output"), ("tanh", "none"), ("identity", "output"), ("identity", "none")],
)
def test_value_and_jacobian_at_the_origin_stay_and_so_does_the_form(squash, centre):
    network = _network(squash, centre, clip=(np.full(2, -50.0), np.full(2, 50.0)))
    new = contracted(network, 1 / 16)
    zero = np.zeros((1, 3))
    np.testing.assert_allclose(new(zero, U_EQ), network(zero, U_EQ), atol=1e-5)
    J = network.jacobian_at_origin(U_EQ)
    np.testing.assert_allclose(new.jacobian_at_origin(U_EQ), J, atol=1e-5 * np.abs(J).max())
    assert new.layers == network.layers and (new.squash, new.centre) == (squash, centre)
    for name in ("scale", "offset"):
        np.testing.assert_array_equal(getattr(new, name), getattr(network, name))
    np.testing.assert_array_equal(new.clip, network.clip)
    assert all(np.array_equal(a.astype(np.float32), a) for a in (*new.weights, *new.biases[:-1]))


def test_factor_one_is_the_policy_and_small_ones_are_its_linearisation():
    network, x = _network(), np.random.default_rng(0).uniform(-1, 1, (50, 3))
    np.testing.assert_allclose(contracted(network, 1.0)(x, U_EQ), network(x, U_EQ), atol=1e-5)
    flat = contracted(network, 2.0**-10)
    new, old = (nonlinearity_on(each, U_EQ, np.ones(3)) for each in (flat, network))
    assert new.bend < 1e-2 * old.bend and new.rms < 1e-2 * old.rms and new.largest < 1e-2 * old.largest


def test_what_is_left_falls_with_the_square_at_rest_and_linearly_elsewhere():
    """Without biases units bend by their third derivative first, with biases by their second."""
    for bias, order in ((0.0, 2.0), (0.7, 1.0)):
        network = _network(bias=bias)
        found = [departure_of(contracted(network, factor), [0.3] * 3) for factor in (2.0**-5, 2.0**-6)]
        assert np.log2(found[0] / found[1]) > order - 0.05
    assert np.log2(found[0] / found[1]) < 2.3  # values at the origin shrink too, so it is two here as well


def test_zero_biases_stay_zero_and_with_them_the_exact_centring():
    network = replace(_network(centre="none", bias=0.0), offset=np.array([0.5, -2.0]))
    u_eq = (Fraction(1, 2), Fraction(-2))
    new = contracted(network, 0.3)
    assert not any(np.any(b) for b in new.biases)
    require_centred(new, u_eq)
    shifted = network.with_layers(squash="identity", biases=(*network.biases[:-1], np.array([0.1, 0.2])))
    np.testing.assert_array_equal(contracted(shifted, 0.3).biases[-1], shifted.biases[-1])  # 0.1 is no float32


def test_a_saturated_unit_passes_nothing_on():
    network = _network()
    biases = (np.where(np.arange(7) == 2, 80.0, network.biases[0]), *network.biases[1:])
    stuck = network.with_layers(biases=biases)
    new = contracted(stuck, 0.25)
    assert np.all(np.isfinite(new.weights[1])) and not np.any(new.weights[1][:, 2])
    np.testing.assert_allclose(new.jacobian_at_origin(U_EQ), stuck.jacobian_at_origin(U_EQ), rtol=1e-3, atol=1e-5)


def test_the_last_bias_gives_the_value_that_is_asked_for():
    network, value = _network(), np.array([0.25, -1.5])
    np.testing.assert_allclose(with_value_at_origin(network, value).net(np.zeros(3)), value, atol=1e-6)


@pytest.mark.parametrize("factor", [0.0, -1.0, 1.5, np.nan])
def test_other_factors_are_refused(factor):
    with pytest.raises(InputError, match="`factor`"):
        contracted(_network(), factor)


def test_a_shipped_policy_keeps_its_jacobian():
    from certify.loop.plants import get_system

    network, u_eq = load_policy("examples/policies/quadrotor2d.pt").network, get_system("quadrotor2d").exact_u_eq()
    change = contracted(network, 1 / 64).jacobian_at_origin(u_eq) - network.jacobian_at_origin(u_eq)
    assert np.linalg.norm(change) < 1e-5 * np.linalg.norm(network.jacobian_at_origin(u_eq))
