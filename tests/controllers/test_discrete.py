"""Plants in discrete time: a step is one application of the map, for training, judging and flattening alike."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
import torch
from typer.testing import CliRunner

from certify.analysis.api import certify_roa
from certify.certificates.verdict import Verdict
from certify.errors import InputError
from certify.loop.plants import get_system, load_system
from certify.loop.policies import Policy, PolicyNetwork, save_policy
from controllers.cli import app
from controllers.comparison.methods import OURS
from controllers.comparison.options import CompareOptions
from controllers.comparison.table import Response, table
from controllers.evaluation.evaluation import evaluate
from controllers.evaluation.settling import EvaluationOptions
from controllers.evaluation.theory_constants import theory
from controllers.figures import draw_over_time, draw_positions, draw_space, draw_states
from controllers.flattening.flattening import flatten
from controllers.flattening.options import FlattenOptions
from controllers.history.gain_distance import distances
from controllers.history.policies import RunPolicy
from controllers.identification.least_squares import fit_A, fit_B
from controllers.identification.linearisation import discrete_linearisation
from controllers.identification.riccati import riccati_gain
from controllers.options import TrainingOptions, get_plant
from controllers.plants.choice import chosen_plant
from controllers.plants.defaults import default_plant
from controllers.simulation.closed_loop import continuous_loop
from controllers.simulation.stepping import Stepper
from controllers.simulation.trajectories import simulate
from controllers.training.environment import PlantEnvironment
from controllers.training.trainer import Trainer, train
from tests.support.marks import slow_after

HENON = Path(__file__).parents[2] / "examples" / "plants" / "henon.toml"
A = np.array([[-2 * 1.4 * 0.63, 1.0], [0.3, 0.0]])
B = np.array([[1.0], [0.0]])
SHORT = {
    "steps": 400,
    "start": 0.25,
    "warm_up": 100,
    "n_A": 60,
    "n_B": 60,
    "batch": 16,
    "actor": (4,),
    "critic": (8, 8),
    "learning_rate": 0.01,
    "gain_weight": 20.0,
}
# Numbers of few binary digits, so that some steps of the map are exact in floats.
DYADIC = """name = "dyadic"
time = "discrete"
states = ["x", "y"]
inputs = ["u"]
[dynamics]
x = "x/2 + y - x**2/4 + u"
y = "x/4 + u/2"
[u_eq]
u = 0
[domain]
x = [-2, 2]
y = [-2, 2]
[input_bounds]
u = [-1, 1]
"""
runner = CliRunner()


@pytest.fixture(scope="module")
def henon():
    return chosen_plant(str(HENON))


def _linear(gain, name="henon", **record):
    """u = u_eq - K x with hardly a bend, and a record of what evaluations need."""
    network = PolicyNetwork.of_layers(
        (-np.array([gain]) / 100,), (np.zeros(1),), np.array([100.0]), np.zeros(1), "tanh", "output"
    )
    return Policy(network, name, training={"state_weights": [1.0, 1.0], "input_weights": [1.0]} | record)


def _dyadic(folder):
    (folder / "dyadic.toml").write_text(DYADIC)
    return load_system(folder / "dyadic.toml")


def test_a_simulated_trajectory_is_the_iterated_map_exactly(tmp_path):
    system = _dyadic(tmp_path)
    training = replace(default_plant(system).preset, state_weights=(1.0, 2.0), input_weights=(4.0,))
    x0 = np.array([[0.5, -0.25], [-1.0, 0.75]])
    found, cost = simulate(system, training, lambda x: -x[:, :1] / 2, x0, 3)
    assert found.shape == (4, 2, 2)  # a duration of 3 is three steps
    environment = PlantEnvironment(system, training)
    for k, start in enumerate(x0):
        x, y = map(Fraction, start)
        total = Fraction(0)
        environment.reset(seed=0)
        environment.restore(replace(environment.snapshot(), x=tuple(start)))
        for step in range(4):
            assert [Fraction(v) for v in found[step, k]] == [x, y]
            assert Fraction(cost[step, k]) == total
            u = -x / 2
            total += x**2 + 2 * y**2 + 4 * u**2
            x, y = x / 2 + y - x**2 / 4 + u, x / 4 + u / 2
            if step < 3:
                after, *_ = environment.step(np.array([float(u)]))
                assert [Fraction(v) for v in after] == [x, y]


def test_a_step_of_henon_is_henons_equations(henon):
    system, _ = henon
    generator = np.random.default_rng(0)
    x, u = generator.uniform(-0.5, 0.5, (50, 2)), generator.uniform(-1, 1, (50, 1))
    after = Stepper(system, 1.0, "numpy")(x, u)
    x_now, y_now = 0.63 + x[:, 0], 0.189 + x[:, 1]
    wanted = np.stack([1 - 1.4 * x_now**2 + y_now + u[:, 0] - 0.63, 0.3 * x_now - 0.189], -1)
    np.testing.assert_allclose(after, wanted, atol=1e-14)
    torches = Stepper(system, 1.0, "torch")(torch.from_numpy(x), torch.from_numpy(u))
    np.testing.assert_allclose(torches.numpy(), after, atol=1e-14)


def test_the_linearisation_and_what_is_fitted_are_those_of_the_map(henon):
    system, _ = henon
    true_A, true_B = discrete_linearisation(system, 1.0)
    np.testing.assert_allclose(true_A, A, atol=1e-14)
    np.testing.assert_allclose(true_B, B, atol=1e-14)
    generator, step = np.random.default_rng(0), Stepper(system, 1.0, "numpy")
    x, v = generator.uniform(-0.01, 0.01, (100, 2)), generator.uniform(-0.1, 0.1, (100, 1))
    u_eq = float(system.exact_u_eq()[0])
    found = fit_A(x, step(x, np.full((100, 1), u_eq)))
    np.testing.assert_allclose(found, A, atol=5e-3)
    np.testing.assert_allclose(fit_B(x, v, step(x, u_eq + v), found), B, atol=1e-3)


@pytest.fixture(scope="module")
def trained(henon):
    system, plant = henon
    trainer = Trainer(system, replace(plant.preset, **SHORT), plant=plant)
    return trainer, train(trainer, evaluate_every=400)


def test_a_run_learns_the_map_and_the_gain_of_its_riccati_equation(trained):
    trainer, policy = trained
    options = trainer.options
    assert options.dt == 1 and policy.training["dt"] == 1
    found_A, found_B, K = (np.array(policy.training[name]) for name in "ABK")
    np.testing.assert_allclose(found_A, A, atol=0.01)
    np.testing.assert_allclose(found_B, B, atol=0.01)
    Q, R = np.diag(options.state_weights), np.diag(options.input_weights)
    S = scipy.linalg.solve_discrete_lyapunov((found_A - found_B @ K).T, Q + K.T @ R @ K)  # cost of the gain
    closing = found_A.T @ S @ found_A - S + Q - found_A.T @ S @ found_B @ K
    assert np.abs(closing).max() < 1e-10 * np.abs(S).max()
    np.testing.assert_allclose(K, np.linalg.solve(R + found_B.T @ S @ found_B, found_B.T @ S @ found_A), rtol=1e-8)
    assert trainer.monitored[-1].settled == 1.0 and trainer.monitored[-1].K_error < 0.01


def test_what_is_trained_is_stable_settles_and_is_proved(trained, henon, tmp_path):
    _, policy = trained
    found = evaluate(policy, EvaluationOptions(states=100), henon)
    J = policy.network.jacobian_at_origin(henon[0].exact_u_eq())
    np.testing.assert_allclose(sorted(found.eigenvalues, key=abs), sorted(np.linalg.eigvals(A + B @ J), key=abs))
    assert max(map(abs, found.eigenvalues)) < 0.5
    assert (found.held.settled, found.held.states) == (100, 100)
    assert max(found.A_relative_error, found.B_relative_error, found.K_relative_error) < 0.01
    save_policy(tmp_path / "p.pt", policy)
    result = certify_roa(str(HENON), tmp_path / "p.pt", tmp_path / "o", candidate="lyapunov", effort=0.6)
    assert result.verdict is Verdict.PROVED


@pytest.mark.parametrize("gain", [[0.0, 0.0], [0.64, 2.926]])
def test_a_policy_that_does_not_hold_the_map_is_not_called_settled(henon, tmp_path, gain):
    """The second gain is that of the same equations, were they a rate of change."""
    policy = _linear(gain, dt=0.05)
    assert np.linalg.eigvals(A - B @ [gain]).real.max() < 1  # the largest is negative
    found = evaluate(policy, EvaluationOptions(states=50), henon)
    assert max(map(abs, found.eigenvalues)) > 1.9
    assert found.held.settled == 0 and found.continuous is None


def test_a_stable_policy_settles_and_its_times_are_steps(henon, tmp_path):
    K = riccati_gain(A, B, np.eye(2), np.eye(1))
    policy = _linear(K[0].tolist())  # without `dt`: the map has no other step
    path = tmp_path / "p.pt"
    save_policy(path, policy)
    command = ["evaluate", str(path), "--system", str(HENON), "--states", "20"]
    shown = runner.invoke(app, command)
    assert shown.exit_code == 0, shown.stderr
    assert "20 of 20 settled (3000 steps)" in shown.stdout and " s)" not in shown.stdout
    assert "below 1: stable" in shown.stdout and "continuous" not in shown.stdout
    data = json.loads(runner.invoke(app, [*command, "--json"]).stdout)
    assert data["time"] == "discrete" and data["continuous"] is None and data["held"]["step"] == 1
    for wrong in ("nan", "inf"):
        refused = runner.invoke(app, [*command, "--duration", wrong])
        assert refused.exit_code == 2 and f"--duration must be positive and finite; found {wrong}" in refused.stderr


def test_settling_is_counted_in_steps(henon):
    """A gain that takes |x| from step to step to about 0.9 of it: by how many steps it is small is known."""
    policy = _linear(scipy.signal.place_poles(A, B, [0.9, 0.5]).gain_matrix[0].tolist())
    near = henon[0], replace(henon[1], initial_states=(0.01, 0.01))
    long, short = (
        evaluate(policy, EvaluationOptions(states=20, duration_steps=n, window_steps=5), near).held for n in (300, 60)
    )
    assert long.settled == 20 and short.settled == 0  # 0.9^295 = 3e-14, 0.9^55 = 3e-3
    assert 1e-6 < short.largest < 1
    with pytest.raises(InputError, match="`duration_steps` must be at least the window, 5 steps"):
        EvaluationOptions(duration_steps=4, window_steps=5)


@pytest.mark.parametrize("where", ["table", "option"])
def test_another_time_step_than_the_maps_own_is_refused(tmp_path, where):
    text = HENON.read_text()
    path = tmp_path / "henon.toml"
    path.write_text(text + ("dt = 0.05\n" if where == "table" else ""))
    more = ["--dt", "0.05"] if where == "option" else []
    result = runner.invoke(app, ["train", str(path), "--out", str(tmp_path / "p.pt"), *more])
    assert result.exit_code == 2
    said = "--dt" if where == "option" else "`dt`"
    assert f"{said} must be 1 for henon" in result.stderr and f"Leave {said} out" in result.stderr
    path.write_text(text + "dt = 1\n")
    assert chosen_plant(str(path))[1] == chosen_plant(str(HENON))[1]
    with pytest.raises(InputError, match="`dt` must be 1"):
        Stepper(load_system(HENON), 0.02)


def test_a_map_that_no_input_holds_is_refused(tmp_path):
    path = tmp_path / "d.toml"
    path.write_text(DYADIC.replace('y = "x/4 + u/2"', 'y = "2*y"'))
    with pytest.raises(InputError, match="the linearisation of dyadic must be stabilisable"):
        chosen_plant(str(path))
    path.write_text(DYADIC.replace('y = "x/4 + u/2"', 'y = "-y/2"'))  # stable by itself, and unstable were it a rate
    assert chosen_plant(str(path))[1].preset.dt == 1


def _bent(K, seed=0):
    """A policy whose hidden units bend, fitted to -K x near the origin."""
    generator = np.random.default_rng(seed)
    W, b = generator.normal(size=(12, 2)) * 1.5, 0.5 * generator.normal(size=12)
    x = generator.uniform(-0.5, 0.5, (400, 2))
    h = np.tanh(x @ W.T + b) - np.tanh(b)
    last = np.linalg.lstsq(h, -x @ np.array(K).T, rcond=None)[0].T
    weights, biases = [W, last], [b, -last @ np.tanh(b)]
    return PolicyNetwork.of_layers(
        tuple(w.astype(np.float32).astype(float) for w in weights),
        tuple(v.astype(np.float32).astype(float) for v in biases),
        np.ones(1), np.zeros(1), "tanh", "output",
    )  # fmt: skip


@pytest.mark.parametrize("gain", slow_after(1, ["kept", "lqr"]))
def test_flattening_judges_by_the_map(henon, gain):
    system, plant = henon[0], replace(henon[1], initial_states=(0.2, 0.2))
    Q, R = (np.diag(v) for v in (plant.preset.state_weights, plant.preset.input_weights))
    network = _bent(riccati_gain(A, B, Q, R))
    options = FlattenOptions(steps=40, batch=64, states=20, gain=gain)
    result = flatten(Policy(network, "henon", training={"dt": 0.05}), options, (system, plant))
    assert result.before.settled == result.after.settled == 20
    assert result.after.departure < 0.5 * result.before.departure
    assert result.after.cost <= 1.05 * result.before.cost
    x = np.random.default_rng(0).uniform(-1, 1, (20, 2)) * plant.initial_states
    total, u_eq = np.zeros(20), system.exact_u_eq()
    for _ in range(1000):
        u = network(x, u_eq)
        total += (x**2 @ Q).sum(1) + ((u - float(u_eq[0])) ** 2 @ R).sum(1)
        now = x + np.array([0.63, 0.189])
        x = np.stack([1 - 1.4 * now[:, 0] ** 2 + now[:, 1] + u[:, 0] - 0.63, 0.3 * now[:, 0] - 0.189], -1)
    assert result.before.cost == pytest.approx(np.median(total), rel=1e-9)
    if gain == "lqr":
        K = np.array(result.policy.training["flattened"]["K"])
        np.testing.assert_allclose(K, riccati_gain(A, B, Q, R), rtol=1e-9)


def test_a_history_is_measured_against_the_maps_gain(trained, henon):
    _, policy = trained
    (found,) = distances([RunPolicy(400, policy)], henon[0])
    assert 0 < max(found.A, found.B, found.K, found.mean) < 0.01
    bare = {name: value for name, value in policy.training.items() if name != "dt"}
    assert distances([RunPolicy(400, replace(policy, training=bare))], henon[0]) == [found]


def test_tables_and_figures_of_a_map_count_steps(monkeypatch):
    """No plant in discrete time ships; figures and tables ask for the plant by its name and look at its time."""
    system = replace(get_system("cartpole"), time="discrete")
    x = np.zeros((101, 3, 4))
    x[:51] = 0.5  # large until step 50, and from then on 0
    x[60:, 0] = 1e-3
    response = Response(OURS, 0, 10, x, np.cumsum(np.linalg.norm(x, axis=2), axis=0))
    rows = table(system, 1.0, [response], CompareOptions())  # the window is the last 50 steps
    assert rows[0].settled == 0 and rows[0].floor == 1.0
    rows = table(system, 1.0, [response], CompareOptions(window_steps=49))
    assert rows[0].settled == 2 and rows[0].floor == 0.0
    texts = _texts(monkeypatch)
    for draw in (draw_positions, draw_states, draw_space):
        draw(system, 1.0, [response])
    for what in ("cost", "norm"):
        draw_over_time(what, system, 1.0, [response], rows)
    assert "steps" in texts and any("last steps" in text for text in texts)
    assert not any(" s\n" in f"{text}\n" or "(s)" in text or "second" in text or "∫" in text for text in texts)


def _texts(monkeypatch):
    """All that figures say from now on."""
    from matplotlib.figure import Figure
    from matplotlib.text import Text
    from PIL import Image

    texts = list[str]()

    def keep(figure, file, **_):
        Image.new("RGB", (1, 1)).save(file, format="png")
        texts.extend(text.get_text() for text in figure.findobj(Text))

    monkeypatch.setattr(Figure, "savefig", keep)
    return texts


def test_what_is_about_continuous_time_alone_is_refused(henon):
    system, _ = henon
    policy = _linear([0.0, 0.0], dt=1.0, gamma=0.99, reward_weights=[1.0, 1.0])
    with pytest.raises(InputError, match=r"henon must be in continuous time.*Use `controllers evaluate`"):
        theory(policy, henon)
    with pytest.raises(InputError, match="must be in continuous time to be followed between two steps"):
        continuous_loop(system, 0.1, lambda x: x[:, :1], np.ones(2), np.ones(1))


def test_a_held_input_is_trained_with_a_period_that_the_plant_has():
    system, plant = get_system("pendulum"), get_plant("pendulum")
    free = default_plant(system).preset.dt
    assert default_plant(system.with_sample((Fraction(1, 200), Fraction(1, 200)))).preset.dt == 0.005
    assert default_plant(system.with_sample((Fraction(0), Fraction(10)))).preset.dt == free
    assert default_plant(system.with_sample((Fraction(1, 2), Fraction(1)))).preset.dt == 0.5
    held = system.with_sample((Fraction(1, 20), Fraction(1, 10)))
    with pytest.raises(InputError, match=r"`dt` must be between 0\.05 and 0\.1, over which pendulum holds its inputs"):
        Trainer(held, plant.preset)
    assert isinstance(Trainer(held, replace(plant.preset, dt=0.05)).options, TrainingOptions)
    policy = _linear([9.0, 1.8], "pendulum", dt=0.02)
    brief = EvaluationOptions(states=2, duration=1)
    for judged, step in ((held, 0.05), (system, 0.02)):
        assert evaluate(policy, brief, (judged, default_plant(judged))).held.step == step
