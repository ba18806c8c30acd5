"""Which candidate is given time, and when the race is over before all of them are made."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import certify.roa
from certify.closed_loop import ClosedLoop
from certify.engines.base import Budget, Proof, Report
from certify.lyapunov import solve_lyapunov, volume
from certify.options import RoaOptions
from certify.policies import load_policy
from certify.race import Race
from certify.roa import certify_roa
from certify.systems import System
from certify.trials import Trial, trial
from tests.support.loops import chain, scalar_tanh

SHIPPED = Path(__file__).parent.parent / "examples" / "policies" / "pendulum.pt"


class Reaches:
    """An attempt that proves a share of what is asked for in its first heat."""

    boxes, expected, gained, done = 1, 0.0, True, True

    def __init__(self, target: float, share: float) -> None:
        self.target, self.share, self.level = target, share, None

    def advance(self, budget: Budget, report: Report | None = None) -> None:
        self.level = self.share * self.target

    def proof(self) -> Proof:
        raise AssertionError("nobody asks")


def trials() -> list[Trial]:
    """Two ellipses that only the domain limits, the smaller one first."""
    loop = ClosedLoop(*chain(2, [-1, -2]))
    A = loop.linearise()[0]
    pair = [(name, solve_lyapunov(A, np.diag(Q))) for name, Q in (("small", [1.0, 1.0]), ("large", [1.0, 3.0]))]
    small, large = (trial(loop, P, name, RoaOptions()) for name, P in pair)
    assert small.limited_by == large.limited_by == "domain" and 0.5 * large.volume < small.volume < 0.9 * large.volume
    return [small, large]


def race(share: float) -> tuple[Race, list[str]]:
    """A race whose attempts prove this share of their levels, and the names in the order in which they began."""
    began: list[str] = []

    def begin(one: Trial) -> Reaches:
        began.append(one.name)
        return Reaches(one.task.target, share)

    return Race(begin, lambda: 1.0, 100), began  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("share", "most", "settled", "entered"),
    [
        (1.0, 1.0, True, ["large"]),
        (0.99, 1.0, True, ["large"]),  # its volume is a hundredth less than there could be
        (0.95, 1.0, False, ["large"]),
        (1.0, 1.015, True, ["large"]),
        (1.0, 1.03, False, []),  # it is not made to run for nothing
    ],
)
def test_a_race_is_settled_where_no_other_could_be_let_in(
    share: float, most: float, settled: bool, entered: list[str]
) -> None:
    run, began = race(share)
    largest = trials()[1].volume
    assert run.is_settled_by(trials()[1], 1.0, most * largest) is settled
    assert began == entered


def test_what_has_run_is_not_entered_again() -> None:
    run, began = race(0.4)
    given = trials()
    assert not run.is_settled_by(given[1], 1.0, volume(given[1].P, given[1].limit))
    run.enter(given, 1.0)
    assert began == ["large", "small"]


def test_no_candidate_is_made_that_could_not_win(
    tmp_path: Path, pendulum: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pendulum's set fills its domain, and the slow candidate is not made; that changes no byte."""
    made = list[str]()
    robust = certify.roa.robust

    def counted(loop: ClosedLoop, options: RoaOptions) -> Trial | None:
        made.append(loop.system.name)
        return robust(loop, options)

    monkeypatch.setattr(certify.roa, "robust", counted)
    network = load_policy(SHIPPED).network
    quick = certify_roa(pendulum, network, tmp_path / "quick")
    assert not made and quick.verdict.value == "PROVED"
    monkeypatch.setattr(Race, "is_settled_by", lambda *_: False)
    slow = certify_roa(pendulum, network, tmp_path / "slow")
    assert made == ["pendulum"]
    assert quick.raw == slow.raw and quick.tried == slow.tried


def test_a_candidate_that_could_win_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The origin attracts two thirds of this domain: nothing that is proved of it could settle the race."""
    made = list[str]()
    monkeypatch.setattr(certify.roa, "robust", lambda loop, _: made.append(loop.system.name))
    system, network = scalar_tanh()
    found = certify_roa(replace(system), network, tmp_path)
    assert found.verdict.value == "PROVED" and made == ["scalar"]
