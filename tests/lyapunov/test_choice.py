"""Candidates by name: what each solves, the fallback with its notice, and their volumes side by side."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from certify.candidates import compare_candidates
from certify.cli import _run
from certify.closed_loop import ClosedLoop
from certify.errors import BackendError, InputError
from certify.lyapunov import choice, choose_candidate, domain_limit, volume
from certify.policies import Policy, save_policy
from certify.roa import RoaOptions, certify_roa
from certify.systems import System
from tests.support.loops import chain, pendulum_network


def test_each_candidate_solves_its_equation(pendulum: System) -> None:
    loop = ClosedLoop(pendulum, pendulum_network())
    A, _, K = loop.linearise()
    plain = choose_candidate(loop, "lyapunov", (2.0, 3.0))
    assert plain.name == "lyapunov" and plain.notice is None
    np.testing.assert_allclose(A.T @ plain.P + plain.P @ A, -np.diag([2.0, 3.0]), atol=1e-10)
    lqr = choose_candidate(loop, "lqr", None, (0.5,))
    np.testing.assert_allclose(A.T @ lqr.P + lqr.P @ A, -(np.eye(2) + 0.5 * K.T @ K), atol=1e-9)
    assert choose_candidate(loop, "optimised").name == "optimised"


@pytest.mark.parametrize(("Q", "R"), [((1.0,), None), ((1.0, -1.0), None), (None, (0.0,)), (None, (1.0, 1.0))])
def test_weights_must_be_positive_and_of_the_right_number(
    pendulum: System, Q: tuple[float, ...] | None, R: tuple[float, ...] | None
) -> None:
    with pytest.raises(InputError, match="positive numbers"):
        choose_candidate(ClosedLoop(pendulum, pendulum_network()), "lqr", Q, R)


def test_the_optimised_candidate_falls_back_with_a_notice(
    pendulum: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise BackendError("cvxpy is not installed.")

    monkeypatch.setattr(choice, "optimise_candidate", fail)
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(candidate="optimised"))
    assert result.verdict.value == "PROVED" and result.candidate == "lyapunov"
    assert result.notice is not None and "cvxpy is not installed" in result.notice
    assert result.to_dict()["lyapunov"]["candidate"] == "lyapunov"
    plain = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions())
    assert plain.P is not None and result.P is not None and np.array_equal(plain.P, result.P)


def test_volumes_side_by_side() -> None:
    """A linear plant: only the domain limits a level, and a P that is known is not computed again."""
    system, network = chain(2, [-1, -2])
    known = np.array([[2.0, 0.5], [0.5, 1.0]])
    rows = compare_candidates(system, network, RoaOptions(), {"lyapunov": known}, ["lyapunov", "lqr"])
    assert [row.candidate for row in rows] == ["lyapunov", "lqr"]
    assert all(row.limited_by == "domain" for row in rows)
    level = domain_limit(known, system.domain)
    assert (rows[0].level, rows[0].volume) == (level, volume(known, level))


def test_the_command_compares(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum", {"m": "0.15"}))
    assert _run(["roa", "--policy", str(path), "--out", str(tmp_path), "--json", "--compare"], True) == 0
    data = json.loads(capsys.readouterr().out)
    rows = {row["candidate"]: row for row in data["candidates"]}
    assert list(rows) == ["lyapunov", "lqr", "optimised"]
    assert [row["proved"] for row in rows.values()] == [True, False, False]
    assert data["volume"] <= rows["lyapunov"]["volume"]
    page = (tmp_path / "report.html").read_text()
    assert "Lyapunov candidates" in page and "--compare" not in page
