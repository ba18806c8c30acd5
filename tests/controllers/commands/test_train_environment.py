"""`controllers train --env`: an environment that somebody names, in place of equations."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from certify import LinearStructure
from certify import identify as certify_identify
from certify.errors import InputError
from certify.loop.policies import load_policy
from controllers.cli import app
from controllers.identification.riccati import riccati_gain
from controllers.plants.black_box import Told, black_box
from controllers.training.black_box import BlackBoxEnvironment

SHORT = ["--steps", "420", "--warm-up", "100", "--n-A", "60", "--n-B", "60", "--batch", "16", "--critic", "8,8"]
WORLD = '''
import gymnasium, numpy as np

class Shown(gymnasium.Env):
    """x+ = A x + B u and a square, around a place where it rests."""
    observation_space = gymnasium.spaces.Box(-2.0, 2.0, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-3.0, 3.0, (1,), np.float64)
    dt, at, u_at = 0.1, np.zeros(2), 0.0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = self.at + self.np_random.uniform(-0.05, 0.05, 2)
        return self.state.copy(), {}

    def step(self, action):
        (p, v), u = self.state - self.at, float(action[0]) - self.u_at
        self.state = self.at + np.array([p + 0.1 * v, v + 0.2 * p + 0.05 * p * p + 0.1 * u])
        return self.state.copy(), 7.0, False, False, {}

class Hidden(Shown):
    """The same, whose state cannot be set."""
    def reset(self, **given):
        shown, info = super().reset(**given)
        self._hidden, self.state = self.state, None
        return shown, info

    def step(self, action):
        self.state = self._hidden
        shown, *rest = super().step(action)
        self._hidden, self.state = self.state, None
        return (shown, *rest)

class Deaf(Shown):
    """Its attribute is a copy of the state: setting it has no effect."""
    def reset(self, **given):
        shown, info = super().reset(**given)
        self._own = self.state.copy()
        return shown, info

    def step(self, action):
        self.state = self._own
        shown, *rest = super().step(action)
        self._own = self.state.copy()
        return (shown, *rest)

class Elsewhere(Shown):
    at, u_at = np.array([0.5, 0.0]), 1.0

class Timeless(Shown):
    dt = None

class Wide(Shown):
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

class Keys(Shown):
    action_space = gymnasium.spaces.Discrete(2)

class Ending(Shown):
    """It ends by itself at once."""
    def step(self, action):
        shown, reward, _, _, info = super().step(action)
        return shown, reward, True, False, info

class Turning(gymnasium.Env):
    """An angle that turns by the action."""
    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float64)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)
    dt = 0.1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.state = np.array([0.3])
        return self._show(), {}

    def step(self, action):
        self.state = self.state + action
        return self._show(), 0.0, False, False, {}

    def _show(self):
        return np.array([np.cos(self.state[0]), np.sin(self.state[0])])
'''
A, B = np.array([[1, 0.1], [0.2, 1]]), np.array([[0], [0.1]])

runner = CliRunner()


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("world") / "world.py"
    path.write_text(WORLD)
    return path


def _train(*arguments):
    return runner.invoke(app, ["train", *map(str, arguments)])


def _told(world: Path, name: str, **more) -> Told:
    return Told(**({"name": f"{world}:{name}", "domain": {}, "rest": {}, "rest_input": {}} | more))


def _rows(path: Path) -> tuple[list[str], np.ndarray]:
    names, *rows = csv.reader(path.read_text().splitlines())
    return names, np.array(rows, dtype=float)


def test_a_policy_and_guaranteed_ranges_without_equations(world, tmp_path):
    """The ranges that its own data leave hold the true A and B, and its gain is that of the plant it learned."""
    out, data = tmp_path / "p.pt", tmp_path / "data.csv"
    arguments = ["--env", f"{world}:Shown", "--observed", "p,v", *SHORT, "--seed", 3, "--json"]
    done = _train(*arguments, "--out", out, "--write-data", data)
    assert done.exit_code == 0, done.stderr
    found, policy = json.loads(done.stdout), load_policy(out)
    assert found["next"].startswith(f"certify identify {data} --structure linear --second 'p=BOUND' --second 'v=")
    assert policy.system == "world_py_Shown" and policy.training["dt"] == 0.1
    learned = policy.training
    assert np.allclose(learned["A"], A, atol=5e-3) and np.allclose(learned["B"], B, atol=5e-3)
    Q, R = np.diag(learned["state_weights"]), np.diag(learned["input_weights"])
    assert np.allclose(learned["K"], riccati_gain(np.array(learned["A"]), np.array(learned["B"]), Q, R))

    names, rows = _rows(data)
    x, u, after = rows[:, :2], rows[:, 2:3], rows[:, 3:]
    assert names == ["p", "v", "u", "p_next", "v_next"] and len(rows) == 120
    assert np.allclose(after, x @ A.T + u @ B.T + np.outer(x[:, 0] ** 2, [0, 0.05]), atol=1e-15)
    assert (np.linalg.norm(x, axis=1) <= learned["eta"]).all() and (u[:60] == 0).all() and (np.abs(u) <= 3).all()

    linear = LinearStructure(second={"p": "1e-9", "v": "0.05*p**2"})
    left = certify_identify(data, linear, noise="1e-9").ranges
    for name, true in {"A11": 1, "A12": 0.1, "A21": 0.2, "A22": 1, "B21": 0.1}.items():
        lo, hi = map(float, left[name])
        assert lo <= true <= hi and hi - lo < 0.01, name

    again = tmp_path / "again.pt"
    assert _train(*arguments, "--out", again).exit_code == 0
    assert load_policy(again).network.sha256() == policy.network.sha256()


@pytest.mark.slow
def test_a_plant_that_rests_elsewhere_is_learned_in_deviations(world, tmp_path):
    """The data have the plant's own values, and at rest the policy gives its input there."""
    out, data = tmp_path / "p.pt", tmp_path / "data.csv"
    at = ["--rest", "x1=0.5", "--rest-input", "u=1"]
    done = _train("--env", f"{world}:Elsewhere", *at, *SHORT, "--out", out, "--write-data", data)
    assert done.exit_code == 0, done.stderr
    policy, (names, rows) = load_policy(out), _rows(data)
    assert names[:3] == ["x1", "x2", "u"] and np.allclose(policy.training["A"], A, atol=5e-3)
    assert np.abs(rows[:, 0] - 0.5).max() <= policy.training["eta"] and (rows[:60, 2] == 1).all()
    x, v, after = rows[:, :2] - [0.5, 0], rows[:, 2:3] - 1, rows[:, 3:] - [0.5, 0]
    assert np.allclose(after, x @ A.T + v @ B.T + np.outer(x[:, 0] ** 2, [0, 0.05]), atol=1e-15)


@pytest.mark.parametrize("name, settable", [("Shown", True), ("Hidden", False), ("Deaf", False)])
def test_the_state_is_set_only_where_that_has_its_effect(world, name, settable):
    box = black_box(_told(world, name))
    assert box.settable is settable
    assert box.plant.preset.identification_starts == ("ball" if settable else "domain")
    environment = BlackBoxEnvironment(box, box.plant.preset)
    starts = [environment.reset(seed=0)[0], *(environment.reset()[0] for _ in range(20))]
    assert bool(np.abs(starts).max() > 0.05) is settable  # else where its reset puts them
    x_next = environment.step(np.array([0.5]))[0]
    assert np.allclose(x_next, A @ starts[-1] + B @ [0.5] + [0, 0.05 * starts[-1][0] ** 2], atol=1e-15)


def test_a_state_that_cannot_be_set_is_learned_from_resets(world, tmp_path):
    out = tmp_path / "p.pt"
    given = ["--env", f"{world}:Hidden", "--eta", "0.1", "--horizon", "10", *SHORT, "--out", out]
    refused = _train(*given, "--identification-starts", "ball")
    assert refused.exit_code == 2 and "--identification-starts must be domain: this environment's" in refused.stderr
    done = _train(*given)
    assert done.exit_code == 0, done.stderr
    assert np.allclose(load_policy(out).training["A"], A, atol=5e-3)


def test_an_angle_is_followed_over_full_turns(world):
    box = black_box(_told(world, "Turning", observed="cos(q),sin(q)", domain={"q": Fraction(20)}))
    environment = BlackBoxEnvironment(box, replace(box.plant.preset, start=0.1))
    x, _ = environment.reset(seed=0)
    for k in range(1, 10):
        assert np.allclose(environment.step(np.ones(1))[0], x + k)


def test_the_reward_is_that_of_any_plant_and_an_end_by_itself_is_a_failure(world):
    rewards = {}
    for name in ("Shown", "Ending"):
        box = black_box(_told(world, name))
        environment = BlackBoxEnvironment(box, box.plant.preset)
        environment.reset(seed=0, options={"radius": 0.01})
        x, rewards[name], terminated, _, _ = environment.step(np.zeros(1))
        assert terminated is (name == "Ending")
    options = box.plant.preset
    assert rewards["Shown"] == pytest.approx(1 - float(np.dot(options.reward_weights, x * x)))
    assert rewards["Ending"] == pytest.approx(rewards["Shown"] - options.penalty)


@pytest.mark.parametrize(
    "name, more, message",
    [
        ("Shown", ["--checkpoint-dir", "runs"], "--checkpoint-dir must be left out with --env"),
        ("Shown", ["--keep", "runs"], "--keep must be left out with --env"),
        ("Shown", ["--observed", "p,v,w"], "must be the 3 numbers"),
        ("Shown", ["--observed", "cos(p),v"], "as cos(NAME),sin(NAME)"),
        ("Shown", ["--inputs", "a,b"], "--inputs must name the 1 actions"),
        ("Shown", ["--rest", "y=1"], "--rest names 'y'"),
        ("Shown", ["--rest", "x1=3"], "--rest must lie inside what"),
        ("Shown", ["--rest", "x1=0.5"], "--rest and --rest-input must say where the environment rests"),
        ("Elsewhere", ["--rest", "x1=0.5"], "a step from there moves x2 by -0.1"),
        ("Timeless", [], "--dt must be given"),
        ("Wide", [], "--domain must have a half-width of x1"),
        ("Keys", [], "must be a row of numbers with finite bounds"),
        ("Missing", [], "has no 'Missing'"),
        ("WORLD", [], "has no 'WORLD'"),
    ],
)
def test_what_an_environment_does_not_say_has_to_be_said(world, tmp_path, name, more, message):
    done = _train("--env", f"{world}:{name}", *more, "--out", tmp_path / "p.pt", *SHORT)
    assert done.exit_code == 2 and message in done.stderr and "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "arguments, message",
    [
        ([], "one of the two"),
        (["pendulum", "--env", "Pendulum-v1"], "one of the two"),
        (["pendulum", "--observed", "theta"], "--observed is for an environment"),
        (["--env", "Nowhere-v0"], "gymnasium has no environment 'Nowhere-v0'"),
    ],
)
def test_a_plant_or_an_environment(tmp_path, arguments, message):
    done = _train(*arguments, "--out", tmp_path / "p.pt", *SHORT)
    assert done.exit_code == 2 and message in done.stderr


def test_gymnasium_s_own_pendulum(tmp_path):
    """Its A and B are known: semi-implicit Euler of 15 sin(theta) + 3 u over 0.05 s."""
    told = Told(
        name="Pendulum-v1",
        observed="cos(theta),sin(theta),omega",
        domain={"omega": Fraction(3)},
        rest={},
        rest_input={},
    )
    box = black_box(told)
    assert box.settable and box.plant.preset.dt == 0.05 and box.system.input_bounds == ((-2, 2),)
    environment = BlackBoxEnvironment(box, box.plant.preset)
    x, _ = environment.reset(seed=1, options={"radius": 0.1})
    found = environment.step(np.array([0.5]))[0]
    omega = x[1] + 0.05 * (15 * np.sin(x[0]) + 3 * 0.5)
    assert np.allclose(found, [x[0] + 0.05 * omega, omega], atol=1e-6)
    with pytest.raises(InputError, match="there are 3"):
        black_box(replace(told, observed="theta,omega"))


REPORT = ["--noise", "1e-9", "--second", "v=0.05*p**2"]


@pytest.mark.slow
def test_a_report_has_guaranteed_ranges_of_what_was_learned(world, tmp_path):
    """They hold the true A and B, and the gain that the true plant would have."""
    out, report = tmp_path / "p.pt", tmp_path / "p.json"
    arguments = ["--env", f"{world}:Shown", "--observed", "p,v", *SHORT, "--out", out]
    done = _train(*arguments, "--identify-report", report, *REPORT)
    assert done.exit_code == 0, done.stderr
    found, learned = json.loads(report.read_text()), load_policy(out).training
    true = riccati_gain(A, B, np.diag(learned["state_weights"]), np.diag(learned["input_weights"]))
    for name, matrix in {"A": A, "B": B, "K": true}.items():
        lo, hi = (np.array(found[name]["range"][end]) for end in ("lo", "hi"))
        assert (lo <= matrix).all() and (matrix <= hi).all() and np.abs(hi - lo).max() < 1e-3, name
        assert found[name]["learned"] == learned[name]
    assert found["second"] == {"v": "0.05*p**2"} and found["transitions"] == 120
    assert f"identified   {report}" in done.stdout and "K11" in done.stdout and "off by at most" in done.stdout
    too_little = _train(*arguments, "--identify-report", report, "--noise", "1e-9", "--json")
    assert (
        too_little.exit_code == 0
        and "of v the bounds must be at least" in json.loads(too_little.stdout)["identified"]["refuted"]
    )


@pytest.mark.parametrize(
    "more, message",
    [
        (["--second", "v=p**2"], "--second is for the report of --identify-report"),
        (["--identify-report", "r.json"], "--identify-report needs --noise"),
        (["--identify-report", "r.json", "--noise", "1e-9", "--second", "w=p**2"], "--second names 'w'"),
        (["--identify-report", "r.json", "--noise", "0"], "--noise must be a positive bound"),
    ],
)
def test_a_report_needs_what_it_assumes(world, tmp_path, monkeypatch, more, message):
    monkeypatch.chdir(tmp_path)
    done = _train("--env", f"{world}:Shown", "--observed", "p,v", *SHORT, *more, "--out", tmp_path / "p.pt")
    assert done.exit_code == 2 and message in done.stderr and "Traceback" not in done.stderr
    assert not list(tmp_path.iterdir())
