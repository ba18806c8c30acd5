"""Plants: exact numbers, the grammar, and plants described in TOML."""

from __future__ import annotations

import importlib
import itertools
import math
import pickle
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import sympy
import torch

from certify.errors import InputError
from certify.loop.expressions import Number, Symbol, differentiate, evaluate_exactly, sqrt, symbols
from certify.loop.plants import (
    System,
    available_systems,
    exact,
    get_system,
    load_system,
    require_origin_inside,
    with_origin,
)
from certify.loop.plants import shipped as plants
from certify.loop.plants.ode import rk4_step
from certify.loop.plants.toml import parse_expression
from tests.support.algebra import same
from tests.support.loops import box

VAN_DER_POL = Path(__file__).parent.parent.parent / "examples" / "van_der_pol.toml"


def test_text_is_decimal_and_a_float_is_binary() -> None:
    assert exact("0.15") == Fraction(3, 20)
    assert exact(0.15) == Fraction(0.15) != Fraction(3, 20)
    assert exact("1e-3") == Fraction(1, 1000)


@pytest.mark.parametrize(
    "value", ["", "abc", "1/0", "nan", "inf", "1e999999999", "-1E-999999999", "1e", float("nan"), float("inf")]
)
def test_what_is_no_number_is_refused(value: object) -> None:
    with pytest.raises(InputError, match="mass"):
        exact(value, "mass")  # type: ignore[arg-type]


def test_pendulum_equations(pendulum: System) -> None:
    x = np.array([[0.3, -1.2], [2.0, 5.0]])
    u = np.array([[0.7], [-3.0]])
    expected = np.stack([x[:, 1], 9.81 / 0.5 * np.sin(x[:, 0]) + (u[:, 0] - 0.1 * x[:, 1]) / (0.15 * 0.25)], -1)
    np.testing.assert_allclose(pendulum.function()(x, u), expected, rtol=1e-14)
    result = pendulum.function("torch")(torch.tensor(x), torch.tensor(u))
    np.testing.assert_allclose(result.numpy(), expected, rtol=1e-14)
    assert same(differentiate(pendulum.exact_dynamics()[1], pendulum.inputs[0]), Fraction(80, 3))


def test_every_registered_plant_has_its_equilibrium_and_units() -> None:
    for name in available_systems():
        system = get_system(name)
        at_zero = dict.fromkeys(system.states, Fraction(0)) | dict(zip(system.inputs, system.exact_u_eq(), strict=True))
        assert all(evaluate_exactly(e, at_zero) == 0 for e in system.exact_dynamics())
        names = [s.name for s in (*system.states, *system.inputs)] + list(system.parameters)
        assert set(names) <= set(system.units)


def rotation(phi: float, theta: float, psi: float) -> np.ndarray:
    """Body to world for ZYX angles, Rz(psi) Ry(theta) Rx(phi)."""
    (cf, sf), (ct, st), (cp, sp) = ((np.cos(v), np.sin(v)) for v in (phi, theta, psi))
    about_x = np.array([[1, 0, 0], [0, cf, -sf], [0, sf, cf]])
    about_y = np.array([[ct, 0, st], [0, 1, 0], [-st, 0, ct]])
    return np.array([[cp, -sp, 0], [sp, cp, 0], [0, 0, 1]]) @ about_y @ about_x


@pytest.mark.parametrize("seed", range(5))
def test_quadrotor3d_is_a_rigid_body(seed: int) -> None:
    """Thrust along the body's z axis, R' = R [w]x, and the power of forces and torques is the change of energy."""
    system = get_system("quadrotor3d")
    generator = np.random.default_rng(seed)
    m, inertia, g, a, k = 0.486, np.array([4.9e-3, 4.9e-3, 8.8e-3]), 9.81, 0.225, 1.1 / 29
    x, u = generator.uniform(-0.9, 0.9, 12), generator.uniform(0, 3.6, 4)
    position, angles, v, w = np.split(system.function()(x, u), 4)
    R, rates = rotation(*x[3:6]), x[9:]
    np.testing.assert_allclose(position, x[6:9], rtol=1e-15)
    np.testing.assert_allclose(v, R[:, 2] * u.sum() / m - [0, 0, g], rtol=1e-12, atol=1e-12)
    h = 1e-6
    moved = (rotation(*(x[3:6] + h * angles)) - rotation(*(x[3:6] - h * angles))) / (2 * h)
    cross = np.array([[0, -rates[2], rates[1]], [rates[2], 0, -rates[0]], [-rates[1], rates[0], 0]])
    np.testing.assert_allclose(moved, R @ cross, atol=1e-8)
    torque = [a * (u[1] - u[3]), a * (u[2] - u[0]), k * (u[0] - u[1] + u[2] - u[3])]
    np.testing.assert_allclose(inertia * w + np.cross(rates, inertia * rates), torque, atol=1e-12)
    energy = m * x[6:9] @ v + rates @ (inertia * w) + m * g * x[8]
    np.testing.assert_allclose(energy, x[6:9] @ R[:, 2] * u.sum() + rates @ torque, rtol=1e-10)


def test_quadrotor2d_is_one_plane_of_quadrotor3d() -> None:
    """Roll alone, seen from -y: the same trajectory as the planar plant with the same mass, arm and inertia."""
    planar = get_system("quadrotor2d").with_parameters({"l": "0.225", "I": "4.9e-3"})
    x, u = np.array([0.3, -0.2, 0.4, 1.0, -0.5, 2.0]), np.array([2.0, 1.5])
    y, z, phi, vy, vz, p = x
    whole = np.array([0, y, z, phi, 0, 0, 0, vy, vz, p, 0, 0])
    # u2 and u4 make the roll; u1 and u3 are off, so that the yaw torque -k (u2 + u4) only turns psi
    change = get_system("quadrotor3d").function()(whole, np.array([0, u[0], 0, u[1]]))
    np.testing.assert_allclose(change[[1, 2, 3, 7, 8, 9]], planar.function()(x, u), rtol=1e-12)


def test_parameters_are_replaced_exactly(pendulum: System) -> None:
    changed = pendulum.with_parameters({"m": "0.3"})
    assert changed.parameters["m"] == Fraction(3, 10)
    assert pendulum.parameters["m"] == Fraction(3, 20)
    assert same(differentiate(changed.exact_dynamics()[1], pendulum.inputs[0]), Fraction(40, 3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"z": 1}, "no parameter 'z'"),
        ({"m": 0}, "must be positive"),
        ({"m": "-1"}, "must be positive"),
        ({"m": "x"}, "m"),
    ],
)
def test_bad_parameters(pendulum: System, change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        pendulum.with_parameters(change)  # type: ignore[arg-type]


def test_a_domain_may_be_given_in_floats(pendulum: System) -> None:
    assert pendulum.with_domain({"theta": (-1.5, 0.1)}).domain[0] == (Fraction(-3, 2), Fraction(0.1))


def test_domain_must_surround_the_origin_where_v_is_0_there(pendulum: System) -> None:
    inside = pendulum.with_domain({"theta": (Fraction(-1), Fraction(2))})
    assert inside.domain[0] == (-1, 2)
    require_origin_inside(inside)
    at_its_end = pendulum.with_domain({"theta": (Fraction(0), Fraction(2))})
    with pytest.raises(InputError, match="interior"):
        require_origin_inside(at_its_end)
    with pytest.raises(InputError, match="interior"):
        with_origin(inside, (Fraction(2), Fraction(0)), (Fraction(0),))
    with pytest.raises(InputError, match="lo < hi"):
        pendulum.with_domain({"theta": (Fraction(1), Fraction(1))})
    with pytest.raises(InputError, match="no state 'phi'"):
        pendulum.with_domain({"phi": (Fraction(-1), Fraction(2))})


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda x, u: sympy.log(2) + u, "simplified when it was made"),
        (lambda x, u: 0.5 * x + u, "rounded number"),
        (lambda x, u: x ** Fraction(1, 3) + u, "an exponent must be an integer"),
        (lambda x, u: x**x + u, "an exponent must be an integer"),
        (lambda x, u: x**0 + u, "write 1"),
        (lambda x, u: x**65 + u, "at most 64"),
        (lambda x, u: sqrt(-2) * x + u, "the square root of -2"),
        (lambda x, u: x / (sqrt(4) * 0) + u, "divides by 0"),
        (lambda x, u: sqrt(x + 0.1) + u, "rounded number"),
        (lambda x, u: sympy.Symbol("x") + 0 * u, "simplified when it was made"),
        (lambda x, u: "x" + u, "symbols, exact numbers"),
        (lambda x, u: Symbol("y") + u, "no state, input, parameter or disturbance"),
    ],
)
def test_the_grammar_is_closed(build: object, message: str) -> None:
    x, u = symbols("x u")
    with pytest.raises(InputError, match=message):
        System("s", (x,), (u,), {}, (build(x, u),), (Number(0),), box(1), box(1))  # type: ignore[operator]


@pytest.mark.parametrize("name", ["x y", "", "1x", "x'", "y" * 65])
def test_names_are_identifiers(name: str) -> None:
    u = Symbol("u")
    with pytest.raises(InputError, match="an identifier"):
        System("s", (Symbol(name),), (u,), {}, (u,), (Number(0),), box(1), box(1))


def test_unknown_plant_names_the_known_ones() -> None:
    with pytest.raises(InputError, match="pendulum"):
        get_system("pendulun")


PLANT = """
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System

def {function}() -> System:
    x, u = symbols("x u")
    return System("{name}", (x,), (u,), {{}}, (u - x,), (Number(0),), (({lo}, 1),), ((-1, 1),))
"""


@pytest.fixture
def plant_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str, str], Path]]:
    """Writes a plant's file as if it lay in the folder of the plants; what was imported of it is forgotten."""
    monkeypatch.setattr(plants, "__path__", [*plants.__path__, str(tmp_path)])
    written = []

    def write(name: str, text: str) -> Path:
        written.append(name)
        path = tmp_path / f"{name}.py"
        path.write_text(text)
        importlib.invalidate_caches()
        return path

    yield write
    for name in written:
        sys.modules.pop(f"{plants.__name__}.{name}", None)
        vars(plants).pop(name, None)


def test_a_plant_is_one_file(plant_file: Callable[[str, str], Path]) -> None:
    before = available_systems()
    plant_file("leak", PLANT.format(function="leak", name="leak", lo=-1))
    plant_file("_helpers", "raise RuntimeError")
    assert available_systems() == tuple(sorted([*before, "leak"]))
    assert get_system("leak").exact_dynamics() == (Symbol("u") - Symbol("x"),)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x = 1", r"leak\.py must define a function `leak\(\)`"),
        ("leak = 1", r"leak\.py must define a function `leak\(\)`"),
        ("def leak(): return 1", r"`leak\(\)` in .*leak\.py must return a System; it returns int"),
        (PLANT.format(function="leak", name="drip", lo=-1), "must have the name 'leak'; it is called 'drip'"),
        (PLANT.format(function="leak", name="leak", lo=1), "the domain of x must satisfy lo < hi"),
    ],
)
def test_a_file_that_holds_no_plant_is_refused_and_the_others_still_work(
    plant_file: Callable[[str, str], Path], text: str, message: str
) -> None:
    plant_file("leak", text)
    assert "leak" in available_systems() and get_system("pendulum").n == 2
    with pytest.raises(InputError, match=message):
        get_system("leak")


def test_listing_plants_imports_none_of_them() -> None:
    code = (
        "import sys, certify.loop.plants as s; s.available_systems(); "
        "print([n for n in sys.modules if '.plants.shipped.' in n])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"


@pytest.mark.parametrize("name", ["plants", "system", "pendulum.pendulum", "../system", ".pendulum", ""])
def test_what_is_no_plant_s_file_is_an_unknown_plant(name: str) -> None:
    with pytest.raises(InputError, match="unknown system"):
        get_system(name)


@pytest.mark.parametrize("module", ["numpy", "torch"])
def test_runge_kutta_converges_with_order_four(module: str) -> None:
    """Harmonic oscillators of several frequencies in one batch, against their exact flow over 2 s."""
    make = np.array if module == "numpy" else partial(torch.tensor, dtype=torch.float64)
    stack = np.stack if module == "numpy" else torch.stack
    w = np.array([0.5, 1.0, 2.0])
    squared, exact_end = make(w**2), np.stack([np.cos(2 * w), -w * np.sin(2 * w)], -1)

    def error(steps: int) -> np.ndarray:
        x = make([[1.0, 0.0]] * 3)
        for _ in range(steps):
            x = rk4_step(lambda y: stack((y[..., 1], -squared * y[..., 0]), -1), x, 2.0 / steps)
        return np.linalg.norm(np.asarray(x) - exact_end, axis=-1)

    errors = [error(steps) for steps in (20, 40, 80)]
    orders = [np.log2(coarse / fine) for coarse, fine in itertools.pairwise(errors)]
    assert all(np.abs(order - 4).max() < 0.1 for order in orders), orders
    assert np.abs(orders[1] - 4).max() < np.abs(orders[0] - 4).max()  # and tends to it


def test_a_runge_kutta_step_is_taylor_s_polynomial_for_a_linear_plant() -> None:
    """Of degree four exactly: in rationals, where nothing rounds."""
    x, h, a = Fraction(3, 7), Fraction(1, 5), Fraction(-9, 4)
    expected = x * sum((a * h) ** k / math.factorial(k) for k in range(5))
    assert rk4_step(lambda y: a * y, x, h) == expected


def test_a_runge_kutta_step_passes_x_itself_first_and_takes_a_step_a_state(pendulum: System) -> None:
    f, x, asked = pendulum.function(), np.array([[0.3, -1.2], [2.0, 5.0]]), []
    u = np.zeros((2, 1))

    def field(y: np.ndarray) -> np.ndarray:
        asked.append(y)
        return f(y, u)

    h = np.array([[0.02], [0.05]])
    after = rk4_step(field, x, h)
    assert asked[0] is x and len(asked) == 4
    for k in range(2):  # a row of the batch is what it is alone, to the last bit
        alone = rk4_step(lambda y: f(y, u[:1]), x[k : k + 1], float(h[k, 0]))
        np.testing.assert_array_equal(after[k : k + 1], alone)


def test_toml_plant() -> None:
    system = load_system(VAN_DER_POL)
    x = np.array([0.5, -0.25])
    np.testing.assert_allclose(system.function()(x, np.array([0.1])), [-0.25, -0.5 + (1 - 0.25) * -0.25 + 0.1])


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('x')",
        "x.real",
        "x^2",
        "x**u",
        "x**0.5",
        "[x]",
        "x if u else x",
        "lambda: x",
        "sin(x, u)",
        "sin()",
        "1/0",
        "y",
        "x**99999999",
        "1e999999999",
        "x <",
        "0x+",
    ],
)
def test_equations_are_parsed_not_executed(text: str) -> None:
    names = {n: Symbol(n) for n in ("x", "u")}
    with pytest.raises(InputError):
        parse_expression(text, names)


def test_decimals_in_equations_are_exact() -> None:
    assert parse_expression("0.1*x", {"x": Symbol("x")}) is Fraction(1, 10) * Symbol("x")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mu = 1", "nu = 1", "mu"),
        ('x1 = "x2"', 'x9 = "x2"', "x1"),
        ("states =", "stated =", "unknown keys"),
        ("name =", "name", "not valid TOML"),
        ("[-5, 5]", "[5, -5]", "the bounds of x1 must satisfy lo < hi"),
    ],
)
def test_bad_toml(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = VAN_DER_POL.read_text()
    assert old in text
    path = tmp_path / "plant.toml"
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=message):
        load_system(path)


def test_missing_toml(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        get_system(str(tmp_path / "nothing.toml"))


def test_plants_are_pickled_by_their_fields() -> None:
    plant = load_system(VAN_DER_POL)
    again = pickle.loads(pickle.dumps(plant))
    assert again == plant and type(again.parameters) is type(plant.parameters)
    with pytest.raises(TypeError):
        again.parameters["mu"] = Fraction(2)


SECTIONS = {
    "pendulum": "Pendulum",
    "cartpole": "Cartpole",
    "quadrotor2d": "Planar quadrotor",
    "quadrotor3d": "Quadrotor in space",
}


@pytest.mark.parametrize("name", available_systems())
def test_the_page_of_the_plants_says_where_each_number_is_from(name: str) -> None:
    """A parameter, an input's bound or a side of the domain that is changed must be changed there, with its source."""
    page = (VAN_DER_POL.parent.parent / "docs" / "plants.md").read_text("utf-8")
    section = page.split(f"\n## {SECTIONS[name]}\n")[1].split("\n## ")[0]
    said = {Fraction(number) for number in re.findall(r"(?<![\w.])\d+(?:\.\d+)?(?![\w.]*\d)", section)}
    said |= {Fraction("1.1") / 29} if "1.1/29 m" in section else set()
    said |= {q / 1000 for q in said} if "× 10⁻³ kg m²" in section else set()
    system = get_system(name)
    bounds = {abs(side) for pair in (*system.domain, *system.input_bounds) for side in pair}
    assert {*system.parameters.values(), *bounds} - {0} <= said
