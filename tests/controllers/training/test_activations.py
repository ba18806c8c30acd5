"""Actors of other activations: their units, the gain's tie, corners that stay away, and files of tanh as they were."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from certify.errors import OptionError
from certify.loop.activations import ACTIVATIONS
from certify.loop.plants import get_system
from certify.loop.policies import PolicyNetwork, load_policy, require_centred
from controllers.cli import app
from controllers.evaluation.corners import nearest_corner
from controllers.options import Activation, default_record, preset
from controllers.training.actor import Actor
from controllers.training.departure import departure_of
from controllers.training.interface import Interface
from controllers.training.trainer import Trainer
from controllers.training.units import Units
from tests.support.marks import slow_after

PENDULUM = get_system("pendulum")
ORIGIN = PENDULUM.exact_u_eq()
K = torch.tensor([[1.76, 0.59]])
BENT = [name for name, row in ACTIVATIONS.items() if not row.is_smooth]
SHORT = ["--steps", "260", "--warm-up", "100", "--n-A", "60", "--n-B", "60", "--batch", "16", "--critic", "8,8"]
runner = CliRunner()


def _actor(activation, centre="preactivation", seed=0) -> Actor:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Actor(Interface(PENDULUM), (16, 16), centre, (-5.0, 2.0), activation)


def test_options_name_the_rows_of_the_table():
    assert get_args(Activation) == tuple(ACTIVATIONS)
    with pytest.raises(OptionError, match="`activation` must be one of"):
        replace(preset("pendulum"), activation="swish")


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_values_and_slopes_are_those_of_the_table(name):
    y = torch.linspace(-9, 9, 73, dtype=torch.float64)
    expected, units = ACTIVATIONS[name].pair(y.numpy()), Units(name)
    for found, wanted in zip(units.pair(y), expected, strict=True):
        np.testing.assert_allclose(found.numpy(), wanted, atol=1e-14)
    np.testing.assert_allclose(units(y).numpy(), expected[0], atol=1e-14)


@pytest.mark.parametrize("name", ACTIVATIONS)
@pytest.mark.parametrize("centre", ["preactivation", "output"])
def test_the_jacobian_is_that_of_the_exported_policy(name, centre):
    actor = _actor(name, centre)
    mean, jacobian = actor.at_origin()
    network, h = actor.network(), 1e-6
    assert network.activation == name
    columns = [(network(h * e, ORIGIN) - network(-h * e, ORIGIN)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(jacobian.detach().numpy(), np.array(columns).T, atol=1e-5)
    np.testing.assert_allclose(mean.detach().numpy(), replace(network, centre="none")(np.zeros(2), ORIGIN), atol=1e-6)
    x = np.array([[0.4, -2.0]])
    columns = [(network(x + h * e, ORIGIN) - network(x - h * e, ORIGIN))[0] / (2 * h) for e in np.eye(2)]
    there = actor.jacobian(torch.tensor(x, dtype=torch.float32)).detach()
    if centre == "preactivation":  # with `output` the network adds rounding only
        np.testing.assert_allclose(there[0].numpy(), np.array(columns).T, atol=2e-5)
    require_centred(network, ORIGIN)


@pytest.mark.parametrize("name", slow_after(4, ACTIVATIONS))
def test_descending_the_gain_term_moves_the_jacobian_to_minus_K(name):
    actor = _actor(name)
    optimiser = torch.optim.Adam(actor.parameters(), 1e-2 if name == "sigmoid" else 3e-3)
    before = actor.distance(K)[0]
    for _ in range(300):
        optimiser.zero_grad()
        actor.gain_loss(K).backward()
        optimiser.step()
        actor.keep_corners_away(torch.tensor([0.3, 2.0]))
    assert actor.distance(K)[0] < 0.1 * before


@pytest.mark.parametrize("name", BENT)
def test_corners_begin_away_from_the_origin_and_stay_away(name):
    actor, box = _actor(name), torch.tensor([0.3, 2.0])  # a tenth of the domain
    smooth = _actor("tanh")
    assert nearest_corner(smooth.network(), PENDULUM) == math.inf
    for layer, other in zip(actor.hidden, smooth.hidden, strict=True):
        assert torch.equal(layer.weight, other.weight) and not torch.equal(layer.bias, other.bias)
    assert nearest_corner(actor.network(), PENDULUM) > 0.02
    sides = [torch.sign(layer(torch.zeros(layer.in_features))) for layer in actor.hidden[:1]]
    with torch.no_grad():
        for layer in actor.hidden:
            layer.bias.mul_(1e-4)
    actor.keep_corners_away(box)
    share = min(0.3 / math.pi, 0.1)
    assert nearest_corner(actor.network(), PENDULUM) == pytest.approx(share, rel=0.05)
    assert torch.equal(torch.sign(actor.hidden[0].bias), sides[0])
    biases = [layer.bias.clone() for layer in actor.hidden]
    actor.keep_corners_away(0.5 * box)  # nothing to do
    for layer, bias in zip(actor.hidden, biases, strict=True):
        torch.testing.assert_close(layer.bias, bias, atol=1e-6, rtol=0)


def test_within_the_nearest_corner_relu_is_affine():
    """The share is exact for layers of relu: inside it nothing bends, just outside a unit does."""
    network = replace(_actor("relu", "none").network(), squash="identity")
    lo, hi = np.array(PENDULUM.domain, dtype=float).T
    share, J = nearest_corner(network, PENDULUM), network.jacobian_at_origin(ORIGIN)
    assert 0 < share < 1
    corners = np.array([[lo[0], lo[1]], [lo[0], hi[1]], [hi[0], lo[1]], [hi[0], hi[1]]])

    def off(x):
        return np.abs(network(x, ORIGIN) - network(np.zeros(2), ORIGIN) - x @ J.T).max()

    assert off(0.999 * share * corners) < 1e-12 < off(1.01 * share * corners)


def test_a_corner_at_the_origin_is_none_away_and_a_unit_at_rest_has_none():
    weights, ones = (np.array([[1.0, 0.0], [0.0, 0.0]]), np.ones((1, 2))), np.ones(1)
    for bias, expected in (([0.0, 0.0], 0.0), ([math.pi / 4, 0.0], 0.25)):
        network = PolicyNetwork.of_layers(weights, (np.array(bias), ones), ones, ones * 0, activation="relu")
        lo, hi = PENDULUM.domain[0]
        assert nearest_corner(network, PENDULUM) == pytest.approx(expected * math.pi / float(min(-lo, hi)), abs=1e-12)


@pytest.mark.parametrize("name", ["relu", "silu"])
def test_the_departure_of_other_units_is_their_distance_from_the_tangent(name):
    """One unit of one state, by its formula."""
    W, b, v = 0.7, 0.5, 0.7 * 2.0
    network = PolicyNetwork.of_layers(
        (np.array([[W]]), np.array([[3.0]])), (np.array([b]), np.zeros(1)), np.ones(1), np.zeros(1), activation=name
    )
    values, slopes = ACTIVATIONS[name].pair(np.array([b, b + v, b - v]))
    ends = values[1:] - values[0] - slopes[0] * np.array([v, -v])
    assert departure_of(network, [2.0]) == pytest.approx(np.abs(ends).mean() / (slopes[0] * v), rel=1e-9)


def test_a_record_of_tanh_is_as_it_was_and_others_say_their_activation():
    options = preset("pendulum")
    assert not {"activation", "corner_margin"} & options.record().keys()
    assert options.full_record()["activation"] == default_record()["activation"] == "tanh"
    assert replace(options, activation="relu").record().items() >= {"activation": "relu", "corner_margin": 0.1}.items()
    assert replace(options, corner_margin=0.2).record()["corner_margin"] == 0.2


def test_the_term_of_units_at_rest_is_of_tanh_only():
    assert _actor("silu").rest_loss().item() == 0.0 < _actor("tanh").rest_loss().item()


@pytest.mark.parametrize("name", slow_after(1, ["relu", "elu", "silu"]))
def test_a_policy_is_trained_and_evaluated(tmp_path, name):
    out, folder = tmp_path / "p.pt", tmp_path / "runs"
    arguments = ["pendulum", *SHORT, "--activation", name, "--checkpoint-dir", folder, "--checkpoint-every", 130]
    done = runner.invoke(app, ["train", *map(str, arguments), "--out", str(out), "--json"])
    assert done.exit_code == 0, done.stderr
    policy = load_policy(out)
    assert policy.network.activation == policy.training["activation"] == name
    assert ("nearest_corner" in policy.training) == (name in BENT)
    again = tmp_path / "again.pt"
    resumed = runner.invoke(app, ["train", *map(str, arguments), "--out", str(again), "--resume"])
    assert resumed.exit_code == 0 and again.read_bytes() == out.read_bytes()
    other = runner.invoke(app, ["train", "pendulum", *SHORT, "--checkpoint-dir", str(folder), "--resume", "--out", "x"])
    assert other.exit_code == 2 and f"--activation was {name}" in other.stderr
    judged = runner.invoke(app, ["evaluate", str(out), "--states", "2", "--duration", "1", "--json"])
    assert judged.exit_code == 0, judged.stderr
    found = json.loads(judged.stdout)["nearest_corner"]
    assert found is None if name == "silu" else found == policy.training["nearest_corner"] > 0.0999


def test_a_policy_with_a_corner_at_the_origin_does_not_ship():
    trainer = Trainer(PENDULUM, replace(preset("pendulum"), activation="relu", identification="never"))
    with torch.no_grad():
        trainer.sac.actor.hidden[0].bias.zero_()
    with pytest.raises(OptionError, match="a unit of relu has its corner at the origin"):
        trainer.policy()


def test_corners_of_deeper_layers_count():
    actor = _actor("relu")
    with torch.no_grad():
        last = actor.hidden[1]
        first = torch.relu(actor.hidden[0].bias)
        last.bias.sub_(last.weight @ first + last.bias)
    assert nearest_corner(actor.network(), PENDULUM) < 1e-6
