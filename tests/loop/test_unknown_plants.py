"""Tables of a plant's file for what is not known: ranges of parameters, residuals, and the settings of data."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.plants import System, dynamics_of_values, load_system

PLANT = """name = "cart"
states = ["x", "v"]
inputs = ["u"]
positive = ["m"]

[parameters]
m = [0.5, "3/2"] # kg
k = 2

[dynamics]
x = "v"
v = "(u - k*x)/m"

[residual]
v = "0.1*abs(v)"

[u_eq]
u = 0

[domain]
x = [-1, 1]
v = [-2, 2]

[input_bounds]
u = [-3, 3]

[data]
file = "runs.csv"
sha256 = "SHA"
period = [0.01, 0.02]

[data.noise]
x = 1e-3
v = 0

[data.priors]
m = [0.1, 2]
""".replace("SHA", "0123456789abcdef" * 4)


def load(folder: Path, text: str = PLANT) -> System:
    path = folder / "plant.toml"
    path.write_text(text)
    return load_system(path)


def test_a_parameter_may_be_a_range_of_which_its_value_is_the_middle(tmp_path: Path) -> None:
    found = load(tmp_path)
    assert found.ranges["m"] == (Fraction(1, 2), Fraction(3, 2)) and found.parameters["m"] == 1
    assert "k" not in found.ranges and found.parameters["k"] == 2


def test_a_residual_is_one_disturbance_times_its_bound(tmp_path: Path) -> None:
    found = load(tmp_path)
    assert [s.name for s in found.disturbances] == ["residual_v"] and found.ranges["residual_v"] == (-1, 1)
    assert str(dynamics_of_values(found)[1]) == "(u - k*x)/m + residual_v*(0.1*v)"
    f, x, u = found.uncertain_function(), np.array([0.3, -0.7]), np.array([0.4])
    names = list(found.ranges)
    for w in (-1.0, 0.5, 1.0):
        q = [1.0 if name == "m" else w for name in names]
        assert f(x, u, q)[1] == pytest.approx(0.4 - 0.6 + w * 0.1 * -0.7, rel=1e-14)


def test_a_residuals_bound_may_have_corners_elsewhere(tmp_path: Path) -> None:
    """Only factors lose their abs: a sum of them has another size without."""
    bound = "abs(x)*(2 + abs(v - 1))/3"
    found = load(tmp_path, PLANT.replace("0.1*abs(v)", bound))
    assert str(dynamics_of_values(found)[1]).endswith("residual_v*(x*(2 + abs(v - 1))/3)")


def test_settings_of_data_are_measurements_without_runs(tmp_path: Path) -> None:
    data = load(tmp_path).measurements
    assert data is not None and data.runs == () and data.sha256 == "0123456789abcdef" * 4
    assert data.period == (Fraction(1, 100), Fraction(1, 50)) and data.noise == (Fraction(1, 1000), 0)
    assert dict(data.priors) == {"m": (Fraction(1, 10), 2)}


def test_one_period_is_a_pair(tmp_path: Path) -> None:
    data = load(tmp_path, PLANT.replace("[0.01, 0.02]", "0.02")).measurements
    assert data is not None and data.period == (Fraction(1, 50), Fraction(1, 50))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('m = [0.5, "3/2"]', "m = [0.5]", "must be a pair [lo, hi]"),
        ('m = [0.5, "3/2"]', "m = [3, 1]", "must satisfy lo < hi"),
        ('m = [0.5, "3/2"]', "m = [0.0, 1]", "parameter m of cart must be positive"),
        ('m = [0.5, "3/2"]', "m = [0.5, true]", "must be a number"),
        ('v = "0.1*abs(v)"', 'w = "0.1"', "'w' is no state"),
        ('v = "0.1*abs(v)"', 'v = "0.1*q"', "'q' is no state, input, parameter or disturbance"),
        ('v = "0.1*abs(v)"', "v = [1, 2]", "must be an equation as text"),
        ("k = 2", "k = 2\nresidual_v = 1", "found 'residual_v' twice"),
        ("[u_eq]", "[disturbances]\nresidual_v = 5\n\n[u_eq]", "its disturbance is residual_v"),
        ('file = "runs.csv"', "", "must have file"),
        ("period = [0.01, 0.02]", "", "must have period"),
        ("period = [0.01, 0.02]", "period = [0.02, 0.01]", "must be a positive time"),
        ("period = [0.01, 0.02]", "period = 0", "must be a positive time"),
        ("0123456789abcdef" * 4, "12", "must be 64 hexadecimal digits"),
        ("x = 1e-3\nv = 0", "x = 1e-3", "v has none"),
        ("x = 1e-3\nv = 0", "x = 1e-3\nv = -1", "must be at least 0"),
        ("x = 1e-3\nv = 0", "x = 1e-3\nv = 0\nw = 1", "'w' is no state"),
        ("m = [0.1, 2]", "k = [0.1, 2]", "'k' is no ranged parameter"),
        ("m = [0.1, 2]", "m = [2, 0.1]", "must satisfy lo < hi"),
        ("m = [0.1, 2]", "", "there must be a range for a parameter"),
        ('sha256 = "', 'seed = 1\nsha256 = "', "'seed' is no entry"),
    ],
)
def test_a_fault_is_named_with_its_place(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert PLANT.count(old) == 1
    with pytest.raises(InputError) as error:
        load(tmp_path, PLANT.replace(old, new))
    assert said in str(error.value) and str(tmp_path / "plant.toml") in str(error.value)


def test_in_discrete_time_there_is_no_period(tmp_path: Path) -> None:
    steps = PLANT.replace('name = "cart"', 'name = "cart"\ntime = "discrete"')
    with pytest.raises(InputError, match="must be left out in discrete time"):
        load(tmp_path, steps)
    data = load(tmp_path, steps.replace("period = [0.01, 0.02]\n", "")).measurements
    assert data is not None and data.period is None


def test_the_command_shows_what_ranges_rest_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    load(tmp_path)
    assert _run(["plant", str(tmp_path / "plant.toml")], False) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "noise at most x 0.001, v 0; transitions of 0.01 to 0.02" in shown and "before data m 0.1 to 2" in shown
    assert _run(["plant", str(tmp_path / "plant.toml"), "--json"], True) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["data"]["priors"] == {"m": ["1/10", "2"]} and found["data"]["period"] == ["1/100", "1/50"]
