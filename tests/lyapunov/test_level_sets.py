"""Bounds on level sets have the direction they promise, however ill-conditioned P is, and are no wider than one ulp."""

from __future__ import annotations

import math
import time
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, target
from hypothesis import strategies as st

from certify.errors import InputError
from certify.lyapunov import domain_limit, extents, inverse, is_positive_definite, semi_axes, volume

PI = Fraction(314159265358979323846264338327950288, 10**35)  # below pi, by less than 1e-35
ULP = Fraction(1, 2**52)


def ill_conditioned(n: int, seed: int, decades: float, scale: float) -> np.ndarray:
    """A symmetric positive definite matrix with eigenvalues from `scale` to `scale` 10^decades."""
    generator = np.random.default_rng(seed)
    U, _ = np.linalg.qr(generator.standard_normal((n, n)))
    P = scale * U @ np.diag(np.logspace(0, decades, n)) @ U.T
    return np.asarray((P + P.T) / 2)


matrices = st.builds(
    ill_conditioned, st.integers(1, 6), st.integers(0, 10_000), st.floats(0, 14), st.sampled_from([1e-8, 1.0, 3e5])
)
levels = st.floats(1e-9, 1e9)


def exact_inverse(P: np.ndarray) -> tuple[list[list[Fraction]], Fraction]:
    """Inverse and determinant by Gauss-Jordan in fractions, without pivoting: P is positive definite."""
    n = len(P)
    rows = [[Fraction(float(v)) for v in row] + [Fraction(int(i == j)) for j in range(n)] for i, row in enumerate(P)]
    det = Fraction(1)
    for k in range(n):
        pivot = rows[k][k]
        det *= pivot
        rows[k] = [v / pivot for v in rows[k]]
        for i in range(n):
            if i != k:
                factor = rows[i][k]
                rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return [row[n:] for row in rows], det


def positive(P: np.ndarray) -> bool:
    """Whether a symmetric P that rounding may have made indefinite is still positive definite, in fractions."""
    rows = [[Fraction(float(v)) for v in row] for row in P]
    for k in range(len(rows)):
        if rows[k][k] <= 0:
            return False
        for i in range(k + 1, len(rows)):
            factor = rows[i][k] / rows[k][k]
            rows[i] = [a - factor * b for a, b in zip(rows[i], rows[k], strict=True)]
    return True


@given(matrices, levels)
def test_the_bounding_box_contains_the_set(P: np.ndarray, level: float) -> None:
    assert is_positive_definite(P) == positive(P)
    if not positive(P):
        return
    M, _ = exact_inverse(P)
    shares = [Fraction(float(e)) ** 2 / (Fraction(level) * M[i][i]) for i, e in enumerate(extents(P, level))]
    target(float(max(shares) - 1), label="wideness")
    assert all(1 <= share < 1 + 3 * ULP for share in shares)


@given(matrices, levels)
def test_semi_axes_end_in_the_set(P: np.ndarray, level: float) -> None:
    if not positive(P):
        return
    for i, axis in enumerate(semi_axes(P, level)):
        V = Fraction(float(P[i, i])) * Fraction(float(axis)) ** 2
        assert Fraction(level) * (1 - 3 * ULP) < V <= Fraction(level)


@given(matrices, levels)
def test_the_volume_is_not_overstated(P: np.ndarray, level: float) -> None:
    if not positive(P):
        return
    n, (_, det) = len(P), exact_inverse(P)
    unit = Fraction(2) if n % 2 else PI
    for k in range(n, 2, -2):
        unit *= 2 * PI / k
    squared = unit**2 * Fraction(level) ** n / det
    assert squared * (1 - 3 * ULP) < Fraction(volume(P, level)) ** 2 < squared * (1 + Fraction(1, 10**30))


@given(matrices, st.lists(st.floats(0.01, 100), min_size=6, max_size=6))
def test_levels_below_the_domain_limit_fit_the_domain(P: np.ndarray, sides: list[float]) -> None:
    if not positive(P):
        return
    M, _ = exact_inverse(P)
    domain = tuple((-Fraction(a), 2 * Fraction(a)) for a in sides[: len(P)])
    exact = min(lo**2 / M[i][i] for i, (lo, _) in enumerate(domain))
    assert exact * (1 - 3 * ULP) < Fraction(domain_limit(P, domain)) <= exact


@given(matrices)
def test_the_inverse_is_the_exact_one_rounded(P: np.ndarray) -> None:
    if positive(P):
        M, _ = exact_inverse(P)
        assert inverse(P).tolist() == [[float(v) for v in row] for row in M]


def test_numbers_at_the_ends_of_the_range() -> None:
    tiny, huge = np.array([[1e-300]]), np.array([[1e300]])
    assert Fraction(extents(tiny, 1e308)[0]) ** 2 >= Fraction(1e308) / Fraction(1e-300)
    assert semi_axes(huge, 5e-324)[0] > 0
    assert volume(np.eye(3) * 1e300, 1e-300) == 0.0  # below every positive binary64 number
    assert extents(np.array([[5e-324]]), 1.7e308)[0] == math.inf  # 6e315, above every one
    assert volume(np.eye(3) * 1e-300, 1e300) == np.finfo(float).max


@pytest.mark.parametrize(
    "P", [np.zeros((2, 2)), -np.eye(2), np.array([[1.0, 2.0], [2.0, 1.0]]), np.array([[1.0, np.nan], [np.nan, 1.0]])]
)
def test_what_is_no_ellipsoid_is_refused(P: np.ndarray) -> None:
    for measure in (extents, semi_axes, volume):
        with pytest.raises(InputError, match="`P` must be"):
            measure(P, 1.0)


def test_positive_definite_by_the_last_bit() -> None:
    nearly = np.array([[1.0, 1.0], [1.0, 1.0]])
    assert not is_positive_definite(nearly)
    nearly[1, 1] = np.nextafter(1.0, 2.0)
    assert is_positive_definite(nearly)


def test_twelve_states_take_milliseconds() -> None:
    P = ill_conditioned(12, 0, 12.0, 1.0)
    start = time.perf_counter()
    for _ in range(10):
        extents(P, 0.3)
        semi_axes(P, 0.3)
        volume(P, 0.3)
    assert time.perf_counter() - start < 3  # a tenth of it is a bound with room on a busy machine; measured 4 ms
