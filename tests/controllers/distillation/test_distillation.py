"""Distillation: what the new policy has of its source, how near it is, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from certify.errors import InputError
from certify.loop.expressions import Symbol, cos, sin
from certify.loop.networks import Affine, Map, Network, Observe, Sum
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, load_policy, require_centred, save_policy
from controllers.cli import app
from controllers.distillation.distillation import distil
from controllers.distillation.last_layer import fitted
from controllers.distillation.options import DistilOptions
from controllers.evaluation.corners import nearest_corner
from controllers.simulation.trajectories import initial_states
from tests.support.marks import slow_after

SHIPPED = Path(__file__).parents[3] / "examples" / "policies" / "pendulum.pt"
PENDULUM = get_system("pendulum")
ORIGIN = PENDULUM.exact_u_eq()
QUICK = DistilOptions(hidden=(16, 16), steps=150, samples=2000, batch=128, states=20)
GAIN = np.array([[6.0, 2.0]])
runner = CliRunner()


def _observed(squash="tanh", centre="preactivation", scale=6.0, clip=None) -> PolicyNetwork:
    """A policy of cos, sin and the rate, whose layer of silu has a skip connection beside it."""
    theta, rate = Symbol("theta"), Symbol("theta_dot")
    generator = np.random.default_rng(1)
    first = generator.normal(size=(3, 3))
    steps = (
        Observe((0,), (theta, rate), (cos(theta), sin(theta), rate / 8)),
        Affine((1,), first, 0.1 * np.ones(3)),
        Map((2,), "silu"),
        Sum((1, 3)),
        Affine((4,), np.array([[0.1, -1.5, -3.0]]), np.array([-1.0])),
    )
    return PolicyNetwork(Network(2, steps), np.array([scale]), np.zeros(1), squash, centre, clip)


def _by_differences(network: PolicyNetwork) -> np.ndarray:
    h = 1e-6
    return np.array([(network(h * e, ORIGIN) - network(-h * e, ORIGIN)) / (2 * h) for e in np.eye(2)]).T


@pytest.mark.parametrize("name", slow_after(2, ["tanh", "relu", "elu", "silu", "softsign"]))
def test_a_small_network_imitates_the_source_and_has_its_gain(name):
    source = load_policy(SHIPPED)
    result = distil(source, replace(QUICK, activation=name))
    network = result.policy.network
    assert network.layers == (2, 16, 16, 1) and network.activation == name and network.centre == "preactivation"
    assert network.network.is_chain and (network.scale, network.offset) == (source.network.scale, source.network.offset)
    J = source.network.jacobian_at_origin(ORIGIN)
    np.testing.assert_allclose(_by_differences(network), J, atol=1e-4 * np.abs(J).max())
    assert result.gain_error < 1e-5
    assert result.mean[0] < 0.05 * 6 and result.mean[0] < result.largest[0] < 1.5
    assert result.own.settled == result.source.settled == 20
    assert result.own.cost == pytest.approx(result.source.cost, rel=0.03)
    require_centred(network, ORIGIN)
    if name in ("tanh", "silu"):
        assert result.corner == np.inf and "nearest_corner" not in result.policy.training
    else:
        assert result.corner == result.policy.training["nearest_corner"] > 0.0999


def test_its_figures_are_those_of_the_two_policies():
    source = load_policy(SHIPPED)
    result = distil(source, QUICK)
    x0 = initial_states(PENDULUM, 500, 3)
    off = np.abs(result.policy.network(x0, ORIGIN) - source.network(x0, ORIGIN))
    assert 0 < off.max() <= 1.1 * result.largest[0]
    assert result.policy.training["distilled"]["sha256"] == source.network.sha256()
    assert result.policy.training["distance"] < 0.01 and result.policy.training["K"] == source.training["K"]


@pytest.mark.parametrize(
    ("squash", "centre", "scale", "clip", "asked", "wanted"),
    slow_after(
        2,
        [
            ("tanh", "preactivation", 6.0, None, None, "preactivation"),
            ("tanh", "output", 6.0, None, "preactivation", "preactivation"),
            ("tanh", "preactivation", 6.0, None, "output", "output"),
            ("identity", "output", 2.0, ([-6.0], [6.0]), None, "output"),
            ("identity", "none", 2.0, ([-6.0], [6.0]), "none", "none"),
        ],
    ),
)
def test_any_steps_are_imitated_with_the_centring_that_is_asked_for(squash, centre, scale, clip, asked, wanted):
    source = _observed(squash, centre, scale, clip)
    result = distil(Policy(source, "pendulum"), replace(QUICK, centre=asked, activation="elu", steps=400))
    network = result.policy.network
    assert network.network.is_chain and network.centre == wanted and network.squash == squash
    assert (network.clip is None) == (clip is None)
    J = source.jacobian_at_origin(ORIGIN)
    np.testing.assert_allclose(network.jacobian_at_origin(ORIGIN), J, atol=1e-4 * np.abs(J).max())
    zero = np.zeros(2)
    at_0 = source(zero, ORIGIN) if wanted == "none" else zero[:1]
    np.testing.assert_allclose(network(zero, ORIGIN), at_0, atol=1e-4)
    assert result.mean[0] < 0.6
    assert {"dt", "state_weights", "input_weights"} <= result.policy.training.keys()  # so that it can be evaluated


def test_the_last_layer_has_the_jacobian_exactly_and_the_least_squares_beyond_it():
    """Without squash and clip it is a linear problem with a condition: no allowed change makes it much better."""
    generator = np.random.default_rng(0)
    features, slopes = generator.normal(size=(60, 7)), generator.normal(size=(7, 2))
    wanted, J, weights = generator.normal(size=(60, 2)), generator.normal(size=(2, 2)), generator.uniform(1, 2, 60)
    form = PolicyNetwork.of_layers(
        (np.zeros((2, 2)),), (np.array([0.3, -0.1]),), np.array([2.0, 0.5]), np.array([0.1, 0.0]), "identity", "none"
    )
    W = fitted(np.zeros((2, 7)), features, slopes, wanted, J, weights, form)
    np.testing.assert_allclose(W @ slopes, J, atol=1e-9)
    goal = (wanted - form.offset) / form.scale - form.net(np.zeros(2))  # of features @ W.T
    free, root = np.linalg.svd(slopes.T)[2][2:].T, np.sqrt(weights)[:, None]  # changes that leave the Jacobian
    for j in range(2):
        own = np.linalg.lstsq(slopes.T, J[j], rcond=None)[0]
        best = (
            own
            + free @ np.linalg.lstsq(root * features @ free, root[:, 0] * (goal[:, j] - features @ own), rcond=None)[0]
        )
        off, least = (float((weights * (features @ row - goal[:, j]) ** 2).sum()) for row in (W[j], best))
        assert least * (1 - 1e-9) <= off < 1.11 * least


def test_the_command_writes_the_same_bytes_twice_and_says_how_far_it_is(tmp_path):
    source = tmp_path / "source.pt"
    save_policy(source, Policy(_observed(), "pendulum"))
    short = ["--steps", "10", "--samples", "300", "--states", "5", "--hidden", "12", "--activation", "relu"]
    outs = [tmp_path / "a.pt", tmp_path / "b.pt"]
    for out in outs:
        done = runner.invoke(app, ["distil", str(source), *short, "--out", str(out), "--json"])
        assert done.exit_code == 0, done.stderr
    assert outs[0].read_bytes() == outs[1].read_bytes()
    said, policy = json.loads(done.stdout), load_policy(outs[0])
    assert said["sha256"] == policy.network.sha256() and said["layers"] == [2, 12, 1] and said["activation"] == "relu"
    assert said["nearest_corner"] == nearest_corner(policy.network, PENDULUM)
    assert said["distilled"]["states"] == said["source"]["states"] == 5
    judged = runner.invoke(app, ["evaluate", str(outs[0]), "--states", "2", "--duration", "1"])
    assert judged.exit_code == 0 and "nearest corner" in judged.stdout
    table = runner.invoke(app, ["distil", str(source), *short, "--out", str(outs[0])])
    for words in ("difference", "error of J(0)", "runs of the source", "2-12-1 relu, centre preactivation"):
        assert words in table.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--hidden", "8,wide"], "--hidden must be widths as in 32,32"),
        (["--hidden", "0"], "--hidden must be positive widths"),
        (["--activation", "swish"], "--activation must be one of"),
        (["--centre", "nowhere"], "--centre must be one of"),
        (["--hidden", "1", "--steps", "3"], "the new units cannot have the source's Jacobian"),
    ],
)
def test_what_cannot_be_distilled_is_refused(tmp_path, arguments, message):
    done = runner.invoke(app, ["distil", str(SHIPPED), "--out", str(tmp_path / "p.pt"), *arguments])
    assert done.exit_code == 2 and message in done.stderr and not (tmp_path / "p.pt").exists()


def test_a_policy_of_another_plant_or_centring_is_refused():
    with pytest.raises(InputError, match="must map 4 states to 1 inputs for cartpole"):
        distil(Policy(_observed(), "cartpole"), QUICK)
    with pytest.raises(InputError, match="`centre` 'preactivation' needs `squash` 'tanh'"):
        distil(Policy(_observed("identity", "output"), "pendulum"), replace(QUICK, centre="preactivation"))
