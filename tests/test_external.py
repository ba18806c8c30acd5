"""Policies that others trained, by one command each and without options beyond what their files cannot say.

The files are not part of the project; where the folder is missing the tests are skipped.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from certify.cli.main import _run

FOLDER = Path(__file__).parent.parent.parent / "shared" / "external" / "two_stage"
SAID = {
    "pendulum_bigtorque_seed_0": ("--system pendulum --states theta,theta_dot --squash tanh --action-scale 6", 190.0),
    "cartpole_seed_0": (
        "--system cartpole --param l=1 --states p,theta,p_dot,theta_dot --squash tanh --action-scale 30",
        0.5,
    ),
    "2dquadrotor_seed_0": (
        "--system quadrotor2d --states x,y,theta,x_dot,y_dot,theta_dot --squash relu-tanh --action-scale 6",
        3e-6,
    ),
}

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not FOLDER.is_dir(), reason=f"policies of others are not here: {FOLDER}"),
]


def roa(capsys: pytest.CaptureFixture[str], name: str, tmp_path: Path, *options: str) -> dict[str, object]:
    command = ["roa", "--policy", str(FOLDER / f"{name}.pth"), *SAID[name][0].split(), "--out", str(tmp_path), "--json"]
    status = _run([*command, *options], True)
    answer: dict[str, object] = json.loads(capsys.readouterr().out)
    assert status == 0, answer
    return answer


@pytest.mark.parametrize("name", SAID)
def test_the_default_proves_a_large_set(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    answer = roa(capsys, name, tmp_path)
    volume = answer["volume"]
    assert answer["verdict"] == "PROVED" and isinstance(volume, float) and volume >= SAID[name][1]


def test_the_optimised_candidate_of_the_planar_quadrotor_is_accepted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The checker rejected what the engine had proved: a leaf was proved with a multiplier for an earlier c2."""
    answer = roa(capsys, "2dquadrotor_seed_0", tmp_path, "--candidate", "optimised", "--effort", "1.2")
    assert answer["verdict"] == "PROVED" and answer["checked"] == "ACCEPTED"
