"""The policy beside the saturated linear feedback of its own gain: known answers for networks whose parts are known."""

from __future__ import annotations

import json
import math
from fractions import Fraction

import numpy as np
import pytest

from certify.loop.policies import PolicyNetwork
from certify.loop.policies.nonlinearity import nonlinearity
from certify.report.words import nonlinearity_in_words

ZERO = (Fraction(0),)
X = np.linspace(-3, 3, 1001)[:, None]


def _tanh_of(slope: float, scale: float = 1.0, **options: object) -> PolicyNetwork:
    """u = scale squash(tanh(slope x))."""
    one = np.ones((1, 1))
    return PolicyNetwork.of_layers(
        [slope * one, one], [np.zeros(1), np.zeros(1)], [scale], [0.0], **{"centre": "none", **options}
    )


@pytest.mark.parametrize("centre", ["none", "output", "preactivation"])
@pytest.mark.parametrize("u_eq", [Fraction(0), Fraction(1, 2)])
def test_a_saturated_gain_is_its_own_linear_part(centre, u_eq):
    """One layer behind a squash bends nowhere, however far it saturates."""
    network = PolicyNetwork.of_layers([[[-4.0]]], [np.zeros(1)], [2.0], [0.0], centre=centre)
    found = nonlinearity(network, (u_eq,), X)
    assert max(found.rms, found.largest, found.bend) < 1e-12
    ends = np.abs(network(X, (u_eq,)) - network.folded((u_eq,)).offset) >= 2 * (1 - 0.02)
    assert found.saturated == pytest.approx(ends.mean()) and 0.3 < found.saturated < 1


def test_the_difference_is_that_of_tanh_from_its_tangent():
    """Without a squash: rms and largest of tanh(x) - x over those of x, which the units of the input leave alone."""
    difference = np.abs(np.tanh(X) - X)
    for scale in (1.0, 250.0):
        found = nonlinearity(_tanh_of(1.0, scale, squash="identity"), ZERO, X)
        assert found.rms == pytest.approx(math.sqrt((difference**2).mean() / (X**2).mean()), rel=1e-12)
        assert found.largest == pytest.approx(difference.max() / 3, rel=1e-12)
        assert found.bend == pytest.approx(found.rms, rel=1e-12) and found.saturated == 0


def test_saturation_hides_a_bend_from_the_input():
    """Where squash or clip act on both, the input differs by less than net does."""
    plain, squashed = (nonlinearity(_tanh_of(1.0, squash=squash), ZERO, X) for squash in ("identity", "tanh"))
    assert squashed.rms < plain.rms and squashed.bend == pytest.approx(plain.bend)
    clip = (np.array([-0.5]), np.array([0.5]))
    clipped = nonlinearity(_tanh_of(1.0, squash="identity", clip=clip), ZERO, X)
    assert clipped.rms < 0.1 * plain.rms and clipped.saturated == pytest.approx((np.abs(np.tanh(X)) >= 0.49).mean())


def test_a_policy_without_a_gain_has_no_ratio():
    """x^2 by two softplus units: its linear part is 0, and so JSON has no number and the words say so."""
    weights = [np.array([[1.0], [-1.0]]), np.array([[1.0, 1.0]])]
    found = nonlinearity(
        PolicyNetwork.of_layers(weights, [np.zeros(2), np.zeros(1)], [1.0], [0.0], activation="softplus"), ZERO, X
    )
    assert math.isinf(found.rms) and found.to_dict()["rms"] is None
    json.dumps(found.to_dict(), allow_nan=False)
    assert "departs from its saturated linear part by more than" in nonlinearity_in_words(found.to_dict())


def test_no_share_of_a_linear_part_that_is_nearly_0_is_said():
    """tanh(50 x) - 49.9 x: a gain of 0.1 at 0, and values of some 100 away from it."""
    one = np.ones((1, 1))
    network = PolicyNetwork.of_layers(
        [np.array([[50.0], [1e-3]]), np.array([[1.0, -49.9e3]])], [np.zeros(2), np.zeros(1)], one[0], 0 * one[0],
        squash="identity", centre="none",
    )  # fmt: skip
    entry = nonlinearity(network, ZERO, 0.1 * X).to_dict()
    words = nonlinearity_in_words(entry)
    assert entry["rms"] > 1 and "departs from its saturated linear part by more than that varies" in words
    assert "%" not in words


@pytest.mark.parametrize("x", [0.0, 0.3, 1.7, 3.0])
def test_on_a_set_of_one_point_a_gain_does_the_same(x: float) -> None:
    """All differences are roundings there: their ratio was any number of per cent."""
    generator = np.random.default_rng(7)
    weights = [generator.normal(size=shape) for shape in ((32, 2), (32, 32), (1, 32))]
    network = PolicyNetwork.of_layers(
        weights, [generator.normal(size=len(W)) for W in weights], [1.0], [0.0], squash="identity", centre="none"
    )
    found = nonlinearity(network, ZERO, np.full((1000, 2), [x, 0.2]), fitted=True)
    assert (found.rms, found.largest, found.bend) == (0.0, 0.0, 0.0) and "within 0 %" in nonlinearity_in_words(
        found.to_dict()
    )


def test_a_fit_is_taken_where_the_tangent_at_0_says_nothing():
    """An affine policy that is far from linear about 0 in other places: the fit on its straight part is exact."""
    network = _tanh_of(5.0, squash="identity")
    far = X[X[:, 0] > 2]
    assert nonlinearity(network, ZERO, far).rms > 0.5
    found = nonlinearity(network, ZERO, np.linspace(-0.01, 0.01, 50)[:, None] + 0.05, fitted=True)
    assert found.fitted and found.bend < 0.05


def test_a_reader_is_told_whether_a_gain_does_the_same():
    entry = nonlinearity(_tanh_of(1.0, squash="identity"), ZERO, 0.1 * X).to_dict()
    assert "a gain does nearly the same" in nonlinearity_in_words(entry)
    entry = nonlinearity(_tanh_of(1.0, squash="identity"), ZERO, X).to_dict()
    words = nonlinearity_in_words(entry)
    assert "its own gain does not do the same" in words and "no part of the proof" in words
