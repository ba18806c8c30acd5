"""`certify identify --rotate`: data of a closed loop bound sums of parameters, and axes along these are claimed of."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import certify
from certify.certificates.checking import ask
from certify.certificates.reading import read_certificate
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.plants import Axis, Measurements, System, load_system
from certify.loop.plants.axes import axes_of, sums_of
from certify.loop.policies import load_policy
from certify.provers import data as provers_data
from certify.report.identified import page, sums_along
from tests.analysis.test_identify import POLICY, STRUCTURE, TRUE, Array, command, holds, identified, simulated, write

WIDE = STRUCTURE.replace("[10, 30]", "[2, 100]").replace("[1, 4]", "[0.1, 20]").replace("[10, 50]", "[5, 200]")
ROW = tuple[Fraction, ...]


def under_the_policy(count: int = 120, noise: float = 1e-3, seed: int = 0) -> Array:
    """Transitions of the shipped loop near the origin, (N, 5): u is nearly -K x in all of them."""
    draw, network = np.random.default_rng(seed), load_policy(POLICY).network
    x = draw.uniform(-1, 1, (count, 2)) * [0.1, 0.3]
    u = np.array([np.ravel(network(row, [Fraction(0)])) for row in x])
    errors = draw.uniform(-noise, noise, (2, count, 2))
    return np.hstack([x + errors[0], u, simulated(x, u) + errors[1]])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("rotated")


@pytest.fixture(scope="module")
def found_in(folder: Path) -> dict[str, certify.IdentifyResult]:
    """What is found of the data in a folder, along axes and without, by the name of the file that says it."""
    (folder / "structure.toml").write_text(WIDE)
    data, structure = write(folder / "data.csv", under_the_policy()), folder / "structure.toml"
    options = {"noise": "1e-3", "sample_time": "0.02"}
    return {
        name: certify.identify(data, structure, out=folder / f"{name}.toml", rotate=rotate, **options)  # type: ignore[arg-type]
        for name, rotate in (("known", True), ("boxed", False))
    }


@pytest.fixture(scope="module")
def known(folder: Path, found_in: dict[str, certify.IdentifyResult]) -> Path:
    """The folder with a plant along axes, the same without, and their data."""
    return folder


def proved(folder: Path, name: str) -> certify.RoaResult:
    data = folder / "data.csv"
    return certify.certify_roa(
        folder / f"{name}.toml", POLICY, folder / name, data=data, candidate="lyapunov", effort=0.2
    )


@pytest.fixture(scope="module")
def along_axes(known: Path) -> certify.RoaResult:
    return proved(known, "known")


@pytest.mark.slow
def test_axes_prove_what_ranges_do_not(known: Path, along_axes: certify.RoaResult) -> None:
    assert proved(known, "boxed").verdict == "UNKNOWN"
    found = along_axes
    assert found.verdict == "PROVED" and found.volume is not None and found.volume > 190
    certificate = known / "known" / "certificate.json"
    for program in ("checker", "reference"):
        assert ask(certificate, program)[1]["result"] == "ACCEPTED"
    assert "constant a in [2, 100], b in [0.1, 20] and c in [5, 200] with which" in found._repr_html_()
    again = read_certificate(certificate).system
    assert (
        again.measurements is not None
        and again.measurements.axes == load_system(known / "known.toml").measurements.axes
    )  # type: ignore[union-attr]


def test_the_plant_along_axes_is_the_plant(known: Path) -> None:
    """At any parameters, the axes that belong to them give the same equations; the truth lies within [-1, 1]."""
    turned, plain = load_system(known / "known.toml"), load_system(known / "boxed.toml")
    data = turned.measurements
    assert data is not None and list(turned.ranges) == ["axis_1", "axis_2", "axis_3"] == list(data.constants)
    assert not {*turned.parameters} & {*data.priors} and not turned.positive
    x, u = np.array([[0.3, -1.0], [2.0, 5.0]]), np.array([[1.0], [-2.0]])
    for p in (list(map(Fraction, TRUE.values())), [Fraction(7), Fraction(1, 3), Fraction(90)]):
        q = [axis.at + sum(s * v for s, v in zip(axis.by, p, strict=True)) for axis in data.axes]
        f, g = turned.uncertain_function(), plain.uncertain_function()
        assert np.allclose(f(x, u, list(map(float, q))), g(x, u, list(map(float, p))), rtol=1e-9)
        assert all(abs(v) <= 1 for v in q) is (p[0] > 10)
    assert axes_of(sums_of(data.axes)) == data.axes


def test_axes_are_much_closer_than_ranges(found_in: dict[str, certify.IdentifyResult]) -> None:
    found, plain = found_in["known"], found_in["boxed"]
    assert found.smaller > 10 and holds(found)
    assert found.to_dict()["axes"]["smaller"] == found.smaller and len(found.to_dict()["axes"]["sums"]) == 3
    assert plain.smaller == 1 and plain.to_dict()["axes"]["sums"] == {} and plain.system.ranges == plain.known.ranges
    assert plain.ranges == found.ranges


@pytest.mark.slow
def test_axes_that_do_not_hold_all_that_is_left_go(
    tmp_path: Path, found_in: dict[str, certify.IdentifyResult], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where ranges are 1e8 times narrower than their priors, and the axes' ends round inside."""
    plain = found_in["boxed"]
    identify, asked = provers_data.identify, list[tuple[Axis, ...]]()

    def wider(system: System, measurements: Measurements, **how: Any) -> Any:
        found = identify(system, measurements, **how)
        asked.append(measurements.axes)
        return replace(found, turned={name: (lo, 1 + hi) for name, (lo, hi) in found.turned.items()})

    monkeypatch.setattr(provers_data, "identify", wider)
    found = identified(tmp_path, under_the_policy(), WIDE, rotate=True)
    assert [bool(axes) for axes in asked] == [False, True]
    assert found.smaller == 1 and found.system.measurements is not None and found.system.measurements.axes == ()
    assert found.system.ranges == plain.system.ranges


def test_one_parameter_has_no_other_axis(tmp_path: Path) -> None:
    text = STRUCTURE.replace("a = [10, 30]", "a = 19.62").replace("b = [1, 4]", 'b = "8/3"')
    found = identified(tmp_path, under_the_policy(), text, rotate=True)
    assert found.smaller == 1 and list(found.system.ranges) == ["c"]


@pytest.mark.slow
def test_runs_have_axes_too(tmp_path: Path) -> None:
    """Rows in time order, whose errors are shared."""
    draw, network = np.random.default_rng(1), load_policy(POLICY).network
    rows = []
    for run in range(6):
        x = draw.uniform(-1, 1, (1, 2)) * [0.2, 0.5]
        for _ in range(8):
            u = np.array([np.ravel(network(x[0], [Fraction(0)]))])
            rows.append(np.concatenate([x[0] + draw.uniform(-1e-3, 1e-3, 2), u[0], [run]]))
            x = simulated(x, u)
    path = write(tmp_path / "runs.csv", np.array(rows), "theta,theta_dot,u,run")
    (tmp_path / "s.toml").write_text(WIDE)
    found = certify.identify(path, tmp_path / "s.toml", noise="1e-3", sample_time="0.02", rotate=True)
    assert found.smaller > 3
    data = found.system.measurements
    assert data is not None
    truth = [axis.at + sum(s * Fraction(v) for s, v in zip(axis.by, TRUE.values(), strict=True)) for axis in data.axes]
    assert all(abs(q) <= 1 for q in truth)
    result = certify.certify_roa(found.system, POLICY, candidate="lyapunov", level=1e-3)
    assert result.verdict == "PROVED", result.reason


def test_ranges_of_axes_that_are_too_narrow_are_refused(known: Path, tmp_path: Path) -> None:
    text = (known / "known.toml").read_text()
    table = text.index("[data.axes]")
    lines = text[table:].splitlines()
    parts = [line.split(", ") for line in lines[1:]]
    narrow = [", ".join([first, str(float(slope) / 2), *others]) for first, slope, *others in parts]
    (tmp_path / "known.toml").write_text("\n".join([text[:table], lines[0], *narrow]))
    with pytest.raises(InputError, match="the range of axis_1 must hold all that the data leave"):
        certify.certify_roa(tmp_path / "known.toml", POLICY, data=known / "data.csv", candidate="lyapunov")


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("a = [", "a = [1, ", "a list of 4 numbers for each prior"),
        ("c = [", "d = [", "'d' is no parameter with a prior"),
        ("all", "b = [0, 0, 0, 0]", "must span all"),
        ("axis", "", "must have no axis_1 of its own"),
        ("rest", "", "must not depend on"),
    ],
)
def test_tables_of_axes_that_are_none(known: Path, tmp_path: Path, old: str, new: str, said: str) -> None:
    text = (known / "known.toml").read_text()
    head, table = text[: text.index("[data.axes]")], text[text.index("[data.axes]") :]
    if old == "axis":
        head = head.replace("[parameters]", "[parameters]\naxis_1 = 2")
    elif old == "rest":
        head = head.replace("[u_eq]", '[observations]\nseen = "a*theta"\n\n[u_eq]')
    elif old == "all":
        table = "\n".join(new if line.startswith("b = ") else line for line in table.splitlines())
    else:
        table = table.replace(old, new)
    (tmp_path / "known.toml").write_text(head + table)
    with pytest.raises(InputError, match=said):
        load_system(tmp_path / "known.toml")


def test_the_command_turns(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = under_the_policy()
    assert _run(command(tmp_path, "--rotate", rows=rows, text=WIDE), False) == 0
    assert "times smaller than that of the ranges" in capsys.readouterr().out
    assert _run(command(tmp_path, "--rotate", "--json", rows=rows, text=WIDE), True) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert found["axes"]["smaller"] > 10
    known = load_system(tmp_path / "known.toml")
    assert replace(known, measurements=None).ranges == dict.fromkeys(["axis_1", "axis_2", "axis_3"], (-1, 1))
    assert _run(["plant", str(tmp_path / "known.toml")], False) == 0


def test_pages_and_words_name_the_sums_that_axes_bound(
    known: Path, found_in: dict[str, certify.IdentifyResult], along_axes: certify.RoaResult
) -> None:
    found = found_in["known"]
    said, sums, data = found.to_dict(), sums_along(found.to_dict()), found.measurements
    assert len(sums) == 3 and max(a.shrink for a in sums) > 30
    for along, axis in zip(sums, data.axes, strict=True):
        size = max(axis.by, key=abs)
        ends = [sum(q * v for q, v in zip(axis.by, TRUE.values(), strict=True)) / size]
        assert along.range[0] <= ends[0] <= along.range[1] and along.prior[0] < along.range[0] + 1
        assert {axis.at + size * v for v in along.range} == {-1, 1}
        assert max(map(abs, along.factors.values())) == 1
    text = page(found.residuals(), said)
    assert all(a.text in text and a.ends in text for a in sums) and "axis₁" in text
    assert along_axes.certificate is not None
    certificate = along_axes.certificate
    for program in ("certify.checker", "certify.reference"):
        command = [sys.executable, "-m", program, str(certificate)]
        words = subprocess.run(command, capture_output=True, text=True, check=True).stdout
        assert "axis_1 = " in words and not re.search(r"axis_\d = [^,]*\d{12}", words)
