"""Plants as files: each fits its equations, a new one is a file on either side, a bad one is refused by name."""

from __future__ import annotations

import importlib
import json
import math
import subprocess
import sys
from dataclasses import replace

import pytest
from typer.testing import CliRunner

from certify.errors import InputError
from certify.loop.plants import available_systems, get_system
from certify.loop.plants import shipped as system_plants
from certify.loop.policies import load_policy
from controllers.cli import app
from controllers.options import Plant, available_plants, get_plant
from controllers.plants import shipped

EQUATIONS = """
from fractions import Fraction
from certify.loop.expressions import Number, sin, symbols
from certify.loop.plants import System

def leak() -> System:
    x, y, u = symbols("x y u")
    third = Fraction(1, 3)
    box = ((-2, 2), (-2, 2))
    return System("leak", (x, y), (u,), {}, (y, third * sin(x) + u), (Number(0),), box, ((-3, 3),))
"""
TRAINED = """
from dataclasses import replace
from controllers.options import Plant, preset

small = {"steps": 260, "warm_up": 100, "n_A": 60, "n_B": 60, "batch": 16, "critic": (8, 8)}
PLANT = Plant(
    preset=replace(preset("pendulum"), **small), initial_states=(0.5, 0.25), positions=("x", "y")
)
"""


@pytest.fixture
def plant_file(tmp_path, monkeypatch):
    """Writes a file as if it lay in one of the two folders of plants; what was imported of it is forgotten."""
    written = []

    def write(package, name, text):
        folder = tmp_path / package.__name__
        if not folder.exists():
            folder.mkdir()
            monkeypatch.setattr(package, "__path__", [*package.__path__, str(folder)])
        (folder / f"{name}.py").write_text(text)
        importlib.invalidate_caches()
        written.append((package, name))

    yield write
    for package, name in written:
        sys.modules.pop(f"{package.__name__}.{name}", None)
        vars(package).pop(name, None)


@pytest.mark.parametrize("name", available_plants())
def test_a_plant_fits_its_equations(name):
    get_plant(name).check(get_system(name))


def test_every_plant_that_is_trained_has_equations_and_the_order_is_alphabetical():
    assert set(available_plants()) <= set(available_systems())
    assert list(available_plants()) == sorted(available_plants())


@pytest.mark.slow
def test_a_new_plant_is_one_file_on_either_side(plant_file, tmp_path):
    plant_file(system_plants, "leak", EQUATIONS)
    plant_file(shipped, "leak", TRAINED)
    assert "leak" in available_systems() and "leak" in available_plants()
    out, runner = tmp_path / "leak.pt", CliRunner()
    trained = runner.invoke(app, ["train", "leak", "--out", str(out), "--json"])
    assert trained.exit_code == 0, trained.stderr
    assert load_policy(out).system == "leak" and json.loads(trained.stdout)["steps"] == 260
    judged = runner.invoke(app, ["evaluate", str(out), "--states", "3", "--duration", "1", "--json"])
    assert judged.exit_code == 0, judged.stderr
    assert json.loads(judged.stdout)["held"]["states"] == 3
    arguments = ["--runs", tmp_path / "runs", "--out", tmp_path / "out", "--seeds", 1, "--states", 2, "--duration", 1]
    without = ["--without", "sb3-sac", "--without", "sb3-ppo", "--steps", 260]
    compared = runner.invoke(app, ["compare", "leak", *map(str, [*arguments, *without])])
    assert compared.exit_code == 0, compared.stderr
    assert (tmp_path / "out" / "leak-states.png").is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [("x = 1", r"leak\.py must define `PLANT`, a Plant"), ("PLANT = {}", r"must define `PLANT`, a Plant; found dict")],
)
def test_a_file_without_its_plant_is_refused_and_the_others_still_work(plant_file, text, message):
    plant_file(shipped, "leak", text)
    assert "leak" in available_plants() and get_plant("pendulum").positions == ("theta",)
    with pytest.raises(InputError, match=message):
        get_plant("leak")


def test_an_unknown_plant_names_the_known_ones():
    with pytest.raises(InputError, match=r"'spaceship'; known are cartpole, pendulum, "):
        get_plant("spaceship")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"initial_states": (1.0,)}, "`initial_states` of pendulum must have 2 half-widths; found 1"),
        ({"positions": ("theta", "phi")}, r"`positions` of pendulum must be among its states .*; found 'phi'"),
        (
            {"preset": replace(get_plant("pendulum").preset, reward_weights=(1.0,))},
            "`reward_weights` must be 2 numbers",
        ),
    ],
)
def test_a_plant_that_does_not_fit_its_equations_is_refused(change, message):
    with pytest.raises(InputError, match=message):
        replace(get_plant("pendulum"), **change).check(get_system("pendulum"))


@pytest.mark.parametrize("widths", [(), (0.0, 1.0), (-1.0, 1.0), (math.inf, 1.0), (math.nan, 1.0)])
def test_boxes_have_positive_finite_half_widths(widths):
    with pytest.raises(InputError, match="`initial_states` must be positive and finite"):
        Plant(preset=get_plant("pendulum").preset, initial_states=widths, positions=("theta",))


def test_listing_plants_imports_none_of_them():
    code = (
        "import sys; from controllers.options import available_plants; available_plants(); "
        "print(sorted(name for name in sys.modules if '.plants.' in name or name == 'torch'))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "['controllers.plants.shipped']\n"  # the folder
