"""Gymnasium's own steps as plants in discrete time: that the files say what its code computes, and what is proved."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Verdict
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import find_rest
from certify.loop.plants import System, controllability, linearise, load_system, residuals
from certify.loop.policies import Policy, load_policy
from tests.support.reference import judge_bytes

EXAMPLES = Path(__file__).parents[2] / "examples"
FOLDER = EXAMPLES / "plants" / "gymnasium"
POLICY = EXAMPLES / "policies" / "gymnasium" / "pendulum.pt"
ENVIRONMENTS = {"pendulum": "Pendulum-v1", "cartpole": "CartPole-v1", "mountain_car": "MountainCarContinuous-v0"}
BOTTOM = {"pendulum": 0.0, "cartpole": 0.0, "mountain_car": np.pi / 6}  # what is added to its first state
Array = NDArray[np.float64]


def plant(name: str) -> System:
    return load_system(FOLDER / f"{name}.toml")


def stepped(name: str, env: Any, x: Array, u: float) -> Array:
    """The state one step later, by Gymnasium's code."""
    moved = x - np.eye(len(x))[0] * BOTTOM[name]
    env.reset(seed=0)
    env.state = moved
    if name == "cartpole":
        env.force_mag, action = abs(u), int(u > 0)
        env.step(action)
    else:
        env.step(np.array([u]))
    return np.asarray(env.state, dtype=np.float64) + np.eye(len(x))[0] * BOTTOM[name]


def test_all_are_here() -> None:
    assert sorted(path.stem for path in FOLDER.glob("*.toml")) == sorted(
        [*ENVIRONMENTS, "mountain_car_goal", "mountain_car_actions"]
    )


def test_the_car_on_its_way_to_the_flag() -> None:
    """With the wall, in Gymnasium's coordinates: before the end of the road a step is Gymnasium's, and
    where it ends at the flag, so does an episode."""
    gymnasium = pytest.importorskip("gymnasium")
    system, env = plant("mountain_car_goal"), gymnasium.make("MountainCarContinuous-v0").unwrapped
    f, random, walled, arrived = system.function(), np.random.default_rng(0), 0, 0
    for k in range(1000):
        x, u = random.uniform([-1.2, -0.07], [0.6 if k % 4 else -1.15, 0.07]), random.uniform(-1, 1, 1)
        ours = f(x, u)
        env.reset(seed=0)
        env.state = x
        _, _, ended, *_ = env.step(u)
        if ours[0] > 0.6 - 1e-5 or abs(x[0] + ours[1] + 1.2) < 1e-5:
            continue
        walled, arrived = walled + (env.state[0] == np.float32(-1.2)), arrived + ended
        np.testing.assert_allclose(ours, env.state, rtol=1e-6, atol=2e-7)
        if abs(ours[0] - 0.45) > 1e-5 and abs(ours[1]) > 1e-5:
            assert ended == (ours[0] >= 0.45 and ours[1] >= 0)
    assert walled > 20 and arrived > 20


def test_the_car_with_three_actions() -> None:
    """The plant takes the action with the largest score; a step from anywhere is Gymnasium's, at the wall too."""
    gymnasium = pytest.importorskip("gymnasium")
    system, env = plant("mountain_car_actions"), gymnasium.make("MountainCar-v0").unwrapped
    f, random, stopped, arrived, taken = system.function(), np.random.default_rng(0), 0, 0, set[int]()
    for k in range(1500):
        x = random.uniform([-1.2, -0.07], [0.6 if k % 3 else -1.1, 0.07])
        scores = random.normal(size=3) * 10.0 ** random.integers(-3, 4)
        action = int(scores.argmax())
        env.reset(seed=0)
        env.state = tuple(x)
        _, _, ended, *_ = env.step(action)
        faster = np.clip(x[1] + (action - 1) * 0.001 - 0.0025 * np.cos(3 * x[0]), -0.07, 0.07)
        if abs(x[0] + faster + 1.2) < 1e-9 or x[0] + faster > 0.6:
            continue  # rounding decides which of the two it is, or the road ends behind the flag
        np.testing.assert_allclose(f(x, scores), env.state, rtol=1e-12, atol=1e-15)
        taken.add(action)
        stopped, arrived = stopped + (env.state[0] == -1.2), arrived + ended
        assert ended == (env.state[0] >= 0.5 and env.state[1] >= 0)
    assert taken == {0, 1, 2} and stopped > 50 and arrived > 20


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_a_step_is_gymnasiums(name: str) -> None:
    """Anywhere in the domain, to single precision: some of its states are stored so."""
    gymnasium = pytest.importorskip("gymnasium")
    system, env = plant(name), gymnasium.make(ENVIRONMENTS[name]).unwrapped
    f, random = system.function(), np.random.default_rng(0)
    (lo, hi), (u_lo, u_hi) = (np.array(box, dtype=float).T for box in (system.domain, system.input_bounds))
    for _ in range(400):
        x, u = random.uniform(lo, hi), float(random.uniform(u_lo, u_hi)[0])
        ours = f(x, np.array([u]))
        np.testing.assert_allclose(ours, stepped(name, env, x, u), rtol=1e-6, atol=2e-7)
        if name == "mountain_car":
            assert env.min_position + 1e-3 < env.state[0] < env.goal_position - 1e-3


@pytest.mark.parametrize(("name", "fast"), [("pendulum", [0.0, 7.9]), ("mountain_car", [0.3, 0.0699])])
def test_speeds_are_clipped(name: str, fast: list[float]) -> None:
    gymnasium = pytest.importorskip("gymnasium")
    system, env = plant(name), gymnasium.make(ENVIRONMENTS[name]).unwrapped
    limit, f = env.max_speed, system.function()
    for sign in (1.0, -1.0):
        x, u = sign * np.array(fast), sign * float(system.input_bounds[0][1])
        x = x if name == "pendulum" else x * [-1.0, 1.0]  # downhill
        assert f(x, np.array([u]))[1] == sign * limit
        np.testing.assert_allclose(f(x, np.array([u])), stepped(name, env, x, u), rtol=1e-6, atol=2e-7)


@pytest.mark.parametrize("name", ENVIRONMENTS)
def test_it_rests_at_the_origin_and_can_be_controlled(name: str) -> None:
    system = plant(name)
    assert residuals(system) == {s.name: 0 for s in system.states} and system.time == "discrete"
    found = controllability(*linearise(system))
    assert found.exact and found.rank == system.n


@pytest.fixture(scope="module")
def policy() -> Policy:
    return load_policy(POLICY)


def test_the_policy_belongs_to_its_plant(policy: Policy) -> None:
    system = plant("pendulum")
    assert policy.system == system.name and policy.network.centre == "none"
    assert {name: Fraction(value) for name, value in policy.parameters.items()} == dict(system.parameters)
    assert [W.shape for W in policy.network.weights] == [(8, 2), (1, 8)]


@pytest.mark.slow
def test_the_pendulum_goes_to_one_point(policy: Policy, tmp_path: Path) -> None:
    """As it is the policy holds it beside upright: a fixed point, which each step from {V <= c0} comes closer to."""
    system = plant("pendulum")
    rest = find_rest(ClosedLoop(system, policy.network))
    assert rest is not None and rest.stable and -1e-3 < float(rest.x[0]) < -1e-5 and float(rest.x[1]) == 0
    result = certify_roa(system, policy.network, tmp_path, RoaOptions(candidate="optimised", effort=0.02))
    assert result.verdict is Verdict.PROVED and result.claim == "nearby" and result.certificate is not None
    assert result.network.is_moved and result.to_dict()["volume"] > 9
    assert judge_bytes(Path(result.certificate).read_bytes()) is None
    x = np.array([float(v) for v in rest.x])
    f = system.function()
    np.testing.assert_allclose(f(x, ClosedLoop(system, policy.network).policy(x[None])[0]), x, atol=1e-12)


def test_the_pendulum_goes_upright_if_the_policy_is_centred(policy: Policy, tmp_path: Path) -> None:
    network = replace(policy.network, centre="preactivation")
    result = certify_roa(plant("pendulum"), network, tmp_path, RoaOptions(candidate="optimised", effort=0.1))
    assert result.verdict is Verdict.PROVED and result.claim == "asymptotic" and result.to_dict()["volume"] > 9
    assert result.certificate is not None and judge_bytes(Path(result.certificate).read_bytes()) is None
