"""Plants with ranges: what is proved holds at every corner, what fails at one of them only is found there."""

from __future__ import annotations

import json
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, RoaResult, certify_roa
from certify.certificates.claims import Problem
from certify.certificates.verdict import Verdict
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Number, symbols
from certify.loop.plants import System, at_values, corners, get_system, load_system, with_input_errors
from certify.loop.policies import PolicyNetwork, load_policy
from certify.loop.rigorous import evaluate_vdot
from certify.lyapunov import diagonalising_coordinates
from certify.lyapunov.function import Quadratic
from certify.provers.ball.local import local_ball, prove_local
from certify.provers.falsify import confirm, falsify, refutes
from tests.support.loops import box
from tests.support.reference import judge_bytes

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
TENTH = {"m": (Fraction(135, 1000), Fraction(165, 1000)), "b": (Fraction(9, 100), Fraction(11, 100))}


def pendulum(ranges: dict[str, tuple[Fraction, Fraction]]) -> System:
    return get_system("pendulum").with_ranges(ranges)


def gain(lo: str, hi: str, centre: str = "none") -> tuple[System, PolicyNetwork]:
    """xdot = q x - tanh(x): the origin attracts |x| < x* with tanh(x*) = q x*, for q below 1."""
    x, u, q = symbols("x u q")
    system = System(
        "gain", (x,), (u,), {"q": (Fraction(lo) + Fraction(hi)) / 2}, (q * x + u,), (Number(0),), box(3), box(1)
    )
    network = PolicyNetwork.of_layers((np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "tanh", centre)
    return system.with_ranges({"q": (Fraction(lo), Fraction(hi))}), network


def problem_of(system: System, network: PolicyNetwork) -> tuple[Problem, np.ndarray]:
    loop = ClosedLoop(system, network)
    P, (A, _, _) = np.eye(system.n), loop.linearise()
    return Problem(loop, Quadratic(P)), diagonalising_coordinates(P, A)


def proved(system: System, out: Path, **more: object) -> RoaResult:
    options = RoaOptions(candidate="lqr", effort=4, **more)  # type: ignore[arg-type]
    result = certify_roa(system, load_policy(POLICIES / "pendulum.pt").network, out, options)
    assert result.verdict is Verdict.PROVED, result.detail
    assert result.raw is not None and judge_bytes(result.raw) is None
    return result


def decreases(result: RoaResult, inner: float, outer: float) -> None:
    """Vdot < 0 in Arb between the levels, at every corner and at the nominal plant."""
    network, generator = result.network, np.random.default_rng(0)
    assert result.P is not None
    L, system = np.linalg.inv(np.linalg.cholesky(result.P)).T, result.system
    middle = {name: (lo + hi) / 2 for name, (lo, hi) in system.ranges.items()}
    for values in [*corners(system), middle]:
        loop = ClosedLoop(at_values(system, values), network)
        for level in np.geomspace(inner * 1.001, outer * 0.999, 6):
            for d in generator.standard_normal((6, 2)):
                assert evaluate_vdot(loop, result.P, L @ d / np.linalg.norm(d) * np.sqrt(level)) < 0, (values, level)


def test_the_pendulum_with_uncertain_mass_and_friction(tmp_path: Path) -> None:
    result = proved(pendulum(TENTH), tmp_path)
    assert result.claim == "asymptotic" and result.levels.roa is not None and result.levels.roa > 10
    plant = json.loads(result.raw or b"")["plant"]
    assert plant["uncertain"] == [
        {"name": "m", "range": ["27/200", "33/200"]}, {"name": "b", "range": ["9/100", "11/100"]}]  # fmt: skip
    decreases(result, 1e-6 * result.levels.roa, result.levels.roa)


@pytest.mark.slow
def test_the_pendulum_under_a_torque_and_errors_of_its_input(tmp_path: Path) -> None:
    disturbed = TENTH | {"torque": (Fraction(-1, 20), Fraction(1, 20))}
    system = with_input_errors(pendulum(disturbed), {"u": Fraction(1, 10_000)})
    result = proved(system, tmp_path)
    document = json.loads(result.raw or b"")
    assert result.claim == "nearby" and [q["name"] for q in document["plant"]["uncertain"]] == [
        "m", "b", "torque", "error_u"]  # fmt: skip
    floor = float.fromhex(document["levels"]["floor"])
    assert result.levels.roa is not None and 0 < floor < 0.01 * result.levels.roa
    decreases(result, floor, result.levels.roa)


# ---------------------------------------------------------------------------------------------------------- falsifier


def test_the_falsifier_finds_the_corner_at_which_the_claim_fails() -> None:
    """tanh(x) = 9/10 x at x = 0.5838...: below it all is well for each q, and it is q = 9/10 that fails first."""
    problem, T = problem_of(*gain("2/5", "9/10"))
    found = falsify(problem, T, 1.0)
    assert found is not None and found.values == {"q": Fraction(9, 10)} and found.kind == "vdot"
    x = 0.5838
    assert abs(abs(found.x[0]) - x) < 1e-3 and np.tanh(x) - 0.9 * x == pytest.approx(0, abs=1e-3)
    assert confirm(problem, found) and refutes(problem, found, 1.0) and not refutes(problem, found, 0.3)
    assert "q = 0.9" in found.describe(problem.loop.system)
    assert falsify(problem, T, 0.33) is None


def test_the_nominal_plant_has_no_such_violation() -> None:
    system, network = gain("2/5", "9/10")
    problem, T = problem_of(at_values(system, {"q": Fraction(13, 20)}), network)
    assert falsify(problem, T, 1.0) is None


def test_a_level_is_refuted_with_the_values_at_which_it_fails(tmp_path: Path) -> None:
    system, network = gain("2/5", "9/10")
    options = RoaOptions(P=np.eye(1), level=0.5)
    result = certify_roa(system, network, tmp_path, options)
    assert result.verdict is Verdict.REFUTED and result.witness is not None
    assert dict(result.witness.values) == {"q": Fraction(9, 10)}
    assert Fraction(float(result.witness.x[0])) ** 2 <= Fraction(1, 2)
    below = certify_roa(system, network, tmp_path, RoaOptions(P=np.eye(1), level=0.32))
    assert below.verdict is Verdict.PROVED


def test_a_violation_is_judged_with_the_policy_of_the_nominal_plant() -> None:
    """u_eq = m belongs to the policy: at m = 3/2 the loop is not at rest at 0, though u = m would hold it there."""
    x, u, m = symbols("x u m")
    system = System("lift", (x,), (u,), {"m": Fraction(1)}, (u - m,), (m,), box(3), box(5))
    system = system.with_ranges({"m": (Fraction(1, 2), Fraction(3, 2))})
    network = PolicyNetwork.of_layers(
        (np.array([[-1.0]]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "output"
    )
    problem, T = problem_of(system, network)
    found = falsify(problem, T, 1.0)  # x' = -x + 1 - m is 1/2 - x at m = 1/2
    assert found is not None and found.level < 0.01 and confirm(problem, found)
    held = ClosedLoop(at_values(system, {"m": Fraction(3, 2)}), network)
    assert held.u_eq == (Fraction(1),) == problem.loop.u_eq
    assert evaluate_vdot(held, np.eye(1), np.array([-0.25])) > 0 > evaluate_vdot(held, np.eye(1), np.array([0.25]))


# -------------------------------------------------------------------------------------------------------- local proof


def test_a_wider_range_proves_less_with_one_cell() -> None:
    """The gradient of q x moves with q in a straight line."""
    cuts, levels = [], []
    for hi in ("1/2", "4/5", "19/20"):
        problem, T = problem_of(*gain("2/5", hi))
        level = prove_local(problem, T, 1.0)
        assert level is not None
        ball, parts = local_ball(problem, T, level)
        assert ball.J.shape == (1, 1) and len(parts) == 1
        cuts.append(parts[0])
        levels.append(level)
    assert levels == sorted(levels, reverse=True) and levels[-1] > 0
    assert cuts == [1, 1, 1]


@pytest.mark.slow
def test_nothing_local_is_proved_where_one_end_is_unstable() -> None:
    problem, T = problem_of(*gain("2/5", "1001/1000"))
    assert prove_local(problem, T, 1.0) is None


NINE = """
name = "pendulum"
states = ["theta", "theta_dot"]
inputs = ["u"]
[parameters]
A1 = [19.3, 19.9]
A2 = [-2.8, -2.5]
B1 = [26, 27]
C1 = [-0.05, 0.05]
C2 = [-0.02, 0.02]
B0 = [-0.01, 0.01]
D1 = [-0.1, 0.1]
D2 = [-0.02, 0.02]
[residual]
theta_dot = "10*theta**2"
[dynamics]
theta = "(1 + C2)*theta_dot + C1*theta + B0*u"
theta_dot = "(A1 + D1)*theta + (A2 + D2)*theta_dot + B1*u"
[u_eq]
u = 0
[domain]
theta = [-3.14, 3.14]
theta_dot = [-20, 20]
[input_bounds]
u = [-6, 6]
"""


def test_more_quantities_than_have_corners_are_proved(tmp_path: Path) -> None:
    (tmp_path / "nine.toml").write_text(NINE)
    policy, options = load_policy(POLICIES / "pendulum.pt").network, RoaOptions(candidate="optimised", effort=0.05)
    result = certify_roa(load_system(tmp_path / "nine.toml"), policy, tmp_path / "out", options)
    assert result.verdict is Verdict.PROVED, result.detail
    assert result.levels is not None and result.levels.local is not None and result.levels.local > 0.1
    assert result.raw is not None and judge_bytes(result.raw) is None
