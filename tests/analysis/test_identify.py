"""`certify identify`: files of measurements, the ranges that they leave, contradictions, and data in a claim."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import re
import runpy
import sys
import tempfile
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import certify
from certify.analysis.identifying.reading import Readings, read_data
from certify.analysis.identifying.writing import rounded
from certify.certificates.checking import ask
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.plants import Measurements, Run, System, get_system, load_system
from certify.loop.policies import load_policy
from certify.provers.data import Contradiction
from certify.provers.data.identify import _Box, _Data
from certify.provers.data.models import Flows
from certify.reference import rules as second
from tests.support.marks import slow_after

EXAMPLES = Path(__file__).parents[2] / "examples"
Array = NDArray[np.float64]
STRUCTURE = """# a pendulum whose numbers are not known
name = "pendulum"
states = ["theta", "theta_dot"]
inputs = ["u"]
positive = ["c"]

[parameters]
a = [10, 30] # g/l
b = [1, 4] # friction by inertia
c = [10, 50]

[dynamics]
theta = "theta_dot"
theta_dot = "a*sin(theta) - b*theta_dot + c*u"

[u_eq]
u = 0

[domain]
theta = [-3.14, 3.14]
theta_dot = [-20, 20]

[input_bounds]
u = [-6, 6]

[angles]
theta = "2*pi"
"""
TRUE = {"a": 9.81 / 0.5, "b": 0.1 / 0.0375, "c": 1 / 0.0375}  # of the plant that ships
NOISE = 1e-3
COLUMNS = "theta,theta_dot,u,theta_next,theta_dot_next"


def simulated(x: Array, u: Array, h: float = 0.02, drag: float = 0.0) -> Array:
    """The plant's states a time h later, (N, 2)."""
    f = get_system("pendulum").function()

    def rate(y: Array) -> Array:
        return f(y, u) - np.array([0.0, drag]) * y * np.abs(y)

    for _ in range(8):
        k = h / 8
        one = rate(x)
        two = rate(x + k / 2 * one)
        three = rate(x + k / 2 * two)
        x = x + k / 6 * (one + 2 * two + 2 * three + rate(x + k * three))
    return x


def transitions(count: int = 60, noise: float = NOISE, **how: float) -> Array:
    """Measured transitions, (N, 5)."""
    draw = np.random.default_rng(5)
    x, u = draw.uniform(-1, 1, (count, 2)) * [1.5, 2.0], draw.uniform(-6, 6, (count, 1))
    after = simulated(x, u, **how)
    errors = draw.uniform(-noise, noise, (2, count, 2))
    return np.hstack([x + errors[0], u, after + errors[1]])


def write(path: Path, rows: Array, header: str | None = None) -> Path:
    """A file of rows, by default of the pendulum's, or of the wheel's if they have three entries."""
    header = header or (COLUMNS if np.shape(rows)[1] == 5 else "theta_dot,u,theta_dot_next")
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header.split(","))
    writer.writerows([repr(float(v)) for v in row] for row in rows)
    path.write_text(stream.getvalue())
    return path


@pytest.fixture
def structure(tmp_path: Path) -> Path:
    path = tmp_path / "structure.toml"
    path.write_text(STRUCTURE)
    return path


def system() -> System:
    return get_system("pendulum")


def identified(folder: Path, rows: Array, text: str = STRUCTURE, **given: Any) -> certify.IdentifyResult:
    path = folder / "structure.toml"
    path.write_text(text)
    options = {"noise": str(NOISE), "sample_time": "0.02"} | given
    return certify.identify(write(folder / "data.csv", rows), path, **options)


def holds(found: certify.IdentifyResult, names: Sequence[str] = ("a", "b", "c")) -> bool:
    return all(lo <= Fraction(TRUE[name]) <= hi for name, (lo, hi) in found.ranges.items() if name in names)


# Files


def test_transitions_and_rows_in_time_order_are_the_same_runs(tmp_path: Path) -> None:
    rows = transitions(4)
    single = read_data(write(tmp_path / "a.csv", rows), system())
    assert [r.states.shape for r in single.runs] == [(2, 2)] * 4 and single.places[1] == "line 3"
    assert np.array_equal(single.runs[2].states[1], rows[2, 3:]) and single.runs[2].inputs[0, 0] == rows[2, 2]
    assert single.sha256 == hashlib.sha256((tmp_path / "a.csv").read_bytes()).hexdigest()
    timed = np.zeros((8, 4))
    timed[::2, :3], timed[1::2, :2], timed[:, 3] = rows[:, :3], rows[:, 3:], np.repeat(np.arange(4), 2)
    again = read_data(write(tmp_path / "b.csv", timed, "theta,theta_dot,u,run"), system())
    assert all(np.array_equal(p.states, q.states) for p, q in zip(single.runs, again.runs, strict=True))
    assert again.places == ("line 2", "line 4", "line 6", "line 8")


def test_a_long_run_keeps_its_rows(tmp_path: Path) -> None:
    rows = transitions(7)[:, :3]
    found = read_data(write(tmp_path / "a.csv", rows, "theta,theta_dot,u"), system())
    assert len(found.runs) == 1 and np.array_equal(found.runs[0].states, rows[:, :2])
    assert np.array_equal(found.runs[0].inputs, rows[:-1, 2:]) and len(found.places) == 6


def arrays(kind: str) -> dict[str, Any]:
    rows = transitions(6)
    if kind == "single":
        return {"x": rows[:, :2], "u": rows[:, 2:3], "x_next": rows[:, 3:]}
    if kind == "columns":
        return dict(zip(COLUMNS.split(","), rows.T, strict=True))
    return {"states": rows[:, :2].reshape(2, 3, 2), "inputs": rows[:4, 2].reshape(2, 2, 1)}


@pytest.mark.parametrize(
    ("kind", "count", "place"), [("single", 6, "row 3"), ("columns", 6, "row 3"), ("runs", 4, "run 1, step 1")]
)
def test_arrays_are_read(tmp_path: Path, kind: str, count: int, place: str) -> None:
    np.savez(tmp_path / "a.npz", **arrays(kind))
    found = read_data(tmp_path / "a.npz", system())
    assert len(found.places) == count and found.places[3] == place


def test_parquet_is_read_as_csv_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    rows = transitions(5)
    columns = dict(zip(COLUMNS.split(","), rows.T.tolist(), strict=True))
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    same = read_data(write(tmp_path / "a.csv", rows), system())
    found = read_data(tmp_path / "a.parquet", system())
    assert all(np.array_equal(p.states, q.states) for p, q in zip(found.runs, same.runs, strict=True))
    columns["u"][2] = None  # type: ignore[call-overload]
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    with pytest.raises(InputError, match="row 3, column u: there must be a number; found None"):
        read_data(tmp_path / "a.parquet", system())
    monkeypatch.setitem(sys.modules, "pyarrow.parquet", None)
    with pytest.raises(InputError, match="needs pyarrow"):
        read_data(tmp_path / "a.parquet", system())


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (lambda t: "", "it is empty"),
        (lambda t: "\n\n", "must have a header"),
        (lambda t: t.splitlines()[0] + "\n", "must have rows below its header"),
        (lambda t: t.replace("theta_dot_next", "theta_next"), "found 'theta_next' twice"),
        (lambda t: t.replace(",u,", ",force,"), "u is missing among theta, theta_dot, force"),
        (lambda t: t.replace("theta_dot_next", "other"), "theta_dot_next is missing"),
        (lambda t: t.replace("\n", ",1\n", 3), "line 4: there must be 6 entries, as in the header; found 5"),
        (lambda t: _cell(t, 2, 3, "nan"), "line 4, column theta_next: a number must be finite; found nan"),
        (lambda t: _cell(t, 0, 0, "-inf"), "line 2, column theta: a number must be finite"),
        (lambda t: _cell(t, 3, 2, ""), "line 5, column u: there must be a number; found ''"),
        (lambda t: _cell(t, 3, 2, "1_000"), "line 5, column u: there must be a number"),
        (lambda t: _cell(t, 3, 2, "1;2"), "line 5, column u: there must be a number"),
        (lambda t: t.replace("\n", "\n\n", 2), "line 2: there must be 5 entries, as in the header; found 0"),
    ],
)
def test_nothing_of_a_table_is_dropped(tmp_path: Path, edit: Callable[[str], str], said: str) -> None:
    path = write(tmp_path / "a.csv", transitions(4))
    path.write_text(edit(path.read_text()))
    with pytest.raises(InputError) as error:
        read_data(path, system())
    assert said in str(error.value)


def _cell(text: str, row: int, column: int, value: str) -> str:
    lines = text.splitlines()
    cells = lines[row + 1].split(",")
    cells[column] = value
    lines[row + 1] = ",".join(cells)
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"x_next": None}, "x_next is missing"),
        ({"u": np.zeros((5, 1))}, "must have as many rows"),
        ({"u": np.zeros((6, 2))}, "array u: the shape must be (any, 1)"),
        ({"u": np.zeros(6)}, "array u: the shape must be (any, 1)"),
        ({"x": np.full((6, 2), np.nan)}, "numbers must be finite; found nan at [0, 0]"),
        ({"x": np.zeros((6, 2), dtype=complex)}, "there must be numbers"),
        ({"x": np.array([["a", "b"]] * 6)}, "there must be numbers"),
        ({"x": np.array([[None, 1]] * 6, dtype=object)}, "no npz file of numbers"),
    ],
)
def test_nothing_of_arrays_is_dropped(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    given = {name: value for name, value in (arrays("single") | change).items() if value is not None}
    np.savez(tmp_path / "a.npz", **given)
    with pytest.raises(InputError) as error:
        read_data(tmp_path / "a.npz", system())
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("runs", "said"),
    [("0,0,1,1,0,0", "rows of a run must stand together"), ("0,0,1,2,2,2", "line 4: a run must have two rows")],
)
def test_runs_stand_together(tmp_path: Path, runs: str, said: str) -> None:
    rows = np.column_stack([transitions(6)[:, :3], [float(r) for r in runs.split(",")]])
    with pytest.raises(InputError, match=said):
        read_data(write(tmp_path / "a.csv", rows, "theta,theta_dot,u,run"), system())


def test_an_unknown_ending_and_a_missing_file_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("1")
    for name, said in (("a.txt", "must be one of .csv, .npz, .parquet"), ("b.csv", "cannot be read")):
        with pytest.raises(InputError, match=said):
            read_data(tmp_path / name, system())


def test_angles_are_unwrapped_and_other_states_are_not(tmp_path: Path, structure: Path) -> None:
    turning = np.array([[3.0, 9.0, 0.0], [-3.1, 9.0, 0.0], [-2.9, 9.0, 0.0], [3.1, -9.0, 0.0]])
    path = write(tmp_path / "a.csv", turning, "theta,theta_dot,u")
    found: Readings = read_data(path, load_system(structure))
    x = found.runs[0].states
    assert np.all(np.abs(np.diff(x[:, 0])) < math.pi) and np.array_equal(x[:, 1], turning[:, 1])
    assert np.abs(np.sin(x[:, 0]) - np.sin(turning[:, 0])).max() < 1e-14
    assert "2 differences of theta were unwrapped" in found.notes[0]
    assert np.array_equal(read_data(path, system()).runs[0].states, turning[:, :2])  # it declares no angle


def test_angles_that_are_not_wrapped_stay(tmp_path: Path, structure: Path) -> None:
    """Four radians a row are not taken for a turn less."""
    path = write(tmp_path / "a.csv", np.array([[4.0 * k, 9.0, 0.0] for k in range(4)]), "theta,theta_dot,u")
    found = read_data(path, load_system(structure))
    assert found.runs[0].states[:, 0].tolist() == [0.0, 4.0, 8.0, 12.0]
    assert not any("unwrapped" in note for note in found.notes)


def test_numbers_beyond_the_plants_bounds_are_told(tmp_path: Path) -> None:
    rows = transitions(4)
    rows[1, 2] = 7.0
    notes = read_data(write(tmp_path / "a.csv", rows, COLUMNS), system()).notes
    assert notes == ("1 values of u lie beyond its bounds: data must have what acted",)


# Ranges


def test_the_true_parameters_lie_in_ranges_that_are_small(tmp_path: Path) -> None:
    found = identified(tmp_path, transitions(), out=tmp_path / "known.toml")
    assert holds(found) and all(found.shrink(name) > 10 for name in TRUE)
    known = load_system(tmp_path / "known.toml")
    for name, (lo, hi) in found.ranges.items():
        low, high = known.ranges[name]
        assert low <= lo <= hi <= high and (high - low) <= (hi - lo) * Fraction(100_001, 100_000)
    assert known.dynamics == found.system.dynamics and known.ranges == found.system.ranges
    assert (tmp_path / "known.toml").read_text().startswith("# a pendulum whose numbers are not known\n")
    assert "# friction by inertia" in (tmp_path / "known.toml").read_text()


def test_an_operating_point_that_binary64_does_not_hold_moves_no_range(tmp_path: Path) -> None:
    """Deviations are those from x_eq itself, which its nearest number is 0.875 beside; noise is 0.3."""
    (tmp_path / "far.toml").write_text(
        f"""name = "far"
time = "discrete"
states = ["x"]
inputs = ["u"]
[parameters]
p = [-1, -0.8]
x0 = "{2**56 + 7}/8"
[dynamics]
x = "x0 + p*(x - x0) + u"
[x_eq]
x = "x0"
[u_eq]
u = 0
[domain]
x = [{2**53 - 1000}, {2**53 + 1000}]
[input_bounds]
u = [-6, 6]
"""
    )
    x0, p, chance, rows = 2**53 + Fraction(7, 8), Fraction(-9, 10), np.random.default_rng(0), []
    for y in (2**53 + 2 * chance.integers(-20, 21, 60)).tolist():
        after = x0 + p * (y + Fraction(int(chance.integers(-30, 31)), 100) - x0)
        end = float(after)
        rows.append((float(y), float(Fraction(round(64 * (Fraction(end) - after)), 64)), end))
    write(tmp_path / "a.csv", np.array(rows), "x,u,x_next")
    found = certify.identify(tmp_path / "a.csv", tmp_path / "far.toml", noise="0.31")
    lo, hi = found.ranges["p"]
    assert lo <= p <= hi and hi - lo < Fraction(1, 20)


def test_runs_and_a_period_of_some_length(tmp_path: Path) -> None:
    """True periods lie in the range that is given, and so do the parameters in theirs."""
    draw, rows = np.random.default_rng(2), list[Array]()
    for run in range(5):
        x = draw.uniform(-1, 1, (1, 2))
        for k in range(6):
            u = draw.uniform(-2, 2, (1, 1))
            rows.append(np.concatenate([x[0] + draw.uniform(-1e-4, 1e-4, 2), u[0], [run]]))
            x = simulated(x, u, h=0.0199 if k % 2 else 0.0201)
    path = write(tmp_path / "run.csv", np.array(rows), "theta,theta_dot,u,run")
    (tmp_path / "s.toml").write_text(STRUCTURE)
    found = certify.identify(path, tmp_path / "s.toml", noise="1e-4", sample_time=("0.0199", "0.0201"))
    assert holds(found) and found.shrink("c") > 5


def test_noise_that_is_smaller_than_it_was_is_contradicted(tmp_path: Path) -> None:
    rows = transitions(200)
    found = identified(tmp_path, rows)
    assert found.least_noise is not None and 0.5 < found.least_noise <= 1
    for factor in (0.5, 0.99 * found.least_noise):
        with pytest.raises(Contradiction) as error:
            identified(tmp_path, rows, noise=NOISE * factor)
        assert error.value.transitions
    axis = found.least_determined
    assert axis is not None and max(axis.entries.values()) == 1 and 0 < axis.share <= 2


def test_the_least_noise_does_not_depend_on_units(tmp_path: Path) -> None:
    """Linear programs drop numbers below 1e-9, as noise in small units is."""
    draw = np.random.default_rng(3)
    x, u = draw.uniform(-1, 1, (2, 80, 1))
    rows = np.hstack([x, u, 0.8 * x + u + 1e-2 * draw.uniform(-1, 1, (80, 1))])
    least = []
    for number, unit in enumerate((1.0, 1e-9)):
        (tmp_path / f"{number}.toml").write_text(
            'name = "one"\ntime = "discrete"\nstates = ["x"]\ninputs = ["u"]\nu_eq = {u = 0}\n'
            "parameters = {a = [0.5, 0.95]}\ndomain = {x = [-3, 3]}\ninput_bounds = {u = [-1, 1]}\n"
            '[dynamics]\nx = "a*x + u"\n'
        )
        path = write(tmp_path / f"{number}.csv", unit * rows, "x,u,x_next")
        found = certify.identify(path, tmp_path / f"{number}.toml", noise=1e-2 * unit)
        least.append(found.least_noise)
    assert least[0] is not None and 0.3 < least[0] < 1 and least[1] == pytest.approx(least[0], rel=1e-3)


@pytest.mark.parametrize(
    "text",
    [
        STRUCTURE.replace(" - b*theta_dot", "").replace("b = [1, 4] # friction by inertia\n", ""),
        STRUCTURE.replace("a = [10, 30]", "a = [21, 30]"),
        STRUCTURE.replace('theta = "theta_dot"', 'theta = "theta_dot*1.1"', 1),
    ],
    ids=["no friction", "a prior without the truth", "another equation"],
)
def test_a_structure_that_the_data_contradict_is_refuted(tmp_path: Path, text: str) -> None:
    with pytest.raises(Contradiction):
        identified(tmp_path, transitions(noise=1e-4), text, noise="1e-4")


@pytest.mark.slow
def test_what_the_equations_lack_is_a_residual(tmp_path: Path) -> None:
    """With a drag that they do not have the data refute them; with a bound of it the truth is inside."""
    rows = transitions(noise=1e-4, drag=0.2)
    with pytest.raises(Contradiction):
        identified(tmp_path, rows, noise="1e-4")
    lacking = STRUCTURE.replace("[u_eq]", '[residual]\ntheta_dot = "0.2*theta_dot**2"\n\n[u_eq]')
    found = identified(tmp_path, rows, lacking, noise="1e-4")
    assert holds(found) and found.system.ranges["residual_theta_dot"] == (-1, 1)


RESIDUAL = STRUCTURE.replace("[u_eq]", '[residual]\ntheta_dot = "{}"\n\n[u_eq]')
WHEEL = """name = "wheel"
states = ["theta_dot"]
inputs = ["u"]
positive = ["c"]

[parameters]
b = [1, 4]
c = [10, 50]

[dynamics]
theta_dot = "c*u - b*theta_dot"

[u_eq]
u = 0

[domain]
theta_dot = [-20, 20]

[input_bounds]
u = [-6, 6]
"""
DRAGGED = WHEEL.replace("[u_eq]", '[residual]\ntheta_dot = "{}"\n\n[u_eq]')


def wheel(drag: float = 0.0) -> Array:
    """Transitions of b = 2 and c = 20, with a drag that the structure lacks, (N, 3)."""
    draw = np.random.default_rng(5)
    v, u = draw.uniform(-2, 2, 60), draw.uniform(-6, 6, 60)

    def rate(v: Array) -> Array:
        return np.asarray(20 * u - 2 * v - drag * v * np.abs(v))

    after = v
    for _ in range(64):
        middle = after + 0.02 / 128 * rate(after)
        after = after + 0.02 / 64 * rate(middle)
    errors = draw.uniform(-1e-4, 1e-4, (2, 60))
    return np.stack([v + errors[0], u, after + errors[1]], axis=1)


@pytest.mark.slow
def test_the_least_factor_of_a_residual_is_no_larger_than_the_true_one(tmp_path: Path) -> None:
    """The plant has half the bound that the structure allows; what is refuted is refuted as a bound by itself."""
    rows = wheel(0.2)
    found = identified(tmp_path, rows, DRAGGED.format("0.4*theta_dot**2"), noise="1e-4")
    (least,) = found.least_residual
    assert least.open is not None
    refuted, open_ = least.refuted["theta_dot"], least.open["theta_dot"]
    assert 0.2 < refuted < 0.5 and refuted < open_ < 1.1 * refuted
    with pytest.raises(Contradiction):
        identified(tmp_path, rows, DRAGGED.format(f"{0.4 * refuted}*theta_dot**2"), noise="1e-4")
    identified(tmp_path, rows, DRAGGED.format(f"{0.4 * open_}*theta_dot**2"), noise="1e-4")
    none = identified(tmp_path, wheel(), DRAGGED.format("0.4*theta_dot**2"), noise="1e-4")
    assert [(one.refuted, one.open) for one in none.least_residual] == [({"theta_dot": 0}, {"theta_dot": 0})]
    assert none.to_dict()["least_residual"] == [{"refuted": {"theta_dot": 0}, "open": {"theta_dot": 0}}]
    assert identified(tmp_path, wheel(), WHEEL, noise="1e-4").least_residual == ()


@pytest.mark.slow
def test_factors_are_of_all_residuals_and_of_each_beside_the_others(tmp_path: Path) -> None:
    rows = transitions(noise=1e-4, drag=0.2)
    lacking = RESIDUAL.format('0.4*theta_dot**2"\ntheta = "0.1*theta_dot')
    found = identified(tmp_path, rows, lacking, noise="1e-4")
    assert [set(one.refuted) for one in found.least_residual] == [{"theta", "theta_dot"}, {"theta"}, {"theta_dot"}]
    both, theta, rate = (max(one.refuted.values()) for one in found.least_residual)
    assert theta == 0 and 0.2 < rate <= both * 1.1 < 0.55


def test_a_refuted_structure_says_what_its_equations_lack(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The drag is at most 0.2 of the square of a rate of up to 6: less than it is refuted, and what is said to be tried
    is not."""
    rows = wheel(0.2)
    assert _run(command(tmp_path, "--noise", "1e-4", rows=rows, text=WHEEL), False) == 1
    shown = capsys.readouterr().out
    advice = re.search(r'try next +in the structure \[residual\] theta_dot = "(\S+)", or bounds', shown)
    assert advice is not None and "in θ̇′ is contradicted as well" in shown and 0.2 < float(advice[1]) < 7.2
    assert _run(command(tmp_path, "--noise", "1e-4", "--json", rows=rows, text=WHEEL), True) == 1
    found = json.loads(capsys.readouterr().out)
    least = next(one for one in found["least_constants"] if "theta_dot" in one["refuted"])
    refuted = least["refuted"]["theta_dot"]
    assert found["least_residual"] == [] and refuted < least["open"]["theta_dot"] <= float(advice[1]) < 1.2 * refuted
    for size, status in ((refuted, 1), (float(advice[1]), 0)):
        more = command(tmp_path, "--noise", "1e-4", "--json", rows=rows, text=DRAGGED.format(size))
        assert _run(more, True) == status
    capsys.readouterr()


@pytest.mark.slow
def test_a_residual_that_is_too_small_is_refuted_with_the_factor_that_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows, text = wheel(0.2), DRAGGED.format("0.05*theta_dot**2")
    assert _run(command(tmp_path, "--noise", "1e-4", rows=rows, text=text), False) == 1
    shown = capsys.readouterr().out
    factor = re.search(r"θ̇: (\S+) times the bound is contradicted; (\S+) times is not", shown)
    assert factor is not None and 1 < float(factor[1]) < 4 and float(factor[1]) < float(factor[2])


def test_a_wrong_period_is_refuted_and_one_in_a_range_is_not(tmp_path: Path) -> None:
    """A period that is 1 % off moves theta by 4e-4 at 2 rad/s, more than this noise."""
    rows = transitions(noise=1e-5)
    with pytest.raises(Contradiction):
        identified(tmp_path, rows, noise="1e-5", sample_time="0.0202")
    assert holds(identified(tmp_path, rows, noise="1e-5", sample_time=("0.0198", "0.0202")))


@pytest.mark.parametrize("fault", ["outlier", "degrees", "millinewtons"])
def test_outliers_and_wrong_units_are_refuted(tmp_path: Path, fault: str) -> None:
    rows = transitions()
    if fault == "outlier":
        rows[17, 3] += 0.1
    if fault == "degrees":
        rows[:, [0, 3]] *= 180 / math.pi
    if fault == "millinewtons":
        rows[:, 2] *= 1000
    with pytest.raises(Contradiction) as error:
        identified(tmp_path, rows)
    assert fault != "outlier" or 17 in error.value.transitions


def test_ranges_are_rounded_outwards_within_the_priors() -> None:
    priors = {"p": (Fraction(1, 3), Fraction(2)), "q": (Fraction(-1), Fraction(1, 10**9))}
    ranges = {"p": (Fraction(1, 3), Fraction(5, 7)), "q": (Fraction(-1, 7), Fraction(1, 10**9))}
    found = rounded(ranges, priors)
    assert found["p"][0] == Fraction(1, 3) and found["q"][1] == Fraction(1, 10**9)
    for name, (lo, hi) in ranges.items():
        low, high = found[name]
        assert low <= lo and hi <= high and high - low <= (hi - lo) * Fraction(100_001, 100_000)


def test_an_end_of_a_prior_that_no_measurement_moves_may_be_any_number(tmp_path: Path) -> None:
    """2.1 and 2.9 are no binary64 numbers: the box that the certificate states reaches just beyond them, and the range
    has to hold it, as `certify roa --data` asks."""
    result = identified(tmp_path, transitions()[:6], STRUCTURE.replace("b = [1, 4]", "b = [2.1, 2.9]"), noise="0.02")
    lo, hi = result.ranges["b"]
    low, high = result.system.ranges["b"]
    assert lo < Fraction("2.1") and hi > Fraction("2.9")  # neither end was moved
    assert low <= lo and hi <= high and high - low < Fraction("0.8000001")


def test_measurements_that_narrow_nothing_end_with_what_to_do(tmp_path: Path) -> None:
    """With errors of 10 rad/s in the velocity nothing is known of its derivative: there are no ranges to be had."""
    with pytest.raises(certify.InputError, match=r"narrow no prior, in .* parts of the priors: write the equations"):
        identified(tmp_path, transitions()[:6], noise={"theta": "1e-3", "theta_dot": "10"})


@pytest.mark.parametrize(
    ("equation", "prior", "left", "said"),
    [
        ("a*sin(theta)/d - b*theta_dot + c*u", "d = [0.9, 1.1]", ["d"], "not linear in the parameters"),
        ("a*sin(theta) - b*theta_dot + c*u + d*0.00001*theta", "d = [0, 1]", ["d"], "measure where states or inputs"),
    ],
)
def test_a_prior_that_is_left_as_it_is_has_an_advice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], equation: str, prior: str, left: list[str], said: str
) -> None:
    rows = transitions(20)
    text = STRUCTURE.replace("a*sin(theta) - b*theta_dot + c*u", equation).replace(
        "[parameters]", f"[parameters]\n{prior}"
    )
    assert _run(command(tmp_path, text=text, rows=rows), False) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"not narrowed {', '.join(left)}: " in shown and said in shown
    assert _run(command(tmp_path, "--json", text=text, rows=rows), True) == 0
    assert json.loads(capsys.readouterr().out)["not_narrowed"] == left
    assert _run(command(tmp_path, "--json", rows=rows), True) == 0
    assert json.loads(capsys.readouterr().out)["not_narrowed"] == []


def test_inputs_in_another_unit_under_which_states_diverge_are_asked_about(tmp_path: Path) -> None:
    """Of a car whose force is 100,000 times too large the flow has no enclosure, and more rows help little."""
    car = """name = "car"
states = ["v"]
inputs = ["u"]
[parameters]
m = [800, 2000]
c = [0.1, 1]
[dynamics]
v = "(u - c*v*abs(v))/m"
[u_eq]
u = 0
[domain]
v = [-35, 35]
[input_bounds]
u = [-4000, 4000]
"""
    rows = np.array([[20.0, u, 20.0 + u / 2400] for u in (-3000.0, -1000.0, 1500.0, 4000.0)])
    rows[:, 1] *= 100_000
    (tmp_path / "car.toml").write_text(car)
    data = write(tmp_path / "data.csv", rows, "v,u,v_next")
    with pytest.raises(certify.InputError, match="look at the units of the measurements and at the period"):
        certify.identify(data, tmp_path / "car.toml", noise="0.02", sample_time="0.5")


def test_a_part_of_which_nothing_is_left_is_stated_beyond_its_ends(tmp_path: Path) -> None:
    """A certificate has binary64 numbers, and the ends of priors need not be such."""
    file = tmp_path / "plant.toml"
    file.write_text(STRUCTURE.replace("a = [10, 30]", "a = [24.1, 29.9]").replace("b = [1, 4]", "b = [1.1, 3.9]"))
    rows = transitions(noise=1e-4)
    runs = tuple(Run(np.stack([row[:2], row[3:]]), row[None, 2:3]) for row in rows)
    plant = load_system(file)
    period = (Fraction(1, 50), Fraction(1, 50))
    measurements = Measurements(plant.ranges, period, (Fraction(1, 10**4),) * 2, runs, "0" * 64)
    part = _Box(_Data(plant, measurements), Flows(plant, measurements, 4, 1), dict(plant.ranges))
    part.separately(np.arange(len(rows)), 3)
    ((_, _, stated),) = part.rounds
    assert part.empty
    for name, (lo, hi) in plant.ranges.items():
        low, high = stated[name]
        assert Fraction(float(low)) == low and Fraction(float(high)) == high
        assert name == "a" or (low <= lo and hi <= high)


# The command


def command(folder: Path, *more: str, rows: Array | None = None, text: str = STRUCTURE) -> list[str]:
    write(folder / "data.csv", transitions() if rows is None else rows)
    (folder / "structure.toml").write_text(text)
    files = ["identify", str(folder / "data.csv"), "--structure", str(folder / "structure.toml")]
    return [*files, "--sample-time", "0.02", "--noise", "1e-3", "--out", str(folder / "known.toml"), *more]


def test_the_command_prints_ranges_and_draws_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(command(tmp_path), False) == 0
    shown = capsys.readouterr().out
    assert shown.startswith("IDENTIFIED") and "least determined" in shown and "noise smaller than" in shown
    page = (tmp_path / "known.html").read_text()
    assert "<script" not in page and page.count("<img") == 3 and 'src="http' not in page
    assert _run(command(tmp_path, "--json"), True) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["schema"] == "certify-identify/1" and found["data"]["transitions"] == 60
    known = load_system(tmp_path / "known.toml")
    for entry in found["parameters"]:
        lo, hi = map(Fraction, entry["range"])
        assert known.ranges[entry["name"]] == (lo, hi) and lo <= Fraction(TRUE[entry["name"]]) <= hi
        assert all(place.startswith("line ") for place in entry["shown_by"])


def test_a_contradiction_is_a_finding_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = wheel()
    rows[17, 2] += 0.1
    assert _run(command(tmp_path, rows=rows, text=WHEEL), False) == 1
    shown = capsys.readouterr().out
    assert shown.startswith("REFUTED") and "line 19" in shown and not (tmp_path / "known.toml").exists()
    assert _run(command(tmp_path, "--json", rows=rows, text=WHEEL), True) == 1
    found = json.loads(capsys.readouterr().out)
    assert found["verdict"] == "REFUTED" and "line 19" in found["transitions"]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--noise", "theta=1e-3"], "--noise takes a bound for each of theta, theta_dot; theta_dot is missing"),
        (["--noise", "theta=1e-3,omega=1"], "omega is no state"),
        (["--noise", "-1"], "--noise must be at least 0"),
        (["--sample-time", "0"], "--sample-time must be a positive time"),
        (["--sample-time", "soon"], "must be a finite number"),
        (["--env", "Pendulum-v1"], "one of the two"),
        (["--out", "known.txt"], "must be a .toml file"),
    ],
)
def test_bad_input_ends_with_2(tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str) -> None:
    assert _run(command(tmp_path, *more), False) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("a = [10, 30] # g/l\nb = [1, 4] # friction by inertia\nc = [10, 50]", "a = 20\nb = 2\nc = 20", "found none"),
        ("a = [10, 30] # g/l", "a = [10,\n 30]", "the range must stand on a line of its own"),
        (
            "[angles]",
            f'[data]\nfile = "d"\nsha256 = "{"0" * 64}"\nperiod = 1\nnoise = {{theta = 1, theta_dot = 1}}\n'
            "priors = {a = [1, 2]}\n[angles]",
            "must have no table [data] yet",
        ),
    ],
)
def test_a_structure_that_cannot_be_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    assert STRUCTURE.count(old) == 1
    assert _run(command(tmp_path, text=STRUCTURE.replace(old, new)), False) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "known.toml").exists()


def test_the_structure_is_not_written_over(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(command(tmp_path, "--out", str(tmp_path / "structure.toml")), False) == 2
    assert "must not be written over" in capsys.readouterr().err
    assert (tmp_path / "structure.toml").read_text() == STRUCTURE


def test_an_environment_is_recorded_into_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Gymnasium's pendulum, as a black box that shows cos and sin of its angle."""
    pytest.importorskip("gymnasium")
    plant = tmp_path / "plant.toml"
    plant.write_text(
        'name = "box"\ntime = "discrete"\nstates = ["theta", "omega"]\ninputs = ["u"]\n[parameters]\na = [0.5, 1.5]\n'
        'b = [0.05, 0.3]\n[where]\nfaster = "clip(omega + a*sin(theta) + b*u, -8, 8)"\n[dynamics]\n'
        'theta = "theta + 0.05*faster"\nomega = "faster"\n[u_eq]\nu = 0\n[domain]\ntheta = [-3.2, 3.2]\n'
        'omega = [-9, 9]\n[input_bounds]\nu = [-2, 2]\n[angles]\ntheta = "2*pi"\n'
    )
    given = ["identify", "--env", "Pendulum-v1", "--episodes", "1", "--structure", str(plant), "--noise", "1e-5"]
    given += ["--out", str(tmp_path / "known.toml")]
    assert _run(given, False) == 2 and "Say what they are with --observed" in capsys.readouterr().err
    assert _run([*given, "--observed", "cos(theta),sin(theta)"], False) == 2
    assert _run([*given, "--observed", "cos(theta),sin(theta),omega", "--json"], True) == 0
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["data"]["transitions"] == 200 and found["data"]["file"] == "known_data.csv"
    raw = (tmp_path / "known_data.csv").read_bytes()
    assert found["data"]["sha256"] == hashlib.sha256(raw).hexdigest()
    (a_lo, a_hi), (b_lo, b_hi) = (map(float, map(Fraction, p["range"])) for p in found["parameters"])
    assert a_lo <= 0.75 <= a_hi and b_lo <= 0.15 <= b_hi and a_hi - a_lo < 1e-3


# Data in a claim


POLICY = EXAMPLES / "policies" / "pendulum.pt"


def certifying(folder: Path, *more: str) -> list[str]:
    files = ["roa", str(POLICY), "--system", str(folder / "known.toml"), "--out", str(folder / "out")]
    return [*files, "--candidate", "lyapunov", "--level", "1e-3", *more]


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the file of a plant that was identified, and its data."""
    folder = tmp_path_factory.mktemp("known")
    assert _run(command(folder, "--quiet"), False) == 0
    return folder


def test_data_become_a_part_of_the_claim(known: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(certifying(known, "--data", str(known / "data.csv"), "--json"), True) == 0
    found = json.loads(capsys.readouterr().out)
    data, plant = found["data"], load_system(known / "known.toml")
    stated = json.loads((known / "out" / "certificate.json").read_text())
    assert found["verdict"] == "PROVED" and found["checked"] == "ACCEPTED"
    assert ask(known / "out" / "certificate.json", "reference")[1]["result"] == "ACCEPTED"
    assert stated["claim"]["data"]["sha256"] == data["sha256"] == plant.measurements.sha256  # type: ignore[union-attr]
    assert data["transitions"] == sum(run["steps"] for run in stated["claim"]["data"]["runs"]) <= 60
    assert data["noise"] == {"theta": "1/1000", "theta_dot": "1/1000"} and data["period"] == ["1/50", "1/50"]
    assert data["priors"]["c"] == ["10", "50"] and Fraction(data["ranges"]["c"][0]) == plant.ranges["c"][0]
    page = " ".join((known / "out" / "report.html").read_text().split())
    assert "For every constant a in [10, 30], b in [1, 4] and c in [10, 50] with which" in page
    assert "Parameters that change." in page and "drifting or jumping" not in page
    assert _run(["contains", str(known / "out" / "certificate.json"), "theta=0.001"], False) == 0
    assert _run(["plot", str(known / "out" / "certificate.json"), "--out", str(known / "out" / "set.svg")], False) == 0
    assert _run(["prove-in-coq", str(known / "out" / "certificate.json"), "--out", str(known / "coq")], False) == 2
    assert "ranges that measurements bound" in capsys.readouterr().err


@pytest.mark.slow
def test_python_takes_data_as_the_command_does(known: Path) -> None:
    given = {"candidate": "lyapunov", "level": 1e-3, "data": known / "data.csv"}
    found = certify.certify_roa(known / "known.toml", POLICY, **given)  # type: ignore[arg-type]
    assert found.verdict == "PROVED" and found.to_dict()["data"]["transitions"] > 0
    assert "constant a in [10, 30]" in found._repr_html_()
    plant = certify.identify(
        known / "data.csv", known / "structure.toml", noise={"theta": 1e-3, "theta_dot": 1e-3}, sample_time="0.02"
    ).system
    again = certify.certify_roa(plant, POLICY, candidate="lyapunov", level=1e-3)
    assert again.verdict == "PROVED" and again.to_dict()["data"]["sha256"] == found.to_dict()["data"]["sha256"]


@pytest.mark.slow
def test_a_tube_has_data_too(known: Path) -> None:
    """Both checkers derive the ranges; without the evidence of one transition, or with other ends, they refuse it."""
    network = load_policy(EXAMPLES / "policies" / "pendulum.pt").network
    options: dict[str, Any] = {"candidate": "lyapunov", "level": 0.3, "enlarge": True, "effort": 0.6}
    result = certify.certify_roa(known / "known.toml", network, known / "tube", data=known / "data.csv", **options)
    assert (result.verdict.value, result.claim) == ("PROVED", "enlarged") and result.raw is not None
    whole = json.loads(result.raw)
    assert len(whole["evidence"]["tube"]) > 1 and whole["claim"]["data"]["runs"]
    assert both(whole) == {"ACCEPTED"}
    for change, rule in (
        (lambda d: d["evidence"]["data"].update(rounds=[]), "data"),
        (lambda d: d["claim"]["data"]["parameters"][0].update(range=["10", "31"]), "data"),
        (lambda d: d["plant"]["uncertain"][0].update(range=["39/2", "59/3"]), "data"),
        (lambda d: d["evidence"]["tube"].pop(0), "tube"),
    ):
        forged = json.loads(result.raw)
        change(forged)
        assert both(forged) == {rule}


def both(data: Any) -> set[str]:
    """The words of both checkers: ACCEPTED, or a rule."""
    raw = json.dumps(data).encode()
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        file.write(raw)
        file.flush()
        _, answer = ask(Path(file.name))
    judged = second.judge(raw)
    return {str(answer.get("rule") or answer["result"]), judged.rule or judged.result}


@pytest.mark.slow
def test_what_fails_in_the_ranges_refutes_no_claim_about_data(known: Path) -> None:
    """The middle of the ranges, or a corner, need not be a consistent plant."""
    none = certify.PolicyNetwork.of_layers(
        (np.zeros((1, 2)),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    law = certify.PolicyNetwork.of_layers(
        (np.array([[-4.0, -1.0]]),), (np.zeros(1),), np.array([6.0]), np.zeros(1), "tanh", "none"
    )
    for network, level, verdict in ((none, None, "UNKNOWN"), (law, 1.0, "UNKNOWN"), (law, 4.0, "REFUTED")):
        found = [
            certify.certify_roa(known / "known.toml", network, candidate="lyapunov", level=level, data=data)
            for data in (None, known / "data.csv")
        ]
        assert [one.verdict.value for one in found] == ["REFUTED", verdict]
        assert ("need not be consistent" in str(found[1].notice)) is (verdict == "UNKNOWN")


def test_an_invariant_set_has_no_data(known: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(POLICY), "--system", str(known / "known.toml"), "--data", str(known / "data.csv")]
    assert _run(["roa", *files, "--claim", "invariant", "--out", str(known / "out")], False) == 2
    assert "must be for ranges as they stand" in " ".join(capsys.readouterr().err.split())


def test_without_data_ranges_are_taken_as_they_stand(known: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(certifying(known, "--json"), True) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert found["data"] is None and "--data makes the measurements" in said.err
    assert "data" not in json.loads((known / "out" / "certificate.json").read_text())["claim"]


def test_a_region_is_reached_for_ranges_as_they_stand(known: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop = [str(POLICY), "--system", str(known / "known.toml"), "--sample-time", "0.02"]
    text = (known / "known.toml").read_text()
    (known / "known.toml").write_text(text.replace('[angles]\ntheta = "2*pi"\n', ""))
    asked = ["--target", "theta**2 <= 4", "--from", "theta=1..1.1,theta_dot=0", "--out", str(known / "out")]
    assert _run(["reach", *loop, *asked, "--effort", "0.1", "--json"], True) == 0
    said = capsys.readouterr()
    assert "ranges are taken as they stand" in json.loads(said.out)["notice"] and "as they stand" in said.err


def test_other_data_are_refused(known: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (known / "data.csv").read_text()
    (tmp_path / "data.csv").write_text(text.replace("\n", "\n", 1) + "\n")  # the same rows in other bytes
    assert _run(certifying(known, "--data", str(tmp_path / "data.csv")), False) == 2
    assert "must be the one from which the plant was identified" in capsys.readouterr().err
    assert _run(["roa", str(POLICY), "--data", str(known / "data.csv"), "--out", str(tmp_path / "out")], False) == 2
    assert "must have a table [data]" in capsys.readouterr().err


@pytest.mark.parametrize("share", [0.0, 0.9])
def test_ranges_that_do_not_hold_what_is_left_are_refused(
    known: Path, tmp_path: Path, share: float, capsys: pytest.CaptureFixture[str]
) -> None:
    """Somebody narrows a range in the file, or on the command line."""
    lo, hi = load_system(known / "known.toml").ranges["c"]
    narrow = f"c={float(lo):.12f}..{float(lo + (hi - lo) * Fraction(max(share, 0.1))):.12f}"
    given = certifying(known, "--data", str(known / "data.csv"), "--param", narrow, "--out", str(tmp_path / "out"))
    assert _run(given, False) == 2
    assert "the range of c must hold all that the data leave" in capsys.readouterr().err


EXACT = {"quadrotor3d": {"m": "0.486", "jx": "10000/49", "jy": "10000/49", "jz": "1250/11"}}


@pytest.mark.parametrize("length", [[], ["--length", "10"]], ids=["transitions", "runs"])
@pytest.mark.parametrize("name", slow_after(1, ["pendulum", "cartpole", "quadrotor3d"]))
def test_the_examples_find_the_plants_that_ship(
    tmp_path: Path, name: str, length: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, ships = tmp_path / "data.csv", get_system(name).parameters
    monkeypatch.setattr(sys, "argv", ["measure.py", name, str(data), "--transitions", "100", *length])
    runpy.run_path(str(EXAMPLES / "unknown" / "measure.py"), run_name="__main__")
    found = certify.identify(data, EXAMPLES / "unknown" / f"{name}.toml", noise="1e-3", sample_time="0.02")
    true = TRUE if name == "pendulum" else EXACT.get(name) or {p: float(q) for p, q in ships.items()}
    assert len(found.ranges) == 3 + (name == "quadrotor3d")
    assert all(lo <= Fraction(true[p]) <= hi and found.shrink(p) > 5 for p, (lo, hi) in found.ranges.items())
