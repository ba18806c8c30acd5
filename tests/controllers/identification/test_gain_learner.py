"""Least squares recovers the plant it was shown, and the gain has the sign of u = u_eq - K x."""

from __future__ import annotations

import json

import numpy as np
import pytest
import scipy.linalg

from certify.errors import InputError
from certify.loop.plants import get_system
from controllers.identification.gain_learner import GainLearner
from controllers.identification.least_squares import fit_A, fit_B
from controllers.identification.linearisation import discrete_linearisation
from controllers.identification.riccati import riccati_gain
from controllers.simulation.stepping import Stepper

A = np.array([[1.0, 0.1], [0.3, 0.9]])
B = np.array([[0.02, 0.0], [0.5, -0.25]])


def _transitions(count, seed=0, spread=1.0):
    generator = np.random.default_rng(seed)
    return spread * generator.standard_normal((count, 2)), generator.standard_normal((count, 2))


def test_least_squares_recovers_a_linear_plant():
    x, v = _transitions(20)
    found_A = fit_A(x, x @ A.T)
    np.testing.assert_allclose(found_A, A, rtol=0, atol=1e-13)
    np.testing.assert_allclose(fit_B(x, v, x @ A.T + v @ B.T, found_A), B, rtol=0, atol=1e-12)


def test_B_is_fitted_given_A():
    # With the wrong A the error must end up in B: A is an input of the fit, not fitted again.
    x, v = _transitions(20)
    wrong = A + np.array([[0.0, 0.0], [0.1, 0.0]])
    assert np.abs(fit_B(x, v, x @ A.T + v @ B.T, wrong) - B).max() > 1e-3


def test_transitions_in_one_direction_do_not_determine_A():
    x = np.outer(np.arange(1.0, 6.0), [1.0, 2.0])
    with pytest.raises(InputError, match=r"determine A.*1 of 2"):
        fit_A(x, x @ A.T)


def test_quadratic_terms_of_the_plant_spoil_a_linear_fit_of_A_and_not_one_that_has_them():
    generator = np.random.default_rng(1)
    M, N = generator.standard_normal((2, 2, 2)), generator.standard_normal((2, 2, 2))
    errors: dict[str, list[float]] = {"linear": [], "quadratic": []}
    where = generator.uniform(-1, 1, (40, 2))
    for radius in (1e-3, 5e-4):
        x = radius * where
        quadratic = x @ A.T + np.einsum("ijk,nj,nk->ni", M, x, x)
        np.testing.assert_allclose(fit_A(x, quadratic, "quadratic"), A, rtol=0, atol=1e-12)
        cubic = quadratic + np.einsum("ijk,nj,nk->ni", N, x, x**2)
        for terms, found in errors.items():
            found.append(np.linalg.norm(fit_A(x, cubic, terms) - A))
    assert errors["linear"][0] > 100 * errors["quadratic"][0]
    orders = {terms: np.log2(found[0] / found[1]) for terms, found in errors.items()}
    assert orders == pytest.approx({"linear": 1, "quadratic": 2}, abs=0.01)


def test_states_in_tiny_units_determine_A_and_the_quadratic_terms():
    x, _ = _transitions(20)
    units = np.array([1e-9, 1e3])
    scaled = A * units[:, None] / units
    found = fit_A(x * units, (x @ A.T + x**2) * units, "quadratic")
    np.testing.assert_allclose(found, scaled, rtol=1e-9)


def test_quadratic_terms_take_rows_of_their_own():
    x, _ = _transitions(4)
    with pytest.raises(InputError, match=r"A and the quadratic terms: they span 4 of 5"):
        fit_A(x, x @ A.T, "quadratic")
    with pytest.raises(InputError, match=r"at least 5 and 2; found 4 and 3"):
        GainLearner(1.0, 4, 3, np.eye(2), np.eye(2), terms_A="quadratic")


def test_the_gain_stabilises_with_a_minus_sign_and_solves_the_discrete_riccati_equation():
    Q, R = np.diag([1.0, 0.5]), np.diag([1.0, 2.0])
    K = riccati_gain(A, B, Q, R)
    S = scipy.linalg.solve_discrete_are(A, B, Q, R)
    np.testing.assert_allclose(K, np.linalg.solve(R + B.T @ S @ B, B.T @ S @ A), rtol=1e-9)
    assert np.abs(np.linalg.eigvals(A - B @ K)).max() < 1
    assert np.abs(np.linalg.eigvals(A + B @ K)).max() > 1


def test_an_unstabilisable_plant_has_no_gain():
    with pytest.raises(InputError, match=r"Riccati|stable"):
        riccati_gain(np.diag([2.0, 0.5]), np.array([[0.0], [1.0]]), np.eye(2), np.eye(1))


def test_the_learner_asks_for_A_before_B_and_takes_only_what_fits():
    learner = GainLearner(1.0, 4, 3, np.eye(2), np.eye(2))
    x, v = _transitions(200, spread=0.3)
    inside = np.linalg.norm(x, axis=1) <= 1.0
    for state, action in zip(x, v, strict=True):  # actions are no use while A is unknown
        learner.observe(state, action, A @ state + B @ action)
    assert learner.phase == "A" and learner.identified is None
    learner.observe(np.array([5.0, 5.0]), np.zeros(2), np.array([9.0, -9.0]))  # outside the ball
    for state in x[inside][:4]:
        learner.observe(state, np.zeros(2), A @ state)
    assert learner.phase == "B" and learner.identified is None
    for state, action in zip(x[inside][4:7], v[inside][4:7], strict=True):
        learner.observe(state, action, A @ state + B @ action)
    assert learner.phase == "idle" and learner.identified is not None
    np.testing.assert_allclose(learner.identified.A, A, atol=1e-12)
    np.testing.assert_allclose(learner.identified.B, B, atol=1e-11)


def _round(learner, x, v, plant=1.0):
    """One round: zero action on the first rows, v on the others; the plant's A may have changed by a factor."""
    for k, state in enumerate(x):
        action = v[k] * (learner.phase == "B")
        learner.observe(state, action, plant * A @ state + B @ action)


def test_a_refresh_begins_with_A_and_keeps_the_old_gain_meanwhile():
    learner = GainLearner(1.0, 4, 3, np.eye(2), np.eye(2), transitions="latest")
    x, v = _transitions(7, spread=0.2)
    _round(learner, x, v)
    old = learner.identified
    learner.refresh()
    assert learner.phase == "A" and learner.identified is old and old is not None
    _round(learner, x, v, plant=0.9)  # the plant has changed since
    assert learner.identified is not None
    np.testing.assert_allclose(learner.identified.A, 0.9 * A, atol=1e-12)


def test_each_round_adds_to_the_transitions_that_are_fitted_or_replaces_them():
    generator = np.random.default_rng(3)
    learners = {which: GainLearner(1.0, 4, 3, np.eye(2), np.eye(2), transitions=which) for which in ("all", "latest")}
    free: list[list[np.ndarray]] = []
    driven: list[list[np.ndarray]] = []
    for _ in range(3):
        x, v = generator.uniform(-0.5, 0.5, (7, 2)), generator.standard_normal((7, 2))
        noise = 0.01 * generator.standard_normal((7, 2))
        v[:4] = 0.0
        x_next = x @ A.T + v @ B.T + noise
        for learner in learners.values():
            learner.refresh()  # continues the first round
            for row in zip(x, v, x_next, strict=True):
                learner.observe(*row)
            assert learner.phase == "idle"
        free.append([x[:4], x_next[:4]])
        driven.append([x[4:], v[4:], x_next[4:]])
        for which, rounds in (("all", slice(None)), ("latest", slice(-1, None))):
            found = learners[which].identified
            wanted = fit_A(*(np.vstack(part) for part in zip(*free[rounds], strict=True)))
            np.testing.assert_array_equal(found.A, wanted)
            rows = (np.vstack(part) for part in zip(*driven[rounds], strict=True))
            np.testing.assert_array_equal(found.B, fit_B(*rows, wanted))
    errors = {which: np.linalg.norm(learner.identified.A - A) for which, learner in learners.items()}
    assert errors["all"] < errors["latest"]


def test_matrices_lie_in_memory_as_a_checkpoint_gives_them_back():
    """Products depend on it in their last bits, and with them a resumed run."""
    x, v = _transitions(40)
    after = x @ A.T + v @ B.T
    found = (
        fit_A(x, after),
        fit_A(x, after, "quadratic"),
        fit_B(x, v, after, A),
        riccati_gain(A, B, np.eye(2), np.eye(2)),
    )
    assert all(matrix.flags.c_contiguous for matrix in found)


@pytest.mark.parametrize("which", ["all", "latest"])
@pytest.mark.parametrize("seen", [0, 2, 4, 5, 7, 9, 12])
def test_a_learner_goes_on_from_its_state(which, seen):
    x, v = _transitions(14, spread=0.2)
    rows = [(state, v[k] * (k % 7 >= 4), A @ state + state**2 + B @ (v[k] * (k % 7 >= 4))) for k, state in enumerate(x)]

    def feed(learner, begin, end):
        for k in range(begin, end):
            if k == 7:
                learner.refresh()
            learner.observe(*rows[k])

    whole, first, resumed = (GainLearner(9.0, 4, 3, np.eye(2), np.eye(2), transitions=which) for _ in range(3))
    feed(whole, 0, 14)
    feed(first, 0, seen)
    resumed.load_state(json.loads(json.dumps(first.state())))
    feed(resumed, seen, 14)
    assert resumed.state() == whole.state() and whole.phase == "idle"
    np.testing.assert_array_equal(resumed.identified.K, whole.identified.K)


@pytest.mark.parametrize("seen", [2, 5])
def test_a_state_of_a_run_that_kept_the_rows_of_its_phase_alone_is_read(seen):
    x, v = _transitions(7, spread=0.2)
    whole, resumed = (GainLearner(1.0, 4, 3, np.eye(2), np.eye(2), transitions="latest") for _ in range(2))
    _round(whole, x[:seen], v[:seen])
    state = whole.state()
    resumed.load_state(
        {name: state[name] for name in ("phase", "A", "identified")} | {"rows": state["rows"][whole.phase]}
    )
    for learner in (whole, resumed):
        _round(learner, x[seen:], v[seen:])
    assert resumed.state() == whole.state() and whole.phase == "idle"


# Rows of the continuous [A B], written out for each plant.
CONTINUOUS = {
    "pendulum": [[0, 1, 0], [9.81 / 0.5, -0.1 / 0.0375, 1 / 0.0375]],
    "cartpole": [
        [0, 0, 1, 0, 0],
        [0, 0, 0, 1, 0],
        [0, -0.1 * 9.81, 0, 0, 1],
        [0, 1.1 * 9.81 / 0.5, 0, 0, -1 / 0.5],
    ],
}


@pytest.mark.parametrize("name", CONTINUOUS)
def test_a_plant_is_identified_from_a_small_ball(name):
    system, dt = get_system(name), 0.02
    stepper, generator = Stepper(system, dt, "numpy"), np.random.default_rng(0)
    x, u = generator.uniform(-0.01, 0.01, (100, system.n)), generator.uniform(-0.1, 0.1, (100, system.m))
    true_A, true_B = discrete_linearisation(system, dt)
    square = np.vstack([CONTINUOUS[name], np.zeros((system.m, system.n + system.m))])
    exact = scipy.linalg.expm(square * dt)[: system.n]
    np.testing.assert_allclose(np.hstack([true_A, true_B]), exact, atol=1e-5)  # RK4 against the exact one
    found = fit_A(x, stepper(x, np.zeros((100, system.m))))
    np.testing.assert_allclose(found, true_A, atol=1e-4)
    np.testing.assert_allclose(fit_B(x, u, stepper(x, u), found), true_B, atol=1e-4)
