"""Constraints: where a box or a ball is shown to keep one it does, and a level set that grazes one is never proved."""

from __future__ import annotations

import dataclasses
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates import run_checker
from certify.certificates.verdict import Stop, Verdict
from certify.effort import UNIT, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.constraints import Constraints
from certify.loop.expressions import Expression, Symbol, evaluate_exactly, maximum, minimum
from certify.loop.plants import System, get_system, in_parts, kept_constraints, mean_rate, with_constraints
from certify.lyapunov import domain_limit, optimise_candidate, solve_lyapunov, volume
from certify.provers.ball.local import Rule, ball_around, prove_local
from certify.provers.base import Budget, Task
from certify.provers.boxes.engine import BoundsEngine
from certify.provers.boxes.rule import VdotBound
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import confirm, falsify, refutes, touch
from tests.provers.test_steps import Stepped, alone, held, stepped, uncertain_pendulum
from tests.provers.test_vdot import boxes
from tests.support.loops import pendulum_network, scalar_tanh
from tests.support.marks import slow_after

POLICIES = Path(__file__).parents[2] / "examples" / "policies"
KEEP = ("theta_dot + 3*theta <= 2", "max(abs(u) - 4, theta*theta_dot/3 + sin(theta) - 0.8) <= 0")
AVOID = ("(theta - 0.8)**2 + (theta_dot/4 + 0.3)**2 < 0.09",)


def pendulum(system: System | None = None) -> System:
    return with_constraints(system or get_system("pendulum"), KEEP, AVOID)


CASES = {
    "at once": lambda: stepped(pendulum(), pendulum_network()),
    "held": lambda: stepped(pendulum().with_sample(held("1/50")), pendulum_network()),
    "jitter": lambda: stepped(pendulum().with_sample(held("1/100", "1/50")), pendulum_network()),
    "uncertain": lambda: stepped(pendulum(uncertain_pendulum()), pendulum_network()),
    "uncertain, held": lambda: stepped(pendulum(uncertain_pendulum()).with_sample(held("1/50")), pendulum_network()),
    "discrete": lambda: stepped(*with_wall(*alone("x/2 - tanh(x) + x**3/20"))),
}


def with_wall(system: System, network: object) -> tuple:
    return with_constraints(system, ["x <= 0.7", "x**3 - x >= -2"], []), network


def worst(case: Stepped, x: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """The largest g (B,) at states (B, n) and at all times of a random period from them, for random quantities."""
    loop, system = case.loop, case.loop.system
    constraints, u = Constraints(loop), loop.policy(x)
    f, found = system.uncertain_function(), np.full(len(x), -np.inf)
    values = [generator.uniform(float(lo), float(hi)) for _, (lo, hi) in system.uncertain]
    longest = 0.0 if system.sample is None else float(system.sample[1])
    for share in (0.0,) if not longest else (0.0, 0.3, 0.7, 1.0):
        h = share * longest
        after = x + h * mean_rate(system, lambda y, v: f(y, v, values), x, u, h) if h else x
        constraints.values = [values]
        found = np.maximum(found, constraints.at(after, u).max(-1))
    return found


@pytest.mark.parametrize(("keep", "reads"), [("x <= 0.7", False), ("abs(u) <= 0.3", True)])
def test_the_policy_is_asked_only_where_a_constraint_reads_an_input(
    monkeypatch: pytest.MonkeyPatch, keep: str, reads: bool
) -> None:
    system, network = alone("x/2 - tanh(x)")
    constraints = Constraints(ClosedLoop(with_constraints(system, [keep], []), network))
    x = np.linspace(-1, 1, 24).reshape(4, 6, 1)
    expected, asked = constraints.at(x, constraints.loop.policy(x)).max(-1), list[object]()
    monkeypatch.setattr(ClosedLoop, "policy", lambda loop, y: asked.append(y) or loop.folded(y, loop.u_eq))
    assert np.array_equal(constraints.worst(x), expected) and bool(asked) is reads


@pytest.mark.parametrize("name", CASES)
def test_what_is_proved_on_boxes_is_so(name: str) -> None:
    case, generator = CASES[name](), np.random.default_rng(0)
    n, outer, met = case.loop.system.n, 3.0, 0
    for size in (0.3, 0.1):
        lo, hi = boxes(n, 300, size)
        proved = VdotBound(case.problem, case.T, inside=not case.loop.step)(lo, hi, 1e-3, outer).smooth
        for _ in range(20):
            z = lo + (hi - lo) * generator.random(lo.shape)
            x = z.T @ case.T.T
            inside = proved & (case.problem.V(x) <= outer)
            assert np.all(worst(case, x, generator)[inside] < 0)
            met += int(inside.sum())
    assert met > 300


@pytest.mark.parametrize("name", CASES)
def test_the_ball_of_the_local_rule_keeps_them(name: str) -> None:
    case, generator = CASES[name](), np.random.default_rng(1)
    limit = domain_limit(case.problem.V.P, case.loop.system.domain) * (1 - 1e-9)
    level = prove_local(case.problem, case.T, limit)
    if name == "uncertain, held":  # nothing of it is proved on a ball, with or without constraints
        assert level is None
        rule = Rule.anywhere(case.problem, case.T)
        rule = dataclasses.replace(rule, cells=[tuple(case.loop.system.ranges.values())])
        keeps = (q for q in limit * 0.9 ** np.arange(80) if rule.keeps(ball_around(case.problem, case.T, q)))
        level = next(keeps)
    assert level is not None
    n = case.loop.system.n
    z = generator.standard_normal((20_000, n))
    z *= (math.sqrt(level) * generator.random((len(z), 1)) ** (1 / n)) / np.linalg.norm(z, axis=1, keepdims=True)
    assert np.all(worst(case, z @ case.T.T, generator) < 0)


def test_a_wall_ends_the_ball_where_it_touches() -> None:
    """x < 0.7 and V = p x^2: the level is p 0.49, within the search's 2 %, and without the wall much larger."""
    plain, network = scalar_tanh()
    case = stepped(with_constraints(plain, ["x <= 0.7"], []), network)
    edge = float(case.problem.V.P[0, 0]) * 0.49
    level = prove_local(case.problem, case.T, 10.0)
    free = prove_local(stepped(plain, network).problem, case.T, 10.0)
    assert level is not None and free is not None and 0.975 * edge <= level < edge < 0.8 * free


def test_the_falsifier_finds_the_lowest_violation() -> None:
    """Of a half-space a'x < b it lies at b^2 / (a'P^-1 a)."""
    system = with_constraints(get_system("pendulum"), ["2*theta + theta_dot/3 <= 0.6"], [])
    case = stepped(system, pendulum_network())
    a = np.array([2.0, 1 / 3])
    lowest = 0.36 / float(a @ np.linalg.solve(case.problem.V.P, a))
    for found in (falsify(case.problem, case.T, 2 * lowest), touch(case.problem, case.T, 2 * lowest)):
        assert found is not None and found.kind == "keep" and found.constraint == "keep"
        assert lowest <= found.level < lowest * (1 + 1e-5) and confirm(case.problem, found)
        assert refutes(case.problem, found, found.level * (1 + 1e-9))
        assert not refutes(case.problem, found, lowest * (1 - 1e-9))
    assert falsify(case.problem, case.T, lowest * (1 - 1e-6)) is None
    assert touch(case.problem, case.T, lowest * (1 - 1e-6)) is None


def grazed(seed: int, by: float) -> tuple[System, np.ndarray, float]:
    """The pendulum, P and a level, with a constraint that is violated by so much on the level set: a half-space, or a
    disc from outside."""
    generator, system = np.random.default_rng(seed), get_system("pendulum")
    loop = ClosedLoop(system, pendulum_network())
    P = solve_lyapunov(loop.mean_rate(), np.eye(2))
    level, angle = 0.05 * generator.uniform(0.5, 1.0), generator.uniform(0, 2 * math.pi)
    root = np.linalg.inv(np.linalg.cholesky(P)).T
    x = math.sqrt(level) * root @ [math.cos(angle), math.sin(angle)]  # on the level set
    normal = P @ x / np.linalg.norm(P @ x)
    if seed % 2:
        a, b = (Fraction(v) for v in normal)
        keep, avoid = [f"{a}*theta + ({b})*theta_dot <= {Fraction(float(normal @ x) - by)}"], list[str]()
    else:
        middle, radius = x + 0.05 * normal, 0.05 + by
        p, q = (Fraction(v) for v in middle)
        keep, avoid = [], [f"(theta - ({p}))**2 + (theta_dot - ({q}))**2 < {Fraction(radius) ** 2}"]
    return with_constraints(system, keep, avoid), P, level


@pytest.mark.parametrize("seed", slow_after(1, range(6)))
@pytest.mark.parametrize("by", [1e-3, 1e-6, -1e-6, -1e-3])
def test_a_level_that_grazes_a_constraint_is_proved_on_one_side_only(seed: int, by: float, tmp_path: Path) -> None:
    system, P, level = grazed(seed, by)
    result = certify_roa(system, pendulum_network(), tmp_path, RoaOptions(P=P, level=level, effort=0.05))
    if by > 0:
        assert result.verdict is Verdict.REFUTED and result.witness is not None
        assert result.witness.kind == "keep" and result.certificate is None
    elif by < -1e-4:
        assert result.verdict is Verdict.PROVED


def test_a_violation_just_inside_the_level_ends_the_search(tmp_path: Path) -> None:
    """Without telling the falsifier: boxes find it, and the level is below."""
    system, P, level = grazed(0, 1e-4)
    case = stepped(system, pendulum_network(), P=P)
    task = Task(case.problem, "asymptotic", level)
    proof = BoundsEngine(case.T, ThreadRunner()).prove(task, Budget(Effort(UNIT)))
    assert proof.claim is not None and proof.claim.roa < level and len(proof.claim.keep) == 1
    assert proof.witness is None or proof.witness.kind == "keep"
    assert proof.stop in (Stop.WITNESS, Stop.SMALL)


def test_the_optimised_candidate_turns_away_from_a_wall() -> None:
    system = with_constraints(get_system("pendulum"), ["theta <= 0.5"], [])
    loop = ClosedLoop(system, pendulum_network())
    start = solve_lyapunov(loop.mean_rate(), np.eye(2))
    P = optimise_candidate(loop, start, effort=Effort(UNIT))
    a = np.array([1.0, 0.0])
    assert math.sqrt(a @ np.linalg.solve(P, a)) <= 0.5 * (1 + 1e-9)
    most = 0.25 / float(a @ np.linalg.solve(start, a))
    assert volume(P, 1.0) > 1.2 * volume(start, most)


def test_half_spaces_are_recognised() -> None:
    system = with_constraints(
        get_system("pendulum"), ["2*theta - (theta_dot - 1)/4 <= 3", "u <= 4", "theta**2 <= 1", "theta >= g/2"], []
    )
    planes = Constraints(ClosedLoop(system, pendulum_network())).planes
    assert len(planes) == 1 and planes[0][0].tolist() == [2.0, -0.25] and planes[0][1] == 2.75


x, y = Symbol("x"), Symbol("y")


@pytest.mark.parametrize(
    ("g", "parts"),
    [
        (abs(x) - 4, 2),
        (abs(x) + 2 * abs(y - 1) - 4, 4),
        (maximum(x, y, x * y) - 1, 3),
        (1 - minimum(x, 3 - abs(y)), 3),
        (-3 * minimum(x, y) / 2 - 1, 2),
        (1 - abs(x), 1),
        (abs(x) * y - 1, 1),
        (x * x - 1, 1),
    ],
)
def test_parts_say_together_what_the_whole_says(g: Expression, parts: int) -> None:
    found, generator = in_parts(g), np.random.default_rng(0)
    assert len(found) == parts
    for point in generator.integers(-12, 13, (200, 2)).tolist():
        at = {x: Fraction(point[0], 2), y: Fraction(point[1], 2)}
        assert max(evaluate_exactly(e, at) for e in found) == evaluate_exactly(g, at)


def test_a_constraint_that_has_no_model_at_rest_is_one_that_its_parts_have(tmp_path: Path) -> None:
    """abs(u) has none around u = 0; u and -u do."""
    system = with_constraints(get_system("pendulum"), ["abs(u) <= 2"], [])
    assert [str(g) for g in kept_constraints(system).values()] == ["u - 2", "-u - 2"]
    options = RoaOptions(candidate="lyapunov", effort=0.05)
    result = certify_roa(dataclasses.replace(system), pendulum_network(), tmp_path, options)
    assert result.verdict is Verdict.PROVED and result.certificate is not None
    assert list(result.constraints) == ["keep_1", "keep_2"]
    assert run_checker(result.certificate, program="reference")["result"] == "ACCEPTED"
