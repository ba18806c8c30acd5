"""Angles and constraints of a plant: their file, and the changes of a plant that they follow."""

from __future__ import annotations

import pickle
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import pytest

from certify.errors import InputError
from certify.loop.expressions import Symbol, evaluate_exactly
from certify.loop.plants import (
    System,
    at_values,
    constraints_of_values,
    load_system,
    with_input_errors,
    with_origin,
)
from certify.loop.plants.constraints import in_words, kept_constraints

CART = """
name = "cart"
time = "discrete"
states = ["p", "theta"]
inputs = ["F"]
[parameters]
length = 1.5
[disturbances]
wind = 0.25
[dynamics]
p = "1 + (p - 1)/2 + F"
theta = "theta/2 + wind"
[x_eq]
p = 1
[u_eq]
F = 0
[domain]
p = [-4, 4]
theta = [-4, 4]
[input_bounds]
F = [-9, 9]
"""
MORE = """
[angles]
theta = "2*pi"
[constraints]
wall = "p <= length"
force = "abs(F) < 8"
obstacle = "(p - 1)**2 + (theta)**2 >= 0.25"
plain = "p - 3 + wind < 0"
"""
p, theta, F, wind = map(Symbol, ("p", "theta", "F", "wind"))


def plant(tmp_path: Path, more: str = MORE) -> System:
    path = tmp_path / "cart.toml"
    path.write_text(CART + more)
    return load_system(path)


def at(system: System, name: str, **values: object) -> Fraction:
    """The value of g, where deviations, inputs and quantities have these values."""
    numbers = {Symbol(key): Fraction(str(value)) for key, value in values.items()}
    return evaluate_exactly(system.uncertain_constraints()[name], numbers)


def test_comparisons_become_what_must_be_negative(tmp_path: Path) -> None:
    system = plant(tmp_path)
    assert system.angles == ("theta",) and list(system.constraints) == ["wall", "force", "obstacle", "plain"]
    assert at(system, "wall", p="0.25") == Fraction("-0.25")  # 1 + 0.25 - 1.5
    assert at(system, "force", F=-9) == 1
    assert at(system, "obstacle", p=0, theta="0.5") == 0 and at(system, "obstacle", p=1, theta=0) == Fraction("-0.75")
    assert at(system, "plain", p=1, wind="0.25") == Fraction("-0.75")
    shown = constraints_of_values(system)
    assert str(shown["wall"]) == "p - length" and str(shown["plain"]) == "p - 3 + wind"


def test_constraints_follow_what_changes_the_plant(tmp_path: Path) -> None:
    system = plant(tmp_path)
    longer = system.with_parameters({"length": 2}).with_sample(None)
    assert at(longer, "wall", p="0.25") == Fraction("-0.75") and longer.angles == ("theta",)
    ranged = system.with_ranges({"length": (Fraction(1), Fraction(2))})
    assert at(ranged, "wall", p=0, length=1) == 0
    moved = with_origin(system, [Fraction(1), Fraction(0)], [Fraction(0)])
    assert at(moved, "wall", p=0) == Fraction("0.5") and str(constraints_of_values(moved)["wall"]) == "p - length"
    erring = with_input_errors(system, {"F": Fraction(1)})
    assert at(erring, "force", F=7, error_F=2) == 1
    assert at(at_values(system, {"wind": Fraction(1, 4)}), "plain", p=1) == Fraction("-0.75")
    again = pickle.loads(pickle.dumps(system))
    assert again.constraints == system.constraints and again.angles == system.angles


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('[angles]\ntheta = "360"', "write theta = \"2*pi\"; found '360'"),
        ("[angles]\ntheta = 6.28", "an angle repeats after a full turn"),
        ('[angles]\nphi = "2*pi"', "'phi' is no state"),
        ('[constraints]\nwall = "p == 1"', "compare two expressions by <=, <, >= or >"),
        ('[constraints]\nwall = "-1 <= p <= 1"', "write two constraints"),
        ('[constraints]\nwall = "p - 1.5"', "write 'p - 1.5 <= 0' if it must not be positive, 'p - 1.5 >= 0' if"),
        ('[constraints]\nwall = "q <= 1"', "'q' is no state, input, parameter or disturbance"),
        ('[constraints]\nwall = "1 <= 2"', "must depend on a state or an input"),
        ("[constraints]\nwall = 3", "must be a comparison as text"),
        ('[constraints]\nwall = "p <= (1"', "cannot be read"),
        ('[constraints]\nwall = "p <= 1 if p else 2"', "no cases"),
        ('[constraints]\n"a b" = "p <= 1"', "must be an identifier"),
    ],
)
def test_other_tables_are_refused_with_their_line(tmp_path: Path, more: str, said: str) -> None:
    with pytest.raises(InputError) as refused:
        plant(tmp_path, more)
    assert said in str(refused.value) and "cart.toml" in str(refused.value)


def test_a_plant_in_python_is_held_to_the_same(tmp_path: Path) -> None:
    system = plant(tmp_path, "")
    with pytest.raises(InputError, match="must be one of its states"):
        replace(system, angles=("F",))
    with pytest.raises(InputError, match="each state once"):
        replace(system, angles=("p", "p"))
    with pytest.raises(InputError, match="uses z"):
        replace(system, constraints={"wall": Symbol("z") - 1})


@pytest.mark.parametrize("at", ["m", "2*m - 0.5"])
def test_words_are_of_the_states_values_where_the_operating_point_is_a_parameters(at: str, tmp_path: Path) -> None:
    """They were `0.5 + (p - m) - 1.9 < 0`, in which p is the value and m is 0.5."""
    path = tmp_path / "wall.toml"
    path.write_text(
        'name = "wall"\nstates = ["p", "v"]\ninputs = ["F"]\nparameters = { m = 0.5 }\n[dynamics]\np = "v"\n'
        f'v = "F - v - (p - ({at}))"\n[u_eq]\nF = 0\n[x_eq]\np = "{at}"\n[domain]\np = [-2, 2]\nv = [-4, 4]\n'
        '[input_bounds]\nF = [-10, 10]\n[constraints]\nwall = "p <= 1.9"\n'
    )
    system = load_system(path)
    assert in_words(system) == {"wall": "p - 1.9 < 0"}
    assert in_words(replace(system, constraints=kept_constraints(system))) == {"wall": "p - 1.9 < 0"}
