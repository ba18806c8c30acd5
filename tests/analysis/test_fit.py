"""`certify fit`: true functions within what is found, and what cannot be asked."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from functools import reduce
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify import RoaResult, certify_roa, compose
from certify.analysis.fitting import linear
from certify.analysis.fitting.grid import Grid, enclosed
from certify.analysis.fitting.linear import Bounds, Contradicted, Sampling, beyond
from certify.analysis.fitting.polynomial import bounded, errors, fitted
from certify.analysis.fitting.possible import require_possible
from certify.analysis.fitting.run import Fitted, fit_plant, structure_in
from certify.analysis.fitting.samples import read_samples
from certify.analysis.stated import stated
from certify.certificates import Certificate, parse_certificate
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.plants import Sampled, Unknown, load_system
from certify.loop.plants.samples import Point
from certify.loop.policies import Policy, PolicyNetwork, save_policy
from certify.report.drawn import page_of
from tests.checker.test_handover import verdicts
from tests.support.marks import slow_after

STRUCTURE = """
name = "box"
states = ["x", "v"]
inputs = ["u"]
[dynamics]
x = "v"
[unknown.v]
"x*x" = 2
"x*v" = 0
"v*v" = 0
"x*u" = 0
"v*u" = 0
"u*u" = 0
[u_eq]
u = 0
[domain]
x = [-1, 1]
v = [-1, 1]
[input_bounds]
u = [-1, 1]
"""


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Grids among scattered samples of fewer points, that a test may end soon."""
    monkeypatch.setattr("certify.analysis.fitting.grid._MOST", 150)


def grid_of(values: Mapping[Point, Fraction], noise: Fraction = Fraction(0)) -> Grid:
    """The grid of samples."""
    axes = tuple(tuple(sorted(set(axis))) for axis in zip(*values, strict=True))
    return Grid(axes, {z: Bounds(y - noise, y + noise, (), ()) for z, y in values.items()})


class Truth:
    """g(z) = a.z + sum_k c_k (cos(w_k.z + s_k) - cos(s_k)), bent by at most sum |c_k| |w_k||w_k|'."""

    def __init__(self, seed: int, noise: float = 0.01) -> None:
        self.draw = np.random.default_rng(seed)
        self.d, self.noise = int(self.draw.integers(1, 4)), noise
        self.a = self.draw.normal(size=self.d)
        self.c, self.w = self.draw.normal(size=2), self.draw.normal(size=(2, self.d))
        self.s = self.draw.uniform(0, 6, 2)
        self.curvature = np.einsum("k,ki,kj->ij", np.abs(self.c), np.abs(self.w), np.abs(self.w))

    def __call__(self, z: np.ndarray) -> np.ndarray:
        return z @ self.a + (np.cos(z @ self.w.T + self.s) - np.cos(self.s)) @ self.c

    def gradient(self) -> np.ndarray:
        return self.a - (self.c * np.sin(self.s)) @ self.w

    def unknown(self, share: float = 1.0) -> Unknown:
        rows = [[Fraction(share * v) + Fraction(1, 10**12) for v in row] for row in self.curvature.tolist()]
        box = ((Fraction(-2), Fraction(2)),) * self.d
        return Unknown("y", tuple(f"z{j}" for j in range(self.d)), tuple(map(tuple, rows)), box)

    def samples(self, scattered: bool = False) -> Sampled:
        """On a grid, or of as many points as variables are worth, half of them close to the origin."""
        points = self.draw.uniform(-2, 2, (20 * self.d, self.d)).round(6) if scattered else self.of_a_grid()
        if scattered:
            points[::2] = (points[::2] * 10 ** self.draw.uniform(-2, 0, (len(points[::2]), 1))).round(6)
        values = self(points) + self.noise * self.draw.choice([-1.0, 1.0], len(points))
        exact = tuple(tuple(map(decimal, z)) for z in points.tolist())
        return Sampled(exact, tuple(map(decimal, values.tolist())))

    def of_a_grid(self) -> np.ndarray:
        inner = [self.draw.uniform(-2, 2, self.draw.integers(0, 3)).round(1) for _ in range(self.d)]
        axes = [np.unique(np.concatenate([axis, [-2, -0.125, 0.125, 2]])) for axis in inner]
        return np.array(list(product(*axes)))


def decimal(v: float) -> Fraction:
    return Fraction(repr(v))


def within(truth: Truth, share: float = 1.0, scattered: bool = False) -> tuple[bool, bool]:
    """True if the polynomial is within its error of g at random points, and if the slopes hold g's."""
    one, noise = truth.unknown(share), Fraction(truth.noise) + Fraction(1, 10**12)
    sampling = Sampling(one, truth.samples(scattered), noise)
    grid = enclosed(sampling)
    p = fitted(one, grid, 5)
    bound = bounded(one, errors(p, one, grid))
    z = truth.draw.uniform(-2, 2, (200, truth.d))
    said = np.array([float(p.at(tuple(map(Fraction, point)))) for point in z.tolist()])
    most = float(bound.constant) + z**2 @ np.array([float(k) for k in bound.rise])
    a = truth.gradient()
    inside = all(
        float(lo) - 1e-9 <= v <= float(hi) + 1e-9 for (lo, hi, *_), v in zip(sampling.slopes(), a, strict=True)
    )
    rest = np.array([float(beyond(one, tuple(map(Fraction, point)))) for point in z.tolist()])
    assert share < 1 or (np.abs(truth(z) - z @ a) <= rest + 1e-9).all()
    return bool((np.abs(truth(z) - said) <= most + 1e-9).all()), inside


@pytest.mark.parametrize("scattered", [False, True])
@pytest.mark.parametrize("seed", slow_after(1, range(60)))
def test_the_truth_is_within_what_is_found(seed: int, scattered: bool) -> None:
    assert within(Truth(seed), scattered=scattered) == (True, True)


@pytest.mark.parametrize("seed", slow_after(10, range(100)))
def test_an_interval_holds_the_truth(seed: int) -> None:
    """At random points of the box, among scattered samples and far from all of them."""
    truth = Truth(seed)
    sampling = Sampling(truth.unknown(), truth.samples(True), Fraction(truth.noise) + Fraction(1, 10**12))
    for z in truth.draw.uniform(-2, 2, (20, truth.d)).round(4):
        lo, hi, *both = sampling.at(tuple(map(decimal, z.tolist())))
        assert float(lo) - 1e-9 <= float(truth(z[None])[0]) <= float(hi) + 1e-9
        assert all(sum(v for _, v in weights) == 1 for weights in both)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [Fraction(1, 10**9), Fraction(10**9)])
def test_an_interval_is_as_sharp_of_small_and_large_values(seed: int, share: Fraction) -> None:
    truth = Truth(seed)
    one, taken, noise = truth.unknown(), truth.samples(True), Fraction(truth.noise)
    rows = tuple(tuple(share * m for m in row) for row in one.curvature)
    scaled = Sampled(taken.points, tuple(share * y for y in taken.values))
    for z in truth.draw.uniform(-2, 2, (5, truth.d)).round(2):
        p = tuple(map(decimal, z.tolist()))
        lo, hi, *_ = Sampling(one, taken, noise).at(p)
        low, high, *_ = Sampling(replace(one, curvature=rows), scaled, share * noise).at(p)
        assert abs((high - low) / share / (hi - lo) - 1) < Fraction(1, 10**6)


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("noise", [Fraction(0), Fraction(1, 100)])
def test_an_interval_is_sharp(seed: int, noise: Fraction) -> None:
    """A quadratic function that bends as much as is declared, and whose samples are off by all the noise, is at the end
    of its interval in the middle of d + 1 samples around it; with less of either it is outside."""
    draw = np.random.default_rng(seed)
    d = int(draw.integers(1, 4))
    M = [Fraction(int(v), 10) for v in draw.integers(1, 50, d)]
    p, sign = tuple(Fraction(int(v), 10) for v in draw.integers(-5, 6, d)), seed % 2 * 2 - 1
    a = draw.integers(-5, 6, d).tolist()
    steps = [tuple(Fraction(int(v), 10) for v in row) for row in draw.integers(1, 9, (d, d)) * np.eye(d, dtype=int)]
    steps.append(tuple(Fraction(-int(v), 10) for v in draw.integers(1, 9, d)))  # with the others around 0
    points = tuple(tuple(map(sum, zip(p, s, strict=True))) for s in steps)
    bend = [sum((m * v * v for m, v in zip(M, s, strict=True)), Fraction(0)) / 2 for s in steps]
    values = tuple(sum((k * v for k, v in zip(a, z, strict=True)), Fraction(0)) + sign * (b + noise)
                   for z, b in zip(points, bend, strict=True))  # fmt: skip
    true = sum((k * v for k, v in zip(a, p, strict=True)), Fraction(0))

    def interval(share: Fraction, off: Fraction) -> Bounds:
        rows = tuple(tuple(share * m * (i == j) for j in range(d)) for i, m in enumerate(M))
        one = Unknown("y", tuple(f"z{j}" for j in range(d)), rows, ((Fraction(-2), Fraction(2)),) * d)
        return Sampling(one, Sampled(points, values), off).at(p)

    found = interval(Fraction(1), noise)
    assert (found.lo if sign > 0 else found.hi) == true
    less = Fraction(1) - Fraction(1, 10**9)
    for share, off in ((less, noise), (Fraction(1), less * noise)):
        lo, hi, *_ = interval(share, off)
        assert (share, off) == (1, noise) or not lo <= true <= hi


def test_understated_bounds_lose_the_truth_or_are_refuted() -> None:
    """The test above can fail: with a tenth of the curvature slopes are lost in some of the seeds."""
    lost = 0
    for seed in range(12):
        try:
            lost += within(Truth(seed, noise=1e-4), share=0.02) != (True, True)
        except Contradicted:
            lost += 1
    assert lost > 4


def test_a_known_error() -> None:
    """g = z^2 on [-1, 1], sampled at both ends and 0, and p = 0: 1 at an end, and 1/8 (2 + 0) within a cell."""
    one = Unknown("y", ("z",), ((Fraction(2),),))
    values = {(Fraction(k),): Fraction(k * k) for k in (-1, 0, 1)}
    grid = grid_of(values, Fraction(1, 100))
    flat = Unknown("y", ("z",), ((Fraction(0),),))
    p = fitted(flat, grid, 1)  # of degree 1 where no curvature is declared
    assert p.coefficients == (Fraction(0),)
    assert set(errors(p, one, grid).values()) == {1 + Fraction(1, 100) + Fraction(1, 4)}


def test_a_bend_is_bounded_on_cells() -> None:
    one = Truth(3).unknown()
    grid = enclosed(Sampling(one, Truth(3).samples(), Fraction(0)))
    p = fitted(one, grid, 5)
    cell = next(iter(errors(p, one, grid)))
    for j in range(len(cell)):
        lo, hi = (np.array([float(pair[k]) for pair in cell]) for k in (0, 1))
        z = np.random.default_rng(0).uniform(lo, hi, (100, len(cell)))
        h = 1e-3 * np.eye(len(cell))[j]
        second = [float(sum(c * p.at(tuple(map(Fraction, q))) for c, q in zip((1, -2, 1), (point - h, point, point + h),
                  strict=True))) / 1e-6 for point in z]  # fmt: skip
        assert max(map(abs, second)) <= float(p.bent(j, cell)) * (1 + 1e-6) + 1e-6


# ------------------------------------------------------------------------------------------------------------ the files


@pytest.fixture
def asked(tmp_path: Path) -> list[str]:
    return box_in(tmp_path)


def box_in(folder: Path) -> list[str]:
    """The command that fits a structure to samples on a grid, and both files."""
    (folder / "box.toml").write_text(STRUCTURE)
    rows = ["x,v,u,v_rate"]
    for x, v, u in product(np.linspace(-1, 1, 9), (-1, 0, 1), (-1, 1)):
        rows.append(f"{x},{v},{u},{float(-2 * np.sin(x) - v + u)!r}")
    (folder / "samples.csv").write_text("\n".join(rows))
    return ["fit", str(folder / "samples.csv"), "--structure", str(folder / "box.toml"), "--noise", "1e-9",
            "--out", str(folder / "out")]  # fmt: skip


def test_two_plants_are_written(asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run([*asked, "--json"], True) == 0
    data = json.loads(capsys.readouterr().out)["unknown"]["v"]
    assert data["samples"] == 54 and float(Fraction(data["largest_error"])) < 0.035
    lo, hi = map(Fraction, data["slopes"]["x"])
    assert lo <= -2 <= hi and hi - lo < 0.6
    far, near = (load_system(tmp_path / "out" / f"{name}.toml") for name in ("far", "near"))
    z = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    true = -2 * np.sin(z[:, 0]) - z[:, 1] + z[:, 2]
    assert np.abs(far.function()(z[:, :2], z[:, 2:])[:, 1] - true).max() < 0.035
    assert [p for p in near.ranges if p.startswith("slope_v_")] == ["slope_v_x", "slope_v_v", "slope_v_u"]
    assert _run(asked, False) == 0
    said = capsys.readouterr().out
    assert "assumed      the bounds of second derivatives and of the noise, as far as a grid of samples or" in said
    assert "beyond       at most 1 x^2\n" in said


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("x,v,u,v_rate", "x,v,w,v_rate", "must have the columns x, v, u, v_rate; u is missing among"),
        ("x,v,u,v_rate", "x,v,u,rate", "Rows of states and inputs alone are for certify identify"),
        ("x,v,u,v_rate", "x,v,u,w_rate", "v_rate is missing among x, v, u, w_rate"),
        ("-1.0,-1,-1,", "-1.0,-1,nan,", "line 2, column u: there must be a finite number; found 'nan'"),
        ("-1.0,-1,-1,", "-1.0,-1,,", "line 2, column u: there must be a finite number; found ''"),
        ("-1.0,-1,-1,", f"-1.{40 * '1'},-1,-1,", "line 2, column x: a number must have some 35 digits"),
    ],
)
def test_samples_that_are_none(
    asked: list[str], capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    path = Path(asked[1])
    path.write_text(path.read_text().replace(old, new, 1))
    assert _run(asked, False) == 2
    assert said in capsys.readouterr().err


def fitted_to(path: Path, asked: list[str]) -> dict[str, Any]:
    """What is found from another file, without its hash."""
    unknowns, system = structure_in(Path(asked[3]))
    taken, sha256 = read_samples(path, unknowns, system)
    assert sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    return taken


def test_files_of_every_form_are_read(asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Decimals of CSV, and of other files what binary64 holds, exactly."""
    pyarrow, parquet = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    names = ["x", "v", "u", "v_rate"]
    rows = np.loadtxt(asked[1], delimiter=",", skiprows=1)
    columns = dict(zip(names, rows.T.tolist(), strict=True))
    parquet.write_table(pyarrow.table(columns), tmp_path / "a.parquet")
    np.savez(tmp_path / "a.npz", **columns)
    rates = np.column_stack([np.zeros(len(rows)), rows[:, 3]])
    np.savez(tmp_path / "b.npz", x=rows[:, :2], u=rows[:, 2:3], x_rate=rates)
    exact = Sampled(
        tuple(tuple(map(Fraction, row[:3])) for row in rows.tolist()), tuple(map(Fraction, columns["v_rate"]))
    )
    for name in ("a.parquet", "a.npz", "b.npz"):
        assert fitted_to(tmp_path / name, asked) == {"v": exact}
    assert fitted_to(Path(asked[1]), asked)["v"].values[0] == Fraction(repr(columns["v_rate"][0]))
    assert _run([asked[0], str(tmp_path / "b.npz"), *asked[2:]], False) == 0
    assert "FITTED  v: 54 samples" in capsys.readouterr().out
    columns["v_rate"][3] = np.nan
    np.savez(tmp_path / "a.npz", **columns)
    with pytest.raises(InputError, match=r"array v_rate: numbers must be finite; found nan at \[3\]"):
        fitted_to(tmp_path / "a.npz", asked)
    np.savez(tmp_path / "a.npz", **columns | {"v_rate": [1.0]})
    with pytest.raises(InputError, match="arrays must have as many rows"):
        fitted_to(tmp_path / "a.npz", asked)


def test_steps_of_runs_are_samples(asked: list[str], tmp_path: Path) -> None:
    """Rows in time order, and arrays of runs: the last row of each has no next one."""
    Path(asked[3]).write_text('time = "discrete"\n' + STRUCTURE)
    x = np.arange(12.0).reshape(2, 3, 2)
    np.savez(tmp_path / "a.npz", states=x, inputs=np.ones((2, 2, 1)))
    rows = [f"{run},{x[run, t, 0]},{x[run, t, 1]},1" for run in range(2) for t in range(3)]
    (tmp_path / "a.csv").write_text("\n".join(["run,x,v,u", *rows]))
    single = [f"{x[r, t, 0]},{x[r, t, 1]},1,{x[r, t + 1, 1]}" for r in range(2) for t in range(2)]
    (tmp_path / "b.csv").write_text("\n".join(["x,v,u,v_next", *single]))
    found = [fitted_to(tmp_path / name, asked)["v"] for name in ("a.npz", "a.csv", "b.csv")]
    assert found[0] == found[1] == found[2]
    assert found[0].values == (3, 5, 9, 11) and found[0].points[1] == (2, 3, 1)


def test_an_environment_is_recorded_into_samples(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Gymnasium's pendulum, whose next velocity is a function that nobody wrote down."""
    pytest.importorskip("gymnasium")
    structure = STRUCTURE.replace('"x*x" = 2', '"x*x" = 0.76')
    given = ["fit", "--env", "Pendulum-v1", "--episodes", "2", "--observed", "cos(x),sin(x),v", "--noise", "1e-5"]
    given += [*asked[2:4], "--out", str(tmp_path / "out")]
    Path(asked[3]).write_text(structure)
    assert _run(given, False) == 2 and 'write time = "discrete"' in capsys.readouterr().err
    Path(asked[3]).write_text('time = "discrete"\n' + structure)
    assert _run([*given, "--json"], True) == 0
    found = json.loads(capsys.readouterr().out)
    raw = (tmp_path / "out" / "samples.csv").read_bytes()
    assert found["data"]["sha256"] == hashlib.sha256(raw).hexdigest()
    for name, true in (("x", 0.75), ("v", 1), ("u", 0.15)):
        lo, hi = map(Fraction, found["unknown"]["v"]["slopes"][name])
        assert lo <= true <= hi
    assert _run([*given[:1], asked[1], *given[1:]], False) == 2 and "one of the two" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"x*v" = 0\n', "", "there must be a bound for each pair"),
        ('"x*v" = 0', '"x*w" = 0', "must be two states or inputs"),
        ('"x*v" = 0', '"x*v" = -1', "must be at least 0, and stand once"),
        ('"x*v" = 0', '"x*v" = 1e40', "must have some 35 digits at most"),
        ('"x*v" = 0', '"x*v" = 0\n"v*x" = 1', "must be at least 0, and stand once"),
        ("[unknown.v]", "[unknown.y]", "is no state"),
        ('x = "v"', 'x = "v"\nv = "u"', "not both"),
        ("u = 0\n[domain]", "u = 1\n[domain]", "must have x_eq and u_eq 0"),
        (
            "x = [-1, 1]",
            f"x = ['-1.{40 * '0'}1', '1']",
            "domain and the input bounds of x, v, u must have some 35 digits",
        ),
    ],
)
def test_structures_that_are_none(
    asked: list[str], capsys: pytest.CaptureFixture[str], old: str, new: str, said: str
) -> None:
    path = Path(asked[3])
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new, 1))
    assert _run(asked, False) == 2
    assert said in capsys.readouterr().err


def test_a_structure_is_no_plant_by_itself(asked: list[str]) -> None:
    """Nobody proves anything of a plant whose unknown functions are left out."""
    with pytest.raises(ValueError, match="unknown"):
        load_system(Path(asked[3]))


@pytest.mark.parametrize("change", [("2", "1/100"), ("1", "0")])
def test_samples_that_refute_the_bounds(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], change: tuple[str, str]
) -> None:
    path = Path(asked[3])
    if change[0] == "2":
        path.write_text(path.read_text().replace('"x*x" = 2', '"x*x" = 0.01'))
    else:  # the origin is no equilibrium
        samples = Path(asked[1])
        rows = [row.rsplit(",", 1) for row in samples.read_text().splitlines()[1:]]
        samples.write_text("x,v,u,v_rate\n" + "\n".join(f"{z},{float(y) + 3!r}" for z, y in rows))
    assert _run(asked, False) == 1
    said = (
        "REFUTED  these samples refute the bounds of second derivatives and of the noise, or that 0 is an equilibrium"
    )
    assert capsys.readouterr().out.startswith(said)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("z", "said"),
    [((0, 0, 0), "v is 0.5 away from 0 at the origin"), ((0.75, 0, 1), "v bends more along x around x = ")],
)
def test_one_sample_that_refutes_the_bounds(
    asked: list[str], capsys: pytest.CaptureFixture[str], z: tuple[float, float, float], said: str
) -> None:
    """No slope at the origin rests on it: all that was proved of such samples would be of no function at all."""
    rows = ["x,v,u,v_rate"]
    for x, v, u in product(np.linspace(-1, 1, 9), (-1, 0, 1), (-1, 0, 1)):
        rows.append(f"{x},{v},{u},{float(-2 * np.sin(x) - v + u) + 0.5 * ((x, v, u) == z)!r}")
    Path(asked[1]).write_text("\n".join(rows))
    assert _run(asked, False) == 1
    assert said in capsys.readouterr().out


def scattered_rows(count: int, off: float = 0.0) -> str:
    """Samples of the same function at random points, the first of which is off by so much."""
    z = np.random.default_rng(0).uniform(-1, 1, (count, 3)).round(4)
    z[::2] = (z[::2] / 10).round(4)
    y = -2 * np.sin(z[:, 0]) - z[:, 1] + z[:, 2]
    y[0] += off
    return "\n".join(["x,v,u,v_rate", *(",".join(map(repr, row)) for row in np.column_stack([z, y]).tolist())])


@pytest.mark.slow
def test_scattered_samples(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """What is missing is said in both forms; of samples beyond the domain nothing is assumed, and they are left out."""
    Path(asked[1]).write_text(scattered_rows(60) + "\n7,0,0,123\n0,0,-1.001,5\n")
    assert _run([*asked, "--json"], True) == 0
    data = json.loads(capsys.readouterr().out)["unknown"]["v"]
    assert (data["samples"], data["left_out"]) == (60, 2) and data["grid"] > 8 and data["missing"]
    lo, hi = map(Fraction, data["slopes"]["x"])
    assert lo <= -2 <= hi and hi - lo < 0.6
    assert _run(asked, False) == 0
    said = capsys.readouterr().out
    assert "left out     2 samples beyond the domain or the input bounds" in said
    assert "missing      samples near x = " in said
    assert f"try next     {len(data['missing'])} more, at points that --json names" in said


@pytest.mark.slow
def test_more_samples_where_they_are_missing_help_as_much_as_is_said(asked: list[str], tmp_path: Path) -> None:
    def found() -> Fitted:
        return fit_plant(Path(asked[1]), Path(asked[3]), lambda _: Fraction(1, 10**9), tmp_path / "out").found[0]

    Path(asked[1]).write_text(scattered_rows(40))
    before = found()
    assert before.missing.largest is not None and before.missing.largest <= float(before.largest) / 2
    z = np.array([[float(v) for v in p] for p in before.missing.points])
    y = -2 * np.sin(z[:, 0]) - z[:, 1] + z[:, 2]
    more = [",".join(map(repr, row)) for row in np.column_stack([z, y]).tolist()]
    Path(asked[1]).write_text("\n".join([scattered_rows(40), *more]))
    assert float(found().largest) < 1.1 * before.missing.largest


@pytest.mark.parametrize("off", [0.5, -3.0])
def test_a_scattered_sample_that_refutes_the_bounds(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], off: float
) -> None:
    Path(asked[1]).write_text(scattered_rows(80, off))
    assert _run(asked, False) == 1
    said = capsys.readouterr().out
    first = scattered_rows(1).splitlines()[1].split(",")
    assert "are consistent with the samples" in said and ", ".join(first[:3]) in said
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (["7,0,0,1", "8,0,0,1"], "no sample of v lies in the domain and the input bounds"),
        (["0.5,0,0,1", "0.25,0.5,0,1"], "take some near it along each variable"),
        ([f"{x},{2 * x},0,{x}" for x in (-0.5, 0.25, 0.125, 0.5)], "take some near it along each variable"),
    ],
)
def test_scattered_samples_that_bound_nothing(
    asked: list[str], capsys: pytest.CaptureFixture[str], rows: list[str], said: str
) -> None:
    Path(asked[1]).write_text("\n".join(["x,v,u,v_rate", *rows]))
    assert _run(asked, False) == 2
    assert said in capsys.readouterr().err


def test_more_samples_than_a_certificate_holds(
    asked: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Commas and brackets of a file are 10^6 at most; a sample of three variables and its weights have some 15."""
    monkeypatch.setattr("certify.analysis.fitting.samples._MOST_PARTS", 15 * 20)
    assert _run(asked, False) == 2
    assert "must be of 1 to 20 rows; found 54" in capsys.readouterr().err


@pytest.mark.parametrize("noise", ["1e400", "1e-40", "-1", "v=1,v=2", "x=1"])
def test_bounds_of_the_noise_that_are_none(asked: list[str], capsys: pytest.CaptureFixture[str], noise: str) -> None:
    asked[asked.index("--noise") + 1] = noise
    assert _run(asked, False) == 2
    said = {
        "1e400": "below 1.8e308",
        "1e-40": "some 35 digits at most",
        "-1": "at least 0",
        "v=1,v=2": "found v twice",
        "x=1": "a bound for v",
    }[noise]
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("M", [Fraction(2), Fraction(1, 3)])
@pytest.mark.parametrize("noise", [Fraction(0), Fraction(1, 10)])
def test_samples_may_bend_as_much_as_is_declared(M: Fraction, noise: Fraction) -> None:
    """M z^2/2 on a grid of other steps, each sample off by all the noise, in turn; a bit less of either is refuted."""
    axis = tuple(Fraction(k, 10) for k in (-10, -6, -5, 1, 2, 10))
    values = {(z,): M * z * z / 2 + noise * (-1) ** k for k, z in enumerate(axis)}
    grid, less = grid_of(values), Fraction(1, 10**12)
    require_possible(Unknown("y", ("z",), ((M,),)), grid, noise)
    for bent, off in ((M - less, noise), (M, noise - less)):
        if off >= 0:
            with pytest.raises(Contradicted, match="bends more along z"):
                require_possible(Unknown("y", ("z",), ((bent,),)), grid, off)


@pytest.mark.parametrize("M", [Fraction(2), Fraction(1, 3)])
@pytest.mark.parametrize("noise", [Fraction(0), Fraction(1, 10)])
def test_samples_may_bend_along_two_variables_as_much_as_is_declared(M: Fraction, noise: Fraction) -> None:
    """M y z, and beside it 5 x, with all the noise at the corners of the whole grid against each other. Of noise no
    rectangle but the largest shows that a bound is a bit too small."""
    x, y, z = (
        (Fraction(-1), Fraction(2)),
        tuple(map(Fraction, (-3, -1, 0, 1, 4))),
        tuple(map(Fraction, (-2, 0, 1, 5))),
    )
    values = {
        (a, b, c): 5 * a + M * b * c + noise * ((b in (-3, 4)) and (c in (-2, 5))) * (1 if b * c > 0 else -1)
        for a, b, c in product(x, y, z)
    }
    grid, less = grid_of(values), Fraction(1, 10**6)

    def asked(bent: Fraction, off: Fraction) -> None:
        along = ((0, 0, 0), (0, 10, bent), (0, bent, 10))
        one = Unknown("v", ("x", "y", "z"), tuple(tuple(map(Fraction, row)) for row in along))
        require_possible(one, grid, off)

    asked(M, noise)
    for bent, off in ((M - less, noise), (M, noise - less)):
        if off >= 0:
            where = "x = -1, y = -3, z = -2 to x = -1, y = 4, z = 5" if noise else ""
            with pytest.raises(Contradicted, match=f"v bends more along y and z from {where}"):
                asked(bent, off)


@pytest.mark.slow
def test_three_states_from_samples_to_one_claim(tmp_path: Path) -> None:
    """x' = y, y' = v, v' = 3 sin x - y - v + u, of which |g_xx| <= 3 is declared and that all else is linear."""
    text = STRUCTURE.replace('["x", "v"]', '["x", "y", "v"]').replace('x = "v"', 'x = "y"\ny = "v"')
    text = text.replace('"x*x" = 2', '"x*x" = 3\n' + "".join(f'"{a}*y" = 0\n' for a in "xyvu"))
    text = text.replace("x = [-1, 1]\nv = [-1, 1]", "x = [-1.5, 1.5]\ny = [-2, 2]\nv = [-4, 4]").replace(
        "u = [-1, 1]", "u = [-30, 30]"
    )
    (tmp_path / "box.toml").write_text(text)

    def g(z: np.ndarray) -> np.ndarray:
        return 3 * np.sin(z[:, 0]) - z[:, 1] - z[:, 2] + z[:, 3]

    axis = [-1.5, -1.2, -0.9, -0.6, -0.3, -0.05, 0, 0.05, 0.3, 0.6, 0.9, 1.2, 1.5]
    points = np.array(list(product(axis, (-2, 2), (-4, 4), (-30, 30))))
    rows = [",".join(map(repr, row)) for row in np.column_stack([points, g(points)]).tolist()]
    (tmp_path / "samples.csv").write_text("\n".join(["x,y,v,u,v_rate", *rows]))
    fit_plant(tmp_path / "samples.csv", tmp_path / "box.toml", lambda _: Fraction(1, 10**9), tmp_path)
    W = -np.array([[11.0, 10.0, 5.0]]) / 30
    policy = Policy(PolicyNetwork.of_layers([W], [np.zeros(1)], [30.0], [0.0], centre="none"), "box", {})
    save_policy(tmp_path / "box.pt", policy)
    kinds = {"far": "practical", "near": "asymptotic"}
    for name, claim in kinds.items():
        result = certify_roa(tmp_path / f"{name}.toml", tmp_path / "box.pt", tmp_path / name, claim=claim,
                             candidate="lyapunov", data=tmp_path / "samples.csv")  # fmt: skip
        assert result.verdict == "PROVED", result.reason
    both = compose(*(tmp_path / name / "certificate.json" for name in kinds), tmp_path / "both")
    assert both.verdict == "PROVED" and (both.checker or {})["result"] == "ACCEPTED", both.reason
    assert (both.to_dict()["samples"] or {})["functions"][0]["samples"] == len(points)
    assert both.outer.roa > 2 * both.outer.claim.levels["floor"]
    draw = np.random.default_rng(0).normal(size=(200, 3))
    x = draw * np.sqrt(both.outer.roa / np.einsum("ki,ij,kj->k", draw, both.outer.P, draw))[:, None]
    for _ in range(6000):
        u = 30 * np.tanh(x @ W.T)
        x = x + 0.005 * np.column_stack([x[:, 1], x[:, 2], g(np.hstack([x, u]))])
    assert np.abs(x).max() < 1e-3


@pytest.mark.parametrize("seed", range(20))
def test_a_contradiction_is_shown_in_rationals(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Samples of a function that bends more than is said are refuted; those that a slip of the linear program refutes,
    here one that is feigned, are not."""
    truth = Truth(seed, noise=1e-6)
    taken = truth.samples()
    with pytest.raises(Contradicted, match="are consistent with the samples"):
        Sampling(truth.unknown(1e-4), taken, Fraction(1, 10**6)).slopes()
    solve = linear.linprog

    def slips(cost: np.ndarray, **given: object) -> object:
        found = solve(cost, **given)
        found.status = 2 if np.abs(cost[:-1]).any() or len(cost) == truth.d else found.status
        return found

    monkeypatch.setattr(linear, "linprog", slips)
    with pytest.raises(InputError, match="cannot be bounded"):
        Sampling(truth.unknown(), taken, Fraction(1, 10**6) + Fraction(1, 10**12)).slopes()


# ------------------------------------------------------------------------------------------- samples as part of a claim


@pytest.fixture
def fitted_box(asked: list[str], tmp_path: Path) -> Path:
    """The folder with both plants of the box, its samples and a policy."""
    return fitted_in(tmp_path, asked)


def fitted_in(folder: Path, asked: list[str]) -> Path:
    assert _run(asked, False) == 0
    policy = PolicyNetwork.of_layers([np.array([[0.5, 0.5]])], [np.zeros(1)], [-1.0], [0.0], centre="none")
    save_policy(folder / "box.pt", Policy(policy, "box", {}))
    return folder


@pytest.fixture(scope="module")
def once(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, RoaResult]]:
    """Such a folder with a certificate about each plant, and the results."""
    folder = tmp_path_factory.mktemp("box")
    fitted_in(folder, box_in(folder))
    return folder, {name: proved(folder, name, claim=claim) for name, claim in CLAIMS}


@pytest.fixture
def certified(once: tuple[Path, dict[str, RoaResult]], tmp_path: Path) -> Path:
    """A copy of the folder, which a test may change."""
    return shutil.copytree(once[0], tmp_path / "certified")


CLAIMS = (("far", "practical"), ("near", "asymptotic"))


def proved(folder: Path, name: str, **more: Any) -> RoaResult:
    options = {"data": folder / "samples.csv", "candidate": "lyapunov", "effort": 0.05} | more
    return certify_roa(folder / "out" / f"{name}.toml", folder / "box.pt", folder / name, **options)


def test_samples_are_a_part_of_the_claim(
    once: tuple[Path, dict[str, RoaResult]], certified: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of both certificates and of the two joined; both checkers are asked."""
    for name, zero in (("far", False), ("near", True)):
        result = once[1][name]
        assert result.verdict == "PROVED", result.reason
        assert (result.checker or {})["reference"]["result"] == "ACCEPTED"
        said = result.to_dict()["samples"]
        assert said["functions"][0]["samples"] == 54 and said["functions"][0]["vanishes"] is zero
        assert dict(stated(result))["for every"] == "function v′ = g(x, v, u) with which 54 samples are consistent"
        raw = (certified / name / "certificate.json").read_bytes()
        c = parse_certificate(raw, name)
        again = Certificate(c.system, c.network, c.V, c.claim, c.evidence, c.provenance, c.data).document()
        assert {**again, "provenance": {}} == {**json.loads(raw), "provenance": {}}
        page = page_of(raw, certified / name / "certificate.json", dict(result.checker or {}), None)
        assert "For every function v′ = g(x, v, u) with which 54 samples are consistent" in page
        assert "The equation stands for v′ = g(x, v, u): whatever the function is" in page
        assert ("and 0 at the origin" in page) is zero and "a corner between two samples" in page
    paths = [str(certified / name / "certificate.json") for name in ("far", "near")]
    assert _run(["compose", *paths, "--out", str(certified / "both")], False) == 0
    said = capsys.readouterr().out
    assert "for every function v′ = g(x, v, u) with which 54 samples are consistent, every trajectory" in said
    assert "checker      ACCEPTED, reference ACCEPTED" in said


NAMES = {"slope_v_x": "a", "slope_v_v": "b", "slope_v_u": "c", "residual_v": "r"}


@pytest.mark.slow
def test_pages_show_quantities_of_any_names(certified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Numbers are as the checkers see them, whatever operating point a file says to people; that a function is 0 at 0
    is a part of the claim, which needs no slopes."""
    page, paths = certified / "page.html", list[str]()
    for name, _ in CLAIMS:
        path = certified / name / "certificate.json"
        own = reduce(lambda text, names: text.replace(*map(str.encode, names)), NAMES.items(), path.read_bytes())
        path.write_bytes(own)
        paths.append(str(path))
        data = json.loads(own)
        data["claim"]["samples"]["functions"][0]["vanishes"] = True
        data["provenance"]["x_eq"] = {"x": "1"}
        changed = certified / f"{name}.json"
        changed.write_text(json.dumps(data))
        assert verdicts(data) == (None, None)
        c = parse_certificate(changed.read_bytes(), name)
        assert {**c.document(), "provenance": {}} == {**data, "provenance": {}}
        assert _run(["report", str(changed), "--out", str(page)], False) == 0
        said = page.read_text()
        assert "For every function v′ = g(x, v, u) with which 54 samples are consistent" in said
        assert "and 0 at the origin" in said and "range of r" not in said
        assert _run(["contains", str(changed), "x=0.5"], False) == 0
        assert "CONTAINED  x = 0.5, v = 0" in capsys.readouterr().out
    assert _run(["compose", *paths, "--out", str(certified / "both")], False) == 0
    assert "for every function v′ = g(x, v, u) with which 54 samples are consistent" in capsys.readouterr().out


@pytest.mark.slow
def test_scattered_samples_are_a_part_of_the_claim(
    asked: list[str], fitted_box: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two at the same point, and two that are left out, among them."""
    Path(asked[1]).write_text(scattered_rows(120) + "\n0,0,0,1e-10\n0,0,0,0\n7,0,0,123\n0,0,-1.001,5\n")
    assert _run(asked, False) == 0
    for name, claim in (("far", "practical"), ("near", "asymptotic")):
        result = proved(fitted_box, name, claim=claim)
        assert result.verdict == "PROVED", result.reason
        assert (result.checker or {})["reference"]["result"] == "ACCEPTED"
        assert dict(stated(result))["for every"] == "function v′ = g(x, v, u) with which 122 samples are consistent"
        raw = (fitted_box / name / "certificate.json").read_bytes()
        c = parse_certificate(raw, name)
        again = Certificate(c.system, c.network, c.V, c.claim, c.evidence, c.provenance, c.data).document()
        assert {**again, "provenance": {}} == {**json.loads(raw), "provenance": {}}
    paths = [str(fitted_box / name / "certificate.json") for name in ("far", "near")]
    assert _run(["compose", *paths, "--out", str(fitted_box / "both")], False) == 0
    assert "for every function v′ = g(x, v, u) with which 122 samples are consistent" in capsys.readouterr().out


@pytest.mark.slow
def test_the_error_may_count_more_near_the_origin(
    asked: list[str], fitted_box: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The plant's file says so, and the grid is chosen again as it was."""
    monkeypatch.setattr("certify.analysis.fitting.grid._MOST", 120)
    Path(asked[1]).write_text(scattered_rows(120))
    constants = []
    for power in ("0", "2"):
        assert _run([*asked, "--near-origin", power], False) == 0
        said = (fitted_box / "out" / "far.toml").read_text()
        assert ("near_origin = 2" in said) is (power == "2")
        constants.append(float(Fraction(re.findall(r'"\(([0-9/]+)\)', said.split("[residual]")[1])[0])))
    assert constants[1] < 0.9 * constants[0]
    result = proved(fitted_box, "far", claim="practical")
    assert result.verdict == "PROVED" and (result.checker or {})["reference"]["result"] == "ACCEPTED"
    assert _run([*asked, "--near-origin", "-1"], False) == 2


@pytest.mark.slow
def test_two_that_are_of_other_plants_are_not_joined_in_words(
    certified: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second has another known equation: then the words are of plants that are one of both."""
    near = certified / "out" / "near.toml"
    near.write_text(near.read_text().replace('x = "v"', 'x = "v*9/10"'))
    assert proved(certified, "near").verdict == "PROVED"
    paths = [str(certified / name / "certificate.json") for name in ("far", "near")]
    assert _run(["compose", *paths, "--out", str(certified / "both")], False) == 0
    assert "of every plant that is one of both" in capsys.readouterr().out


@pytest.mark.slow
def test_two_of_other_samples_are_not_joined_in_words(certified: Path) -> None:
    """Both state the same sha256, which nobody compares with the numbers; in the second those are others where no slope
    rests on them. A function near these is far from the samples of the first, and that claims nothing of it."""
    far, near = (certified / name / "certificate.json" for name in ("far", "near"))
    assert compose(far, near, certified / "same").to_dict()["samples"] is not None
    data = json.loads(near.read_bytes())
    rests = {k for ends in data["evidence"]["samples"][0]["weights"] for end in ends for k, _ in end}
    values = data["claim"]["samples"]["functions"][0]["values"]
    values[next(k for k in range(len(values)) if k not in rests)] = "5"
    near.write_text(json.dumps(data))
    both = compose(far, near, certified / "both")
    assert both.verdict == "PROVED" and both.to_dict()["samples"] is None


@pytest.mark.parametrize("name", ["far", "near"])
def test_equations_may_be_taken_as_they_stand(fitted_box: Path, name: str) -> None:
    result = proved(fitted_box, name, data=None, claim="practical" if name == "far" else "asymptotic")
    assert result.verdict == "PROVED" and "are taken as they stand" in str(result.notice)
    assert result.to_dict()["samples"] is None
    assert "samples" not in json.loads((fitted_box / name / "certificate.json").read_bytes())["claim"]


def test_claims_by_default_have_samples(fitted_box: Path) -> None:
    """Where the origin need not rest, a nearby equilibrium is not looked for: what the residual is depends on x."""
    result = proved(fitted_box, "far", claim="auto")
    assert result.verdict == "PROVED" and result.claim == "practical", result.reason


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("far", 'v = "(', 'v = "(1/100000) + (', "holds all that the samples allow"),
        ("far", 'v = "(', 'v = "sin(x)*0 + (', "must have a polynomial"),
        ("far", 'v = "(', 'v = "residual_v*x + (', "a number and squares of variables"),
        ("far", 'noise = { v = "1/1000000000" }', 'noise = { v = "1" }', "holds all that the samples allow"),
        ("far", '"x*x" = 2', '"x*x" = 3', "holds all that the samples allow"),
        ("far", "x = [-1, 1]", "x = [-2, 1]", "x must lie in [-1, 1], where the bounds"),
        ("far", 'sha256 = "', 'sha256 = "00', "must be 64 hexadecimal digits"),
        ("far", "noise = {", "nose = {", "is no entry of a plant's samples"),
        ("far", 'v = "1/', 'w = "1/', "is no unknown function"),
        ("near", "slope_v_x = [-2", "slope_v_x = [-1.9", "the range of slope_v_x must hold"),
        ("near", "slope_v_x*x", "slope_v_x*x*2", "must have the sum of slopes times variables"),
        ("near", '"x*x" = 2', '"x*x" = 3', "must have a bound [residual]"),
    ],
)
def test_files_that_were_changed(fitted_box: Path, name: str, old: str, new: str, said: str) -> None:
    path = fitted_box / "out" / f"{name}.toml"
    assert old in path.read_text()
    path.write_text(re.sub(r"(-1\.9)[.0-9]*,", r"\1,", path.read_text().replace(old, new, 1)))
    with pytest.raises(InputError, match=re.escape(said)):
        proved(fitted_box, name, claim="practical" if name == "far" else "asymptotic")


def test_axes_may_have_numbers_of_many_digits(asked: list[str], fitted_box: Path) -> None:
    """Both checkers expand a polynomial of high degree around them."""
    rows, ends = ["x,v,u,v_rate"], (-1.4142135623730951, 1.4142135623730951)
    for x, v, u in product(np.linspace(-2 * np.pi / 3, 2 * np.pi / 3, 17).tolist(), ends, ends):
        rows.append(f"{x!r},{v!r},{u!r},{float(-2 * np.sin(x) - v + u)!r}")
    Path(asked[1]).write_text("\n".join(rows))
    assert _run([*asked, "--degree", "14"], False) == 0
    result = proved(fitted_box, "far", claim="practical")
    assert result.verdict == "PROVED" and (result.checker or {})["reference"]["result"] == "ACCEPTED"


def test_samples_without_noise_of_what_does_not_bend(asked: list[str], tmp_path: Path, fitted_box: Path) -> None:
    """Of these the polynomial is exact: nothing of the equation is uncertain, and far and near may be asymptotic."""
    (tmp_path / "box.toml").write_text(STRUCTURE.replace('"x*x" = 2', '"x*x" = 0'))
    rows = [f"{x},{v},{u},{u - v - 2 * x}" for x, v, u in product((-1, 1), repeat=3)]
    Path(asked[1]).write_text("\n".join(["x,v,u,v_rate", *rows]))
    asked[asked.index("--noise") + 1] = "0"
    assert _run(asked, False) == 0
    for name in ("far", "near"):
        result = proved(fitted_box, name, claim="asymptotic")
        assert result.verdict == "PROVED" and (result.checker or {})["reference"]["result"] == "ACCEPTED"
    claim = json.loads((fitted_box / "far" / "certificate.json").read_bytes())
    assert claim["plant"]["uncertain"] == [] and claim["evidence"]["samples"][0]["error"] is None


def test_other_samples_are_refused(fitted_box: Path) -> None:
    path = fitted_box / "samples.csv"
    path.write_text(path.read_text() + "\n")
    with pytest.raises(InputError, match="must be the one to which the plant was fitted"):
        proved(fitted_box, "far", claim="practical")


def test_a_nearby_equilibrium_is_no_claim_with_samples(fitted_box: Path) -> None:
    with pytest.raises(InputError, match="leave out `data`"):
        proved(fitted_box, "near", claim="nearby")


@pytest.mark.parametrize("bias", [0.01, -0.02])
def test_a_policy_that_is_not_0_at_0(fitted_box: Path, bias: float) -> None:
    """V stays around 0, where the samples are; a policy with an origin of its own is refused."""
    policy = PolicyNetwork.of_layers([np.array([[0.5, 0.5]])], [np.full(1, bias)], [-1.0], [0.0], centre="none")
    save_policy(fitted_box / "box.pt", Policy(policy, "box", {}))
    assert proved(fitted_box, "far", claim="auto").verdict == "PROVED"
    moved = replace(policy, origin=np.array([0.1, 0.0]))
    with pytest.raises(InputError, match="must be around x = 0"):
        certify_roa(load_system(fitted_box / "out" / "far.toml"), moved, fitted_box / "far", claim="practical",
                    data=fitted_box / "samples.csv")  # fmt: skip


def test_an_angle_is_no_number(fitted_box: Path) -> None:
    path = fitted_box / "out" / "near.toml"
    path.write_text(path.read_text() + '\n[angles]\nx = "2*pi"\n')
    with pytest.raises(InputError, match="must have x as a number"):
        proved(fitted_box, "near")


def test_coq_takes_no_samples(certified: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = str(certified / "near" / "certificate.json")
    assert _run(["prove-in-coq", path, "--out", str(certified / "coq")], False) == 2
    assert "Coq's statement covers; found" in capsys.readouterr().err
