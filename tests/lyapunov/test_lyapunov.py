"""Candidates and level sets."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from certify.errors import InputError
from certify.lyapunov import diagonalising_coordinates, domain_limit, extents, semi_axes, solve_lyapunov, volume


def test_the_papers_pendulum() -> None:
    """V = 1.02512 x1^2 + 0.0379687 x1 x2 + 0.0216179 x2^2 in print; A there is rounded to four decimals."""
    P = solve_lyapunov(np.array([[0.0, 1.0], [-26.3375, -24.0073]]), np.eye(2))
    a, b = Fraction("26.3375"), Fraction("24.0073")
    p12, p22 = 1 / (2 * a), (1 + 1 / a) / (2 * b)  # from the two lower equations of A'P + PA = -I, exactly
    p11 = a * p22 + b * p12
    np.testing.assert_allclose(P, [[float(p11), float(p12)], [float(p12), float(p22)]], rtol=1e-14)
    # The last printed digit of the third coefficient is one more than the rounded A gives (0.02161778).
    for value, published, unit in (
        (P[0, 0], 1.02512, 1e-5),
        (2 * P[0, 1], 0.0379687, 1e-7),
        (P[1, 1], 0.0216179, 1e-7),
    ):
        assert abs(value - published) <= 1.5 * unit


def test_not_the_transposed_equation() -> None:
    P = solve_lyapunov(np.array([[0.0, 1.0], [-2.0, -3.0]]), np.eye(2))
    np.testing.assert_allclose(P, [[1.25, 0.25], [0.25, 0.25]], rtol=1e-14)


@given(st.integers(1, 8), st.integers(0, 10_000))
def test_residual_and_symmetry(n: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    A = generator.standard_normal((n, n))
    A -= (np.max(np.linalg.eigvals(A).real) + 0.5) * np.eye(n)
    Q = np.diag(generator.uniform(0.1, 2, n))
    P = solve_lyapunov(A, Q)
    assert np.array_equal(P, P.T)
    assert np.max(np.abs(A.T @ P + P @ A + Q)) <= 1e-10 * np.max(np.abs(P)) * np.max(np.abs(A))
    assert np.min(np.linalg.eigvalsh(P)) > 0
    T = diagonalising_coordinates(P, A)
    np.testing.assert_allclose(T.T @ P @ T, np.eye(n), atol=1e-9)
    rate = T.T @ (A.T @ P + P @ A) @ T
    assert np.max(np.abs(rate - np.diag(np.diag(rate)))) <= 1e-8 * np.max(np.abs(rate))


@pytest.mark.parametrize("A", [np.zeros((2, 2)), np.diag([1.0, -1.0]), np.array([[0.0, 1.0], [-1.0, 0.0]])])
def test_not_hurwitz_is_refused(A: np.ndarray) -> None:
    with pytest.raises(InputError, match="Hurwitz"):
        solve_lyapunov(A, np.eye(2))


@pytest.mark.parametrize("unit", [1e-6, 1e-12])
def test_units_of_very_different_sizes_are_solved(unit: float) -> None:
    """An oscillator whose position is in small units; scipy's solution has another sign. The exact one: P22 = 1 +
    unit^2, by k = 1/unit."""
    A = np.array([[0.0, unit], [-1 / unit, -1.0]])
    for M, step in ((A, 0.0), (A, 0.1)):
        P = solve_lyapunov(M, np.eye(2), step)
        size = np.array([unit, 1.0])
        left = size[:, None] * (M.T @ P + P @ M + step * M.T @ P @ M) * size
        assert np.linalg.eigvalsh(size[:, None] * P * size)[0] > 0.1
        assert np.max(np.abs(left + np.diag(size**2))) < 1e-9


def test_indefinite_Q_is_refused() -> None:
    with pytest.raises(InputError, match="positive definite"):
        solve_lyapunov(-np.eye(2), np.diag([1.0, 0.0]))


def test_geometry_of_a_known_ellipse() -> None:
    P = np.array([[2.0, 1.0], [1.0, 3.0]])
    inverse = np.array([[3.0, -1.0], [-1.0, 2.0]]) / 5
    assert domain_limit(P, ((Fraction(-2), Fraction(1)), (Fraction(-4), Fraction(4)))) == pytest.approx(
        1 / inverse[0, 0]
    )
    np.testing.assert_allclose(extents(P, 7.0), np.sqrt(7 * np.diag(inverse)))
    np.testing.assert_allclose(semi_axes(P, 7.0), np.sqrt([7 / 2, 7 / 3]))
    assert volume(P, 7.0) == pytest.approx(np.pi * 7 / np.sqrt(5))
    assert volume(np.eye(3), 4.0) == pytest.approx(4 / 3 * np.pi * 8)


def test_the_bounding_box_touches_the_ellipsoid() -> None:
    P = solve_lyapunov(np.array([[0.0, 1.0], [-2.0, -3.0]]), np.eye(2))
    angle = np.linspace(0, 2 * np.pi, 100_000)
    L = np.linalg.cholesky(P)
    points = np.linalg.solve(L.T, np.stack([np.cos(angle), np.sin(angle)])) * np.sqrt(0.3)
    np.testing.assert_allclose(np.abs(points).max(axis=1), extents(P, 0.3), rtol=1e-8)
