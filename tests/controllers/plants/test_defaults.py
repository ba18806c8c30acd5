"""Plants of one's own: options from domain and input bounds, from the table of the file, from the command line."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from certify.errors import InputError
from certify.loop.plants import chosen_system, get_system, load_system
from certify.loop.policies import load_policy
from controllers.cli import app
from controllers.plants.choice import chosen_plant
from controllers.plants.defaults import RESOLUTION, default_plant, linearisation, time_step

TEXT = """name = "slider"
states = ["x", "v"]
inputs = ["f"]
[parameters]
m = 2
k = 8
x0 = "1/4"
[dynamics]
x = "v"
v = "(f - k*x**3)/m"
[x_eq]
x = "x0"
[u_eq]
f = "k*x0**3"
[domain]
x = [-0.75, 1.25]
v = [-2, 2]
[input_bounds]
f = [-4, 4]
"""
SMALL = "\n[training]\nsteps = 260\nwarm_up = 100\nn_A = 60\nn_B = 60\nbatch = 16\ncritic = [8, 8]\nactor = [4]\n"
PYTHON = """
from pathlib import Path
from certify.loop.plants import load_system

def make():
    return load_system(Path(__file__).with_name("slider.toml"))
"""
runner = CliRunner()


def _write(folder, text=TEXT, name="slider.toml"):
    path = folder / name
    path.write_text(text)
    return path


def test_weights_are_relative_to_how_far_states_and_inputs_may_go(tmp_path):
    plant = default_plant(load_system(_write(tmp_path)))
    options = plant.preset
    assert options.reward_weights == options.state_weights == (1.0, 0.25)  # w = (1, 2), deviations from x0
    assert options.input_weights == (pytest.approx(1 / 3.875**2, rel=0.01),)  # u_eq = 1/8 of [-4, 4]
    assert plant.initial_states == (0.5, 1.0) and plant.positions == ("x", "v")
    assert options.eta == pytest.approx(0.03)


def test_other_units_are_another_scale_and_the_same_training(tmp_path):
    """Millimetres instead of metres: the same time step, weights by the square of the unit."""
    text = TEXT.replace("k = 8", "k = 0").replace('x = "x0"', "x = 0")
    metres = load_system(_write(tmp_path, text))
    text = text.replace("x = [-0.75, 1.25]\nv = [-2, 2]", "x = [-750, 1250]\nv = [-2000, 2000]")
    millimetres = load_system(_write(tmp_path, text.replace("(f - k*x**3)/m", "1000*f/m"), "mm.toml"))
    one, other = default_plant(metres).preset, default_plant(millimetres).preset
    assert other.dt == one.dt and other.input_weights == one.input_weights
    np.testing.assert_allclose(np.array(one.state_weights) / other.state_weights, 1e6, rtol=0.05)
    assert other.eta == pytest.approx(1000 * one.eta, rel=0.05)


@pytest.mark.parametrize("name", ["pendulum", "cartpole", "quadrotor2d", "quadrotor3d"])
def test_the_time_step_resolves_the_lqr_loop(name):
    import control

    system = get_system(name)
    w = np.array([float(min(-lo, hi)) for lo, hi in system.domain])
    U = np.array([float(hi - lo) / 2 for lo, hi in system.input_bounds])
    A, B = linearisation(system)
    _, _, poles = control.lqr(A, B, np.diag(1 / w**2), np.diag(1 / U**2))
    step, most = time_step(system, w, U), RESOLUTION / np.abs(poles).max()
    assert most / 2.5 <= step <= most
    assert f"{step:.0e}"[0] in "125"


def test_a_plant_that_no_input_reaches_is_refused(tmp_path):
    text = TEXT.replace('"(f - k*x**3)/m"', '"v + k*x0**3 - k*x**3"').replace('x = "x0"', "x = 0")
    text = text.replace("k = 8", "k = 0")
    with pytest.raises(InputError, match="the linearisation of slider must be stabilisable"):
        chosen_plant(str(_write(tmp_path, text)))
    with pytest.raises(InputError, match="u_eq of slider must lie inside the input bounds; it does not for f"):
        chosen_plant(str(_write(tmp_path, TEXT.replace("f = [-4, 4]", "f = [1, 4]"))))


def test_the_table_of_the_file_chooses_and_the_command_line_overrides(tmp_path):
    table = '\n[training]\nsteps = 300\nstart = 0.25\nactor = [8, 8]\ncentre = "output"\ninitial_states = [0.1, 0.2]\n'
    path = _write(tmp_path, TEXT + table + 'positions = ["x"]\nlearning_rate = 1\n')
    _, plant = chosen_plant(str(path))
    assert plant.preset == replace(
        default_plant(load_system(path)).preset, steps=300, start=0.25, actor=(8, 8), centre="output", learning_rate=1.0
    )
    assert plant.initial_states == (0.1, 0.2) and plant.positions == ("x",)
    _, plant = chosen_plant(str(_write(tmp_path, TEXT + "\n[training]\nstart = 0.25\n")))
    assert plant.initial_states == (0.25, 0.5)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("stpes = 3", r"line 22: training\.stpes: 'stpes' is no option of a training; did you mean 'steps'\?"),
        ("steps = 0.5", r"line 22: training\.steps: must be an integer; found"),
        ("steps = true", r"line 22: training\.steps: must be an integer; found True"),
        ('dt = "fast"', r"line 22: training\.dt: must be a number; found 'fast'"),
        ("actor = 16", r"line 22: training\.actor: must be a list, as in \[1, 2\]; found 16"),
        ("actor = [1.5]", r"line 22: training\.actor: must be an integer"),
        ("gamma = 2", r"line 21: training: `gamma` must be in \[0, 1\); found 2\.0"),
        ("reward_weights = [1]", r"`reward_weights` must be 2 numbers for slider"),
        ("initial_states = [1]", r"`initial_states` of slider must have 2 half-widths"),
        ("initial_states = [-1, 1]", r"line 21: training: `initial_states` must be positive"),
        ('positions = ["y"]', r"`positions` of slider must be among its states"),
        ("positions = [1]", r"line 22: training\.positions: must be text; found 1"),
    ],
)
def test_a_bad_table_is_refused_with_its_line(tmp_path, line, message):
    assert len(TEXT.splitlines()) == 19  # so that the table begins in line 21
    with pytest.raises(InputError, match=message):
        chosen_plant(str(_write(tmp_path, f"{TEXT}\n[training]\n{line}\n")))


def test_a_plant_of_ones_own_is_trained_evaluated_and_certified(tmp_path, monkeypatch):
    path, out = _write(tmp_path, TEXT + SMALL), tmp_path / "slider.pt"
    arguments = ["train", str(path), "--out", str(out), "--seed", "3", "--batch", "32", "--evaluate-every", "130"]
    rows = tmp_path / "rows.csv"
    trained = runner.invoke(app, [*arguments, "--evaluations", str(rows), "--json"])
    assert trained.exit_code == 0, trained.stderr
    policy = load_policy(out)
    assert policy.system == "slider" and dict(policy.parameters) == {"m": "2", "k": "8", "x0": "0.25"}
    assert policy.training["seed"] == 3 and policy.training["batch"] == 32 and policy.training["actor"] == [4]
    assert json.loads(trained.stdout)["layers"] == [2, 4, 1]
    settled = [row.split(",")[4] for row in rows.read_text().splitlines()[1:]]
    assert len(settled) == 2 and "nan" not in settled  # simulated from the box of its own
    again = tmp_path / "again.pt"
    repeated = runner.invoke(app, ["train", str(path), "--out", str(again), "--seed", "3", "--batch", "32"])
    assert repeated.exit_code == 0 and again.read_bytes() == out.read_bytes()

    alone = runner.invoke(app, ["evaluate", str(out), "--states", "3", "--json"])
    assert alone.exit_code == 2 and "--system" in json.loads(alone.stdout)["error"]
    judged = runner.invoke(
        app, ["evaluate", str(out), "--system", str(path), "--states", "3", "--duration", "1", "--json"]
    )
    assert judged.exit_code == 0, judged.stderr
    assert json.loads(judged.stdout)["held"]["states"] == 3

    from certify.cli.main import _run

    monkeypatch.chdir(tmp_path)
    common = ["--out", str(tmp_path / "o"), "--effort", "0.1"]
    assert _run(["roa", "--policy", str(out), "--system", str(path), *common], False) in (0, 1, 3)
    assert _run(["roa", "--policy", str(out), *common], False) == 2  # though slider.toml lies here


def test_a_python_plant_is_trained_by_the_defaults(tmp_path):
    _write(tmp_path)
    name = f"{_write(tmp_path, PYTHON, 'mine.py')}:make"
    system, plant = chosen_plant(name)
    assert system == chosen_system(name) and plant == default_plant(system)
    out = tmp_path / "p.pt"
    short = ["--steps", "260", "--warm-up", "100", "--n-A", "60", "--n-B", "60", "--batch", "16", "--actor", "4"]
    trained = runner.invoke(app, ["train", name, "--out", str(out), *short])
    assert trained.exit_code == 0, trained.stderr
    assert load_policy(out).system == "slider"


def test_the_name_of_a_plant_that_ships_is_taken(tmp_path):
    path = _write(tmp_path, TEXT.replace('"slider"', '"pendulum"'))
    with pytest.raises(InputError, match=re.escape("must not bear the name of one that ships, 'pendulum'")):
        chosen_plant(str(path))


@pytest.mark.parametrize("name", ["spaceship", "mine.py", "nothing.toml", "nothing.py:plant"])
def test_an_unknown_plant_is_one_sentence(tmp_path, name):
    result = runner.invoke(app, ["train", name, "--out", str(tmp_path / "p.pt")])
    assert result.exit_code == 2 and "Traceback" not in result.stderr
    assert name.partition(":")[0] in result.stderr
