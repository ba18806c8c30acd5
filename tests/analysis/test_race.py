"""Which candidate is given time, and when the race is over before all of them are made."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import certify.analysis.stages.candidate
import certify.lyapunov.corners
from certify.analysis.candidates.trials import Trial, corrected, firm, optimised, trial
from certify.analysis.options import RoaOptions
from certify.analysis.run import certify_roa
from certify.analysis.selection import Race
from certify.analysis.stages.candidate import _Choice
from certify.analysis.stages.state import Tools
from certify.certificates import TrustedSolver
from certify.certificates.claims import Asymptotic
from certify.certificates.verdict import Stop
from certify.effort import UNIT, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork, load_policy
from certify.lyapunov import solve_lyapunov
from certify.lyapunov.corners import Corners
from certify.provers.base import Budget, Proof, Report
from tests.support.loops import box, chain, scalar_tanh

SHIPPED = Path(__file__).parent.parent.parent / "examples" / "policies" / "pendulum.pt"


class Reaches:
    """An attempt that proves a share of what is asked for in its first heat, and of that one by the local rule."""

    boxes, expected, gained, done, reach = 1, 0.0, True, True, math.inf

    def __init__(self, target: float, share: float, local: float) -> None:
        self.target, self.share, self.local, self.level = target, share, local, None

    def advance(self, budget: Budget, report: Report | None = None) -> None:
        self.level = self.share * self.target

    def proof(self) -> Proof:
        claim = Asymptotic(self.share * self.target, self.local * self.share * self.target)
        return Proof(claim, TrustedSolver("nobody", "1", 0.0, ()), Stop.REQUESTED)


def trials() -> list[Trial]:
    """Two ellipses that only the domain limits, the smaller one first."""
    loop = ClosedLoop(*chain(2, [-1, -2]))
    A = loop.linearise()[0]
    pair = [(name, solve_lyapunov(A, np.diag(Q))) for name, Q in (("small", [1.0, 1.0]), ("large", [1.0, 3.0]))]
    small, large = (trial(loop, P, name, RoaOptions()) for name, P in pair)
    assert small.limited_by == large.limited_by == "domain" and 0.5 * large.volume < small.volume < 0.9 * large.volume
    return [small, large]


def race(share: float, local: float = 0.1) -> tuple[Race, list[str]]:
    """A race whose attempts prove this share of their levels, and the names in the order in which they began."""
    began: list[str] = []

    def begin(one: Trial, proved: bool) -> Reaches:
        began.append(one.name)
        return Reaches(one.task.target, share, local)

    return Race(begin, Effort(UNIT), UNIT, 100), began  # type: ignore[arg-type]


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
    assert run.is_settled_by(trials()[1], most * largest) is settled
    assert began == entered


@pytest.mark.parametrize("local", [0.1, 0.5, 0.51, 1.0])
def test_the_candidate_for_the_local_rule_may_be_ahead_where_that_rule_proves_most(local: float) -> None:
    run, began = race(1.0, local)
    large = trials()[1]
    assert run.is_settled_by(large, large.volume) is (local <= 0.5) and began == ["large"]


def test_a_race_that_is_not_settled_goes_on_as_if_it_began() -> None:
    """The larger of two that are both worth no other comes first, and nothing is begun twice."""
    run, began = race(1.0, 1.0)
    _, large = trials()
    larger = replace(large, name="larger", volume=1.01 * large.volume)
    assert not run.is_settled_by(large, large.volume)
    early = run.early
    assert run.contenders == [] and early is not None and early.proved > 0
    run.enter([large, larger])
    assert [c.trial.name for c in run.contenders] == ["larger"] and began == ["large", "larger"]
    again, began = race(0.4)
    given = trials()
    assert not again.is_settled_by(given[1], given[1].volume)
    early = again.early
    again.enter(given)
    assert began == ["large", "small"] and again.contenders[0] is early


def test_a_contender_that_a_violation_leaves_less_than_is_proved_is_out() -> None:
    run, _ = race(0.4)
    run.enter(trials())
    small = run.contenders[-1]
    for contender in run.contenders:
        contender.attempt.done = False  # type: ignore[misc]
    assert small.trial.name == "small" and small in run.open
    small.attempt.reach = 0.45 * small.trial.task.target  # type: ignore[misc]
    assert 0 < small.reach < run.best.proved and run.open == [run.best]


@pytest.mark.slow
def test_no_candidate_is_made_that_could_not_win(
    tmp_path: Path, pendulum: System, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pendulum's set fills its domain, and the slow candidate is not made; that changes no byte."""
    made = list[str]()
    robust = certify.analysis.stages.candidate.robust

    def counted(loop: ClosedLoop, options: RoaOptions, effort: Effort) -> Trial | None:
        made.append(loop.system.name)
        return robust(loop, options, effort)

    monkeypatch.setattr("certify.analysis.stages.candidate.robust", counted)
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
    monkeypatch.setattr(certify.analysis.stages.candidate, "robust", lambda loop, *_: made.append(loop.system.name))
    system, network = scalar_tanh()
    found = certify_roa(replace(system), network, tmp_path)
    assert found.verdict.value == "PROVED" and made == ["scalar"]


def test_a_start_that_the_solver_only_nearly_mends_is_no_candidate(monkeypatch: pytest.MonkeyPatch) -> None:
    system, network = chain(2, [-1, -2])
    loop = ClosedLoop(system.with_sample((Fraction(1, 2), Fraction(1, 2))), network)
    V = solve_lyapunov(ClosedLoop(system, network).linearise()[0], np.diag([1.0, 1e-4]))
    assert not Corners(loop).decrease(V) and not Corners(loop).decrease(np.eye(2))
    monkeypatch.setattr(certify.lyapunov.corners, "smallest_trace", lambda *_: np.eye(2))
    last = trial(loop, V, "optimised", RoaOptions())
    assert corrected(loop, last, [], RoaOptions(), Effort(0.1 * UNIT)) is None


class Slow(Reaches):
    """An attempt of which each heat proves the same share more; boxes until then are told as given."""

    done = False

    def __init__(self, target: float, share: float, expected: float) -> None:
        super().__init__(target, share, 0.1)
        self.expected, self.heats = expected, 0

    def advance(self, budget: Budget, report: Report | None = None) -> None:
        self.heats += 1
        self.level = min(1.0, self.share * self.heats) * self.target


@pytest.mark.parametrize(
    ("ranged", "of_large", "of_firm", "expected", "began"),
    [
        (True, 0.04, 0.2, 1.0, ["optimised", "firm"]),  # two parts of a heat prove little, two more prove most
        (True, 0.04, 0.2, 1e9, ["optimised", "firm", "robust", "between"]),  # too far off to go on
        (True, 0.04, 0.1, 1.0, ["optimised", "firm", "robust", "between"]),
        (True, 0.3, 0.2, 1.0, ["optimised", "robust", "between"]),  # enough is proved of the largest
        (False, 0.04, 0.2, 1.0, ["optimised", "robust", "between"]),
    ],
)
def test_a_large_margin_is_tried_where_ranges_leave_next_to_nothing_of_the_largest_set(
    ranged: bool,
    of_large: float,
    of_firm: float,
    expected: float,
    began: list[str],
    pendulum: System,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system = pendulum.with_ranges({"m": (Fraction(14, 100), Fraction(16, 100))}) if ranged else pendulum
    loop, options, names = ClosedLoop(system, load_policy(SHIPPED).network), RoaOptions(), list[str]()
    largest = trial(loop, solve_lyapunov(loop.linearise()[0], np.eye(2)), "optimised", options)
    shares = {"optimised": of_large, "firm": of_firm}

    def begin(one: Trial, proved: bool) -> Slow:
        names.append(one.name)
        return Slow(one.task.target, shares.get(one.name, 0.2), expected)

    effort = Effort(UNIT)
    tools = Tools(tmp_path, Any, effort, Any, {})  # type: ignore[arg-type]
    made = {"firm": 0.9, "robust": 0.8}
    for name, share in made.items():
        one = replace(largest, name=name, volume=share * largest.volume)
        monkeypatch.setattr(certify.analysis.stages.candidate, name, lambda *_, one=one: one)
    between = replace(largest, name="between")
    monkeypatch.setattr(certify.analysis.stages.candidate, "blends", lambda *_: [between])
    run = Race(begin, effort, 0.04 * UNIT, 100)  # type: ignore[arg-type]
    state: Any = SimpleNamespace(loop=loop, options=options, interruptible=True)
    _Choice(state, tools, effort, run)._among([largest], largest)
    assert names == began


@pytest.mark.parametrize(
    ("states", "share", "expected", "settled", "heats"),
    [
        (4, 0.11, 1.0, True, 4),  # of the volume by two parts of a heat and two more
        (4, 0.11, 1e9, False, 2),  # a gain is too far off
        (4, 0.09, 1.0, False, 4),
        (3, 0.9, 1.0, False, 0),
    ],
)
def test_in_many_states_the_largest_set_is_gone_on_with_before_others_are_made(
    states: int, share: float, expected: float, settled: bool, heats: int, tmp_path: Path
) -> None:
    loop, options, begun = ClosedLoop(*chain(states, [-1, -4, -6, -4][-states:])), RoaOptions(), list[Slow]()
    large = trial(loop, solve_lyapunov(loop.linearise()[0], np.eye(states)), "optimised", options)

    def begin(one: Trial, proved: bool) -> Slow:
        begun.append(Slow(one.task.target, share ** (2 / states) / 4, expected))
        return begun[-1]

    effort = Effort(UNIT)
    tools = Tools(tmp_path, Any, effort, Any, {})  # type: ignore[arg-type]
    run = Race(begin, effort, 0.04 * UNIT, 100)  # type: ignore[arg-type]
    choice = _Choice(SimpleNamespace(loop=loop, options=options, interruptible=True), tools, effort, run)  # type: ignore[arg-type]
    assert choice._goes_far(large) is settled
    assert [one.heats for one in begun] == ([heats] if heats else [])


def test_the_candidate_of_a_large_margin_is_smaller_and_decays_at_every_corner(pendulum: System) -> None:
    system = pendulum.with_ranges({"m": (Fraction(14, 100), Fraction(16, 100))})
    loop = ClosedLoop(system, load_policy(SHIPPED).network)
    found, large = (make(loop, RoaOptions(), Effort(UNIT)) for make in (firm, optimised))
    assert found is not None and large is not None and (found.name, large.name) == ("firm", "optimised")
    assert 0.3 * large.volume < found.volume < large.volume
    slowest = Corners(loop).slowest
    for A in Corners(loop).rates:
        decay = -np.linalg.eigvals(np.linalg.solve(found.P, A.T @ found.P + found.P @ A)).real.max() / 2
        assert decay > 0.25 * slowest


def crawling() -> tuple[System, PolicyNetwork]:
    """x+ = x + x (x^2 - 1/25)(16/25 - x^2) / 2 + 1e-9: |x| falls below 1/5 and between 4/5 and 1, and rises between."""
    (x,) = symbols("x")
    (u,) = symbols("u")
    squares = (x**2 - Number(Fraction(1, 25))) * (Number(Fraction(16, 25)) - x**2)
    system = System(
        name="crawling",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(x + x * squares / 2 + u,),
        u_eq=(Number(0),),
        domain=box(1),
        input_bounds=box(1),
        time="discrete",
    )
    offset = np.array([1e-9])
    return system, PolicyNetwork.of_layers((np.zeros((1, 1)),), (np.zeros(1),), np.ones(1), offset, "identity", "none")


def test_a_band_that_ends_high_is_worth_what_lies_above_its_floor() -> None:
    """Of a practical claim that is the length of what leaves a band, and not of the band's whole set."""
    found = trial(ClosedLoop(*crawling()), np.eye(1), "given", RoaOptions(claim="practical"))
    assert found.limited_by == "domain" and 0.35 < found.volume < 0.45  # 2 (1 - 4/5) and 2 / 5


def test_a_practical_claim_goes_on_where_the_first_candidate_proves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The largest by its samples is one whose V rises almost everywhere; the next one is proved."""

    def misleading(loop: ClosedLoop, options: RoaOptions, effort: Effort) -> Trial:
        return replace(trial(loop, np.array([[1.0, -0.99], [-0.99, 1.0]]), "misleading", options, effort), volume=1e9)

    monkeypatch.setattr(certify.analysis.stages.candidate, "optimised", misleading)
    policy = load_policy(SHIPPED)
    network = replace(policy.network, centre="none")
    found = certify_roa(
        get_system("pendulum").with_parameters(policy.parameters),
        network,
        tmp_path,
        RoaOptions(claim="practical", candidate="ellipsoid", effort=0.1),
    )
    assert found.verdict == "PROVED" and found.candidate in ("lyapunov", "scaled", "lqr")
    assert [row.proved_volume is None for row in found.tried] == [True, False]
