"""`certify identify --structure linear`: A and B of a plant of which no equation is known, with a declared residual."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import certify
from certify.analysis.identifying.linear import LinearStructure, linear_structure
from certify.certificates.checking import ask
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.plants import load_system
from certify.provers.data import Contradiction
from tests.analysis.test_identify import COLUMNS, EXAMPLES, Array, simulated, write
from tests.support.marks import slow_after

TRUE = {"A21": 9.81 / 0.5, "A22": -0.1 / 0.0375, "B21": 1 / 0.0375}
SECOND = {"theta_dot": "10*theta**2"}
NOISE = "1e-4"


def near(count: int = 80, noise: float = 1e-4, seed: int = 3) -> Array:
    """Transitions near the upright pendulum, (N, 5)."""
    draw = np.random.default_rng(seed)
    x, u = draw.uniform(-1, 1, (count, 2)) * [0.2, 0.4], draw.uniform(-2, 2, (count, 1))
    errors = draw.uniform(-noise, noise, (2, count, 2))
    return np.hstack([x + errors[0], u, simulated(x, u) + errors[1]])


def found(folder: Path, rows: Array, linear: LinearStructure, **more: object) -> certify.IdentifyResult:
    given: dict[str, object] = {"noise": NOISE, "sample_time": "0.02", **more}
    return certify.identify(write(folder / "data.csv", rows), linear, **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", slow_after(2, range(4)))
def test_the_true_linearisation_lies_in_the_ranges(tmp_path: Path, seed: int) -> None:
    result = found(tmp_path, near(seed=seed), LinearStructure(second=SECOND))
    assert list(result.ranges) == list(TRUE)
    for name, (lo, hi) in result.ranges.items():
        assert lo <= Fraction(TRUE[name]) <= hi
        assert hi - lo < Fraction(1, 5) * abs(Fraction(TRUE[name]))
    assert all(lo <= Fraction(TRUE[name]) <= hi for name, (lo, hi) in result.measurements.priors.items())


def test_a_residual_that_is_too_small_is_refuted(tmp_path: Path) -> None:
    """|sin x - x| reaches 0.16 of 19.6 x at 1: with bounds of a tenth no A and B fit."""
    draw = np.random.default_rng(1)
    x, u = draw.uniform(-1, 1, (150, 2)) * [1.5, 0.4], draw.uniform(-2, 2, (150, 1))
    rows = np.hstack([x, u, simulated(x, u)])
    with pytest.raises(Contradiction):
        found(tmp_path, rows, LinearStructure(second={"theta_dot": "0.01*theta**2"}))


@pytest.mark.slow
def test_the_least_share_of_what_is_beyond_the_linear_part(tmp_path: Path) -> None:
    """With two terms, scaled by one factor: the factor that is refuted is refuted as a bound by itself, and a tenth
    more than the one that is open is open by itself, where the series in time may be another."""
    draw, prior = np.random.default_rng(1), {"A21": (0, 40), "A22": (-9, 3), "B21": (10, 50)}
    x, u = draw.uniform(-1, 1, (100, 2)) * [1.5, 0.4], draw.uniform(-2, 2, (100, 1))
    rows, bound = np.hstack([x, u, simulated(x, u)]), "{}*theta**2 + {}*theta*u"

    def of(factor: float) -> certify.IdentifyResult:
        second = {"theta_dot": bound.format(10 * factor, 0.1 * factor)}
        return found(tmp_path, rows, LinearStructure(second=second, prior=prior))  # type: ignore[arg-type]

    (least,) = of(1).least_residual
    assert least.open is not None
    refuted, open_ = least.refuted["theta_dot"], least.open["theta_dot"]
    assert 0.02 < refuted < open_ < 1.1 * refuted < 0.5
    with pytest.raises(Contradiction):
        of(refuted)
    of(1.1 * open_)


def test_the_structure_is_a_plant_of_its_own(tmp_path: Path) -> None:
    linear = LinearStructure(
        second={"theta_dot": "10*theta**2 + 0.1*abs(theta)*u**2"}, prior={"theta_dot": Fraction(40), "A22": (-9, 3)},  # type: ignore[dict-item]
        domain={"theta": Fraction(3)}, input_bounds={"u": Fraction(6)}, without=("theta",),
    )  # fmt: skip
    data, path = write(tmp_path / "data.csv", near()), tmp_path / "structure.toml"
    path.write_text(linear_structure(data, linear, Fraction("0.02"), Fraction(NOISE)))
    plant = load_system(path)
    assert {s.name: str(e) for s, e in zip(plant.states, plant.dynamics, strict=True)}["theta"] == "theta_dot"
    assert plant.ranges["A22"] == (-9, 3) and plant.ranges["B21"] == (-40, 40) and "A21" not in plant.ranges
    assert [w.name for w in plant.disturbances] == ["beyond_theta_dot_1", "beyond_theta_dot_2"]
    assert plant.domain[0] == (-3, 3) and plant.input_bounds == ((-6, 6),)
    assert float(plant.domain[1][1]) >= np.abs(near()[:, 1]).max()
    f = plant.uncertain_function()
    values = dict.fromkeys(plant.ranges, 0.0) | {"beyond_theta_dot_2": 1.0}
    at = np.array([[-0.5, 1.0]]), np.array([[2.0]])
    assert np.allclose(f(*at, list(values.values())), [[1.0, -0.1 * 0.5 * 4]])


@pytest.mark.parametrize("kind", ["rows", "runs", "arrays", "steps"])
def test_files_of_every_form_are_read(tmp_path: Path, kind: str) -> None:
    draw = np.random.default_rng(2)
    x, u = [draw.uniform(-1, 1, (8, 2)) * [0.2, 0.4]], [draw.uniform(-2, 2, (8, 1)) for _ in range(4)]
    for v in u:
        x.append(simulated(x[-1], v))
    states, inputs = np.stack(x, 1), np.stack(u, 1)
    if kind == "arrays":
        np.savez(tmp_path / "data.npz", states=states, inputs=inputs)
        linear = LinearStructure(second=SECOND, states=("theta", "theta_dot"), inputs=("u",))
    elif kind == "steps":
        np.savez(tmp_path / "data.npz", x=x[0], u=u[0], x_next=x[1])
        result = certify.identify(tmp_path / "data.npz", LinearStructure(second={"x2": "x1**2"}), noise="1e-4")
        assert list(result.ranges) == ["A11", "A12", "B11", "A21", "A22", "B21"] and result.system.time == "discrete"
        return
    else:
        rows = np.concatenate(
            [np.column_stack([np.full(5, e), states[e], np.append(inputs[e], inputs[e][-1:], 0)]) for e in range(8)]
        )
        rows = rows if kind == "runs" else rows[:5, 1:]
        write(tmp_path / "data.csv", rows, "run,theta,theta_dot,u" if kind == "runs" else "theta,theta_dot,u")
        linear = LinearStructure(second=SECOND, inputs=("u",))
    data = tmp_path / ("data.npz" if kind == "arrays" else "data.csv")
    result = certify.identify(data, linear, noise="1e-4", sample_time="0.02")
    assert all(lo <= Fraction(TRUE[name]) <= hi for name, (lo, hi) in result.ranges.items())


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ([], "--second for a state at least"),
        (["--second", "omega=theta**2"], "--second names 'omega'; data.csv has theta, theta_dot"),
        (["--second", "theta_dot=speed**2"], "--second of theta_dot"),
        (["--second", "theta_dot"], "takes NAME=VALUE"),
        (["--second", "theta_dot=theta**2", "--prior", "C1=3"], "--prior names 'C1'; there are theta_dot, A21"),
        (["--second", "theta_dot=theta**2", "--without", "p"], "--without names 'p'"),
        (["--second", "theta_dot=theta**2", "--inputs", "force"], "--inputs names 'force'"),
    ],
)
def test_bad_options_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], said: str) -> None:
    data = write(tmp_path / "data.csv", near(8), COLUMNS)
    given = ["identify", str(data), "--structure", "linear", "--noise", NOISE, "--sample-time", "0.02"]
    assert _run([*given, "--out", str(tmp_path / "known.toml"), *more], False) == 2
    assert said in " ".join(capsys.readouterr().err.split())


def test_options_of_another_structure_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write(tmp_path / "data.csv", near(8), COLUMNS)
    plant = str(EXAMPLES / "unknown" / "pendulum.toml")
    given = ["identify", str(data), "--structure", plant, "--noise", NOISE, "--sample-time", "0.02"]
    assert _run([*given, "--second", "theta_dot=theta**2"], False) == 2
    assert "are for the --structure linear" in " ".join(capsys.readouterr().err.split())


def test_data_that_do_not_move_a_state_need_a_prior(tmp_path: Path) -> None:
    rows = near(20)
    rows[:, 2] = 0.0
    with pytest.raises(InputError, match="must move"):
        found(tmp_path, rows, LinearStructure(second=SECOND))


def test_a_plant_without_a_model_is_proved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, known = write(tmp_path / "data.csv", near(), COLUMNS), tmp_path / "known.toml"
    ends = ["--domain", "theta=3.14", "--domain", "theta_dot=20", "--input-bound", "u=6", "--sample-time", "0.02"]
    more = ["--second", "theta_dot=10*theta**2", "--noise", NOISE, "--out", str(known)]
    assert _run(["identify", str(data), "--structure", "linear", *ends, *more], False) == 0
    policy, out = str(EXAMPLES / "policies" / "pendulum.pt"), str(tmp_path / "out")
    loop = ["--policy", policy, "--system", str(known), "--data", str(data), "--out", out]
    assert _run(["roa", *loop, "--candidate", "optimised", "--effort", "0.03"], False) == 0
    assert "for every constant" in capsys.readouterr().out
    assert ask(Path(out) / "certificate.json", "reference")[0] == 0
