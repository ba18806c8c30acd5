"""Least squares recovers the plant it was shown, and the gain has the sign of u = u_eq - K x."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.linalg

from certify.errors import InputError
from certify.systems import get_system
from controllers.environments import Stepper
from controllers.evaluate import discrete_linearisation
from controllers.lqr import GainLearner, fit_A, fit_B, riccati_gain

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


def test_a_refresh_begins_with_A_and_keeps_the_old_gain_meanwhile():
    learner = GainLearner(1.0, 4, 3, np.eye(2), np.eye(2))
    x, v = _transitions(7, spread=0.2)
    for k in range(7):
        action = v[k] * (k >= 4)
        learner.observe(x[k], action, A @ x[k] + B @ action)
    old = learner.identified
    learner.refresh()
    assert learner.phase == "A" and learner.identified is old and old is not None
    copy = GainLearner(1.0, 4, 3, np.eye(2), np.eye(2))
    copy.load_state(learner.state())
    for k in range(7):  # the plant has changed since
        action = v[k] * (k >= 4)
        for one in (learner, copy):
            one.observe(x[k], action, 0.9 * A @ x[k] + B @ action)
    assert learner.identified is not None and copy.identified is not None
    np.testing.assert_allclose(learner.identified.A, 0.9 * A, atol=1e-12)
    np.testing.assert_array_equal(learner.identified.K, copy.identified.K)


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
