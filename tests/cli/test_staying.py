"""`certify roa --claim invariant`: what it prints, exit statuses, files, and what cannot be asked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.cli.main import _run
from certify.loop.policies import Policy, PolicyNetwork, save_policy

PLANT = """
name = "circle"
states = ["x", "y"]
inputs = ["u"]
[parameters]
wanted = 1
[dynamics]
x = "y + x*(wanted - x**2 - y**2)"
y = "-x + y*(wanted - x**2 - y**2) + u/10"
[u_eq]
u = 0
[domain]
x = [-2, 2]
y = [-2, 2]
[input_bounds]
u = [-1, 1]
[constraints]
moving = "x**2 + y**2 > 1/20"
"""
N = "(x**2 + y**2 - wanted)**2"


@pytest.fixture
def asked(tmp_path: Path) -> list[str]:
    network = PolicyNetwork.of_layers([np.array([[0.0, -1.0]])], [np.zeros(1)], [1.0], [0.0], centre="none")
    save_policy(tmp_path / "circle.pt", Policy(network, "circle", {}))
    (tmp_path / "circle.toml").write_text(PLANT)
    return [
        "roa", "--claim", "invariant", "--policy", str(tmp_path / "circle.pt"), "--system",
        str(tmp_path / "circle.toml"), "--quiet", "--out", str(tmp_path / "out"),
    ]  # fmt: skip


def said(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    status = _run([*arguments, "--json"], True)
    return status, json.loads(capsys.readouterr().out)


def test_an_expression_is_proved(asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, data = said(capsys, [*asked, "--lyapunov", N, "--contains", "x=1,y=0"])
    assert status == 0 and (data["verdict"], data["checked"], data["reference"]) == ("PROVED", "ACCEPTED", "ACCEPTED")
    assert data["contains"]["result"] == "contained" and data["constraints"] == {"moving": "1/20 - (x**2 + y**2) < 0"}
    assert (tmp_path / "out" / "report.html").read_text("utf-8").count("data:image/svg") >= 1
    certificate = str(tmp_path / "out" / "certificate.json")
    capsys.readouterr()
    assert _run(["check", certificate], False) == 0 and "N(x) <=" in capsys.readouterr().out
    assert _run(["contains", certificate, "x=0", "y=0"], False) == 1
    for pair, status in (("x,y", 0), ("y,x", 0), ("x,x", 2)):
        assert _run(["plot", certificate, "--out", str(tmp_path / "set.svg"), "--pairs", pair], False) == status
    drawn = (tmp_path / "set.svg").read_text("utf-8")
    assert "proved: never left" in drawn and "a constraint is violated" in drawn
    assert _run(["report", certificate], False) == 0


@pytest.mark.slow
def test_boxes_are_proved_with_a_held_input(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    held = [*asked, "--sample-time", "0.05"]
    assert _run([*held, "--effort", "0.01"], False) == 0
    told = capsys.readouterr().out
    assert "circle: boxes that are never left" in told and "steps is proved" in told
    status, data = said(capsys, [*held, "--effort", "0.012", "--contains", "x=0.9..1.1,y=-0.1..0.1"])
    assert status == 0 and (data["verdict"], data["checked"]) == ("PROVED", "ACCEPTED")
    assert (
        data["claim"] == {"kind": "remains", "sample": ["1/20", "1/20"]} and data["contains"]["result"] == "contained"
    )
    assert data["simulated"]["share"] > 0.5 and data["ranks"]["covered"] > 0.4
    certificate = str(tmp_path / "out" / "certificate.json")
    capsys.readouterr()
    assert _run(["check", certificate], False) == 0
    told = capsys.readouterr().out
    assert "in such a leaf again after" in told and "of these, at all times: " in told
    assert _run(["contains", certificate, "x=1", "y=0"], False) == 0
    assert "(kept along every trajectory from there: " in capsys.readouterr().out
    assert _run(["contains", certificate, "x=0", "y=0"], False) == 1
    assert _run(["plot", certificate, "--out", str(tmp_path / "set.svg")], False) == 0
    drawn = (tmp_path / "set.svg").read_text("utf-8")
    assert "proved: never left" in drawn and "a constraint is violated" in drawn
    assert _run(["report", certificate], False) == 0
    page = (tmp_path / "out" / "report.html").read_text("utf-8")
    assert "is in one of them again after" in page and "Each of them holds before each" in page


def test_it_is_told_in_a_few_lines(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert _run([*asked, "--lyapunov", N, "--lyapunov-level", "0.25"], False) == 0
    told = capsys.readouterr().out
    assert (
        "PROVED  circle: {N <= 0.25} is never left" in told and "moving: 1/20 - (x**2 + y**2) < 0, at all times" in told
    )


def test_unknown_says_what_to_try(asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, data = said(capsys, [*asked, "--lyapunov", "x + y*2", "--effort", "0.05"])
    assert status == 3 and data["verdict"] == "UNKNOWN" and data["next"] and data["certificate"] is None
    assert not (tmp_path / "out" / "certificate.json").exists()


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--level", "1"], "has no ellipsoid"),
        (["--rate", "max"], "neither a rate nor a period"),
        (["--sample-time", "0.1", "--lyapunov", N], "without a function"),
        (["--sample-time", "0.1", "--candidate", "neural"], "without a function"),
        (["--sample-time", "max"], "neither a rate nor a period"),
        (["--lyapunov", "x + nothing*y"], "nothing"),
        (["--lyapunov", "missing.pt"], "missing.pt"),
        (["--lyapunov", "abs(x) + y**2"], "corner"),
    ],
)
def test_what_cannot_be_asked(
    asked: list[str], more: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, data = said(capsys, [*asked, *more])
    assert status == 2 and words in data["error"]
