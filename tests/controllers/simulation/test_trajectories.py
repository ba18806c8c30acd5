"""Trajectories of the held closed loop: the environment's own steps, each by itself, and their cost."""

from dataclasses import replace

import numpy as np
import pytest

from certify.loop.plants import available_systems, get_system
from controllers.options import preset
from controllers.simulation import closed_loop
from controllers.simulation.trajectories import simulate
from controllers.training.environment import PlantEnvironment

TINY = replace(preset("pendulum"), steps=160, warm_up=60, n_A=25, n_B=25, batch=8, actor=(6, 5), critic=(7,))


def test_accumulated_cost_is_the_sum_over_the_environment_s_own_steps():
    x0, gain = np.array([[0.4, -0.3], [2.0, 6.0]]), np.array([-40.0, -3.0])  # the second saturates
    # The gain in products and a sum, which round the same for a row and for a batch. `x @ gain` need not: BLAS
    # contracts a product of a matrix into fused multiply-adds and that of a single row, on the same machine, not.
    states, cost = simulate(get_system("pendulum"), TINY, lambda x: (x * gain).sum(axis=1, keepdims=True), x0, 0.1)
    assert states.shape == (6, 2, 2) and cost.shape == (6, 2)
    environment = PlantEnvironment(get_system("pendulum"), TINY)
    for k in range(2):
        environment.reset(seed=0)
        environment.restore(replace(environment.snapshot(), x=tuple(x0[k])))
        x, total = x0[k], 0.0
        for t in range(5):
            assert cost[t, k] == pytest.approx(total, abs=1e-13)
            u = min(6.0, max(-6.0, float((x * gain).sum())))
            total += 0.02 * (1.0 * x[0] ** 2 + 0.5 * x[1] ** 2 + 1.0 * u**2)
            x, *_ = environment.step(np.array([u]))
            np.testing.assert_array_equal(states[t + 1, k], x)
        assert cost[5, k] == pytest.approx(total, abs=1e-13)


@pytest.mark.parametrize("name", available_systems())
def test_a_trajectory_does_not_depend_on_the_others_of_its_batch(name):
    """To the last bit, for a policy of which that is true; what diverges beside it makes no difference either."""
    system = get_system(name)
    lo, hi = np.array(system.domain, dtype=np.float64).T
    ones_n, ones_m = (1.0,) * system.n, (1.0,) * system.m
    training = replace(TINY, reward_weights=ones_n, state_weights=ones_n, input_weights=ones_m)
    x0 = np.random.default_rng(0).uniform(0.6 * lo, 0.6 * hi, (9, system.n))
    x0[4, -1] = 2 * closed_loop.DIVERGED
    rows = np.random.default_rng(1).standard_normal((system.m, system.n))
    hover = np.array([float(u) for u in system.exact_u_eq()])

    def act(x):
        return np.stack([u + (x * row).sum(axis=1) for u, row in zip(hover, rows, strict=True)], axis=1)

    states, cost = simulate(system, training, act, x0, 0.3)
    assert np.isnan(states[-1, 4]).any()
    for k in range(len(x0)):
        alone, its_cost = simulate(system, training, act, x0[k : k + 1], 0.3)
        np.testing.assert_array_equal(alone[:, 0], states[:, k])
        np.testing.assert_array_equal(its_cost[:, 0], cost[:, k])


def test_the_input_s_cost_is_counted_from_the_equilibrium():
    system = get_system("quadrotor2d")
    hover = float(system.exact_u_eq()[0])
    training = replace(TINY, reward_weights=(1.0,) * 6, state_weights=(2.0,) * 6, input_weights=(3.0, 5.0))
    u = np.array([[hover + 0.1, hover - 0.2]])
    _, cost = simulate(system, training, lambda x: u, np.zeros((1, 6)), 0.02)
    assert cost[:, 0] == pytest.approx([0.0, 0.02 * (3 * 0.1**2 + 5 * 0.2**2)], abs=1e-15)
