"""Kinks on a ball, as the prover finds them: directions, levels, and whole runs whose certificates are accepted."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from certify import certify_roa
from certify.certificates.verdict import Verdict
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import domain_limit
from certify.provers.ball.kinks import ALL, Cone, Directions, OnCone, has_kinks
from certify.provers.ball.local import Rule, local_ball, prove_local
from tests.support.cases import case_of
from tests.support.corners import plant, regulator
from tests.support.marks import slow_after


def sides(*gain: float, share: float = 1.0, bias: float = 0.0) -> PolicyNetwork:
    """u = -K x by two relus, with a share of it alone where K x > 0; with a bias both kinks are away from 0."""
    K = np.array([gain])
    weights = np.vstack([-K, K]), np.array([[1.0, -share]])
    biases = np.full(2, bias), np.array([(share - 1) * bias])
    return PolicyNetwork.of_layers(
        weights, biases, np.ones(1), np.zeros(1), "identity", "none", activation="relu"
    )  # fmt: skip


DOUBLE = plant("x y", "y", "u", half=2, bound=9)


def limit_of(case: Any) -> float:
    return domain_limit(case.P, case.loop.system.domain)


def test_directions_cover_every_direction() -> None:
    directions = Directions(3).refined(lambda cone: cone.narrow and cone.squares[1] < 0.05 * cone.squares[0], 5000)
    assert directions is not None
    cones = directions.cones
    d = np.random.default_rng(0).normal(size=(2000, 3))
    inside = [(d @ c.c >= np.sqrt(c.squares[0] - c.squares[1]) * np.linalg.norm(d, axis=1) - 1e-12) for c in cones]
    assert np.all(np.any(inside, axis=0)) and len(cones) == sum(tree.count(255) for tree in directions.trees)
    assert directions.refined(lambda cone: True, 5000) == directions
    assert Directions(3).refined(lambda cone: False, 50) is None and Directions(3).cones == [ALL]


def test_a_form_lies_in_its_reach() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        c, r = rng.normal(size=3), rng.uniform(0, 0.4, 3)
        cone = Cone(c, r) if r @ r < c @ c else ALL
        a = rng.normal(size=(4, 3))
        below, above = cone.reach(a, np.zeros(4))
        b = c + r * rng.uniform(-1, 1, (200, 3))
        values = b @ a.T / np.linalg.norm(b, axis=1, keepdims=True)
        assert np.all(values <= above + 1e-9) and np.all(values >= -below - 1e-9)


def test_a_network_on_a_cone_is_within_its_kinks() -> None:
    """u - m'x at samples is at most |alpha.d| + beta ||d|| of the two kinks."""
    law, cone = sides(1.0, 1.5, share=0.5), Cone(np.array([1.0, -0.5]), np.array([0.0, 0.3]))
    ball = OnCone(np.eye(2), cone)
    v = ball.run(law.network, ball.argument(np.zeros(2)))
    d = (cone.c + cone.r * np.random.default_rng(0).uniform(-1, 1, (500, 2))) * 0.5
    d /= np.maximum(1.0, np.linalg.norm(d, axis=1, keepdims=True))
    kinks = ball.kinks
    each = np.abs(d @ kinks.alpha.T) + np.outer(np.linalg.norm(d, axis=1), kinks.beta)
    L = np.abs(ball.reached(v)[0])
    assert has_kinks(law.network) and np.any(kinks.rho > 0)
    assert np.all(np.abs(law(d, ()) - d @ v.G.T) <= each @ L.T + 1e-12)


@pytest.mark.parametrize("share", [1.0, 0.6])
def test_a_kink_at_the_origin_has_a_level(share: float) -> None:
    case = case_of(DOUBLE, sides(1.0, 1.5, share=share))
    level = prove_local(case.problem, case.T, limit_of(case))
    assert level is not None and level > 1e-3 * limit_of(case)
    ball, _ = local_ball(case.problem, case.T, level)
    assert ball.directions is not None and len(ball.directions) == 4


def test_a_loop_that_falls_over_to_one_side_has_none() -> None:
    """x'' = x + u, with a gain of 3/5 where x + y > 0."""
    system = plant("x y", "y", "x+u", half=2, bound=9)
    case = case_of(system, sides(2.0, 2.0, share=0.9))
    assert prove_local(case.problem, case.T, limit_of(case)) is not None
    rule = Rule.at_rest(case_of(system, sides(2.0, 2.0, share=0.3)).problem, case.T)
    assert rule.with_kinks(1.0) is None


def test_without_a_kink_nothing_changes() -> None:
    case = case_of(DOUBLE, regulator(1.0, 1.5))
    level = prove_local(case.problem, case.T, limit_of(case))
    assert level is not None and not has_kinks(case.loop.network.network)
    ball, _ = local_ball(case.problem, case.T, level)
    assert ball.directions is None and Rule.at_rest(case.problem, case.T).with_kinks(level) is None


RUNS: dict[str, tuple[Any, PolicyNetwork, dict[str, Any]]] = {
    "three states": (plant("x y z", "y", "z", "u", half=2, bound=9), sides(1.0, 3.0, 3.0, share=0.8), {}),
    "a rest beside a kink": (
        plant("x y", "y", "u+0.001", half=2, bound=9), sides(1.0, 1.5, share=0.6), {"claim": "nearby"},
    ),
    "discrete": (
        plant("x y", "x+y/10", "y+u/10", half=2, bound=9, time="discrete"), sides(1.0, 1.5, share=0.7), {},
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_after(1, ["a rest beside a kink", "discrete", "three states"]))
def test_a_run_is_proved_and_accepted(name: str, tmp_path: Any) -> None:
    system, law, options = RUNS[name]
    result = certify_roa(system, law, out=tmp_path, effort=0.1, **options)
    assert result.verdict is Verdict.PROVED, result.reason
    evidence = json.loads((tmp_path / "certificate.json").read_text("utf-8"))["evidence"]
    assert len(evidence["local"]["directions"]) == 2 * system.n
