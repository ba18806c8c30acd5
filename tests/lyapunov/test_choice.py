"""Candidates by name: what each solves, the fallback with its notice, and their volumes side by side."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.candidates.trials import blends, trial
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Verdict
from certify.cli.main import _run
from certify.effort import UNLIMITED
from certify.errors import BackendError, InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.plants import System, get_system
from certify.loop.policies import Policy, load_policy, save_policy
from certify.lyapunov import choice, choose_candidate, domain_limit, solve_lyapunov, volume
from tests.support.loops import chain, pendulum_network

SHIPPED = Path(__file__).parent.parent.parent / "examples" / "policies"


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
    def fail(*_: object, **__: object) -> None:
        raise BackendError("cvxpy is not installed.")

    monkeypatch.setattr(choice, "optimise_repeatedly", fail)
    result = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(candidate="optimised", effort=0.2))
    assert result.verdict.value == "PROVED" and result.candidate == "lyapunov"
    assert result.notice is not None and "cvxpy is not installed" in result.notice
    assert result.to_dict()["lyapunov"]["candidate"] == "lyapunov"
    plain = certify_roa(pendulum, pendulum_network(), tmp_path, RoaOptions(candidate="lyapunov", effort=0.2))
    assert plain.P is not None and result.P is not None and np.array_equal(plain.P, result.P)


def test_a_trial_knows_its_reach() -> None:
    """A linear plant: only the domain limits a level."""
    system, network = chain(2, [-1, -2])
    P = np.array([[2.0, 0.5], [0.5, 1.0]])
    found = trial(ClosedLoop(system, network), P, "mine", RoaOptions())
    limit = domain_limit(P, system.domain)
    assert found.limited_by == "domain" and found.limit == limit
    assert found.task.target == limit * (1 - 1e-9) and found.volume == volume(P, found.task.target)
    np.testing.assert_allclose(found.unit, P / found.task.target)


def test_blends_lie_between() -> None:
    loop = ClosedLoop(*chain(2, [-1, -2]))
    A = loop.linearise()[0]
    weights = {"a": np.eye(2), "b": np.diag([9.0, 1.0])}
    large, small = (trial(loop, solve_lyapunov(A, Q), name, RoaOptions()) for name, Q in weights.items())
    between = list(blends(loop, large, small, RoaOptions(), UNLIMITED))
    assert len(between) == 3
    for one in between:
        ends = np.sort([large.unit[0, 0], small.unit[0, 0]])
        assert ends[0] <= one.P[0, 0] <= ends[1] and "a with" in one.name and one.name.endswith("of b")


@pytest.mark.slow
def test_several_are_tried_and_the_largest_proved_volume_counts(tmp_path: Path) -> None:
    """With Q = I a violation comes far earlier than with the LQR cost, and with the optimised P later still."""
    policy = load_policy(SHIPPED / "cartpole.pt")
    system = get_system("cartpole").with_parameters(policy.parameters)
    volumes = {}
    for name in ("lyapunov", "lqr", "auto"):
        options = RoaOptions(candidate=name, max_boxes=20_000)  # type: ignore[arg-type]
        result = certify_roa(system, policy.network, tmp_path / name, options)
        volumes[name] = result.to_dict()["volume"]
    assert result.verdict is Verdict.PROVED
    assert volumes["auto"] > 3 * volumes["lqr"] > 30 * volumes["lyapunov"]
    (best,) = (row for row in result.tried if row.proved)
    assert best.candidate == result.candidate
    assert best.proved_volume == volumes["auto"] == max(row.proved_volume or 0.0 for row in result.tried)
    data = result.to_dict()
    assert [row["proved"] for row in data["candidates"]].count(True) == 1


@pytest.mark.parametrize(
    ("options", "name"), [({"Q": (1.0, 2.0)}, "lyapunov"), ({"R": (2.0,)}, "lqr"), ({"level": 0.1}, "lyapunov")]
)
def test_a_weight_or_a_level_is_about_one_candidate(options: dict[str, Any], name: str) -> None:
    assert RoaOptions(**options).only == name and RoaOptions().only is None


def test_the_command_says_what_to_try_next(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum", {"m": "0.15"}))
    command = [
        "roa",
        "--policy",
        str(path),
        "--out",
        str(tmp_path),
        "--json",
        "--candidate",
        "lqr",
        "--max-boxes",
        "20",
    ]
    assert _run(command, True) == 0
    told = json.loads(capsys.readouterr().out)["diagnosis"]
    assert told["kind"] == "boxes" and told["next"]["options"] == {"--max-boxes": "200"}
    assert told["next"]["command"].startswith("certify roa --policy") and told["next"]["command"].endswith(
        "--max-boxes 200"
    )
    assert told["next"]["command"].count("--max-boxes") == 1 and "--candidate lqr" in told["next"]["command"]
    assert _run([*shlex.split(told["next"]["command"])[1:], "--quiet"], True) == 0
    again = json.loads(capsys.readouterr().out)
    assert again["boxes"] > 20


def test_quiet_says_nothing_but_the_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "policy.pt"
    save_policy(path, Policy(pendulum_network((8, 8)), "pendulum", {"m": "0.15"}))
    assert (
        _run(
            ["roa", "--policy", str(path), "--out", str(tmp_path), "--candidate", "lqr", "--effort", "0.2", "--quiet"],
            False,
        )
        == 0
    )
    captured = capsys.readouterr()
    assert captured.err == "" and "PROVED" in captured.out
