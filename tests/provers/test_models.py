"""Tubes and the matrix inequality as the engine has them: the checker's numbers in floats, and only what is true."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from flint import fmpq_mat

from certify.analysis.run import RoaOptions, certify_roa
from certify.certificates.verdict import Verdict
from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.decrease import Models as TheirModels
from certify.checker.decrease import Multipliers as TheirMultipliers
from certify.checker.exact import exactly
from certify.checker.jets import unpacked
from certify.effort import UNIT, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import cos, sin, symbols
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork, load_policy
from certify.lyapunov import domain_limit, leaves_domain
from certify.provers.ball.decrease import Multipliers, best_multipliers, decay_of, rest_of
from certify.provers.ball.local import prove_local
from certify.provers.ball.models import Models, paths
from certify.provers.tube.enlarge import Found, enlarge
from certify.provers.tube.tube import Around, Tube, find_tube
from tests.support.cases import case_of
from tests.support.certificates import parse
from tests.support.jets import remainders, seen, sides
from tests.support.loops import chain, pendulum_network, scalar_tanh, tank, units_apart, valve


def loop_of(name: str) -> tuple[System, PolicyNetwork]:
    if name == "scalar":
        return scalar_tanh()
    return chain(3, [-1, -2, -3]) if name == "chain" else (get_system("pendulum"), pendulum_network())


def floats(A: fmpq_mat) -> np.ndarray:
    return np.array([[int(v.p) / int(v.q) for v in row] for row in A.tolist()])


@pytest.mark.parametrize("name", ["scalar", "chain", "pendulum"])
def test_models_and_sides_are_those_of_the_checker(name: str, tmp_path: Path) -> None:
    """With the evidence of a certificate: the two share no line, and differ by rounding alone."""
    system, network = loop_of(name)
    result = certify_roa(system, network, tmp_path, RoaOptions(level=1e-3))
    assert result.verdict is Verdict.PROVED and result.raw is not None
    c = parse(json.loads(result.raw))
    assert c.evidence.local is not None
    J, by = c.evidence.local.J, TheirMultipliers.of(c.evidence.local)
    mine = paths(case_of(system, network).loop).models(J)
    assert mine.finite and mine.admitted
    with np.errstate(all="ignore"):
        ball = Ball(Case(c), J, "ball")
        found, units = ball.F(), ball.units
    theirs = seen(found)
    shares = np.array([f.B for f in theirs]) @ units.L
    for k, f in enumerate(theirs):
        third = unpacked(f.K[None], len(J))[0]
        for a, b in ((mine.A[k], f.a), (mine.Q[k], f.Q), (mine.K[k], third), (mine.E[k], f.E)):
            assert np.max(np.abs(a - b)) <= 1e-9 * (np.max(np.abs(b)) + 1e-6)
    for a, b in ((mine.shares, shares), (mine.R, remainders(units))):
        assert np.max(np.abs(a - b), initial=0.0) <= 1e-9 * (np.max(np.abs(b), initial=0.0) + 1e-6)
    models = sides(TheirModels(J, found, units, True), exactly(c.P), fmpq_mat(len(J), len(J)), by)
    decay, rest = map(floats, models)
    rows = np.array([[int(v.p) / int(v.q) for v in row] for row in (by.rest, by.apart, by.joint)])
    b = c.P @ J
    assert np.allclose(decay_of(mine, J, b), decay, rtol=1e-9, atol=1e-12 * np.max(decay))
    assert np.allclose(rest_of(mine, b, Multipliers(rows, by.weight)), rest, rtol=1e-6, atol=1e-6 * np.max(decay))
    assert best_multipliers(mine, J, c.P).margin > 0


def test_gradients_are_in_doubt_as_a_checker_has_them_where_units_differ(tmp_path: Path) -> None:
    """A state in nanometres and one in units of some metres a second: a checker bounds roundings of W x by norms, which
    is a millionth of the gradient here. A charge-driven microactuator was REJECTED for it."""
    system, network = units_apart(Fraction(1, 10**9))
    result = certify_roa(system, network, tmp_path, RoaOptions(candidate="scaled", level=0.1))
    assert result.verdict is Verdict.PROVED and result.raw is not None
    c = parse(json.loads(result.raw))
    assert c.evidence.local is not None
    J = c.evidence.local.J
    mine = paths(case_of(system, network, c.P).loop).models(J)
    with np.errstate(all="ignore"):
        theirs = float(Ball(Case(c), J, "ball").F()[1].slack.top)
    assert 1e-8 * np.linalg.norm(mine.inputs.A) < theirs <= mine.slack[1] <= 4 * theirs
    pendulum = paths(case_of(*loop_of("pendulum")).loop).models(0.1 * np.eye(2))
    assert not np.any(pendulum.slack)  # far less than what is left to roundings


def loops() -> dict[str, ClosedLoop]:
    """Networks with and without tanh at their ends, and plants with every function of the grammar."""
    curved = Path(__file__).parents[1] / "data" / "quadrotor2d_curved.pt"
    found = {name: loop_of(name) for name in ("scalar", "chain", "pendulum")} | {"tank": tank(), "valve": valve()}
    found["quadrotor2d"] = get_system("quadrotor2d"), load_policy(curved).network
    x, u = symbols("x u")
    others = {"trigonometric": sin(x + u / 3) + cos(x * u) - 1, "inverse": u + x / (2 + x + u / 5)}
    for name, f in others.items():
        system, network = scalar_tanh()
        found[name] = replace(system, states=(x,), inputs=(u,), dynamics=(f,)), network
    return {name: ClosedLoop(*pair) for name, pair in found.items()}


def beyond(loop: ClosedLoop, models: Models, x: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What F has at x beyond its models' third order, and the bound of that, (points, n)."""
    F = loop.system.function()(x, loop.policy(x))
    third = np.einsum("ihjk,ph,pj,pk->pi", models.K, d, d, d, optimize=True)
    polynomial = models.f + d @ models.A.T + np.einsum("ijk,pj,pk->pi", models.Q, d, d) + third
    units = np.einsum("qjk,pj,pk->pq", models.R, d, d, optimize=True) @ np.abs(models.shares).T
    return np.abs(F - polynomial), np.einsum("ijk,pj,pk->pi", models.E, d, d) + units


@pytest.mark.parametrize("name", list(loops()))
@pytest.mark.parametrize("moved", [False, True])
def test_models_enclose_the_loop_to_third_order(name: str, moved: bool) -> None:
    """At points of balls around the origin and around another state; half the ball has a sixteenth of the error."""
    loop, generator = loops()[name], np.random.default_rng(1)
    n = loop.system.n
    middle = 0.1 * generator.uniform(-1, 1, n) if moved else np.zeros(n)
    known = paths(loop, middle) if moved else paths(loop)
    whole = (0.05 if name == "quadrotor2d" else 0.3) / math.sqrt(n) * generator.standard_normal((n, n + moved))
    d = generator.standard_normal((2000, n + moved))
    d *= generator.random((2000, 1)) ** 0.3 / np.linalg.norm(d, axis=1, keepdims=True)
    bounds = []
    for J in (whole, whole / 2):
        models = known.models(J)
        error, bound = beyond(loop, models, middle + d @ J.T, d)
        assert np.all(error <= bound * (1 + 1e-9) + 1e-12)
        bounds.append(np.max(bound, axis=0))
    curved = bounds[0] > 1e-12
    assert np.any(curved) or name == "chain"
    assert np.all(bounds[0][curved] > 12 * bounds[1][curved])


def test_what_has_no_finite_model_says_so() -> None:
    """A root of what may be negative, an inverse of what may be 0."""
    for name, size in (("tank", 17.0), ("inverse", 2.5)):
        loop = loops()[name]
        with np.errstate(all="ignore"):
            assert not paths(loop).models(np.array([[size]])).finite
        assert paths(loop).models(np.array([[size / 10]])).finite


@pytest.mark.parametrize("name", list(loops()))
@pytest.mark.parametrize("moved", [False, True])
def test_models_on_several_balls_are_those_on_each(name: str, moved: bool) -> None:
    """Of shapes and sizes that differ: none takes anything from its neighbours."""
    loop, generator = loops()[name], np.random.default_rng(2)
    n = loop.system.n
    known = paths(loop, 0.1 * generator.uniform(-1, 1, n)) if moved else paths(loop)
    size = (0.05 if name == "quadrotor2d" else 0.3) * np.array([1.0, 0.03, 0.5, 0.9])[:, None, None]
    balls = size / math.sqrt(n) * generator.standard_normal((4, n, n + moved))
    for J, models in zip(balls, known.models_on(balls), strict=True):
        alone = known.models(J)
        assert alone.finite and models.finite
        for part in ("f", "A", "Q", "K", "E", "shares", "R", "squares"):
            mine, other = getattr(models, part), getattr(alone, part)
            assert np.allclose(mine, other, rtol=1e-12, atol=1e-14 * np.max(np.abs(other), initial=0.0))
        assert np.allclose(models.inputs.curve, alone.inputs.curve, rtol=1e-12)


@pytest.mark.parametrize(("name", "size"), [("tank", 17.0), ("inverse", 2.5)])
def test_a_ball_without_finite_models_leaves_none_to_the_others(name: str, size: float) -> None:
    loop = loops()[name]
    with np.errstate(all="ignore"):
        found = paths(loop).models_on(np.array([[[size / 10]], [[size]]]))
    assert not any(models.finite for models in found)


def check_in_floats(name: str, tube: Tube, goal: np.ndarray) -> None:
    """At points of the ellipsoids of each slab x'P(t)x falls; the slabs hang together, inside of the domain."""
    system, network = loop_of(name)
    loop, generator = case_of(system, network).loop, np.random.default_rng(3)
    before = tube.start
    for slab in tube.slabs:
        assert slab.duration > 0
        rates = (2 * (slab.middle - before), slab.end - before, 2 * (slab.end - slab.middle))
        for P, R in zip((before, slab.middle, slab.end), rates, strict=True):
            assert not leaves_domain(P, 1.0, system.domain)
            d = generator.standard_normal((200, len(P)))
            x = d / np.sqrt(np.einsum("bi,ij,bj->b", d, P, d))[:, None] * generator.uniform(0.1, 1, (200, 1))
            F = loop.system.function()(x, loop.policy(x))
            falls = np.einsum("bi,ij,bj->b", x, R / slab.duration, x) + 2 * np.einsum("bi,ij,bj->b", x, P, F)
            assert np.max(falls) < 0
        before = slab.end
    assert np.linalg.eigvalsh(before - goal)[0] > 0


@pytest.mark.parametrize("name", ["scalar", "chain", "pendulum"])
def test_tubes_lead_where_they_say(name: str) -> None:
    """Into half of what the local proof reaches, from more of it."""
    case, size = case_of(*loop_of(name)), 1.3
    known = paths(case.loop)
    level = prove_local(case.problem, case.T, domain_limit(case.P, case.loop.system.domain), known)
    assert level is not None
    goal = case.P / (level / 2)
    tube = find_tube(Around.of(case.loop, ()), goal / size**2, goal)
    assert tube is not None and (tube.start == goal / size**2).all()
    check_in_floats(name, tube, goal)


def test_no_tube_starts_beyond_the_region_of_attraction() -> None:
    """x' = x/2 - tanh(x): the origin attracts |x| < 1.915008."""
    case = case_of(*scalar_tanh())
    known, goal = Around.of(case.loop, ()), np.eye(1) / 0.25
    assert find_tube(known, np.eye(1) / 1.92**2, goal) is None
    assert find_tube(known, np.eye(1) / 0.36, goal, Effort(0.0)) is None


def test_the_search_reports_ever_larger_starts() -> None:
    case = case_of(*scalar_tanh())
    seen: list[Found] = []
    goal = np.eye(1) / 0.25
    best = enlarge(
        Around.of(case.loop, ()), goal, {"one": np.eye(1), "again": np.eye(1)}, Effort(20 * UNIT), report=seen.append
    )
    assert best is seen[-1] and best.volume > 2 * 0.5
    assert [s.volume for s in seen] == sorted(s.volume for s in seen)
    assert best.tube.start[0, 0] > 1.915009**-2  # inside of what the origin attracts
    check_in_floats("scalar", best.tube, goal)
    assert enlarge(Around.of(case.loop, ()), goal, {"one": np.eye(1)}, Effort(20 * UNIT), worth=2 * 1.9151) is None
