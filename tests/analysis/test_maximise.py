"""The largest rate and the longest period: for exactly the set that was asked for, and nothing said that is not so."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from certify.analysis.maximise import Quantity, certify_largest
from certify.analysis.options import RoaOptions
from certify.certificates import read_certificate
from certify.certificates.verdict import Stop, Verdict
from certify.cli.main import _run
from certify.errors import InputError
from certify.loop.plants import get_system
from certify.loop.policies import load_policy

POLICIES = Path(__file__).parent.parent.parent / "examples" / "policies"


def largest(quantity: Quantity, out: Path, **options: Any) -> Any:
    policy = load_policy(POLICIES / "pendulum.pt")
    system = get_system("pendulum").with_parameters(policy.parameters)
    return certify_largest(quantity, system, policy.network, out, RoaOptions(effort=0.01, **options))


def test_a_level_that_is_asked_for_is_the_level_that_is_proved(tmp_path: Path) -> None:
    result = largest("rate", tmp_path, level=0.5)
    assert result.verdict is Verdict.PROVED and result.problem.rate > 0.1
    assert read_certificate(tmp_path / "certificate.json").roa == result.levels.roa == 0.5
    assert "the level 0.5" in result.notice
    assert result.candidate == "lyapunov" and {one.candidate for one in result.tried} == {"lyapunov"}


def test_a_level_that_was_not_asked_for_is_not_said_to_be(tmp_path: Path) -> None:
    result = largest("rate", tmp_path, candidate="lyapunov")
    assert result.verdict is Verdict.PROVED and result.stop is Stop.REQUESTED
    assert result.candidate == "lyapunov"
    assert result.reason == "requested: 0.95 of the level proved without it" == result.diagnosis.binds
    assert "--level" not in result.diagnosis.next.why and not result.diagnosis.next.options


@pytest.mark.slow
def test_no_search_is_said_to_be_kept(tmp_path: Path) -> None:
    """A run with max has no search that --resume continues, and the folders of its attempts are gone."""
    result = largest("period", tmp_path)
    assert result.stop is Stop.EFFORT and result.search is None
    assert "--resume" not in dict(result.diagnosis.next.options)
    assert [path.name for path in tmp_path.iterdir()] == ["certificate.json"]


@pytest.mark.parametrize(
    ("quantity", "options"),
    [
        ("rate", {"enlarge": True}),
        ("rate", {"candidate": "polynomial"}),
        ("rate", {"engine": "both"}),
        ("period", {"enlarge": True}),
        ("period", {"candidate": "polynomial"}),
        ("period", {"engine": "dreal"}),
    ],
)
def test_what_excludes_it_is_refused_before_anything_is_proved(
    quantity: Quantity, options: dict[str, Any], tmp_path: Path
) -> None:
    with pytest.raises(InputError):
        largest(quantity, tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_the_command_says_what_it_is_to_type_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["roa", str(POLICIES / "pendulum.pt"), "--sample-time", "max", "--effort", "0.01", "--json"]
    assert _run([*asked, "--out", str(tmp_path)], as_json=True) == 0
    data = json.loads(capsys.readouterr().out)
    assert data["search"] is None and "--resume" not in data["diagnosis"]["next"].get("command", "")
