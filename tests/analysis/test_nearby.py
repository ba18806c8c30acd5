"""The set that is claimed where the largest one is not shown to converge to one equilibrium."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from certify import RoaOptions, System, Verdict, certify_roa, symbols
from certify.analysis.stages.candidate import _Choice
from certify.certificates import Certificate, PartitionTree
from certify.certificates.checking import run_checker
from certify.certificates.claims import Practical, Problem
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.policies import PolicyNetwork
from certify.lyapunov.function import Quadratic
from certify.provers.ball.local import Rule, local_ball, prove_band
from tests.support.corners import plant as cornered
from tests.support.corners import regulator
from tests.support.loops import chain


def bumpy(half_width: int = 1, ends: float = 1.0) -> tuple[System, PolicyNetwork]:
    """x+ = u, with u of slope 1/2, but -2 from 0.1 to 0.3, and 2.5 beyond `ends`; not at rest at 0.

    |u| is less than |x| next to the rest, at about 1/1000, but not from 1/4 to 7/20.
    """
    x, u = symbols("x u")
    bound = Fraction(4 * half_width)
    plant = System(
        name="bumpy",
        states=(x,),
        inputs=(u,),
        parameters={},
        dynamics=(u,),
        u_eq=(0,),
        domain=((Fraction(-half_width), Fraction(half_width)),),
        input_bounds=((-bound, bound),),
        time="discrete",
    )
    bends, growth = np.array([-9.0, 0.1, 0.3, ends]), 2.0 * (ends < half_width)
    last = np.array([[0.5, -2.5, 2.5, growth]])
    law = PolicyNetwork.of_layers(
        weights=(np.ones((4, 1)), last),
        biases=(-bends, np.array([-4.5 + 5e-4])),
        scale=[1.0],
        offset=[0.0],
        squash="identity",
        centre="none",
        activation="relu",
    )
    return plant, law


def test_the_set_that_converges_is_claimed_where_that_is_asked_for(tmp_path: Path) -> None:
    plant, law = bumpy()
    large = certify_roa(plant, law, tmp_path / "auto", RoaOptions(candidate="ellipsoid", effort=0.2))
    assert (large.verdict, large.claim) == (Verdict.PROVED, "practical")
    assert large.volume is not None and large.volume > 1.8
    close = certify_roa(plant, law, tmp_path / "nearby", RoaOptions(candidate="ellipsoid", claim="nearby", effort=0.2))
    assert (close.verdict, close.claim) == (Verdict.PROVED, "nearby")
    assert close.volume is not None and 0.15 < close.volume < 0.5
    assert close.notice is not None and "not that all converge to one equilibrium" in close.notice


def test_next_to_nothing_of_the_domain_counts_for_less_than_convergence(tmp_path: Path) -> None:
    plant, law = bumpy(400)
    result = certify_roa(plant, law, tmp_path, RoaOptions(candidate="ellipsoid", effort=0.2))
    assert (result.verdict, result.claim) == (Verdict.PROVED, "nearby")
    assert result.volume is not None and 0.15 < result.volume < 0.5


def test_a_level_without_kinks_is_kept_where_the_effort_ends_with_them(monkeypatch: pytest.MonkeyPatch) -> None:
    plant, law = bumpy()
    problem = Problem(ClosedLoop(plant, law), Quadratic(np.eye(1)))
    effort = Effort(1e9)

    def dear(self: Rule, level: float, effort: Effort) -> None:
        effort.charge(effort.left)

    monkeypatch.setattr(Rule, "with_kinks", dear)
    found: Any = prove_band(problem, np.eye(1), 1.0, effort=effort)
    assert found is not None and found[0] < found[1] < 0.011  # the first kink is at 0.1
    assert 0 < effort.left < 6e8  # half of it was for kinks


def test_a_candidate_leaves_half_of_the_effort_to_its_only_heat() -> None:
    """Beside a function to be learned, a quarter of the whole is there for both; a candidate alone may take as much."""
    state: Any = SimpleNamespace(interruptible=False, options=RoaOptions(candidate="neural"))
    tools: Any = SimpleNamespace(whole=100.0)
    effort = Effort(25.0)
    granted = _Choice(state, tools, effort, race=cast(Any, None))._granted()
    granted.charge(granted.left)
    assert effort.left == 12.5


def test_sampling_other_candidates_leaves_half_to_their_only_heats() -> None:
    """Of a wide network the samples of all candidates took all the effort, and no heat was run."""
    state: Any = SimpleNamespace(interruptible=False, options=RoaOptions())
    tools: Any = SimpleNamespace(whole=100.0)
    effort = Effort(25.0)
    granted = _Choice(state, tools, effort, race=cast(Any, None))._for_others()
    granted.charge(granted.left)
    assert effort.left == 12.5


def test_a_look_at_a_step_is_no_dearer_than_a_step() -> None:
    """Only an input that is held needs a series."""
    plant, law = bumpy()
    rule = Rule.anywhere(Problem(ClosedLoop(plant, law), Quadratic(np.eye(1))), np.eye(1))
    assert rule.operations_of_models == 3 * rule.steps.known.operations


def test_a_loop_that_rests_exactly_in_floats_has_an_enclosure_of_a_period(tmp_path: Path) -> None:
    """Nothing moves the equilibrium, so that the bound of how far it moves within a period starts from 0."""
    plant, law = chain(2, [-1.0, -2.0])
    held = plant.with_sample((Fraction(1, 20), Fraction(1, 20)))
    result = certify_roa(held, law, tmp_path, RoaOptions(candidate="lyapunov", claim="nearby"))
    assert (result.verdict, result.claim) == (Verdict.PROVED, "nearby")


def test_the_checker_follows_a_period_as_closely_as_the_engine(tmp_path: Path) -> None:
    """Where rates at the equilibrium are only rounding the checker takes one more attempt at how far a period leads.

    The next 1.25 of what was already enough made its abs(y) in the period larger than the engine's: it refused balls.
    """
    system = cornered("x y", "y", "-abs(y)*y + min(x, 3/10) + 2*u", bound=5).with_sample((Fraction(0), Fraction(1, 20)))
    P, T = np.array([[0.1215, 0.0355], [0.0355, 0.1215]]), np.array([[-0.448, -2.966], [2.968, 0.438]])
    problem = Problem(ClosedLoop(system, regulator(1, 1)), Quadratic(P))
    level, floor = 0.0025, 1e-10
    ball, cells = local_ball(problem, T, level, floor)
    evidence = PartitionTree(T, np.ones(2), bytes([255]), ball, cells=cells)
    certificate = Certificate(
        system, regulator(1, 1), problem.V, Practical(roa=level, local=level, floor=floor), evidence
    )
    path = tmp_path / "certificate.json"
    path.write_bytes(certificate.to_json().encode())
    answer = run_checker(path)
    assert answer["result"] == "ACCEPTED", answer
