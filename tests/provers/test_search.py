"""A pass that is asked on the way, and what it expects of itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.loop.plants import get_system
from certify.loop.policies import load_policy
from certify.provers.base import Budget, Task
from certify.provers.boxes.engine import BoundsEngine
from certify.provers.boxes.search import outwards, prove_outwards
from certify.provers.execution import ThreadRunner
from tests.support.cases import case_of
from tests.support.loops import pendulum_network, scalar_tanh

POLICIES = Path(__file__).parent.parent.parent / "examples" / "policies"
CURVED = Path(__file__).parents[1] / "data"  # quadrotors before they were flattened
RUNNER = ThreadRunner()


def test_a_pass_in_pieces_is_the_pass_in_one() -> None:
    case = case_of(get_system("pendulum"), pendulum_network())
    whole = prove_outwards(case.problem, case.T, 1e-6, 6.0, Budget(batch=16), RUNNER)
    pieces = outwards(case.problem, case.T, 1e-6, 6.0, RUNNER)
    levels = []
    while not pieces.done:
        assert pieces.advance(Budget(boxes=50, batch=16)) in (Stop.BOXES, None)
        levels.append(pieces.proof(Stop.BOXES).outer)
    assert len(levels) > 3 and levels == sorted(levels)
    found = pieces.proof()
    assert found.outer == whole.outer and found.stop is whole.stop
    assert found.leaves == found.tree.count(b"\xff") and pieces.levels == (1e-6, whole.outer)


def test_boxes_too_small_to_halve_are_no_limit_on_boxes() -> None:
    case = case_of(get_system("pendulum"), pendulum_network())
    found = prove_outwards(case.problem, case.T, 1e-6, 6.0, Budget(batch=16, least_width=0.2), RUNNER)
    assert found.stop is Stop.SMALL and found.outer < 6.0 and found.boxes < 1000


def test_a_snapshot_is_a_proof() -> None:
    """On every leaf that meets the ring of a snapshot the bound is negative with the snapshot's own levels."""
    from certify.certificates.tree import leaves

    case = case_of(get_system("pendulum"), pendulum_network())
    ring = outwards(case.problem, case.T, 1e-6, 6.0, RUNNER)
    while ring.levels[0] == ring.levels[1]:
        ring.advance(Budget(boxes=50, batch=16))
    found = ring.proof(Stop.BOXES)
    assert found.inner < found.outer < 6.0
    lo, hi = (np.array(a.T.copy()) for a in leaves(found.tree, found.root))
    lowest, highest = ring.rule.levels(lo, hi)
    meets = (lowest <= found.outer) & (highest >= found.inner)
    assert int(meets.sum()) > 5 and bool(ring.rule(lo, hi, found.inner, found.outer).proved[meets].all())


def test_a_pass_is_done_where_a_violation_lies_at_its_inner_level() -> None:
    """Boxes that straddle the inner level stay undecided for ever, and could add nothing to it."""
    case = case_of(*scalar_tanh())
    edge = float(case.problem.V.P[0, 0]) * 1.915008048**2
    ring = outwards(case.problem, case.T, edge * (1 - 1e-6), 2 * edge, RUNNER)
    assert ring.advance(Budget(boxes=1000)) is None and ring.done and ring.boxes < 100
    assert ring.sweep.outer <= ring.sweep.inner and len(ring.frontier) and ring.levels[0] == ring.levels[1]
    assert ring.proof().stop is Stop.WITNESS


def test_the_effort_of_the_check_is_left() -> None:
    case = case_of(get_system("pendulum"), pendulum_network())
    ring = outwards(case.problem, case.T, 1e-6, 6.0, RUNNER)
    assert ring.advance(Budget(Effort(UNIT), batch=4, check=0.05 * UNIT)) is Stop.EFFORT
    assert 10 <= ring.proved < 30


@pytest.mark.slow
@pytest.mark.parametrize(("name", "hopeless"), [("cartpole", False), ("quadrotor2d", False), ("quadrotor3d", True)])
def test_what_a_search_expects_tells_the_hopeless(name: str, hopeless: bool) -> None:
    """Four and six states have gained within 40,000 boxes; twelve states would need 1e15."""
    path = POLICIES / "cartpole.pt" if name == "cartpole" else CURVED / f"{name}_curved.pt"
    policy = load_policy(path)
    case = case_of(get_system(name).with_parameters(policy.parameters), policy.network)
    attempt = BoundsEngine(case.T, RUNNER).begin(Task(case.problem, "asymptotic", 1e-2))
    attempt.advance(Budget(boxes=600, batch=600))
    assert (attempt.expected > 1e9) is hopeless
    assert not (hopeless and attempt.gained)


@pytest.mark.slow
def test_a_run_that_gains_nothing_stops_early_and_says_so(tmp_path: Path) -> None:
    policy = load_policy(CURVED / "quadrotor3d_curved.pt")
    system = get_system("quadrotor3d").with_parameters(policy.parameters)
    options = RoaOptions(candidate="lqr", effort=12)
    result = certify_roa(system, policy.network, tmp_path, options)
    assert result.verdict is Verdict.PROVED and result.stop is Stop.STALLED
    assert result.seconds["total"] < 200 and "added nothing to the local level" in result.reason
    assert result.levels.roa == result.levels.local and np.isfinite(result.levels.roa or np.nan)
