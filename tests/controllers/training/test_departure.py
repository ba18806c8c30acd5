"""What bounds see of the hidden units: the formula against another computation, its laws, and its place in training."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from certify.errors import InputError
from certify.loop.plants import get_system
from certify.loop.policies import PolicyNetwork, load_policy
from controllers.cli import app
from controllers.evaluation.forecast import forecast_of
from controllers.options import get_plant, preset
from controllers.training.departure import departure, departure_of, linearised
from controllers.training.interface import Interface
from controllers.training.sac import SAC

PENDULUM = get_system("pendulum")
runner = CliRunner()


def _network(layers=(3, 6, 5, 2), seed=0, bias=0.6) -> PolicyNetwork:
    generator = np.random.default_rng(seed)
    weights = tuple(generator.normal(size=(b, a)) for a, b in pairwise(layers))
    biases = tuple(bias * generator.normal(size=len(W)) for W in weights)
    return PolicyNetwork.of_layers(
        weights, biases, np.full(layers[-1], 2.0), np.zeros(layers[-1]), "tanh", "preactivation"
    )


def _by_differences(network: PolicyNetwork, box: np.ndarray) -> float:
    """The same sum unit by unit: ranges and gains by differences of the network cut in two, quotients at both ends."""

    def upto(x, k):  # values before the k-th tanh
        for j in range(k + 1):
            x = network.weights[j] @ (np.tanh(x) if j else x) + network.biases[j]
        return x

    def beyond(h, k):  # net from the k-th tanh's outputs
        for j in range(k + 1, len(network.weights)):
            h = network.weights[j] @ (np.tanh(h) if j > k + 1 else h) + network.biases[j]
        return h

    step, zero, total = 1e-6, np.zeros(network.n), 0.0
    last = len(network.weights) - 1

    def ranges(k):
        columns = [(upto(step * e, k) - upto(-step * e, k)) / (2 * step) for e in np.eye(network.n)]
        return np.abs(np.array(columns)).T @ box

    for k in range(last):
        y, v = upto(zero, k), ranges(k)
        for i, e in enumerate(np.eye(len(y))):
            gain = np.abs(beyond(np.tanh(y) + step * e, k) - beyond(np.tanh(y) - step * e, k)) / (2 * step)
            slope = 1 / np.cosh(y[i]) ** 2
            bends = [abs(np.tanh(y[i] + s * v[i]) - np.tanh(y[i]) - slope * s * v[i]) for s in (1, -1)]
            total += gain.sum() * np.mean(bends)
    return float(total / ranges(last).sum())


@pytest.mark.parametrize("layers", [(3, 6, 5, 2), (2, 4, 1), (4, 5, 6, 4, 3)])
def test_it_is_the_sum_over_units_by_another_computation(layers):
    network, box = _network(layers), np.linspace(0.2, 0.9, layers[0])
    assert departure_of(network, box.tolist()) == pytest.approx(_by_differences(network, box), rel=1e-6)


def test_one_unit_at_rest_by_hand():
    network = PolicyNetwork.of_layers(
        (np.array([[2.0, 0.0]]), np.array([[-5.0]])), (np.zeros(1),) * 2, np.ones(1), np.zeros(1)
    )
    v = 2.0 * 0.3
    assert departure_of(network, [0.3, 7.0]) == pytest.approx((v - np.tanh(v)) / v, rel=1e-12)
    tiny = network.with_layers(weights=(np.array([[1e-4, 0.0]]), network.weights[1]))
    assert departure_of(tiny, [1.0, 1.0]) == pytest.approx(1e-8 / 3, rel=1e-6)  # single precision sees nothing of it


def test_an_affine_network_departs_by_nothing_and_a_dead_one_is_no_accident():
    affine = PolicyNetwork.of_layers(
        (np.array([[1.0, 2.0]]),), (np.ones(1),), np.ones(1), np.zeros(1), "identity", "output"
    )
    assert departure_of(affine, [1.0, 1.0]) == 0.0
    dead = PolicyNetwork.of_layers(
        (np.zeros((3, 2)), np.ones((1, 3))), (np.zeros(3), np.zeros(1)), np.ones(1), np.zeros(1)
    )
    assert departure_of(dead, [1.0, 1.0]) == 0.0


def test_units_that_cancel_count_twice():
    """Two equal units with opposite gains do nothing together, and bounds that add magnitudes do not see that."""
    W = np.array([[1.0], [1.0], [1.0]])
    one = PolicyNetwork.of_layers((W[:1], np.array([[1.0]])), (np.zeros(1),) * 2, np.ones(1), np.zeros(1))
    three = PolicyNetwork.of_layers(
        (W, np.array([[1.0, 4.0, -4.0]])), (np.zeros(3), np.zeros(1)), np.ones(1), np.zeros(1)
    )
    x = np.linspace(-1, 1, 5)[:, None]
    np.testing.assert_allclose(three.net(x), one.net(x), atol=1e-14)
    assert departure_of(three, [1.0]) == pytest.approx(9 * departure_of(one, [1.0]))


def test_a_larger_box_never_departs_less():
    network = _network()
    sums = []
    for size in (0.1, 0.3, 1.0):
        box = size * np.ones(3)
        linear = np.abs(linearised(*_tensors(network)).jacobians[-1].numpy()) @ box
        sums.append(departure_of(network, box.tolist()) * linear.sum())
    assert sums[0] < sums[1] < sums[2]


def _tensors(network, **options):
    return tuple([torch.tensor(a, **options) for a in arrays] for arrays in (network.weights, network.biases))


def test_its_gradient_is_that_of_differences():
    network, box = _network((2, 3, 3, 1)), torch.tensor([0.5, 0.8], dtype=torch.float64)
    weights, biases = _tensors(network, requires_grad=True)
    departure(weights, biases, box).backward()

    def at(layer, index, change):
        moved = [W.detach().clone() for W in weights]
        moved[layer][index] += change
        return departure(moved, [b.detach() for b in biases], box).item()

    for layer, index in ((0, (1, 0)), (1, (2, 1)), (2, (0, 2))):
        slope = (at(layer, index, 1e-6) - at(layer, index, -1e-6)) / 2e-6
        assert slope != 0 and weights[layer].grad[index].item() == pytest.approx(slope, rel=1e-5)
    assert all(b.grad is not None and bool(b.grad.abs().sum() > 0) for b in biases[:-1])


def test_doing_less_is_no_way_to_lower_it():
    """A term that falls with the gains would train a policy to let go of the plant."""
    network, box = _network(), [0.4, 0.7, 0.2]
    less = network.with_layers(weights=(*network.weights[:-1], 0.1 * network.weights[-1]))
    assert departure_of(less, box) == pytest.approx(departure_of(network, box), rel=1e-12)
    weights, biases = _tensors(network, requires_grad=True)
    departure(weights, biases, torch.tensor(box, dtype=torch.float64)).backward()
    along = (weights[-1].grad * weights[-1]).sum().item()
    assert abs(along) < 1e-9 * weights[-1].grad.norm().item() * weights[-1].norm().item()


def _sac(**changes) -> SAC:
    options = replace(preset("pendulum"), critic=(16, 16), **changes)
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return SAC(Interface(PENDULUM), options, torch.Generator().manual_seed(3))


def test_the_actors_is_that_of_the_exported_policy():
    sac = _sac()
    box = torch.tensor([0.7, 3.0])
    assert sac.actor.departure(box).item() == pytest.approx(departure_of(sac.actor.network(), [0.7, 3.0]), rel=1e-5)


def test_its_box_is_where_episodes_start_unless_another_is_given():
    start = preset("pendulum").start * np.array([min(-float(lo), float(hi)) for lo, hi in PENDULUM.domain])
    np.testing.assert_allclose(_sac().box.numpy(), start)
    assert _sac(proof_box=(0.5, 2.0)).box.tolist() == [0.5, 2.0]


@pytest.mark.slow
def test_its_weight_lowers_it_and_without_weight_nothing_changes():
    x = torch.linspace(-1, 1, 64).reshape(32, 2)
    batch = (x, x[:, :1], torch.ones(32, 1), x, torch.zeros(32, 1))
    found, states = [], []
    for changes in ({}, {"proof_box": (0.5, 2.0)}, {"proof_weight": 10.0, "proof_box": (0.5, 2.0)}):
        sac = _sac(learning_rate=3e-3, **changes)
        for _ in range(200):
            sac.update(batch, None, 1.0)
        network = sac.actor.network()
        found.append(departure_of(network, (0.5, 2.0)))
        states.append((network.sha256(), sac.generator.get_state()))
    assert states[0][0] == states[1][0] != states[2][0]
    assert all(torch.equal(state[1], states[0][1]) for state in states)  # it draws nothing
    assert found[2] < 0.3 * found[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"proof_weight": -1.0}, "`proof_weight`"), ({"proof_box": (1.0, 0.0)}, "`proof_box` must be positive")],
)
def test_a_negative_weight_and_an_empty_box_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        replace(preset("pendulum"), **changes)


def test_the_command_line_trains_with_it_and_records_it(tmp_path):
    short = ["--steps", "200", "--warm-up", "100", "--n-A", "40", "--n-B", "40", "--batch", "16", "--critic", "8"]
    proof = ["--proof-weight", "0.5", "--proof-box", "0.5,2"]
    done = runner.invoke(app, ["train", "pendulum", *short, *proof, "--out", str(tmp_path / "p.pt"), "--json"])
    assert done.exit_code == 0, done.stderr
    record = load_policy(tmp_path / "p.pt").training
    assert (record["proof_weight"], record["proof_box"]) == (0.5, [0.5, 2.0])
    said, network = json.loads(done.stdout), load_policy(tmp_path / "p.pt").network
    assert said["departure"] == departure_of(network, get_plant("pendulum").initial_states)
    assert said["nonlinearity"]["states"] == 1000 and said["nonlinearity"]["rms"] >= 0
    forecast = forecast_of(network, get_system("pendulum"), get_plant("pendulum").initial_states)
    easy = said["departure"] <= 1 and (forecast is None or forecast.size >= 1)
    assert said["next"].startswith("certify roa --policy" if easy else "controllers flatten")
    assert ("provable" in said) == (forecast is not None)
    refused = runner.invoke(app, ["train", "pendulum", "--proof-box", "1", "--out", str(tmp_path / "q.pt"), "--json"])
    assert refused.exit_code == 2
    assert "--proof-box must be 2 numbers for pendulum" in json.loads(refused.stdout)["error"]
