"""`certify learn-lyapunov`: what it writes and says, what `certify roa --lyapunov` makes of it, and what is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.inputs import ellipsoid_beside
from certify.cli.main import _run
from certify.loop.plants import System
from certify.lyapunov import Neural, load_lyapunov, save_lyapunov

SHIPPED = Path(__file__).parents[2] / "examples" / "policies" / "pendulum.pt"
FUNCTION = Neural((np.ones((3, 2)), np.ones((1, 3))), (np.zeros(3), np.zeros(1)))


def run(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    status = _run([str(a) for a in arguments], "--json" in arguments)
    return status, *capsys.readouterr()


def test_what_is_learned_is_written_and_proved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Beyond a domain that the ellipsoid nearly fills there is more than the ellipsoid."""
    out = tmp_path / "V.pt"
    asked = ("--policy", SHIPPED, "--domain", "theta=6", "--domain", "theta_dot=40")
    status, text, _ = run(capsys, "learn-lyapunov", *asked, "--out", out, "--hidden", "10", "--quiet", "--json")
    data = json.loads(text)
    assert status == 0 and data["function"] == {"kind": "network", "layers": [2, 10, 1]}
    assert data["lyapunov"] == str(out) and 0 < data["sampled_cover"] <= 1 and "verdict" not in data
    stored = load_lyapunov(out)
    assert stored.system == "pendulum" and stored.training["learned"]["seed"] == 0
    given = ("--lyapunov", out, "--out", tmp_path / "o", "--effort", "0.2", "--quiet", "--json")
    status, text, _ = run(capsys, "roa", *asked, *given)
    proved = json.loads(text)
    assert status == 0 and proved["checked"] == "ACCEPTED"
    assert proved["lyapunov"]["P"] == data["P"]
    assert proved["outer"]["volume"] > 1.02 * proved["volume"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--hidden", "8", "--degree", "4"), "--hidden must stand without --degree"),
        (("--hidden", "8,x"), "--hidden takes widths"),
        (("--effort", "0"), "--effort must be a positive number"),
    ],
)
def test_options_that_cannot_be(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "V.pt"
    status, text, said = run(capsys, "learn-lyapunov", "--policy", SHIPPED, "--out", out, *options)
    assert status == 2 and message in said and not text and not out.exists()


@pytest.mark.parametrize(
    ("learned", "known"),
    [
        ({"P": [[2.0, 0.5], [0.5, 1.0]]}, True),
        ({"P": [[2.0, 0.5], [0.25, 1.0]]}, False),  # not symmetric
        ({"P": [[2.0, 0.5]]}, False),
        ({"P": [[2.0]]}, False),  # of another plant
        ({"P": [[2.0, float("nan")], [float("nan"), 1.0]]}, False),
        ({"P": "none"}, False),
        ({}, False),
        ("text", False),
        (None, False),
    ],
)
def test_the_ellipsoid_of_a_file_is_a_hint_that_may_be_missing(
    tmp_path: Path, pendulum: System, learned: object, known: bool
) -> None:
    path = tmp_path / "V.pt"
    save_lyapunov(path, FUNCTION, "pendulum", training={} if learned is None else {"learned": learned})
    P = ellipsoid_beside(load_lyapunov(path), pendulum)
    assert (P is not None) == known
    if P is not None:
        assert P.tolist() == [[2.0, 0.5], [0.5, 1.0]]
