"""The geometry of the sublevel set `{x'Px <= c}`, by certain bounds within one unit in the last place.

P and c are binary64 numbers, so the inverse and the determinant are computed in exact rationals and only the last step
is rounded, in a direction: floats lose twice as many digits as P's condition has, and not on the safe side. Sets that
contain it are rounded up, its claimed sizes down. A matrix of 12 states takes a millisecond.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from fractions import Fraction

import flint
import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

Array = NDArray[np.float64]
_ROOT_BITS = 128  # of a square root before it is rounded
_ARB_BITS = 256  # of pi, Gamma and the root in the volume


def domain_limit(P: Array, domain: Sequence[tuple[Fraction, Fraction]]) -> float:
    """Supremum of the levels whose sublevel set lies in the box: `min_i d_i^2 / (P^-1)_ii`, d_i the nearer side.

    Rounded down: the set of every smaller level lies in the interior.

    Raises
    ------
    InputError : P is not positive definite.
    """
    return _down(_domain_limit(P, domain))


def leaves_domain(P: Array, level: float, domain: Sequence[tuple[Fraction, Fraction]]) -> bool:
    """True if the sublevel set is not contained in the domain's interior, decided in rationals.

    Raises
    ------
    InputError : P is not positive definite.
    """
    return Fraction(float(level)) >= _domain_limit(P, domain)


def are_inside(
    P: Array, level: float, points: Iterable[Sequence[Fraction | float]], centre: Sequence[float] = ()
) -> list[bool]:
    """Decide `(x - c)'P(x - c) <= level` at each of the points, in rationals; all entries are finite numbers, taken as
    exact. c is `centre`, 0 if it is empty.

    >>> are_inside(np.eye(2), 1.0, [(0.6, Fraction(4, 5)), (Fraction(3, 5), Fraction(4, 5)), (0.0, 2)])
    [True, True, False]
    """
    c, rows = _rational(float(level)), _exact(P).tolist()
    shift = [_rational(float(v)) for v in centre] or [flint.fmpq(0)] * len(rows)

    def value(x: Sequence[flint.fmpq]) -> flint.fmpq:
        return sum(v * sum(p * w for p, w in zip(row, x, strict=True)) for v, row in zip(x, rows, strict=True))

    def moved(point: Sequence[Fraction | float]) -> list[flint.fmpq]:
        return [flint.fmpq(*v.as_integer_ratio()) - q for v, q in zip(point, shift, strict=True)]

    return [bool(value(moved(point)) <= c) for point in points]


def semi_axes(P: Array, level: float) -> Array:
    """`sqrt(c / P_ii)`: the set's reach along each coordinate axis, shape (n,).

    Rounded down: the points at these distances on the axes lie in the set.

    Raises
    ------
    InputError : P is not positive definite.
    """
    _inverse_diagonal(P)
    c = Fraction(float(level))
    return np.array([_root(c / Fraction(float(p)), _down) for p in np.diag(P)])


def extents(P: Array, level: float) -> Array:
    """`sqrt(c (P^-1)_ii)`: half-widths of the set's bounding box, shape (n,).

    Rounded up: the box contains the set.

    Raises
    ------
    InputError : P is not positive definite.
    """
    c = Fraction(float(level))
    return np.array([_root(c * p, _up) for p in _inverse_diagonal(P)])


def volume(P: Array, level: float) -> float:
    """Volume of the ellipsoid, `pi^(n/2) / Gamma(n/2 + 1) c^(n/2) / sqrt(det P)`.

    Rounded down: the set is at least as large.

    Raises
    ------
    InputError : P is not positive definite.
    """
    n, matrix = len(P), _exact(P)
    _inverse_diagonal(P)
    with flint.ctx.workprec(_ARB_BITS):
        half = flint.arb(n) / 2
        unit = flint.arb.pi() ** half / (half + 1).gamma()
        ratio = flint.arb(_rational(float(level)) ** n / matrix.det())  # one root of an exact number
        mantissa, exponent = (unit * ratio.sqrt()).lower().man_exp()
    return _down(Fraction(int(mantissa)) * Fraction(2) ** int(exponent))


def ball_volume(n: int) -> float:
    """Volume of the unit ball in n dimensions, in floats."""
    return float(math.pi ** (n / 2) / math.gamma(n / 2 + 1))


def is_positive_definite(P: Array) -> bool:
    """True if the symmetric part of P is positive definite, in exact arithmetic; entries must be finite.

    >>> is_positive_definite(np.array([[1.0, 1.0], [1.0, 1.0 + 2.0**-52]]))
    True
    """
    n, M = len(P), _exact(P).tolist()
    minors = ([q for row in M[:k] for q in row[:k]] for k in range(1, n + 1))
    return all(flint.fmpq_mat(k, k, entries).det() > 0 for k, entries in enumerate(minors, start=1))  # Sylvester


def inverse(P: Array) -> Array:
    """The exact inverse of P, each entry rounded to the nearest binary64 number; for drawings.

    Raises
    ------
    InputError : P is singular.
    """
    M = _inverse(P)
    return np.array([[_nearest(Fraction(int(q.p), int(q.q))) for q in row] for row in M.tolist()])


def diagonalising_coordinates(P: Array, A: Array, step: float = 0.0) -> Array:
    """T with `T'PT = I` and `T'(A'P + PA + h A'PA)T` diagonal, up to rounding; columns sorted by decay rate.

    A is the rate of x over a step h, which is 0 in continuous time (`ClosedLoop.mean_rate`, `ClosedLoop.step`).

    In the coordinates `x = T z` sublevel sets are balls, so a smaller inner level costs only logarithmically many
    boxes, and the quadratic part of Vdot is separable.

    Raises
    ------
    InputError : P is not numerically positive definite.
    """
    try:
        L = np.linalg.cholesky(P)
    except np.linalg.LinAlgError as error:
        raise InputError("`P` must be positive definite; Cholesky failed. Try another --Q.") from error
    inverse_root = np.linalg.inv(L)
    decrease = A.T @ P + P @ A + (step * (A.T @ P @ A) if step else 0.0)
    rate = inverse_root @ decrease @ inverse_root.T
    _, U = np.linalg.eigh((rate + rate.T) / 2)
    return np.asarray(inverse_root.T @ U)


def _domain_limit(P: Array, domain: Sequence[tuple[Fraction, Fraction]]) -> Fraction:
    return min(min(-lo, hi) ** 2 / p for (lo, hi), p in zip(domain, _inverse_diagonal(P), strict=True))


def _rational(value: float) -> flint.fmpq:
    return flint.fmpq(*value.as_integer_ratio())


def _exact(P: Array) -> flint.fmpq_mat:
    """The symmetric part of P, which defines x'Px, in rationals."""
    n = len(P)
    if P.shape != (n, n) or not np.all(np.isfinite(P)):
        raise InputError("`P` must be a square matrix of finite numbers.")
    M = flint.fmpq_mat(n, n, [_rational(float(v)) for v in P.ravel()])
    return M if np.array_equal(P, P.T) else (M + M.transpose()) / 2


def _inverse(P: Array) -> flint.fmpq_mat:
    try:
        return _exact(P).inv()
    except ZeroDivisionError as error:
        raise InputError("`P` must be positive definite; it is singular.") from error


def _inverse_diagonal(P: Array) -> list[Fraction]:
    """The diagonal of the inverse, exactly."""
    if not is_positive_definite(P):
        raise InputError("`P` must be positive definite; a leading principal minor is not positive.")
    M = _inverse(P)
    return [Fraction(int(M[i, i].p), int(M[i, i].q)) for i in range(len(P))]


def _root(value: Fraction, direction: Callable[[Fraction], float]) -> float:
    """The square root of a positive rational, rounded in a direction."""
    shift = _ROOT_BITS - (value.numerator.bit_length() - value.denominator.bit_length()) // 2
    power = Fraction(2) ** shift
    squared = value * power * power
    root = math.isqrt(squared.numerator // squared.denominator)  # root <= exact < root + 1
    exact = root * root == squared
    return direction(Fraction(root if exact or direction is _down else root + 1) / power)


def _nearest(value: Fraction) -> float:
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _down(value: Fraction) -> float:
    """The largest binary64 number that is not above a nonnegative rational."""
    near = _nearest(value)
    return near if math.isfinite(near) and Fraction(near) <= value else math.nextafter(near, 0.0)


def _up(value: Fraction) -> float:
    """The smallest binary64 number that is not below a nonnegative rational; infinity where there is none."""
    near = _nearest(value)
    return near if math.isinf(near) or Fraction(near) >= value else math.nextafter(near, math.inf)
