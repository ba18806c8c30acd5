"""Curvature of the mean action near the origin: what is reported, and the term that holds it down."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.plants import get_system
from certify.loop.policies import PolicyNetwork
from controllers.commands.evaluate import _table
from controllers.evaluation.curvature import curvature
from controllers.evaluation.evaluation import evaluate
from controllers.evaluation.settling import EvaluationOptions
from controllers.options import available_plants, preset
from controllers.training.actor import Actor
from controllers.training.interface import Interface
from controllers.training.sac import CURVATURE_POINTS, SAC
from controllers.training.trainer import Trainer, train

PENDULUM = get_system("pendulum")


def _sac(seed=0, **changes) -> SAC:
    options = replace(preset("pendulum"), critic=(16, 16), **changes)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return SAC(Interface(PENDULUM), options, torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("centre", ["preactivation", "output", "none"])
@pytest.mark.parametrize("plant", available_plants())
def test_the_jacobian_anywhere_is_that_of_the_exported_policy(plant, centre):
    system = get_system(plant)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        actor = Actor(Interface(system), (16, 16), centre, (-5.0, 2.0))
        for layer in actor.hidden:
            torch.nn.init.normal_(layer.bias)
    network, u_eq, h = actor.network(), system.exact_u_eq(), 1e-5
    x = np.random.default_rng(0).uniform(-0.5, 0.5, (6, system.n))
    columns = [(network(x + h * e, u_eq) - network(x - h * e, u_eq)) / (2 * h) for e in np.eye(system.n)]
    found = actor.jacobian(torch.from_numpy(x).float()).detach().numpy()
    np.testing.assert_allclose(found, np.stack(columns, axis=-1), rtol=1e-4, atol=1e-4)
    at_origin = actor.at_origin()[1].detach().numpy()
    np.testing.assert_allclose(actor.jacobian(torch.zeros(1, system.n))[0].detach().numpy(), at_origin, atol=1e-5)


def test_curvature_of_a_known_function():
    # pi(x) = 6 tanh(x_1 + beta) - 6 tanh(beta): near 0, |pi''| = 12 |tanh(beta)| / cosh(beta)^2.
    network = PolicyNetwork.of_layers(
        (np.array([[1.0, 0.0]]),), (np.array([0.7]),), np.array([6.0]), np.zeros(1), "tanh", "output"
    )
    second = 12 * np.tanh(0.7) / np.cosh(0.7) ** 2
    assert curvature(network, PENDULUM, 1e-3) == pytest.approx(second, rel=1e-2)
    straight = replace(network, squash="identity")
    assert curvature(straight, PENDULUM, 1.0) == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(InputError, match="radius"):
        curvature(network, PENDULUM, 0.0)


def test_the_term_is_a_mean_over_states_of_the_reported_quotient():
    sac, system = _sac(3), PENDULUM
    x = sac._ball()
    assert x.shape == (CURVATURE_POINTS, 2)
    network, u_eq = sac.actor.network(), system.exact_u_eq()
    quotients, h = [], 1e-5
    for point in x.double().numpy():
        columns = [(network(point + h * e, u_eq) - network(point - h * e, u_eq)) / (2 * h) for e in np.eye(2)]
        change = np.array(columns).T - network.jacobian_at_origin(u_eq)
        quotients.append(np.linalg.norm(change) / np.linalg.norm(point))
    assert sac.actor.curvature_loss(x).item() == pytest.approx(np.mean(quotients), rel=1e-2)
    assert np.mean(quotients) < curvature(network, system, sac.options.eta) * 1.05


def test_its_states_fill_the_ball():
    sac = _sac(eta=0.3)
    radii = torch.linalg.vector_norm(torch.cat([sac._ball() for _ in range(100)]), dim=1)
    assert radii.max() <= 0.3 * (1 + 1e-6)
    assert (radii < 0.3 / 2**0.5).double().mean().item() == pytest.approx(0.5, abs=0.06)  # uniform in area


def test_its_states_are_never_the_origin(monkeypatch):
    """torch.rand draws 0 once in 2^24 times, and ||J(x) - J(0)|| / ||x|| is not finite there."""
    sac = _sac()
    monkeypatch.setattr(torch, "rand", lambda shape, **_: torch.zeros(shape))
    x = sac._ball()
    assert (torch.linalg.vector_norm(x, dim=1) > 0).all()
    assert torch.isfinite(sac.actor.curvature_loss(x))


def test_its_weight_lowers_the_curvature_and_without_weight_nothing_is_drawn():
    x = torch.linspace(-1, 1, 64).reshape(32, 2)
    batch = (x, x[:, :1], torch.ones(32, 1), x, torch.zeros(32, 1))
    found, draws = [], []
    for weight in (0.0, 10.0):
        sac = _sac(curvature_weight=weight, learning_rate=3e-3)
        for _ in range(150):
            sac.update(batch, None, 1.0)
        found.append(curvature(sac.actor.network(), PENDULUM, 0.1))
        draws.append(sac.generator.get_state())
    assert found[1] < 0.2 * found[0]
    plain = torch.Generator().manual_seed(0)
    for _ in range(150):
        torch.randn((32, 1), generator=plain)
    assert torch.equal(draws[0], plain.get_state()) and not torch.equal(draws[1], plain.get_state())


def test_units_at_rest_have_no_curvature_one_by_one():
    """rest_loss is the norms of h(0); where it is 0, the Jacobian of the preactivation is even around the origin."""
    sac = _sac(2)
    network = sac.actor.network()
    h, total = np.zeros(2), 0.0
    for W, b in zip(network.weights[:-1], network.biases[:-1], strict=True):
        h = np.tanh(W @ h + b)
        total += np.linalg.norm(h)
    assert sac.actor.rest_loss().item() == pytest.approx(total, rel=1e-5)
    with torch.no_grad():
        for layer in sac.actor._layers():
            layer.bias.zero_()
    assert sac.actor.rest_loss().item() == 0.0
    x = torch.tensor([[0.1, -0.2]])
    torch.testing.assert_close(sac.actor.jacobian(x), sac.actor.jacobian(-x))


def test_its_weight_brings_the_units_to_rest():
    x = torch.linspace(-1, 1, 64).reshape(32, 2)
    batch = (x, x[:, :1], torch.ones(32, 1), x, torch.zeros(32, 1))
    found = []
    for weight in (0.0, 1.0):
        sac = _sac(rest_weight=weight, learning_rate=3e-3)
        for _ in range(150):
            sac.update(batch, None, 1.0)
        found.append(sac.actor.rest_loss().item())
    assert found[1] < 0.3 * found[0]


def test_a_run_records_it_and_the_evaluation_reports_the_same():
    changes = {"steps": 200, "warm_up": 100, "n_A": 40, "n_B": 40, "batch": 16, "critic": (8,)}
    policy = train(Trainer(PENDULUM, replace(preset("pendulum"), **changes)))
    assert policy.training["curvature"] == curvature(policy.network, PENDULUM, 0.1) > 0
    shown = EvaluationOptions(states=2, duration=1.0)
    result = evaluate(policy, shown)
    assert result.curvature == result.as_json()["curvature"] == policy.training["curvature"]
    assert _table(result, shown)["curvature"] == f"{result.curvature:.4g}"
    training = {name: value for name, value in policy.training.items() if name != "eta"}
    foreign = evaluate(replace(policy, training=training), shown)
    assert np.isnan(foreign.curvature) and _table(foreign, shown)["curvature"] is None


@pytest.mark.parametrize("name", ["curvature_weight", "rest_weight"])
def test_a_negative_weight_is_refused(name):
    with pytest.raises(InputError, match=f"`{name}`"):
        replace(preset("pendulum"), **{name: -1.0})
