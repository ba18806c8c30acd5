"""Tubes and the matrix inequality as the engine has them: the checker's numbers in floats, and only what is true."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from flint import fmpq_mat

from certify.checker.ball import Ball
from certify.checker.case import Case
from certify.checker.decrease import Models, sides
from certify.checker.exact import exactly
from certify.engines.decrease import best_multipliers, decay_of, rest_of
from certify.engines.enlarge import Found, enlarge
from certify.engines.local import prove_local
from certify.engines.models import paths
from certify.engines.tube import Tube, find_tube
from certify.lyapunov import domain_limit, leaves_domain
from certify.policies import TanhNetwork
from certify.roa import RoaOptions, certify_roa
from certify.systems import System, get_system
from certify.verdict import Verdict
from tests.support.cases import case_of
from tests.support.certificates import parse
from tests.support.loops import chain, pendulum_network, scalar_tanh


def loop_of(name: str) -> tuple[System, TanhNetwork]:
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
    J, by = c.evidence.local.J, c.evidence.local.multipliers
    mine = paths(case_of(system, network).loop).models(J)
    assert mine.finite and mine.admitted
    with np.errstate(all="ignore"):
        theirs = Ball(Case(c), J, "ball").F()
    for k, f in enumerate(theirs):
        for a, b in ((mine.A[k], f.a), (mine.Q[k], f.Q), (mine.E[k], f.E)):
            assert np.max(np.abs(a - b)) <= 1e-9 * (np.max(np.abs(b)) + 1e-6)
    decay, rest = map(floats, sides(Models(J, theirs), exactly(c.P), fmpq_mat(len(J), len(J)), by))
    rows = np.array([[int(v.p) / int(v.q) for v in row] for row in (by.rest, by.apart, by.joint)])
    b = c.P @ J
    assert np.allclose(decay_of(mine, J, b), decay, rtol=1e-9, atol=1e-12 * np.max(decay))
    assert np.allclose(rest_of(mine, b, rows), rest, rtol=1e-6, atol=1e-6 * np.max(decay))
    assert best_multipliers(mine, J, c.P).margin > 0


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
    tube = find_tube(known, goal / size**2, goal)
    assert tube is not None and (tube.start == goal / size**2).all()
    check_in_floats(name, tube, goal)


def test_no_tube_starts_beyond_the_region_of_attraction() -> None:
    """x' = x/2 - tanh(x): the origin attracts |x| < 1.915008."""
    case = case_of(*scalar_tanh())
    known, goal = paths(case.loop), np.eye(1) / 0.25
    assert find_tube(known, np.eye(1) / 1.92**2, goal) is None
    assert find_tube(known, np.eye(1) / 0.36, goal, seconds=0.0) is None


def test_the_search_reports_ever_larger_starts() -> None:
    case = case_of(*scalar_tanh())
    seen: list[Found] = []
    goal = np.eye(1) / 0.25
    best = enlarge(paths(case.loop), goal, {"one": np.eye(1), "again": np.eye(1)}, lambda: 20.0, report=seen.append)
    assert best is seen[-1] and best.volume > 2 * 0.5
    assert [s.volume for s in seen] == sorted(s.volume for s in seen)
    assert best.tube.start[0, 0] > 1.915009**-2  # inside of what the origin attracts
    check_in_floats("scalar", best.tube, goal)
    assert enlarge(paths(case.loop), goal, {"one": np.eye(1)}, lambda: 20.0, worth=2 * 1.9151) is None
