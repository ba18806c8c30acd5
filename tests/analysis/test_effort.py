"""Effort: counted work, shared out, and the same answer whatever the clock says."""

from __future__ import annotations

import math
import random
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.run import certify_roa
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, UNLIMITED, Effort
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from tests.support.loops import pendulum_network
from tests.support.marks import slow_after

POLICIES = Path(__file__).parent.parent.parent / "examples" / "policies"


def test_a_part_is_charged_to_the_whole() -> None:
    whole = Effort(10.0)
    part = whole.part(6.0)
    part.charge(4.0)
    assert (part.left, whole.left) == (2.0, 6.0)
    whole.charge(5.0)
    assert part.left == 1.0 and not part.over
    part.charge(3.0)
    assert part.left == whole.left == 0.0 and part.over and whole.over


def test_a_share_is_of_what_is_left() -> None:
    whole = Effort(10.0)
    whole.charge(2.0)
    assert whole.share(0.25).left == 2.0
    assert whole.share(0.25).share(0.5).left == 1.0
    assert UNLIMITED.share(0.5).left == math.inf


def test_a_part_may_be_granted_where_nothing_is_left() -> None:
    whole = Effort(1.0)
    whole.charge(1.0)
    assert whole.part(3.0).over
    grace = whole.part(3.0, even_if_over=True)
    grace.charge(2.0)
    assert grace.left == 1.0 and whole.spent == 3.0


def test_nobody_accounts_for_what_has_no_end() -> None:
    UNLIMITED.charge(1e30)
    assert UNLIMITED.spent == 0.0 and not UNLIMITED.over


def test_the_clock_ends_an_effort_too() -> None:
    effort = Effort(math.inf, seconds=0.05)
    part = effort.part(1e30)
    assert 0 < part.left < UNIT and part.is_short_of_time
    time.sleep(0.06)
    assert part.over and effort.is_short_of_time
    assert not Effort(1.0, seconds=1e6).is_short_of_time


def test_seconds_follow_the_pace() -> None:
    effort = Effort(math.inf, seconds=100.0)
    effort.charge(1e6 * UNIT)
    assert effort.part(1.0).seconds_for(UNIT) < 0.01 and effort.seconds_for(UNIT) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("jobs", slow_after(1, [2, 1]))
def test_a_busy_machine_gives_the_same_bytes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, jobs: int) -> None:
    """One run on its own; one beside other work, with clocks that jump."""
    system, network = get_system("pendulum"), pendulum_network((8, 8))
    quiet = certify_roa(system, network, tmp_path / "quiet", RoaOptions(effort=0.01))
    assert quiet.verdict is Verdict.PROVED
    stop = threading.Event()
    beside = threading.Thread(target=lambda: [sum(range(10_000)) for _ in iter(stop.is_set, True)])
    chance = random.Random(jobs)
    monotonic = time.monotonic
    monkeypatch.setattr("certify.effort.time.monotonic", lambda: monotonic() + 1e4 * chance.random())
    beside.start()
    try:
        busy = certify_roa(system, network, tmp_path / "busy", RoaOptions(effort=0.01, jobs=jobs))
    finally:
        stop.set()
        beside.join()
    assert busy.raw == quiet.raw and busy.levels == quiet.levels and busy.boxes == quiet.boxes


def test_more_effort_proves_no_less(tmp_path: Path) -> None:
    policy = load_policy(POLICIES / "cartpole.pt")
    system = get_system("cartpole").with_parameters(policy.parameters)
    found = [
        certify_roa(system, policy.network, tmp_path / str(effort), RoaOptions(candidate="lyapunov", effort=effort))
        for effort in (1e-3, 0.1)
    ]
    assert [one.verdict for one in found] == [Verdict.PROVED] * 2
    assert found[0].stop is Stop.EFFORT and found[0].boxes < found[1].boxes
    assert (found[0].volume or 0.0) < (found[1].volume or 0.0)


def test_a_limit_on_the_clock_is_said_and_kept(tmp_path: Path) -> None:
    policy = load_policy(POLICIES / "cartpole.pt")
    system = get_system("cartpole").with_parameters(policy.parameters)
    found = certify_roa(system, policy.network, tmp_path, RoaOptions(effort=100.0, time_limit=1.0))
    assert found.stop is Stop.TIME and found.search is not None
    assert found.diagnosis is not None and "--time-limit" in dict(found.diagnosis.next.options)


def pendulum(out: Path, **options: Any) -> RoaResult:
    return certify_roa(get_system("pendulum"), pendulum_network(), out, RoaOptions(**options))


@pytest.mark.parametrize("candidate", ["robust", "peak"])
@pytest.mark.parametrize(("limit", "most"), [("effort", 1e-4), ("time_limit", 1e-3)])
def test_a_candidate_that_was_not_found_in_time_is_no_error(
    candidate: str, limit: str, most: float, tmp_path: Path
) -> None:
    result = pendulum(tmp_path, candidate=candidate, **{limit: most})
    assert result.verdict is Verdict.UNKNOWN and result.stop is (Stop.EFFORT if limit == "effort" else Stop.TIME)
    assert result.candidate == candidate and result.search is None and result.diagnosis is not None
    assert f"--{limit}".replace("_", "-") in dict(result.diagnosis.next.options)


@pytest.mark.parametrize("candidate", ["robust", "peak"])
def test_a_candidate_that_does_not_exist_is_no_error(
    candidate: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("certify.analysis.candidates.robust._all_scaled", lambda *_: [])
    result = pendulum(tmp_path, candidate=candidate)
    assert result.verdict is Verdict.UNKNOWN and result.stop is Stop.LOCAL
    assert result.diagnosis is not None and result.diagnosis.next.options == (("--candidate", "auto"),)


def test_nothing_is_said_to_have_grown_where_nothing_is_proved(tmp_path: Path) -> None:
    result = pendulum(tmp_path, candidate="peak", effort=1e-4)
    assert result.diagnosis is not None and "nothing was proved" in result.diagnosis.next.why
