"""The simulators: gymnasium's contract, the equations of the plant, how an episode ends."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from certify.errors import InputError
from certify.loop.plants import get_system
from controllers.options import available_plants, preset
from controllers.simulation.stepping import Stepper
from controllers.training.environment import PlantEnvironment

ROOT = Path(__file__).parents[3]


@pytest.fixture
def environment() -> PlantEnvironment:
    return PlantEnvironment(get_system("pendulum"), preset("pendulum"))


def _pendulum(x, u):
    (u,) = u
    # theta'' = (g/l) sin theta - b/(m l^2) theta' + u/(m l^2)
    return np.array([x[1], 9.81 / 0.5 * np.sin(x[0]) + (u - 0.1 * x[1]) / (0.15 * 0.5**2)])


def _cartpole(x, u):
    (u,) = u
    # Forces on cart and pole with the accelerations unknown, solved as two linear equations.
    (_, theta, p_dot, theta_dot), mc, mp, length, g = x, 1.0, 0.1, 0.5, 9.81
    s, c = np.sin(theta), np.cos(theta)
    mass = [[mc + mp, mp * length * c], [mp * length * c, mp * length**2]]
    force = [u + mp * length * theta_dot**2 * s, mp * g * length * s]
    return np.array([p_dot, theta_dot, *np.linalg.solve(mass, force)])


def _quadrotor2d(x, u):
    along = np.array([-np.sin(x[2]), np.cos(x[2])])  # the thrusters' direction
    force = (u[0] + u[1]) * along - [0, 0.486 * 9.81]
    return np.array([*x[3:], *force / 0.486, 0.25 * (u[0] - u[1]) / 0.00383])


def _quadrotor3d(x, u):
    # Newton and Euler with rotation matrices; the angles' rates from the body rates as a linear equation.
    (cf, ct, cp), (sf, st, sp) = np.cos(x[3:6]), np.sin(x[3:6])
    yaw, pitch = np.array([[cp, -sp, 0], [sp, cp, 0], [0, 0, 1]]), np.array([[ct, 0, st], [0, 1, 0], [-st, 0, ct]])
    roll = np.array([[1, 0, 0], [0, cf, -sf], [0, sf, cf]])
    inertia, w = np.diag([4.9e-3, 4.9e-3, 8.8e-3]), x[9:]
    rates = np.column_stack([[1, 0, 0], roll.T @ [0, 1, 0], roll.T @ pitch.T @ [0, 0, 1]])
    torque = np.array([0.225 * (u[1] - u[3]), 0.225 * (u[2] - u[0]), 1.1 / 29 * (u[0] - u[1] + u[2] - u[3])])
    force = yaw @ pitch @ roll @ [0, 0, sum(u)] - [0, 0, 0.486 * 9.81]
    turning = np.linalg.solve(inertia, torque - np.cross(w, inertia @ w))
    return np.array([*x[6:9], *np.linalg.solve(rates, w), *force / 0.486, *turning])


WRITTEN = {
    "pendulum": (_pendulum, (0.7, -1.2), (2.5,)),
    "cartpole": (_cartpole, (0.4, -0.6, 1.1, 2.3), (-17.0,)),
    "quadrotor2d": (_quadrotor2d, (0.4, -0.6, 0.7, 1.1, 2.3, -1.5), (2.5, 2.2)),
    "quadrotor3d": (
        _quadrotor3d,
        (0.4, -0.6, 0.7, 0.3, -0.5, 1.2, 1.1, 2.3, -1.5, 0.8, -0.9, 0.4),
        (1.2, 1.0, 1.3, 1.4),
    ),
}
"""The equations of motion in a form of their own, with a state and an input."""


def _own(name):
    """The plant's own equations where nobody has written them in another form, half way to a corner of the domain."""
    system = get_system(name)
    f, u = system.function(), tuple(float(u) for u in system.exact_u_eq())
    return lambda x, u: f(x, np.array(u)), tuple(0.5 * float(hi) for _, hi in system.domain), u


@pytest.mark.parametrize("name", available_plants())
def test_registered_environments_pass_the_checker(name):
    environment = gymnasium.make(f"certify/{name}-v0")
    with warnings.catch_warnings():
        # Advice that does not apply: states are unbounded after a termination, inputs are in physical units.
        warnings.filterwarnings("ignore", message=".*(infinity|symmetric and normalized).*")
        check_env(environment.unwrapped, skip_render_check=True)


def test_a_fresh_process_finds_an_environment_without_importing_this_package():
    code = """
import sys, gymnasium
assert not any(name.startswith("controllers") for name in sys.modules)
environment = gymnasium.make("controllers.training.environment:certify/pendulum-v0")
print(environment.reset(seed=0)[0].shape, environment.spec.id)
import importlib
importlib.reload(sys.modules["controllers.training.environment"])  # once more: -W error makes a warning fail
print(type(gymnasium.make("certify/cartpole-v0").unwrapped).__module__)
"""
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["(2,) certify/pendulum-v0", "controllers.training.environment"]


def test_observation_is_the_raw_float64_state_and_angles_are_not_wrapped(environment):
    environment.reset(seed=0)
    environment.restore(replace(environment.snapshot(), x=(3.13, 5.0)))
    x, _, terminated, _, _ = environment.step(np.zeros(1))
    assert x.dtype == np.float64
    assert x[0] > 3.2 and terminated


@pytest.mark.parametrize("name", available_plants())
def test_step_agrees_with_a_fine_integration_of_the_written_equation(name):
    # By many small midpoint steps.
    environment, pieces = PlantEnvironment(get_system(name), preset(name)), 2000
    f, start, u = WRITTEN.get(name) or _own(name)
    environment.reset(seed=0)
    environment.restore(replace(environment.snapshot(), x=start))
    x, h = np.array(start), environment.options.dt / pieces
    for _ in range(pieces):
        x = x + h * f(x + h / 2 * f(x, u), u)
    found, *_ = environment.step(np.array(u))
    np.testing.assert_allclose(found, x, rtol=0, atol=1e-5)


def test_runge_kutta_converges_with_order_four():
    system, x, u = get_system("pendulum"), np.array([0.7, -1.2]), np.array([2.5])

    def after(steps):
        stepper, y = Stepper(system, 0.2 / steps, "numpy"), x
        for _ in range(steps):
            y = stepper(y, u)
        return y

    exact = after(400)
    errors = [np.linalg.norm(after(steps) - exact) for steps in (4, 8)]
    assert 3.7 < np.log2(errors[0] / errors[1]) < 4.4


@pytest.mark.parametrize("name", available_plants())
def test_batched_torch_stepper_follows_the_environment(name):
    environment, generator = PlantEnvironment(get_system(name), preset(name)), np.random.default_rng(0)
    n, space = environment.system.n, environment.action_space
    x, u = generator.uniform(-1, 1, (5, n)), generator.uniform(space.low, space.high, (5, len(space.high)))
    batched = Stepper(environment.system, environment.options.dt, "torch")(torch.tensor(x), torch.tensor(u))
    for k in range(5):
        environment.reset(seed=0)
        environment.restore(replace(environment.snapshot(), x=tuple(x[k])))
        single, *_ = environment.step(u[k])
        np.testing.assert_allclose(batched[k].numpy(), single, rtol=0, atol=1e-12)


def test_an_action_beyond_its_bounds_is_clipped(environment):
    ends = []
    for action in (6.0, 60.0):
        environment.reset(seed=3)
        ends.append(environment.step(np.array([action]))[0])
    np.testing.assert_array_equal(ends[0], ends[1])


def test_leaving_the_domain_terminates_and_costs_the_penalty(environment):
    options = environment.options
    environment.reset(seed=0)
    environment.restore(replace(environment.snapshot(), x=(3.1, 10.0)))
    x, reward, terminated, truncated, _ = environment.step(np.zeros(1))
    assert terminated and not truncated
    quadratic = float(np.dot(options.reward_weights, x**2))
    assert reward == pytest.approx(options.reward_offset - quadratic - options.penalty, abs=1e-12)


def test_the_time_limit_truncates_and_does_not_terminate():
    environment = PlantEnvironment(get_system("pendulum"), replace(preset("pendulum"), horizon=3))
    environment.reset(seed=0, options={"radius": 0.01})
    endings = [environment.step(np.zeros(1))[2:4] for _ in range(3)]
    assert endings == [(False, False), (False, False), (False, True)]


def test_starts_fill_the_ball_and_stay_inside(environment):
    environment.reset(seed=0)
    radii = [np.linalg.norm(environment.reset(options={"radius": 0.1})[0]) for _ in range(300)]
    assert max(radii) <= 0.1
    assert np.mean(np.array(radii) < 0.1 / np.sqrt(2)) == pytest.approx(0.5, abs=0.1)  # uniform in area


def test_wrong_number_of_reward_weights_is_refused():
    with pytest.raises(InputError, match="reward_weights"):
        PlantEnvironment(get_system("pendulum"), replace(preset("pendulum"), reward_weights=(1.0,)))
