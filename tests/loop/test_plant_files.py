"""A plant of one's own: its file, its operating point, where an error says that it is, and whose code is run."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import sympy
import torch

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import parse_certificate
from certify.certificates.verdict import Verdict
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.expressions import Expression, Number, from_sympy, from_tree, sin, sqrt, symbols
from certify.loop.plants import (
    System,
    chosen_system,
    controllability,
    domain_of_values,
    dynamics_of_values,
    exact,
    get_system,
    in_deviations,
    in_floats,
    linearise,
    load_system,
    require_origin_inside,
    residuals,
    shipped_system,
)
from certify.loop.policies import Policy, PolicyNetwork, save_policy
from certify.report import summary
from tests.support.algebra import same
from tests.support.loops import box
from tests.support.marks import slow_after

TANK = """# a tank: level above a hole, inflow u
name = "tank"
states = ["level", "flow"]
inputs = ["u"]
positive = ["tau"]

[parameters]
tau = 2
rest = "1/3"

[dynamics]
level = "flow - level**3"
flow = "(u - flow)/tau"

[x_eq]
level = "rest"
flow = "rest**3"

[u_eq]
u = "rest**3"

[domain]
level = [0, 1]
flow = [-0.2, 0.2]

[input_bounds]
u = [-1, 1]

[units]
level = "m"
flow = "m/s"
u = "m/s"
"""


def write(folder: Path, text: str = TANK, name: str = "tank.toml") -> Path:
    path = folder / name
    path.write_text(text)
    return path


def gain(system: System, *rows: tuple[float, ...]) -> PolicyNetwork:
    """u = u_eq + rows x, centred by its form."""
    return PolicyNetwork.of_layers(
        (np.array(rows),), (np.zeros(len(rows)),), np.ones(system.m), np.zeros(system.m), "identity", "output"
    )


def test_a_file_is_in_values_and_the_plant_in_deviations(tmp_path: Path) -> None:
    system = load_system(write(tmp_path))
    assert system.exact_x_eq() == (Fraction(1, 3), Fraction(1, 27)) and system.exact_u_eq() == (Fraction(1, 27),)
    assert system.domain == (
        (Fraction(-1, 3), Fraction(2, 3)),
        (Fraction(-1, 5) - Fraction(1, 27), Fraction(1, 5) - Fraction(1, 27)),
    )
    assert domain_of_values(system) == ((0, 1), (Fraction(-1, 5), Fraction(1, 5)))
    x = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 2))
    level, flow, u = 1 / 3 + x[:, 0], 1 / 27 + x[:, 1], np.linspace(-1, 1, 50)
    wanted = np.stack([flow - level**3, (u - flow) / 2], -1)
    np.testing.assert_allclose(system.function()(x, u[:, None]), wanted, rtol=1e-13, atol=1e-15)
    assert set(residuals(system).values()) == {0}
    level, flow, u, tau = symbols("level flow u tau")
    assert all(map(same, dynamics_of_values(system), [flow - level**3, (u - flow) / tau]))


def test_the_certificate_is_that_of_the_plant_that_was_shifted_by_hand(tmp_path: Path) -> None:
    """Nothing that is proved or checked depends on x_eq: the plants differ in what is for people alone."""
    system = load_system(write(tmp_path))
    level, flow, u = system.states + system.inputs
    third, cube = Fraction(1, 3), Fraction(1, 27)
    shifted = System(
        "tank",
        (level, flow),
        (u,),
        {},
        (cube + flow - (third + level) ** 3, (u - (cube + flow)) / Number(2)),
        (cube,),
        system.domain,
        system.input_bounds,
    )
    network = gain(system, (-1.0, -1.0))
    lines = []
    for k, plant in enumerate((system, shifted)):
        result = certify_roa(plant, network, tmp_path / str(k), RoaOptions(effort=0.4, candidate="ellipsoid"))
        assert result.verdict is Verdict.PROVED and result.raw is not None
        lines.append(json.loads(result.raw))
    mine, theirs = (dict(d, provenance=None, plant=dict(d["plant"], dynamics=None)) for d in lines)
    assert mine == theirs
    names = {s.name: s for s in (level, flow, u)}
    trees = zip(*(d["plant"]["dynamics"] for d in lines), strict=True)
    assert all(same(from_tree(a, names), from_tree(b, names)) for a, b in trees)
    assert lines[0]["provenance"]["x_eq"] == {"level": "1/3", "flow": "1/27"} and "x_eq" not in lines[1]["provenance"]


def test_parameters_move_the_operating_point_and_leave_the_domain_in_its_place(tmp_path: Path) -> None:
    system = load_system(write(tmp_path)).with_parameters({"rest": "1/4"})
    assert system.exact_x_eq() == (Fraction(1, 4), Fraction(1, 64))
    assert domain_of_values(system) == ((0, 1), (Fraction(-1, 5), Fraction(1, 5)))
    assert set(residuals(system).values()) == {0}
    with pytest.raises(InputError, match=r"domain of level must contain 0 in its interior, as a deviation from x_eq"):
        require_origin_inside(system.with_parameters({"rest": 1}))


def test_a_report_and_the_terminal_say_the_operating_point(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    system = load_system(write(tmp_path))
    save_policy(tmp_path / "p.pt", Policy(gain(system, (-1.0, -1.0)), "tank", {"tau": 2, "rest": "1/3"}))
    arguments = ["roa", "--policy", str(tmp_path / "p.pt"), "--system", str(tmp_path / "tank.toml")]
    arguments += ["--candidate", "lyapunov"]
    assert _run([*arguments, "--out", str(tmp_path / "o"), "--effort", "0.4"], False) == 0
    out, err = capsys.readouterr()
    assert "operating point" in out and "level = 1/3 m" in out and "level − 0.333333 (m)" in out
    assert "attracted by the operating point" in out and "lengths are deviations from it" in " ".join(out.split())
    assert "trained" not in err
    page = (tmp_path / "o" / "report.html").read_text()
    assert "deviations from the operating point level = 1/3 m, flow = 1/27 m/s" in page
    assert "level − 0.333333 (m)" in page
    certificate = tmp_path / "o" / "certificate.json"
    assert _run(["report", str(certificate), "--out", str(tmp_path / "again.html")], False) == 0
    assert "level = 1/3 m" in (tmp_path / "again.html").read_text()
    # an interval is of values, a half-width of deviations
    assert _run([*arguments, "--out", str(tmp_path / "o"), "--domain", "level=0.1:0.5", "--json"], True) == 0
    reach = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert reach["operating_point"] == {"level": "1/3", "flow": "1/27"}
    assert reach["extents"][0] <= 0.5 - 1 / 3
    assert _run([*arguments, "--out", str(tmp_path / "o"), "--domain", "level=0.1", "--json"], True) == 0
    assert json.loads(capsys.readouterr().out)["extents"][0] <= 0.1


def test_a_result_without_an_operating_point_needs_none() -> None:
    at = {"states": [{"name": "h", "unit": "m"}], "operating_point": {"h": "1/100"}}
    result = {
        "verdict": "UNKNOWN",
        "reason": "time",
        "system": "p",
        "levels": {},
        "policy": {"layers": [1, 1], "words": "1-1", "sha256": "0"},
        "seconds": {},
        "checked": None,
    }
    from rich.console import Console

    for given, wanted in ((result, False), ({**result, **at}, True)):
        console = Console(width=100, record=True, file=open("/dev/null", "w"))  # noqa: SIM115
        console.print(summary(given))
        console.file.close()
        assert ("h = 0.01 m" in console.export_text()) is wanted


@pytest.mark.parametrize(
    "x_eq", slow_after(1, [{"level": "1e9999999"}, {"level": "1/0"}, {"nobody": "1"}, {"level": 1.5}, ["1"], "1"])
)
def test_an_odd_operating_point_in_a_certificate_is_passed_over(tmp_path: Path, x_eq: object) -> None:
    system = load_system(write(tmp_path))
    result = certify_roa(
        system, gain(system, (-1.0, -1.0)), tmp_path / "o", RoaOptions(effort=0.4, candidate="ellipsoid")
    )
    assert result.raw is not None
    assert parse_certificate(result.raw, "c").system.exact_x_eq() == system.exact_x_eq()
    data = json.loads(result.raw)
    data["provenance"]["x_eq"] = x_eq
    read = parse_certificate(json.dumps(data).encode(), "c")
    assert not any(read.system.exact_x_eq()) and read.system.units == {"level": "m", "flow": "m/s", "u": "m/s"}


def refused(tmp_path: Path, changes: Mapping[str, str]) -> str:
    """The message about the tank's file after these replacements, each of which finds its text."""
    text = TANK
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new, 1)
    with pytest.raises(InputError) as found:
        load_system(write(tmp_path, text))
    return str(found.value)


LINES = {line: k for k, line in enumerate(TANK.splitlines(), 1)}


@pytest.mark.parametrize(
    ("old", "new", "line", "parts"),
    [
        ("level**3", "level^3", 'level = "flow - level**3"', ["dynamics.level", "write **"]),
        (
            "level**3",
            "levle**3",
            'level = "flow - level**3"',
            ["'levle' is no state, input, parameter or disturbance", "'level'?"],
        ),
        ("level**3", "xyz", 'level = "flow - level**3"', ["'xyz' is no state", "known are level, flow, u, tau, rest"]),
        ("level**3", "gamma(level)", 'level = "flow - level**3"', ["gamma is not supported", "supported are sin, cos"]),
        ("level**3", "sin(level, u)", 'level = "flow - level**3"', ["sin takes one argument"]),
        ("level**3", "sin", 'level = "flow - level**3"', ["sin must have its argument in brackets"]),
        ("level**3", "tau(level)", 'level = "flow - level**3"', ["tau*(...)"]),
        ("level**3", "level**0.5", 'level = "flow - level**3"', ["exponent", "integer", "1/2"]),
        ("level**3", "level # **3", 'level = "flow - level**3"', ["# begins no comment"]),
        ("level**3", "2(level)", 'level = "flow - level**3"', ["2 is no function", "2*(...)"]),
        ("level**3", "np.sin(level)", 'level = "flow - level**3"', ["for np.sin(level) write sin(level)."]),
        ("level**3", "math.sin(2*level)", 'level = "flow - level**3"', ["for math.sin(2*level) write sin(2*level)."]),
        ("level**3", "sympy.tanh(level)", 'level = "flow - level**3"', ["write tanh(level)."]),
        ("level**3", "torch.cos(level)", 'level = "flow - level**3"', ["write cos(level)."]),
        ("level**3", "numpy.arctan(level)", 'level = "flow - level**3"', ["write atan(level)."]),
        ("level**3", "arctan(level)", 'level = "flow - level**3"', ["for arctan(level) write atan(level)."]),
        ("level**3", "np.power(level, 3)", 'level = "flow - level**3"', ["write level**3."]),
        ("level**3", "power(level + u, 3)", 'level = "flow - level**3"', ["write (level + u)**3."]),
        ("level**3", "np.abs(level)", 'level = "flow - level**3"', ["for np.abs(level) write abs(level)."]),
        ("level**3", "np.sign(level)", 'level = "flow - level**3"', ["write tanh(50*level)", "must have no jumps"]),
        ("level**3", "pi*level", 'level = "flow - level**3"', ["'pi' is no state", "a number, 3.141592653589793,"]),
        ("level**3", "np.pi*level", 'level = "flow - level**3"', ["for np.pi write", "3.141592653589793,"]),
        ("level**3", "level if level > 0 else 0", 'level = "flow - level**3"', ["there are no cases", "1 + tanh("]),
        ("level**3", "(level > 0)*u", 'level = "flow - level**3"', ["'level > 0' is not allowed", "no cases"]),
        ("level**3", "relu(level)", 'level = "flow - level**3"', ["for relu(level) write max(level, 0)."]),
        ("level**3", "np.gamma(level)", 'level = "flow - level**3"', ["np.gamma is not supported; supported are sin"]),
        ("level**3", "level % 3", 'level = "flow - level**3"', ["'level % 3'"]),
        ("level**3", "level/0", 'level = "flow - level**3"', ["divides by 0"]),
        ("level**3", "0x10*level", 'level = "flow - level**3"', ["'0x10'"]),
        ("level**3", "1e999*level", 'level = "flow - level**3"', ["out of range"]),
        ("level**3", "(level", 'level = "flow - level**3"', ["cannot be read"]),
        ('level = "flow - level**3"\n', "", "[dynamics]", ["an equation for level"]),
        ('level = "flow', 'leve1 = "flow', 'level = "flow - level**3"', ["'leve1' is no state", "'level'?"]),
        ('"flow - level**3"', "true", 'level = "flow - level**3"', ["an equation as text"]),
        ('u = "rest**3"', 'u = "level"', 'u = "rest**3"', ["u_eq.u", "'level' is no parameter"]),
        ('level = "rest"', 'level = "u"', 'level = "rest"', ["x_eq.level", "'u' is no parameter"]),
        ("level = [0, 1]\n", "", "[domain]", ["bounds of level", "level = [lo, hi]"]),
        ("level = [0, 1]", "level = [0.5, 1]", "level = [0, 1]", ["operating point level = 0.333333", "[0.5, 1]"]),
        ("level = [0, 1]", "level = [1, 0]", "level = [0, 1]", ["lo < hi", "level"]),
        ("level = [0, 1]", "level = 1", "level = [0, 1]", ["pair [lo, hi]"]),
        ("level = [0, 1]", "level = [false, 1]", "level = [0, 1]", ["must be a number"]),
        ("level = [0, 1]", 'level = ["a", 1]', "level = [0, 1]", ["domain.level", "'a'"]),
        ("u = [-1, 1]", "u = [1, -1]", "u = [-1, 1]", ["input_bounds.u", "lo < hi"]),
        ("u = [-1, 1]", "v = [-1, 1]", "u = [-1, 1]", ["'v' is no input", "known are u"]),
        ("tau = 2", "tau = nan", "tau = 2", ["'nan'", "decimal"]),
        ("tau = 2", "tau = 1e9999", "tau = 2", ["out of range"]),
        ("tau = 2", "tau = true", "tau = 2", ["parameters.tau", "must be a number"]),
        ("[input_bounds]", "[input_bound]", "[input_bounds]", ["'input_bound'", "'input_bounds'?"]),
        ('flow = "m/s"', "flow = 3", 'flow = "m/s"', ["units.flow", "must be a unit as text"]),
        ('flow = "m/s"', 'flwo = "m/s"', 'flow = "m/s"', ["'flwo' is no state", "'flow'?"]),
        ('states = ["level", "flow"]', 'states = "level"', 'states = ["level", "flow"]', ["list of names"]),
        ('states = ["level", "flow"]', "states = []", 'states = ["level", "flow"]', ["at least one"]),
        ('name = "tank"', "name = 3", 'name = "tank"', ["name: must be text"]),
    ],
)
def test_an_error_names_file_line_and_symbol(tmp_path: Path, old: str, new: str, line: str, parts: list[str]) -> None:
    message = refused(tmp_path, {old: new})
    assert message.startswith(f"{tmp_path / 'tank.toml'}, line {LINES[line]}: "), message
    for part in parts:
        assert part in message
    assert message.endswith((".", "?")) and not message.endswith("..") and "\n" not in message


@pytest.mark.parametrize(
    ("old", "new", "part"),
    [
        ("tau = 2", "tau = -2", "parameter tau of tank must be positive"),
        ('positive = ["tau"]', 'positive = ["tua"]', "must name parameters, tau, rest; found 'tua'"),
        (
            'inputs = ["u"]',
            'inputs = ["level"]',
            "names of states, inputs, parameters and disturbances must differ; found 'level' twice",
        ),
        ('name = "tank"', 'name = "a tank"', "an identifier"),
        ("tau = 2", "tau = 0", "positive"),
        ('[u_eq]\nu = "rest**3"\n', "", "missing keys: a plant must have u_eq"),
        ('name = "tank"', 'name = "tank', "not valid TOML"),
        ("[units]", "[[units]]", "units: must be a table"),
    ],
)
def test_other_errors_name_the_file(tmp_path: Path, old: str, new: str, part: str) -> None:
    message = refused(tmp_path, {old: new})
    assert str(tmp_path / "tank.toml") in message and part in message


def test_lines_are_found_under_dotted_keys_and_beside_comments(tmp_path: Path) -> None:
    text = TANK.replace('[dynamics]\nlevel = "flow - level**3"\nflow = "(u - flow)/tau"\n', "").replace(
        'inputs = ["u"]', 'inputs = ["u"] # [dynamics]\ndynamics.level = "flow^2"\ndynamics."flow" = "u"'
    )
    with pytest.raises(InputError, match=r"line 5: dynamics\.level: .*write \*\*"):
        load_system(write(tmp_path, text))
    with pytest.raises(InputError, match=r"line 6: dynamics\.flow: .*write \*\*"):
        load_system(write(tmp_path, text.replace("flow^2", "flow").replace('flow" = "u"', 'flow" = "u^2"')))
    inline = TANK.replace('[dynamics]\nlevel = "flow - level**3"\nflow = "(u - flow)/tau"\n', "").replace(
        'inputs = ["u"]', 'inputs = ["u"]\ndynamics = {level = "u^2", flow = "u"}'
    )
    with pytest.raises(InputError, match=r"line 5: dynamics\.level: .*write \*\*"):
        load_system(write(tmp_path, inline))


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({'flow = "rest**3"': "flow = 0"}, ["level' = -0.037037 (exactly -1/27) in m per second", "flow' = 0.0185185"]),
        ({'u = "rest**3"': "u = 0"}, ["flow' = -0.0185185 (exactly -1/54)"]),
        ({"level**3": "sin(level)"}, ["level' = -0.290158", "u_eq: it rests at level = 0.0786"]),
        ({'flow = "(u - flow)/tau"': 'flow = "u/(flow - rest**3)"'}, ["flow' = nan"]),
    ],
)
def test_a_point_that_is_no_equilibrium_is_refused_with_the_residual(
    tmp_path: Path, changes: dict[str, str], parts: list[str]
) -> None:
    message = refused(tmp_path, changes)
    assert f"line {LINES['[x_eq]']}: x_eq" in message and "must be an equilibrium" in message
    for part in parts:
        assert part in message
    if "sin(level)" in changes.values():
        assert "flow' =" not in message  # only what is off


def test_an_irrational_operating_point_is_refused_with_a_sentence(tmp_path: Path) -> None:
    message = refused(tmp_path, {'level = "rest"': 'level = "sin(rest)"'})
    assert f"line {TANK.splitlines().index('[x_eq]') + 2}: x_eq.level" in message
    assert "must be rational" in message and "sin(1/3)" in message and "digits, 0.327194" in message
    message = refused(tmp_path, {'u = "rest**3"': 'u = "sqrt(tau)"'})
    assert f"line {TANK.splitlines().index('[u_eq]') + 2}: u_eq.u" in message and "found sqrt(2)" in message
    assert load_system(write(tmp_path, TANK.replace('u = "rest**3"', 'u = "sqrt(rest**6)"'))).exact_u_eq() == (
        Fraction(1, 27),
    )
    x, u, a = symbols("x u a")
    with pytest.raises(InputError, match=r"x_eq of x in s must be rational.*sin\(1\)"):
        System("s", (x,), (u,), {"a": Fraction(1)}, (u,), (Number(0),), box(1), box(1), x_eq=(sin(a),))
    with pytest.raises(InputError, match="no state, input, parameter or disturbance"):
        System("s", (x,), (u,), {}, (u,), (Number(0),), box(1), box(1), x_eq=(u,))
    with pytest.raises(InputError, match="`x_eq` of s must have 1 entries; found 2"):
        System("s", (x,), (u,), {}, (u,), (Number(0),), box(1), box(1), x_eq=(Number(0),) * 2)


def test_names_for_shared_expressions(tmp_path: Path) -> None:
    text = TANK.replace("[dynamics]", '[where]\ncube = "level**3"\nout = "2*cube"\n\n[dynamics]').replace(
        "flow - level**3", "flow - out + cube"
    )
    system, plain = load_system(write(tmp_path, text)), load_system(write(tmp_path, TANK, "plain.toml"))
    assert all(map(same, system.dynamics, plain.dynamics))
    for old, new, part in (
        ('cube = "level**3"', 'cube = "out"', "'out' is no name of the plant or of a line above"),
        ("cube =", "flow =", "must be a new name"),
        ("cube =", "sin =", "must be a new name"),
        ('cube = "level**3"', 'cube = "level^3"', "write **"),
        ("flow - out + cube", "flow - ouut", "did you mean 'out'?"),
    ):
        with pytest.raises(InputError) as found:
            load_system(write(tmp_path, text.replace(old, new, 1)))
        assert part in str(found.value) and ", line " in str(found.value)


def test_shared_expressions_that_double_are_refused_before_they_are_written_out(tmp_path: Path) -> None:
    lines = ["a0 = 'level'"] + [f"a{k + 1} = 'sin(a{k}) + cos(a{k})'" for k in range(60)]
    where = "[where]\n" + "\n".join(lines) + "\n\n"
    with pytest.raises(InputError, match=r"where\.a1[0-9]: .* at most 20,000 terms"):
        load_system(write(tmp_path, TANK.replace("[dynamics]", f"{where}[dynamics]")))


def test_an_equation_may_go_over_lines(tmp_path: Path) -> None:
    text = TANK.replace('"flow - level**3"', '"""\n  flow\n  - level**3\n"""')
    assert load_system(write(tmp_path, text)) == load_system(write(tmp_path, TANK, "plain.toml"))


def test_the_table_of_the_training_is_the_trainer_s(tmp_path: Path) -> None:
    assert load_system(write(tmp_path, TANK + '\n[training]\nanything = "goes"\n')).name == "tank"


PYTHON = """
from fractions import Fraction
from pathlib import Path
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System, exact, in_deviations

Path(__file__).with_name("ran").touch()
x, u = symbols("x u")
h0 = Fraction(1, 2)
plant = System("mine", (x,), (u,), {}, in_deviations([u - x], [x], [h0]), (h0,), ((-1, 1),), ((-2, 2),), x_eq=(h0,))

def make():
    return plant

def broken():
    return 1 / 0

def leaves():
    print("{}")
    raise SystemExit(0)

def off():
    zero = (Number(0),)
    return System("off", (x,), (u,), {}, (u - x + 1,), zero, ((-1, 1),), ((-2, 2),), x_eq=(h0,))

number = 3
"""


def test_a_plant_in_python(tmp_path: Path) -> None:
    path = write(tmp_path, PYTHON, "my_plant.py")
    for name in ("plant", "make"):
        system = chosen_system(f"{path}:{name}")
        assert system.name == "mine" and system.operating_point() == {"x": Fraction(1, 2)}
        assert set(residuals(system).values()) == {0}
    assert not list(tmp_path.glob("__pycache__"))


def test_a_python_plant_that_exits_gives_no_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write(tmp_path, PYTHON, "my_plant.py")
    save_policy(tmp_path / "p.pt", Policy(gain(chosen_system(f"{path}:plant"), (-1.0,)), "mine"))
    arguments = ["roa", "--policy", str(tmp_path / "p.pt"), "--system", f"{path}:leaves", "--json"]
    assert _run([*arguments, "--out", str(tmp_path / "o")], True) == 2
    out, err = capsys.readouterr()
    assert list(json.loads(out)) == ["error"] and "{}" in err


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("plan", r"my_plant\.py has no 'plan'; did you mean 'plant'\?"),
        ("number", r"`number` in .*my_plant\.py must be a System or a function .* it gives int"),
        ("broken", r"my_plant\.py, line 16: running it raises ZeroDivisionError: division by zero"),
        ("leaves", r"my_plant\.py, line 20: running it raises SystemExit: 0"),
        ("off", r"`off` in .*my_plant\.py: x_eq of off must be an equilibrium.*x' = 1 "),
    ],
)
def test_a_python_file_without_a_plant_is_refused(tmp_path: Path, name: str, message: str) -> None:
    path = write(tmp_path, PYTHON, "my_plant.py")
    with pytest.raises(InputError, match=message):
        chosen_system(f"{path}:{name}")


def test_a_python_file_that_cannot_be_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        chosen_system(str(tmp_path / "nothing.py:plant"))
    with pytest.raises(InputError, match=r"my_plant\.py:plant"):
        chosen_system(str(write(tmp_path, PYTHON, "my_plant.py")))
    with pytest.raises(InputError, match=r"bad\.py, line 2: running it raises SyntaxError"):
        chosen_system(f"{write(tmp_path, 'x = 1' + chr(10) + 'x = = 2', 'bad.py')}:x")


def test_the_code_of_a_plant_is_run_only_if_a_person_names_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Neither the plant that a policy names nor a name given to the library runs a file, or reads one."""
    path, ran = write(tmp_path, PYTHON, "my_plant.py"), tmp_path / "ran"
    toml = write(tmp_path)
    mine = gain(chosen_system(f"{path}:plant"), (-1.0,))
    assert ran.exists()
    ran.unlink()
    for name in (f"{path}:plant", str(path), str(toml)):
        with pytest.raises(InputError, match="unknown system"):
            shipped_system(name)
        save_policy(tmp_path / "p.pt", Policy(mine, name))
        for arguments in (
            ["roa", "--policy", str(tmp_path / "p.pt"), "--out", str(tmp_path / "o")],
            ["export-smt2", "--policy", str(tmp_path / "p.pt"), "--out", str(tmp_path / "o")],
        ):
            assert _run(arguments, False) == 2
            assert "--system" in capsys.readouterr().err
        from controllers.evaluation.evaluation import evaluate

        with pytest.raises(InputError, match="unknown system"):
            evaluate(Policy(mine, name))
    with pytest.raises(InputError, match="unknown system"):
        get_system(f"{path}:plant")
    assert not ran.exists()
    arguments = ["roa", "--policy", str(tmp_path / "p.pt"), "--system", f"{path}:plant", "--out", str(tmp_path / "o")]
    assert _run([*arguments, "--candidate", "ellipsoid", "--effort", "0.1"], False) == 0 and ran.exists()
    assert "was trained for" in capsys.readouterr().err
    ran.unlink()
    certificate = str(tmp_path / "o" / "certificate.json")
    assert _run(["check", certificate], False) == 0 and _run(["report", certificate], False) == 0
    assert not ran.exists()


def test_a_policy_of_an_own_plant_asks_for_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    system = load_system(write(tmp_path))
    save_policy(tmp_path / "p.pt", Policy(gain(system, (-1.0, -1.0)), "tank", {"tau": "3", "rest": "1/3"}))
    arguments = ["roa", "--policy", str(tmp_path / "p.pt"), "--out", str(tmp_path / "o")]
    assert _run(arguments, False) == 2
    assert "unknown system 'tank'" in (said := capsys.readouterr().err) and "--system tank.toml" in said
    assert _run([*arguments, "--system", str(tmp_path / "tank.toml"), "--candidate", "ellipsoid"], False) == 0
    assert "the policy was trained with tau = 3; --system says otherwise, and counts" in capsys.readouterr().err


def plant_command(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str, str]:
    status = _run(["plant", *arguments], "--json" in arguments)
    out, err = capsys.readouterr()
    return status, out, err


def test_plant_shows_what_a_plant_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(write(tmp_path))
    status, out, _ = plant_command(capsys, path)
    assert status == 0
    words = " ".join(out.split())
    for part in (
        "d level/dt = flow - level**3",
        "state level m 0.333333 (1/3) 0 1",
        "input u m/s 0.037037 (1/27) -1 1",
        "f(x_eq, u_eq) = 0",
        "stable; eigenvalues -0.333333, -0.5",
        "2 of 2 directions: controllable (exact rank of [B, AB, ...] in rationals)",
        "level - 0.333333 (1/3), flow - 0.037037 (1/27): deviations from x_eq",
        "tau 2",
    ):
        assert part in words, part
    status, out, _ = plant_command(capsys, path, "--json", "--param", "tau=4")
    data = json.loads(out)
    assert status == 0 and data["A"] == [[-1 / 3, 1.0], [0.0, -0.25]] and data["B"] == [[0.0], [0.25]]
    assert data["x_eq"] == {"level": "1/3", "flow": "1/27"} and data["domain"]["level"] == ["0", "1"]
    assert data["controllability"] == {"rank": 2, "of": 2, "exact": True, "smallest": None}
    assert data["residual"] == {} and data["parameters"]["tau"] == "4"
    assert plant_command(capsys, "pendulum")[0] == 0
    assert plant_command(capsys, path, "--param", "tau=0")[0] == 2
    status, out, err = plant_command(capsys, "pendulun")
    assert (status, out) == (2, "") and "did you mean 'pendulum'" in err


def test_the_equilibrium_that_is_named_is_one(tmp_path: Path) -> None:
    """Where functions are irrational at rest, so that nobody writes down more than a rounded point."""
    irrational = {"level**3": "exp(level)/8", 'level = "rest"': "level = 0.3", "[0, 1]": "[0.1, 1]"}
    named = refused(tmp_path, irrational).partition("it rests at ")[2].removesuffix(".").split(", ")
    level, flow, u = named
    tank = write(tmp_path, TANK.replace("level**3", "exp(level)/8").replace('level = "rest"', level).replace(
        'flow = "rest**3"', flow).replace('u = "rest**3"', u))  # fmt: skip
    assert max(map(abs, residuals(load_system(tank)).values())) < 1e-15
    roots = {"level**3": "(level**2 - 2)", 'level = "rest"': "level = 1.5", "[0, 1]": "[1, 2]"}
    roots |= {'flow = "rest**3"': "flow = 0", 'u = "rest**3"': "u = 0"}
    assert "it rests at level = 1.4" in refused(tmp_path, roots)


@pytest.mark.parametrize("pace", ["1", "1000000000"])
def test_the_digits_of_an_irrational_equilibrium_of_polynomials_are_one(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], pace: str
) -> None:
    """Lorenz's equilibria have the root of 72; its digits leave a residual, which grows with the pace of the rates."""
    text = f"""
name = "lorenz"
states = ["x", "y", "z"]
inputs = ["u"]
[parameters]
b = "8/3"
pace = {pace}
[dynamics]
x = "pace*10*(y - x)"
y = "pace*(x*(28 - z) - y + u)"
z = "pace*(x*y - b*z)"
[x_eq]
x = 8.4852813742385702
y = 8.4852813742385702
z = 27
[u_eq]
u = 0
[domain]
x = [-20, 25]
y = [-25, 30]
z = [0, 50]
[input_bounds]
u = [-100, 100]
"""
    path = write(tmp_path, text)
    assert 0 < abs(residuals(load_system(path))["z"]) < 1e-14 * float(pace)
    status, out, _ = plant_command(capsys, str(path))
    assert status == 0 and "= 0 within rounding, not exactly" in " ".join(out.split())
    with pytest.raises(InputError, match=r"z' = -.*it rests at x = 8\.4852"):
        load_system(write(tmp_path, text.replace("742385702", "6")))


def test_plant_says_what_cannot_be_controlled_and_what_does_not_rest(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = TANK.replace('"flow - level**3"', '"1/5 - level"').replace(
        TANK[TANK.index("[x_eq]") : TANK.index("[u_eq]")], ""
    )
    text = text.replace("level = [0, 1]", "level = [-1, 1]")
    status, out, err = plant_command(capsys, str(write(tmp_path, text)))
    words = " ".join(out.split())
    assert status == 2 and "Correct x_eq or u_eq" in err  # a command that follows must not take it for usable
    assert "1 of 2 directions: NOT controllable" in words and "policy reads" not in words
    assert "no equilibrium: level' = 0.2, flow' = 0.0185185 at (x_eq, u_eq)" in words
    text = text.replace('"1/5 - level"', '"sin(level + 1)*flow - u"')
    words = " ".join(plant_command(capsys, str(write(tmp_path, text)))[1].split())
    assert "rank in floats: the smallest singular value of [B, AB, ...] over the largest:" in words


def _entries(matrix: sympy.Matrix) -> tuple[tuple[Expression, ...], ...]:
    return tuple(tuple(map(from_sympy, row)) for row in matrix.tolist())


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "tank"', "name = tank", "in 'name = tank'. Put text and equations in quotes: name = \"tank\"."),
        (
            'name = "tank"',
            'name = "a tank"',
            "the plant's name must be an identifier, at most 64",
        ),
        ("tau = 2", "tau = 2/3", 'Put fractions in quotes: "2/3".'),
        ('"flow - level**3"', '"flow - level**0.5"', "a root is sqrt(x)"),
        ('"flow - level**3"', '"flow - lambda*level"', "'lambda' is a word of Python's: take another name"),
        ("level = [0, 1]", "level = 0.4", "must be a pair [lo, hi]; found 0.4; write level = [-0.4, 0.4]"),
        ("level = [0, 1]", "level = [1, 0]", "domain.level: the bounds of level must satisfy lo < hi; found [1, 0]."),
        ("level = [0, 1]", "level = [0, 1e400]", "domain.level: must be a number below 1.8e308 in size; found"),
    ],
)
def test_a_fault_of_the_file_is_named_with_its_repair(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in TANK
    with pytest.raises(InputError, match=re.escape(said)):
        load_system(write(tmp_path, TANK.replace(old, new)))


@pytest.mark.parametrize("seed", range(5))
def test_the_rank_is_that_of_the_construction(seed: int) -> None:
    """A plant in Kalman's form, in coordinates of small integers: as many directions as were put in, exactly."""
    generator = np.random.default_rng(seed)
    n, k = 5, int(generator.integers(1, 6))
    A, B = np.zeros((n, n), dtype=int), np.zeros((n, 1), dtype=int)
    A[:k, :k] = np.diag(np.ones(k - 1), 1)
    A[:k, k:] = generator.integers(-3, 4, (k, n - k))
    A[k:, k:] = generator.integers(-3, 4, (n - k, n - k))
    B[k - 1] = 1
    lower = np.tril(generator.integers(-2, 3, (n, n)), -1) + np.eye(n, dtype=int)
    T = sympy.Matrix(lower)
    moved, into = (_entries(M) for M in (T * sympy.Matrix(A) * T.inv(), T * sympy.Matrix(B)))
    found = controllability(moved, into)
    assert (found.rank, found.exact) == (k, True)
    inexact = controllability(tuple(tuple(e * sqrt(2) for e in row) for row in moved), into)
    assert (inexact.rank, inexact.exact) == (k, False) and inexact.smallest is not None


def test_linearise_is_the_derivative_of_the_simulator(tmp_path: Path) -> None:
    system = load_system(write(tmp_path))
    f, u = system.function("torch"), torch.tensor([1 / 27], dtype=torch.float64)
    A, B = torch.autograd.functional.jacobian(f, (torch.zeros(2, dtype=torch.float64), u))  # type: ignore[no-untyped-call]
    for mine, theirs in zip(linearise(system), (A, B), strict=True):
        np.testing.assert_allclose(in_floats(mine), theirs.numpy(), rtol=1e-12, atol=1e-15)


def test_in_deviations_is_a_shift_of_all_states_at_once() -> None:
    x, y = symbols("x y")
    assert in_deviations([x * y], [x, y], [Number(2), Number(3)]) == ((2 + x) * (3 + y),)
    assert exact("1/3") == Fraction(1, 3)
