"""The learner's parts: likelihood, gain term, export, the first effect of a gradient step."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
import scipy.integrate
import scipy.stats
import torch

from certify.loop.plants import get_system
from controllers.options import available_plants, preset
from controllers.training.actor import Actor, squashed_log_likelihood
from controllers.training.critic import Critic
from controllers.training.interface import Interface
from controllers.training.replay import Replay
from controllers.training.sac import SAC
from tests.support.marks import slow_after

K = torch.tensor([[1.76, 0.59]])


def _actor(centre="preactivation", seed=0, plant="pendulum") -> Actor:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return Actor(Interface(get_system(plant)), (16, 16), centre, (-5.0, 2.0))


def _sac(options, seed=0) -> SAC:
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        return SAC(Interface(get_system("pendulum")), options, torch.Generator().manual_seed(seed))


@pytest.fixture
def options():
    return replace(preset("pendulum"), critic=(16, 16), batch=32)


@pytest.mark.parametrize("mean, log_std, scale, offset", [(0.3, -0.5, 6.0, 0.0), (-1.2, 0.4, 0.7, 2.0)])
def test_likelihood_of_the_squashed_action_is_a_density(mean, log_std, scale, offset):
    def density(u):
        w = np.arctanh((u - offset) / scale)
        arguments = (torch.tensor([v], dtype=torch.float64) for v in (w, mean, log_std, scale))
        return float(torch.exp(squashed_log_likelihood(*arguments)))

    mass, error = scipy.integrate.quad(density, offset - scale, offset + scale, limit=200)
    assert error < 1e-6
    assert mass == pytest.approx(1.0, abs=1e-6)
    # and in the right place: P(u <= offset) = P(w <= 0)
    below, _ = scipy.integrate.quad(density, offset - scale, offset, limit=200)
    assert below == pytest.approx(scipy.stats.norm.cdf(-mean / np.exp(log_std)), abs=1e-6)


def test_likelihood_is_finite_far_out_and_sums_over_inputs():
    w = torch.tensor([[40.0, -40.0]], dtype=torch.float64)
    zero, one = torch.zeros_like(w), torch.ones(2, dtype=torch.float64)
    both = squashed_log_likelihood(w, zero, zero, one)
    single = [squashed_log_likelihood(w[:, k : k + 1], zero[:, :1], zero[:, :1], one[:1]) for k in (0, 1)]
    assert torch.isfinite(both).all()
    torch.testing.assert_close(both, single[0] + single[1])


@pytest.mark.parametrize("plant", available_plants())
@pytest.mark.parametrize("centre", ["preactivation", "output"])
def test_jacobian_at_the_origin_is_that_of_the_exported_policy(centre, plant):
    actor, u_eq = _actor(centre, plant=plant), get_system(plant).exact_u_eq()
    mean, jacobian = actor.at_origin()
    network, h = actor.network(), 1e-6
    columns = [(network(h * e, u_eq) - network(-h * e, u_eq)) / (2 * h) for e in np.eye(network.n)]
    np.testing.assert_allclose(jacobian.detach().numpy(), np.array(columns).T, atol=1e-5)
    raw = replace(network, centre="none")
    np.testing.assert_allclose(mean.detach().numpy(), raw(np.zeros(network.n), u_eq), atol=1e-6)
    assert abs(raw(np.zeros(network.n), u_eq)[0] - float(u_eq[0])) > 1e-3  # so that centring has something to do


def test_descending_the_gain_term_moves_the_jacobian_to_minus_K():
    actor = _actor()
    optimiser = torch.optim.Adam(actor.parameters(), 3e-3)
    before = torch.linalg.vector_norm(actor.at_origin()[1] + K).item()
    for _ in range(800):
        optimiser.zero_grad()
        actor.gain_loss(K).backward()
        optimiser.step()
    mean, jacobian = actor.at_origin()
    assert torch.linalg.vector_norm(jacobian + K).item() < 0.02 * before
    assert (jacobian < 0).all() and abs(mean.item()) < 0.05


@pytest.mark.parametrize("centre", ["preactivation", "output"])
def test_export_is_exact_and_centred(centre):
    actor = _actor(centre, seed=5)
    network = actor.network()
    x = torch.linspace(-3, 3, 22).reshape(11, 2)
    with torch.no_grad():
        mean, _ = actor(x)
    # The same weights as in memory: single precision layers differ from exact ones by rounding only.
    np.testing.assert_allclose(network.net(x.double().numpy()), mean.double().numpy(), atol=1e-5)
    factors = actor.factors.double().numpy()
    np.testing.assert_array_equal(network.weights[0] / factors, actor.hidden[0].weight.detach().double().numpy())
    assert set(np.log2(factors) % 1) == {0.0}  # powers of two: nothing was rounded
    assert network(np.zeros(2), (Fraction(0),)) == pytest.approx(0.0, abs=0)
    assert network.layers == (2, 16, 16, 1) and network.scale == 6 and network.offset == 0


def test_batched_critics_are_independent_networks():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        twin = Critic(3, (8, 8), copies=2, scale=3.0)
    x = torch.linspace(-1, 1, 15).reshape(5, 3)
    for copy in range(2):
        h = x
        for k, (weight, bias) in enumerate(zip(twin.weights, twin.biases, strict=True)):
            h = (torch.tanh(h) if k else h) @ weight[copy] + bias[copy]
        torch.testing.assert_close(twin(x)[copy], 3.0 * h.squeeze(1))
    assert not torch.allclose(twin(x)[0], twin(x)[1])


def test_replay_overwrites_the_oldest():
    replay = Replay(3, 2, 1)
    for k in range(5):
        replay.add(np.full(2, k), np.array([0.5]), float(k), np.full(2, k + 1), k == 4)
    assert len(replay) == 3
    x, action, reward, x_next, terminated = replay.sample(200, torch.Generator().manual_seed(0))
    assert set(reward.flatten().tolist()) == {2.0, 3.0, 4.0}
    torch.testing.assert_close(x[:, 0], reward[:, 0])
    torch.testing.assert_close(x_next[:, 1], reward[:, 0] + 1)
    torch.testing.assert_close(terminated[:, 0], (reward[:, 0] == 4).float())
    assert (action == 0.5).all()


def _batch(size=32, terminated=0.0):
    generator = torch.Generator().manual_seed(1)
    x = torch.randn((size, 2), generator=generator)
    action = torch.rand((size, 1), generator=generator) * 2 - 1
    return x, action, torch.ones(size, 1), x + 0.01, torch.full((size, 1), terminated)


@pytest.mark.parametrize("terminated, goal", slow_after(2, [(1.0, 6.0), (0.0, 6.0 + 0.5 * 10.0)]))
def test_q_learns_the_scaled_reward_and_bootstraps_only_before_a_termination(options, terminated, goal):
    options = replace(options, reward_scale=6.0, gamma=0.5, learning_rate=1e-2, tau=1e-12)
    sac = _sac(options)
    with torch.no_grad():  # a target network that is 10 everywhere
        for parameter in sac.value_target.parameters():
            parameter.zero_()
        sac.value_target.biases[-1].fill_(10.0 / options.critic_scale)
    batch = _batch(terminated=terminated)
    for _ in range(600):
        sac.update(batch, None, actor_step=0.0)
    q = sac.q(torch.cat((batch[0] * sac.actor.factors, batch[1]), 1))
    assert (q - goal).abs().max().item() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "learned"), slow_after(1, [(100.0, True), (1.0, False)]))
def test_returns_of_some_hundreds_are_learned_in_their_own_unit(options, scale, learned):
    """Goals around -500, Adam's steps of 3e-4: in units of one the critic is still far off."""
    options = replace(options, critic=(64, 64), critic_scale=scale, reward_scale=1.0, gamma=0.0)
    sac = _sac(options)
    x, action, _, x_next, terminated = _batch(size=256, terminated=1.0)
    goal = -500.0 + 20.0 * x[:, :1]
    for _ in range(700):
        sac.update((x, action, goal, x_next, terminated), None, actor_step=0.0)
    q = sac.q(torch.cat((x * sac.actor.factors, action), 1))
    assert ((q - goal.T).abs().mean().item() < 20) == learned


def test_the_value_target_is_an_exponential_average(options):
    sac = _sac(options)
    old = [p.detach().clone() for p in sac.value_target.parameters()]
    sac.update(_batch(), None, actor_step=1.0)
    for before, target, value in zip(old, sac.value_target.parameters(), sac.value.parameters(), strict=True):
        torch.testing.assert_close(target, (1 - options.tau) * before + options.tau * value)


def test_the_actor_moves_to_better_actions_and_rests_at_step_zero(options):
    options = replace(options, learning_rate=1e-2, reward_scale=80.0, gamma=0.0)
    sac = _sac(options)
    x, action, _, x_next, terminated = _batch(256)
    batch = (x, action, -((action - 0.5) ** 2), x_next, terminated)  # best is tanh(w) = 0.5
    frozen = [p.detach().clone() for p in sac.actor.parameters()]
    for _ in range(300):
        sac.update(batch, None, actor_step=0.0)
    assert all(torch.equal(a, b) for a, b in zip(frozen, sac.actor.parameters(), strict=True))
    for _ in range(800):
        sac.update(batch, None, actor_step=1.0)
    with torch.no_grad():
        mean, _ = sac.actor(x)
    assert (torch.tanh(mean) - 0.5).abs().mean().item() < 0.1
