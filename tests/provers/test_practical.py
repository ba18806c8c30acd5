"""Practical stability: what is proved is so, what is false is never proved, and nothing is forgotten inside c0."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import cvxpy
import numpy as np
import pytest

from certify.analysis.candidates.peak import peak_candidate
from certify.analysis.candidates.robust import robust_candidate
from certify.analysis.candidates.trials import optimised
from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import run_checker
from certify.certificates.claims import Practical
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, UNLIMITED, Effort
from certify.errors import InputError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork, load_policy
from certify.loop.rigorous import evaluate_vdot
from certify.lyapunov import domain_limit
from certify.provers.ball.local import _band
from certify.provers.base import Budget, Proof, Task
from certify.provers.boxes.engine import BoundsEngine
from certify.provers.boxes.search import prove_inwards
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import _promising, _Search, survey
from tests.provers.test_bounds import planted, vdot
from tests.support.cases import Case, case_of
from tests.support.loops import box, pendulum_network, scalar_tanh
from tests.support.marks import slow_after

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
PRACTICAL = RoaOptions(claim="practical", effort=0.02)


def prove(case: Case, budget: Budget | None = None, exactly: float | None = None) -> Proof:
    limit = domain_limit(case.P, case.loop.system.domain) * (1 - 1e-9)
    task = Task(case.problem, "practical", exactly or limit, exactly is not None)
    return BoundsEngine(case.T, ThreadRunner()).prove(task, budget or Budget(Effort(20 * UNIT)))


def uncentred(seed: int = 0) -> tuple[System, PolicyNetwork]:
    return get_system("pendulum"), dataclasses.replace(pendulum_network(seed=seed), centre="none")


def off_the_origin(shift: Fraction) -> tuple[System, PolicyNetwork]:
    """xdot = -x + shift: every trajectory converges to `shift`, so c0 cannot lie below shift^2 with V = x^2."""
    x, u = symbols("x u")
    drift = Fraction(shift.numerator, shift.denominator)
    system = System("off", (x,), (u,), {}, (u + drift,), (Number(0),), box(3), box(9))
    return system, PolicyNetwork.of_layers(
        (np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )


def test_the_floor_of_a_known_plant() -> None:
    case = case_of(*off_the_origin(Fraction(1, 4)))
    proof = prove(case)
    assert isinstance(proof.claim, Practical) and proof.stop is Stop.REQUESTED
    known = float(case.P[0, 0]) / 16
    assert known < proof.claim.floor < 1.01 * known
    assert proof.claim.roa == domain_limit(case.P, box(3)) * (1 - 1e-9)


def test_the_bounds_hold_on_samples_and_the_floor_is_near_a_violation() -> None:
    case = case_of(*uncentred())
    proof = prove(case)
    assert isinstance(proof.claim, Practical)
    z = np.random.default_rng(0).standard_normal((4000, 2))
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    for level in np.geomspace(proof.claim.floor, proof.claim.roa, 40):
        assert np.max(vdot(case, np.sqrt(level) * z @ case.T.T)) < 0
    below = [np.max(vdot(case, np.sqrt(proof.claim.floor * s) * z @ case.T.T)) for s in (0.99, 0.95, 0.9)]
    assert max(below) >= 0


def test_a_floor_that_roundings_make_does_not_cost_the_ball() -> None:
    """Beside its rest a loop has a floor for each ball, by roundings that grow with it, and none that is least."""

    def rounded(level: float) -> float:
        return 1e-6 * math.sqrt(level)

    def pushed(level: float) -> float:
        return 0.01 + level / 2

    tiny = _band(rounded, 1.0, UNLIMITED, 1.1)
    assert tiny is not None and tiny[1] < 1e-7
    assert _band(rounded, 1.0, UNLIMITED, 1.1, 1e-3) == (1e-6, 1.0)
    assert _band(pushed, 1.0, UNLIMITED, 1.1, 1e-3) == _band(pushed, 1.0, UNLIMITED, 1.1) != (0.51, 1.0)


def test_a_survey_finds_the_band_of_a_known_plant() -> None:
    case = case_of(*scalar_tanh())
    (band,) = survey(case.problem, case.T, 9.0)
    assert band.top < 1.915008**2 <= band.above
    shifted = case_of(*off_the_origin(Fraction(1, 4)))
    (band,) = survey(shifted.problem, shifted.T, 1.0)
    known = float(shifted.P[0, 0]) / 16
    assert band.below <= known < band.floor and band.top == band.above == 1.0


def test_a_survey_climbs_from_the_worst_samples_and_some_of_the_others() -> None:
    case = case_of(*uncentred())
    z = np.random.default_rng(0).standard_normal((3, 512, 2))
    search = _Search(case.problem, case.T)
    chosen = _promising(search, z).reshape(3, -1, 2)
    assert chosen.shape[1] <= 512 / 2  # each costs as much as a hundred samples
    for sphere, some in zip(z, chosen, strict=True):
        assert np.max(search.violation(some)[0]) == np.max(search.violation(sphere)[0])
        assert {tuple(one) for one in sphere[::8]} <= {tuple(one) for one in some}


@pytest.mark.parametrize("claim", ["practical", "asymptotic"])
def test_the_shipped_pendulum_without_its_centring(claim: str, tmp_path: Path) -> None:
    """pi(0) is 2e-5 N m away from 0: no theorem about the origin, but one about a set of a micro-radian."""
    policy = load_policy(POLICIES / "pendulum.pt")
    network = dataclasses.replace(policy.network, centre="none")
    system = get_system("pendulum").with_parameters(policy.parameters)
    if claim == "asymptotic":
        with pytest.raises(InputError, match="--claim practical"):
            certify_roa(system, network, tmp_path, RoaOptions(claim="asymptotic"))
        return
    result = certify_roa(system, network, tmp_path, PRACTICAL)
    assert result.verdict is Verdict.PROVED and result.stop is Stop.DOMAIN and result.certificate is not None
    assert result.levels.floor is not None and result.levels.roa is not None and result.levels.local is not None
    assert result.levels.floor < 1e-8 * result.levels.roa
    assert run_checker(result.certificate)["claim"] == "practical"
    assert run_checker(result.certificate, "reference")["result"] == "ACCEPTED"
    data = result.to_dict()
    assert data["claim"] == {"kind": "practical"} and data["levels"]["floor"] == result.levels.floor


def test_a_policy_trained_without_the_gain(tmp_path: Path) -> None:
    policy = load_policy(POLICIES / "without_gain" / "pendulum.pt")
    options = RoaOptions(claim="practical", candidate="lqr", around="origin", effort=0.02)
    result = certify_roa(get_system("pendulum").with_parameters(policy.parameters), policy.network, tmp_path, options)
    assert result.verdict is Verdict.PROVED and result.problem is not None and result.certificate is not None
    rest = np.array([-0.084302068, 0.0])  # where it comes to rest in simulation
    assert result.levels.floor is not None
    assert result.problem.V(rest) < result.levels.floor < 2 * result.problem.V(rest)
    assert run_checker(result.certificate, "reference")["result"] == "ACCEPTED"


def _check_planted(seed: int) -> bool:
    try:
        case, place = planted(seed)
    except InputError:
        return False
    case = case_of(case.loop.system, dataclasses.replace(case.loop.network, centre="none"), case.P)
    if not evaluate_vdot(case.loop, case.P, place) > 0:
        return False
    claim = prove(case, Budget(boxes=20_000, effort=Effort(60 * UNIT))).claim
    level = case.problem.V.exactly(place)
    assert claim is None or not claim.inner <= level <= claim.roa, f"{claim} has a violation at {level}"
    inside = level <= Fraction(domain_limit(case.P, case.loop.system.domain))
    if inside and claim is not None and level < claim.inner:  # asked for around the violation, it is refused too
        task = Task(case.problem, "practical", claim.roa, True)
        again = BoundsEngine(case.T, ThreadRunner()).prove(task, Budget(boxes=20_000, effort=Effort(60 * UNIT))).claim
        assert again is None or again.inner > level
    return inside


@pytest.mark.slow
def test_planted_violations_between_the_levels_are_never_proved() -> None:
    assert sum(_check_planted(seed) for seed in range(2)) >= 1


@pytest.mark.slow
def test_fifty_planted_violations_are_never_proved() -> None:
    assert sum(_check_planted(seed) for seed in range(100)) >= 50


def with_pole() -> tuple[System, PolicyNetwork]:
    """xdot = -x (1 + 1e-9 / (x - 1/100)): well behaved far out, with a pole inside."""
    x, u = symbols("x u")
    pole = Fraction(1, 10**9) / (x - Fraction(1, 100))
    system = System("pole", (x,), (u,), {}, (u - x * pole,), (Number(0),), box(3), box(9))
    return system, PolicyNetwork.of_layers(
        (np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"
    )


def test_a_pole_inside_the_floor_is_not_forgotten(tmp_path: Path) -> None:
    """Far out Vdot < 0, and trajectories run into the pole: levels above it are no claim, those below it are one."""
    case = case_of(*with_pole())
    at_pole = case.problem.V.exactly(np.array([0.01]))
    proof = prove(case, Budget(boxes=5_000, effort=Effort(20 * UNIT)))
    assert proof.claim is not None and proof.claim.roa < at_pole
    above = prove(case, Budget(boxes=5_000, effort=Effort(20 * UNIT)), exactly=1.0)
    assert above.claim is None and above.stop is Stop.SMOOTH
    result = certify_roa(*with_pole(), tmp_path, RoaOptions(claim="practical", level=1.0, max_boxes=5_000))
    assert result.verdict is Verdict.UNKNOWN and not list(tmp_path.iterdir())


def test_input_bounds_hold_inside_the_floor_too() -> None:
    """The bounds are broken near the origin only: the policy's steep tanhs rise there and cancel further out."""
    x, u = symbols("x u")
    system = System("bump", (x,), (u,), {}, (u - 2 * x,), (Number(0),), box(3), box(4))
    first, bias = np.array([[40.0], [40.0], [0.1]]), np.array([12.0, -12.0, 0.0])
    weights, biases = (first, np.array([[3.0, -3.0, -1.0]])), (bias, np.zeros(1))
    network = PolicyNetwork.of_layers(weights, biases, np.ones(1), np.zeros(1), "identity", "none")
    case = case_of(system, network)
    assert float(case.loop.policy(np.zeros((1, 1)))[0, 0]) > 4
    assert prove(case, Budget(boxes=5000, effort=Effort(20 * UNIT))).claim is None


def test_budgets_leave_a_floor_that_is_proved(tmp_path: Path) -> None:
    case = case_of(*uncentred())
    best = prove(case).claim
    assert isinstance(best, Practical)
    for boxes in (60, 120):
        claim = prove(case, Budget(boxes=boxes, batch=16)).claim
        assert claim is None or (claim.inner >= 0.999 * best.floor and claim.roa <= best.roa)
    ring = prove_inwards(case.problem, case.T, 1e-12, best.roa, Budget(boxes=300, batch=16), ThreadRunner())
    assert ring.inner >= 0.999 * best.floor


def hump() -> Case:
    """x' = -x + u/1000, whose input, 2 tanh(2) at x = 0, leaves its bounds there alone: no box there is closed."""
    x, u = symbols(["x", "u"])
    bounds = ((Fraction(-9), Fraction(19, 10)),)
    system = System("hump", (x,), (u,), {}, (-x + u / 1000,), (Number(0),), box(9), bounds)
    weights, biases = (np.ones((2, 1)), np.array([[1.0, -1.0]])), (np.array([2.0, -2.0]), np.zeros(1))
    network = PolicyNetwork.of_layers(weights, biases, np.ones(1), np.zeros(1), "identity", "none")
    return case_of(system, network)


def test_boxes_that_are_never_closed_end_with_the_effort() -> None:
    """After a pass inwards its open boxes are closed; that was counted nowhere, and ended with four million."""
    case, effort = hump(), Effort(5e7)
    ring = prove_inwards(case.problem, case.T, 1e-6, 16.0 * case.P[0, 0], Budget(effort), ThreadRunner())
    assert ring.stop is Stop.EFFORT and not ring.covered
    assert ring.boxes < 100_000 and effort.spent < 3 * effort.granted


def test_a_ring_that_the_effort_cut_short_is_not_said_to_be_impossible(tmp_path: Path) -> None:
    system = get_system("pendulum").with_sample((Fraction(1, 50), Fraction(1, 50)))
    result = certify_roa(system, pendulum_network(), tmp_path, RoaOptions(claim="practical", effort=0.003))
    assert result.verdict is Verdict.UNKNOWN and result.stop is Stop.EFFORT
    assert result.diagnosis is not None and "--effort" in dict(result.diagnosis.next.options)


def test_an_exact_level(tmp_path: Path) -> None:
    result = certify_roa(*uncentred(), tmp_path, RoaOptions(claim="practical", level=2.0))
    assert result.verdict is Verdict.PROVED and result.levels.roa == 2.0
    outside = certify_roa(*uncentred(), tmp_path, RoaOptions(claim="practical", level=1e6))
    assert outside.verdict is Verdict.REFUTED and outside.stop is Stop.DOMAIN


def test_the_point_that_ends_the_outer_level_is_told() -> None:
    """u = -x leaves [-1, 1] at |x| = 1."""
    system, network = off_the_origin(Fraction(1, 4))
    case = case_of(dataclasses.replace(system, input_bounds=box(1)), network)
    proof = prove(case)
    assert isinstance(proof.claim, Practical) and proof.witness is not None
    assert proof.witness.kind == "input" and proof.claim.roa <= proof.witness.level
    assert abs(abs(proof.witness.x[0]) - 1) < 1e-6 and proof.claim.roa > 0.99 * float(case.P[0, 0])


def test_the_optimised_candidate_is_that_of_the_centred_loop() -> None:
    """Under the policy as it is no V decreases near the origin, and the optimiser finds nothing."""
    system, network = uncentred()
    loop, centred = (ClosedLoop(system, dataclasses.replace(network, centre=c)) for c in ("none", "output"))
    found, known = optimised(loop, PRACTICAL, UNLIMITED), optimised(centred, RoaOptions(claim="asymptotic"), UNLIMITED)
    assert found is not None and known is not None and np.array_equal(found.P, known.P)
    assert found.task.kind == "practical" and found.task.problem.loop is loop
    assert 0 < found.volume <= 1.01 * known.volume


@pytest.mark.parametrize("candidate", slow_after(1, [peak_candidate, robust_candidate]))
def test_a_solution_that_may_be_inaccurate_is_no_warning(
    candidate: Callable[[ClosedLoop], np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The rules judge what comes of it; a user could do nothing about the solver's word."""
    solve, said = cvxpy.Problem.solve, []

    def inaccurate(problem: cvxpy.Problem, **options: object) -> object:
        said.append(problem)
        warnings.warn("Solution may be inaccurate. Try another solver.", stacklevel=1)
        return solve(problem, **options)

    monkeypatch.setattr(cvxpy.Problem, "solve", inaccurate)
    system, network = uncentred() if candidate is peak_candidate else (get_system("pendulum"), pendulum_network())
    P = candidate(ClosedLoop(system, network))
    assert said and np.all(np.linalg.eigvalsh(P) > 0)
