"""Another gain for a network that is there: the Jacobian is the one asked for, and what is not asked for stays."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from certify.errors import InputError
from certify.loop.policies import PolicyNetwork, require_centred
from controllers.flattening.gain_change import regained

U_EQ = (Fraction(1, 4), Fraction(-1, 8))
BOX = np.array([0.5, 2.0, 0.1])
J = np.array([[1.0, -0.25, 3.0], [0.5, 2.0, -1.0]])


def network(centre="preactivation", squash="tanh", bias=0.4, clip=None, seed=3) -> PolicyNetwork:
    """A bent 3-9-9-2 policy with numbers of single precision."""
    generator = np.random.default_rng(seed)
    sizes = (3, 9, 9, 2)
    weights = [generator.normal(size=(b, a)) / np.sqrt(a) for a, b in pairwise(sizes)]
    biases = [bias * generator.normal(size=b) for b in sizes[1:]]
    single = [a.astype(np.float32).astype(float) for a in (*weights, *biases)]
    scale, offset = np.array([2.0, 3.0]), np.array([0.5, 0.0])
    return PolicyNetwork.of_layers(tuple(single[:3]), tuple(single[3:]), scale, offset, squash, centre, clip)


@pytest.mark.parametrize(
    "old",
    [
        network(),
        network("output"),
        network("output", "identity", clip=(np.array([-3.0, -3.0]), np.array([3.0, 3.0]))),
        network("none"),
    ],
    ids=lambda old: f"{old.centre}-{old.squash}",
)
def test_the_jacobian_is_the_one_asked_for_and_the_value_at_the_origin_stays_to_the_bit(old):
    new = regained(old, U_EQ, J, BOX)
    np.testing.assert_allclose(new.jacobian_at_origin(U_EQ), J, rtol=0, atol=1e-6 * np.abs(J).max())
    np.testing.assert_array_equal(new(np.zeros(3), U_EQ), old(np.zeros(3), U_EQ))
    for k in range(3):
        np.testing.assert_array_equal(new.biases[k], old.biases[k])
        assert k == 0 or np.array_equal(new.weights[k], old.weights[k])
    assert (new.squash, new.centre) == (old.squash, old.centre)
    np.testing.assert_array_equal(new.clip or (), old.clip or ())
    assert np.array_equal(new.weights[0].astype(np.float32), new.weights[0])


def test_it_is_the_old_policy_at_the_smallest_state_that_asks_for_the_same():
    old = network()
    new = regained(old, U_EQ, J, BOX)
    x = np.random.default_rng(0).uniform(-BOX, BOX, (50, 3))
    J_old = old.jacobian_at_origin(U_EQ)
    # the least-norm solution of J_old D y = J x, by another way than the pseudo-inverse
    y = np.array([np.linalg.lstsq(J_old * BOX, J @ row, rcond=None)[0] for row in x])
    np.testing.assert_allclose(new(x, U_EQ), old(y * BOX, U_EQ), atol=1e-5)


def test_its_own_jacobian_leaves_what_it_does_along_its_inputs():
    """With m = n nothing is projected away: the policy itself, up to the rounding of its first layer."""
    old = network().with_layers(weights=(network().weights[0][:, :2], *network().weights[1:]))
    new = regained(old, U_EQ, old.jacobian_at_origin(U_EQ), BOX[:2])
    np.testing.assert_allclose(new.weights[0], old.weights[0], atol=1e-5)


def test_zero_biases_stay_exact_centring():
    zeros = tuple(np.zeros(len(b)) for b in network().biases)
    old = network("none").with_layers(biases=zeros, offset=np.zeros(2))
    origin = (Fraction(0), Fraction(0))
    require_centred(old, origin)
    require_centred(regained(old, origin, J, BOX), origin)


def test_inputs_that_depend_on_each_other_are_refused():
    old = network()
    double = np.stack([old.weights[-1][0], 2 * old.weights[-1][0]])
    dependent = old.with_layers(weights=(*old.weights[:-1], double))
    with pytest.raises(InputError, match=r"2 inputs must act independently at the origin; .* rank 1\. Keep its gain"):
        regained(dependent, U_EQ, J, BOX)
    silent = old.with_layers(weights=(*old.weights[:-1], np.zeros((2, 9))))
    with pytest.raises(InputError, match="rank 0"):
        regained(silent, U_EQ, J, BOX)


def test_more_inputs_than_states_are_refused():
    old = network().with_layers(weights=(network().weights[0][:, :1], *network().weights[1:]))
    with pytest.raises(InputError, match="rank 1"):
        regained(old, U_EQ, J[:, :1], BOX[:1])
