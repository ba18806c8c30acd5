"""Queries for solvers of formulas: each says in trees what the closed loop says in Arb."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import flint
import numpy as np
import pytest

from certify.certificates.claims import Asymptotic
from certify.certificates.claims.conditions import (
    conditions,
    domain_conditions,
    input_conditions,
    local_condition,
    ring_condition,
)
from certify.certificates.claims.queries import Query, decay, query
from certify.errors import InputError
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork
from certify.loop.rigorous import evaluate_policy, evaluate_vdot
from certify.provers.ball.local import prove_local
from tests.support.cases import Case, case_of
from tests.support.loops import chain, lqr_gain, pendulum_network, saturated_lqr, scalar_clip, scalar_tanh, tank, valve
from tests.support.oracle import value_of


def quadrotor() -> tuple[System, PolicyNetwork]:
    """u_eq is not the middle of the inputs' range: beta is not 0."""
    system = get_system("quadrotor2d")
    K = lqr_gain(system, np.eye(6), np.eye(2))
    return system, saturated_lqr(K, 3.0, 3.0, [1, 1, 0.5, 1, 1, 1], (40,), "preactivation", 0)


CASES = {
    "scalar": scalar_tanh,
    "scalar, clipped": scalar_clip,
    "tank": tank,
    "valve": valve,
    "pendulum": lambda: (get_system("pendulum"), pendulum_network()),
    "pendulum, output": lambda: (get_system("pendulum"), pendulum_network((16, 16), centre="output")),
    "pendulum, seen from elsewhere": lambda: (
        get_system("pendulum"),
        replace(pendulum_network((16, 16)), centre="none", origin=np.array([0.25, -0.5])),
    ),
    "chain": lambda: chain(3, [-1, -2, -3]),
    "quadrotor": quadrotor,
}


def values(asked: Query, x: np.ndarray) -> dict[str, flint.arb]:
    """Every definition of a query at a state, in Arb."""
    flint.ctx.prec = 200
    names = {name: flint.arb(float(v)) for (name, _, _), v in zip(asked.variables, x, strict=True)}
    for name, tree in asked.definitions:
        assert name not in names
        names[name] = value_of(tree, names)
    return names


@pytest.mark.parametrize("name", CASES)
def test_definitions_are_the_closed_loop(name: str) -> None:
    case = case_of(*CASES[name]())
    loop, n = case.loop, case.loop.system.n
    A, _, _ = loop.linearise()
    ring, local = query(ring_condition(0.1, 1.0), case.problem), query(local_condition(0.1), case.problem)
    generator = np.random.default_rng(0)
    for x in 0.3 * generator.standard_normal((4, n)):
        names = values(ring, x)
        assert names["Vdot."].overlaps(evaluate_vdot(loop, case.P, x))
        for symbol, u in zip(loop.system.inputs, evaluate_policy(loop, x), strict=True):
            assert names[symbol.name].overlaps(u)
        V = sum((Fraction(float(x[i])) * Fraction(float(case.P[i, j])) * Fraction(float(x[j]))
                 for i in range(n) for j in range(n)), Fraction(0))  # fmt: skip
        assert names["V."].contains(flint.arb(flint.fmpq(V.numerator, V.denominator)))
        # the Jacobian against central differences of the closed loop in floating point
        at = values(local, x)
        f, step = loop.system.function(), 1e-5
        for j in range(n):
            ahead, back = x.copy(), x.copy()
            ahead[j] += step
            back[j] -= step
            slope = (f(ahead, loop.policy(ahead[None])[0]) - f(back, loop.policy(back[None])[0])) / (2 * step)
            for i in range(n):
                assert float(at[f"DF.{i}.{j}"].mid()) == pytest.approx(slope[i], rel=1e-5, abs=1e-5)
    origin = values(local, np.zeros(n))
    for i in range(n):
        for j in range(n):
            assert abs(origin[f"Dg.{i}.{j}"]) < 1e-9 * (1 + np.abs(A).max())


@pytest.mark.parametrize("name", CASES)
def test_decay_is_below_the_smallest_eigenvalue(name: str) -> None:
    case = case_of(*CASES[name]())
    A, _, _ = case.loop.linearise()
    smallest = np.linalg.eigvalsh(-(A.T @ case.P + case.P @ A))[0]
    r = decay(case.P, A)
    assert 0.999 * smallest < r < smallest * (1 + 1e-9)


def test_decay_refuses_what_does_not_decay() -> None:
    with pytest.raises(InputError, match="positive definite"):
        decay(np.eye(2), np.array([[0.0, 1.0], [-1.0, 0.0]]))


def holds(asked: Query, x: np.ndarray) -> bool:
    """The constraints of a query at a state, in Arb; what is not certain counts as false."""
    names = values(asked, x)
    found = [(value_of(a, names), relation, value_of(b, names)) for a, relation, b in asked.constraints]
    compare = {">=": lambda a, b: a >= b, "<=": lambda a, b: a <= b, ">": lambda a, b: a > b, "<": lambda a, b: a < b}
    return all(bool(compare[relation](a, b)) for a, relation, b in found)


def test_the_ring_query_is_satisfied_by_violations_only() -> None:
    """xdot = x/2 - tanh x, whose region of attraction is |x| < 1.915008."""
    case = case_of(*scalar_tanh())
    asked = query(ring_condition(0.5, 2.0**2), case.problem)
    level = float(case.P[0, 0])
    assert level == 1.0
    assert holds(asked, np.array([1.9151])) and holds(asked, np.array([-1.99]))
    for x in (1.914, 0.9, 2.01, 0.0):
        assert not holds(asked, np.array([x]))


def test_domain_queries_are_satisfied_beyond_the_limit_only() -> None:
    case = case_of(*chain(2, [-1, -2]))
    inverse = np.linalg.inv(case.P)
    for k, half in enumerate([1.0, 1.5]):
        touching = inverse[:, k] / inverse[k, k] * half  # the lowest V on the side x_k = half
        level = half**2 / inverse[k, k]
        touching[k] = half
        for outer, expected in ((0.999 * level, False), (1.001 * level, True)):
            sides = {c.name: query(c, case.problem) for c in domain_conditions(case.problem, outer)}
            above = sides[f"domain-x{k + 1}-above"]
            assert holds(above, touching) is expected


def test_input_queries_name_what_is_exceeded() -> None:
    case = case_of(get_system("pendulum"), pendulum_network(centre="output"))
    found = {c.name: query(c, case.problem) for c in input_conditions(case.problem, 1e3)}
    assert set(found) == {"inputs-u-below", "inputs-u-above"}
    grid = np.stack(np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-15, 15, 25)), -1).reshape(-1, 2)
    u = case.loop.policy(grid)[:, 0]
    for name, x in (("inputs-u-above", grid[u.argmax()]), ("inputs-u-below", grid[u.argmin()])):
        assert holds(found[name], x) is bool(abs(case.loop.policy(x[None])[0, 0]) > 6)


def test_one_query_a_claim() -> None:
    pendulum = get_system("pendulum")
    bounded, free = (case_of(pendulum, pendulum_network(centre=c)) for c in ("preactivation", "output"))

    def names(case: Case, inner: float, outer: float) -> list[str]:
        found = conditions(Asymptotic(roa=outer, local=inner), case.problem)
        assert [query(c, case.problem).name for c in found] == [c.name for c in found]
        return [c.name for c in found]

    sides = [f"domain-{s}-{side}" for s in ("theta", "theta_dot") for side in ("below", "above")]
    assert names(bounded, 0.1, 1.0) == [*sides, "local", "ring"]
    assert names(bounded, 1.0, 1.0) == [*sides, "local"]
    assert names(free, 0.1, 1.0) == [*sides, "local", "ring", "inputs-u-below", "inputs-u-above"]


def test_the_local_query_agrees_with_the_local_proof() -> None:
    """Where the bounds prove the local level, no sampled state satisfies the query."""
    case: Case = case_of(get_system("pendulum"), pendulum_network())
    level = prove_local(case.problem, case.T, 10.0)
    assert level is not None
    generator = np.random.default_rng(0)
    z = generator.standard_normal((20, 2))
    z *= np.sqrt(level * generator.random((20, 1))) / np.linalg.norm(z, axis=1, keepdims=True)
    asked = query(local_condition(level), case.problem)
    assert not any(holds(asked, x) for x in z @ case.T.T)
    assert any(holds(query(local_condition(4.0), case.problem), x) for x in 10 * z @ case.T.T * np.sqrt(0.04 / level))
