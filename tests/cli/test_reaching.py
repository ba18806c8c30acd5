"""`certify reach --target`: what it prints, exit statuses, files, and what cannot be asked."""

from __future__ import annotations

import io
import json
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from certify.analysis.reaching.options import steps_within
from certify.cli.main import _run
from certify.errors import OptionError
from certify.loop.plants import get_system
from certify.loop.policies import Policy, PolicyNetwork, save_policy
from certify.report.reached import summary

PLANT = """
name = "cart"
time = "discrete"
states = ["p", "v"]
inputs = ["F"]
[parameters]
h = 0.1
[dynamics]
p = "p + h*v"
v = "v + h*F"
[x_eq]
p = "1"
v = "0"
[u_eq]
F = 0
[domain]
p = [-1, 4]
v = [-3, 3]
[input_bounds]
F = [-20, 20]
"""


@pytest.fixture
def asked(tmp_path: Path) -> list[str]:
    """A cart in steps that a gain brakes at p = 1, asked to come near from the right."""
    network = PolicyNetwork.of_layers(
        (np.array([[-2.0, -3.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )
    save_policy(tmp_path / "cart.pt", Policy(network, "cart", {}))
    (tmp_path / "cart.toml").write_text(PLANT)
    return [
        "reach", "--policy", str(tmp_path / "cart.pt"), "--system", str(tmp_path / "cart.toml"), "--quiet",
        "--target", "p <= 1.5", "--from", "p=2.5..3,v=0", "--out", str(tmp_path / "out"),
    ]  # fmt: skip


def said(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> tuple[int, dict[str, Any]]:
    capsys.readouterr()
    status = _run([*arguments, "--json"], True)
    return status, json.loads(capsys.readouterr().out)


def test_a_box_that_gets_there(asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, data = said(capsys, asked)
    assert status == 0 and (data["verdict"], data["checked"], data["reference"]) == ("PROVED", "ACCEPTED", "ACCEPTED")
    assert data["from"] == {"p": ["5/2", "3"], "v": ["0", "0"]} and data["claim"] == {"kind": "reaches"}
    assert data["simulated"]["longest"] <= data["steps"] <= data["ranks"]["steps"]
    assert {"verdict", "reason", "ranks", "seconds", "certificate", "checked"} <= data.keys()
    *stages, total = data["seconds"].items()
    assert total[0] == "total" and 0 < dict(stages)["report"] <= sum(dict(stages).values()) <= total[1]
    file = data["certificate"]
    page = (tmp_path / "out" / "report.html").read_text()
    assert "PROVED · ACCEPTED" in page and "p = 2.5..3" in page and f"<b>{data['steps']} steps</b>" in page
    assert _run(["check", file], False) == 0 and _run(["check", file, "--reference"], False) == 0
    assert _run(["contains", file, "p=2.5..3", "v=0"], False) == 0
    assert f"reached after {data['steps']} steps" in capsys.readouterr().out
    assert _run(["contains", file, "p=3.9", "v=2.9"], False) == 1
    assert _run(["report", file, "--out", str(tmp_path / "again.html")], False) == 0
    assert "PROVED · ACCEPTED" in (tmp_path / "again.html").read_text()
    assert _run(["plot", file, "--out", str(tmp_path / "set.svg")], False) == 0
    assert "steps to the region" in (tmp_path / "set.svg").read_text("utf-8")


@pytest.mark.slow
def test_into_a_certified_set(asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    loop, known = asked[1:5], str(tmp_path / "known")
    assert (
        _run(
            ["roa", *loop, "--quiet", "--level", "0.05", "--effort", "0.2", "--out", known, "--keep", "v >= -2.9"],
            False,
        )
        == 0
    )
    led = ["reach", *loop, "--quiet", "--target", f"{known}/certificate.json", *asked[-4:], "--keep", "v >= -2.9"]
    status, data = said(capsys, led)
    assert status == 0 and (data["checked"], data["reference"]) == ("ACCEPTED", "ACCEPTED")
    assert data["claim"] == {"kind": "asymptotic"} and data["levels"]["roa"] == 0.05
    assert data["simulated"]["longest"] <= data["steps"] <= data["ranks"]["steps"]
    assert _run(["contains", data["certificate"], "p=2.5..3", "v=0"], False) == 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Region of attraction of cart" in page and "PROVED · ACCEPTED" in page and "boxes with ranks" in page
    capsys.readouterr()
    assert _run(led, False) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("PROVED cart: from all of p = 2.5..3, v = 0, V <= 0.05 after")
    assert "then {V <= 0.05} is invariant at every step and attracted by the operating point" in text
    assert "-2.9 - v < 0, at all times" in text
    assert _run(["reach", *loop, "--target", f"{known}/certificate.json", *asked[-4:]], False) == 2
    assert "differs in constraints" in capsys.readouterr().err


def test_what_is_not_so(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    status, data = said(capsys, [*asked, "--within", "3"])
    assert status == 1 and data["verdict"] == "REFUTED" and data["simulated"]["witness"]["end"] == "late"
    status, data = said(capsys, [*asked, "--keep", "fast: v >= -0.5"])
    assert status == 1 and data["simulated"]["witness"]["constraint"] == "fast" and data["certificate"] is None
    status, data = said(capsys, [*asked, "--keep", "v >= -2"])
    assert status == 0 and data["constraints"]
    status, data = said(capsys, [*asked, "--target", "v >= 0.1"])
    assert status == 3 and data["verdict"] == "UNKNOWN" and "in a simulation" in data["reason"]


def test_constraints_are_kept_until_then(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing is said of what happens in the region: the command must not promise more."""
    _, data = said(capsys, [*asked, "--keep", "v >= -2"])
    assert _run(["contains", data["certificate"], "p=2.5..3", "v=0"], False) == 0
    assert "(kept along every trajectory from there until the region is reached: " in capsys.readouterr().out


@pytest.mark.slow
def test_pictures_show_where_a_constraint_is_violated(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Only where one is, in the part of the plane that is drawn; the figure for a paper says it in its legend."""
    grey, page = "Grey: a constraint is violated there", tmp_path / "out" / "report.html"
    for keep, shown in (("v >= -1.1", True), ("v >= -2.5", False), ("abs(F) <= 4.1", True)):
        assert said(capsys, [*asked, "--keep", keep])[0] == 0
        assert (grey in page.read_text()) is shown
    figure = tmp_path / "set.svg"
    assert _run(["plot", str(tmp_path / "out" / "certificate.json"), "--out", str(figure)], False) == 0
    assert "where a constraint is violated, on a grid" in figure.read_text()


TANK = """
name = "tank"
states = ["h", "c"]
inputs = ["q"]
[dynamics]
h = "q - sqrt(h)"
c = "(1 - c)/h"
[domain]
h = [0.2, 3]
c = [0.1, 2]
[u_eq]
q = 0
[input_bounds]
q = [-10, 10]
"""


def test_nothing_need_rest_in_the_domain(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Equations without a value at 0, whose domain ends before: both checkers accept, and a claim with V is refused."""
    weights, bias = (np.array([[-1.0, 0.0]]),), (np.array([2.0]),)
    network = PolicyNetwork.of_layers(weights, bias, np.ones(1), np.zeros(1), "identity", "none")
    save_policy(tmp_path / "tank.pt", Policy(network, "tank", {}))
    (tmp_path / "tank.toml").write_text(TANK)
    loop = ["--policy", str(tmp_path / "tank.pt"), "--system", str(tmp_path / "tank.toml"), "--quiet"]
    folder = tmp_path / "out"
    asked = ["reach", *loop, "--sample-time", "0.1", "--target", "h <= 2.1", "--out", str(folder)]
    status, data = said(capsys, [*asked, "--from", "h=2.4..2.5,c=0.5..0.6", "--keep", "c <= 1.5"])
    assert status == 0 and (data["checked"], data["reference"]) == ("ACCEPTED", "ACCEPTED")
    certificate = str(folder / "certificate.json")
    assert _run(["contains", certificate, "h=2.42", "c=0.55"], False) == 0
    assert _run(["contains", certificate, "h=0", "c=0"], False) == 1
    assert _run(["roa", *loop, "--out", str(tmp_path / "roa")], False) == 2
    assert "the domain of h must contain 0 in its interior" in capsys.readouterr().err


def test_a_share_is_rounded_down(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    """A share of 0.99996 is not 100 %, and is one of the box that was cut, which is smaller than the domain."""
    _, data = said(capsys, asked)
    console = Console(file=io.StringIO(), width=300)
    console.print(summary(data | {"ranks": data["ranks"] | {"covered": 0.99996}}))
    assert ", 99.99 % of the box that was cut, volume" in console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.parametrize(("text", "steps"), [("7", 7), ("0.6s", 3), ("0.59 s", 2), ("1s", 5), ("0.2s", 1)])
def test_a_time_has_as_many_steps_as_fit(text: str, steps: int) -> None:
    """Of the longest period, in rationals: 0.6/0.2 is 3, though not in floats."""
    plant = get_system("pendulum").with_sample((Fraction(1, 10), Fraction(1, 5)))
    assert steps_within(text, plant) == steps
    with pytest.raises(OptionError, match=r"at least a period, 0\.2 s"):
        steps_within("0.19s", plant)


def test_text_for_people(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert _run(asked, False) == 0
    text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("PROVED cart: from all of p = 2.5..3, v = 0, p <= 1.5 after")
    assert "checked ACCEPTED, and by the reference" in text


@pytest.mark.parametrize(
    ("more", "why"),
    [
        (["--target", "p < 1"], "--target takes a comparison by <= or >="),
        (["--target", "p >= 5"], "--target must have states of the domain"),
        (["--box", "p=1"], "--box is about a tube"),
        (["--within", "0"], "--within must be 1 to"),
        (["--within", "2.5s"], "which in cart take no time"),
        (["--within", "2.5"], "--within must be a number of steps, or a time such as 2.5s"),
        (["--sample-time", "0.1"], "discrete"),
    ],
)
def test_what_cannot_be_asked(asked: list[str], more: list[str], why: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run([*asked, *more], False) == 2
    assert why in capsys.readouterr().err


def test_a_target_or_a_state_is_needed(asked: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    k = asked.index("--target")
    assert _run(asked[:k], False) == 2
    assert "--target or --from must be given" in capsys.readouterr().err
