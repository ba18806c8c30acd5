"""The optimised candidate: known ellipsoids, margins, and what happens when the solver fails."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import clarabel
import cvxpy
import numpy as np
import pytest

from certify.errors import BackendError
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import Expression, Number, Symbol, symbols
from certify.loop.plants import System, get_system
from certify.loop.policies import PolicyNetwork
from certify.lyapunov import domain_limit, extents, optimise_candidate, solve_lyapunov, volume
from certify.lyapunov.optimised import _between
from certify.lyapunov.programs import smallest_trace
from tests.support.loops import box, pendulum_network, scalar_tanh


def closed_loop(dynamics: tuple[Expression, ...], domain: tuple[str, ...], gain: list[float], bound: str) -> ClosedLoop:
    """States x1, x2, ... and one input u = gain x, |u| <= bound."""
    n = len(dynamics)
    system = System(
        name="plant",
        states=symbols(f"x{i}" for i in range(1, n + 1)),
        inputs=(Symbol("u"),),
        parameters={},
        dynamics=dynamics,
        u_eq=(Number(0),),
        domain=box(*domain),
        input_bounds=box(bound),
    )
    return ClosedLoop(
        system,
        PolicyNetwork.of_layers((np.array([gain]),), (np.zeros(1),), np.ones(1), np.zeros(1), "identity", "none"),
    )


x1, x2, x3, u = symbols("x1 x2 x3 u")


def van_der_pol() -> ClosedLoop:
    """Van der Pol's oscillator in reversed time: the origin attracts the inside of the limit cycle."""
    return closed_loop((-x2, x1 - (1 - x1**2) * x2 + u), ("3", "3"), [0.0, 0.0], "1")


def sampled_volume(loop: ClosedLoop, P: np.ndarray) -> float:
    """Area up to the lowest sampled V at which Vdot >= 0, on a grid of rays; two states."""
    angle = np.linspace(0, 2 * np.pi, 401)[:, None]
    limit = domain_limit(P, loop.system.domain)
    z = np.stack([np.cos(angle), np.sin(angle)], axis=-1) * np.sqrt(limit) * np.linspace(0.01, 1, 300)[:, None]
    x = z @ np.linalg.inv(np.linalg.cholesky(P))
    vdot = 2 * ((x @ P) * loop.system.function()(x, loop.policy(x))).sum(-1)
    return volume(P, float(np.min(((x @ P) * x).sum(-1)[vdot >= 0], initial=limit)))


@pytest.mark.parametrize("seed", [0, 1])
def test_the_largest_ellipsoid_in_a_box(seed: int) -> None:
    """xdot = -x leaves every ellipsoid invariant: the largest in |x_i| <= d_i is sum (x_i / d_i)^2 <= 1."""
    loop = closed_loop((-x1 + u, -x2, -x3), ("1", "2", "1/2"), [0.0, 0.0, 0.0], "1")
    skewed = solve_lyapunov(-np.eye(3), np.array([[2.0, 0.5, 0.3], [0.5, 1.0, 0.0], [0.3, 0.0, 3.0]]))
    P = optimise_candidate(loop, skewed, seed=seed)
    known = np.diag([1.0, 0.25, 4.0])
    assert volume(known, 1) * 0.99 <= volume(P, 1) <= volume(known, 1) * (1 + 1e-9)
    L = np.diag(1 / np.sqrt(np.diag(known)))
    np.testing.assert_allclose(L @ P @ L, np.eye(3), atol=0.1)


def test_the_bounds_of_the_input_are_kept() -> None:
    """u = -x1 with |u| <= 1/2 is the box |x1| <= 1/2."""
    loop = closed_loop((-x1 + u, -x2), ("1", "1"), [-1.0, 0.0], "1/2")
    P = optimise_candidate(loop, np.array([[1.0, 0.2], [0.2, 1.0]]))
    known = np.diag([4.0, 1.0])
    assert volume(known, 1) * 0.98 <= volume(P, 1) <= volume(known, 1) * 1.01
    assert extents(P, 1.0)[0] <= 0.5 * 1.005


def test_an_invariant_ellipse_of_a_linear_plant_is_as_large_as_can_be() -> None:
    """For A with a rotation no axis-parallel ellipse need be invariant; the optimum keeps A'P + PA < 0 in the box."""
    A = np.array([[0.0, 1.0], [-2.0, -1.0]])
    loop = closed_loop((x2, -2 * x1 - x2 + u), ("1", "1"), [0.0, 0.0], "1")
    start = solve_lyapunov(A, np.eye(2))
    P = optimise_candidate(loop, start)
    assert np.max(np.linalg.eigvalsh(A.T @ P + P @ A)) < 0
    assert domain_limit(P, loop.system.domain) >= 1 - 1e-9
    assert volume(P, 1) > 1.02 * volume(start, domain_limit(start, loop.system.domain))
    grid = np.linspace(-0.99, 0.99, 199)  # P = [[1/a^2, r], [r, 1/b^2]]-shapes that touch both sides, by enumeration
    shapes = [np.linalg.inv(np.array([[1.0, r], [r, 1.0]])) for r in grid]
    margin = 2 * 1.3 * 0.2 * 0.5
    kept = [S for S in shapes if np.max(np.linalg.eigvalsh(A.T @ S + S @ A + margin * S)) <= 0]
    assert not kept or volume(P, 1) >= 0.98 * max(volume(S, 1) for S in kept)


def test_a_nonlinear_plant_with_a_margin() -> None:
    loop = van_der_pol()
    A, _, _ = loop.linearise()
    start = solve_lyapunov(A, np.eye(2))
    P = optimise_candidate(loop, start, decays=(0.05,))
    assert sampled_volume(loop, P) > 1.005 * sampled_volume(loop, start)
    generator = np.random.default_rng(1)
    z = generator.standard_normal((50_000, 2))
    z *= np.sqrt(generator.uniform(0, 0.98, (50_000, 1))) / np.linalg.norm(z, axis=1, keepdims=True)
    x = z @ np.linalg.inv(np.linalg.cholesky(P))
    V = ((x @ P) * x).sum(-1)
    vdot = 2 * ((x @ P) * loop.system.function()(x, loop.policy(x))).sum(-1)
    alpha = 0.05 * 0.5  # the eigenvalues of A are -1/2 +- i sqrt(3)/2
    assert np.all(vdot <= -alpha * V)


def test_a_margin_that_costs_too_much_gives_way() -> None:
    """With a fifth of the linear decay no ellipse beats Q = I here; with a fiftieth one does."""
    loop = van_der_pol()
    A, _, _ = loop.linearise()
    start = solve_lyapunov(A, np.eye(2))
    with pytest.raises(BackendError, match="larger than its start"):
        optimise_candidate(loop, start, decays=(0.2,))
    assert sampled_volume(loop, optimise_candidate(loop, start)) > 1.01 * sampled_volume(loop, start)


def test_a_network_and_the_scale_of_the_start() -> None:
    loop = ClosedLoop(get_system("pendulum"), pendulum_network())
    A, _, _ = loop.linearise()
    start = solve_lyapunov(A, np.diag([1.0, 0.1]))
    P = optimise_candidate(loop, start)
    assert sampled_volume(loop, P) > sampled_volume(loop, start)
    np.testing.assert_array_equal(P, P.T)
    np.testing.assert_array_equal(optimise_candidate(loop, start), P)  # equal seeds
    np.testing.assert_allclose(optimise_candidate(loop, 4 * start), P, rtol=1e-9)


def test_not_larger_than_the_start() -> None:
    loop = ClosedLoop(*scalar_tanh())
    with pytest.raises(BackendError, match="larger than its start"):
        optimise_candidate(loop, np.eye(1))


def test_clarabel_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "clarabel", None)
    with pytest.raises(BackendError, match="clarabel"):
        optimise_candidate(van_der_pol(), np.array([[1.5, -0.5], [-0.5, 1.0]]))


@pytest.mark.parametrize("status", ["AlmostSolved", "NumericalError", "MaxIterations", "PrimalInfeasible"])
def test_an_answer_that_is_not_solved_is_no_answer(status: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not even where the solver's numbers are those of the solution."""
    solver = clarabel.DefaultSolver

    class Doubtful:
        def __init__(self, *program: Any) -> None:
            self.found = solver(*program).solve()

        def solve(self) -> SimpleNamespace:
            return SimpleNamespace(x=self.found.x, status=getattr(clarabel.SolverStatus, status))

    monkeypatch.setattr(clarabel, "DefaultSolver", Doubtful)
    with pytest.raises(BackendError, match="no optimised candidate"):
        optimise_candidate(van_der_pol(), np.array([[1.5, -0.5], [-0.5, 1.0]]))


@pytest.mark.parametrize("step", [0.0, 0.3])
@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_the_program_is_the_one_that_a_modelling_language_finds(n: int, step: float) -> None:
    """To the last bit of the solution: the rows, their order and their rounding are the same."""
    generator = np.random.default_rng(n)
    along = 0.2 * generator.standard_normal((n, n)) - np.eye(n)
    F, corner = generator.standard_normal((7, n, n)), generator.standard_normal(n)
    rows = (F + np.swapaxes(F, 1, 2)) / 2
    least = np.einsum("kii->k", rows) - 0.1  # holds at M = 1, so that the program has a solution
    edge = 0.5 * np.outer(corner, corner) / (corner @ corner)

    def falls(M: np.ndarray) -> np.ndarray:
        rate = M @ along
        return -(rate + np.swapaxes(rate, -1, -2) + (step * _between(M, along) if step else 0.0) + 0.2 * M)

    matrices = [(lambda M: M, 0.2 * np.eye(n)), (lambda M: M, edge), (lambda M: -M, -3 * np.eye(n))]
    found = smallest_trace([*matrices, (falls, np.zeros((n, n)))], rows, least, 1e-7)

    M = cvxpy.Variable((n, n), symmetric=True)
    rate = M @ along
    rate = rate + rate.T + (step * (along.T @ M @ along) if step else 0.0) + 0.2 * M
    within = [M >> 0.2 * np.eye(n), M >> edge, M << 3 * np.eye(n), rate << 0]
    within.append(rows.reshape(7, n * n) @ cvxpy.vec(M, order="C") >= least)
    problem = cvxpy.Problem(cvxpy.Minimize(cvxpy.trace(M)), within)
    problem.solve(solver=cvxpy.CLARABEL, tol_gap_abs=1e-7, tol_gap_rel=1e-7, tol_feas=1e-7)
    assert problem.status == cvxpy.OPTIMAL and found is not None
    np.testing.assert_array_equal(found, M.value)


def test_a_program_with_a_number_that_is_not_finite_has_no_answer() -> None:
    one = (lambda M: M, np.eye(2))
    rows = np.array([[[1.0, 0.0], [0.0, np.nan]]])
    assert smallest_trace([one], rows, np.array([1.0]), 1e-7) is None
    assert smallest_trace([one], np.ones((1, 2, 2)), np.array([np.inf]), 1e-7) is None
    assert smallest_trace([one], np.ones((1, 2, 2)), np.array([1.0]), 1e-7) is not None
