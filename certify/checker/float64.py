"""Rigorous bounds in binary64: every rounding error is bounded, in the safe direction.

Conventions
-----------
u = 2^-53 is the unit roundoff. A computed value comes with a bound on its error that is itself computed
in binary64, so `up` is applied to every bound: it covers the roundings made while the bound was formed.
`up(b) = b (1 + 2^-40) + 2^-960` is safe for non-negative operands with fewer than 2^11 roundings in a row
(2^11 u < 2^-41, and the last two roundings are those of `up` itself); longer sums go through `total`. Its
absolute term covers underflow, at most 2^-1022 a product, for up to 2^60 products, as long as nothing large multiplies
afterwards what has underflowed. So there is one order of factors for all bounds, in which only numbers up to 1 do:

- the argument of one `up` is a sum of products of two factors: exact numbers, or results of `up`;
- EPS, gamma and other constants below 1 multiply the product: `EPS * (a * b)`, never `EPS * a * b`;
- a product of three is `a * up(b * c)`, or `k * b * b` with k from `up`: where k b underflows, b is below 1.

Sums and matrix products are bounded for any order of summation and with or without fused multiply-add:
|fl(AB) - AB| <= gamma_k |A||B| with gamma_k = k u / (1 - k u) (Higham 2002, section 3.5), and
(|A||B|)_ij <= ||A_i:||_2 ||B_:j||_2 by Cauchy and Schwarz. `gamma` doubles k u to spare the denominator.

Overflow never helps: it makes a bound infinite or NaN, and a comparison that has to hold is then False.

tanh, sin, cos, exp and atan use a table of values on a grid of step h = 2^-5, which Arb computes at start-up, an
addition theorem, and Taylor polynomials on |d| <= h/2 = 2^-6. No libm value is trusted; the square root is IEEE's own.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb, ctx, fmpq

Array = Any  # of binary64; numpy's own types say nothing of shapes
U = 2.0**-53
EPS = 2.0**-50  # covers up to eight roundings of one coefficient
TINY = 2.0**-960
_STEP = 2.0**-5
_TANH_END = 20.0  # 1 - tanh(20) < 2^-56
_ANGLE_END = 64.0  # beyond, sin and cos are only known to lie in [-1, 1]
_EXP_END = 64.0  # beyond, nothing is known of exp; below -64 it lies between 0 and 2^-92


def up(bound: Any) -> Any:
    """An upper bound of the exact value that the non-negative `bound` was computed for."""
    return bound * (1 + 2.0**-40) + TINY


def gamma(k: int) -> float:
    """Bound of gamma_{k+2}: relative error of a sum of k products, or of a norm of k numbers."""
    return 2 * (k + 2) * U


def total(array: Any, axis: int) -> Any:
    """An upper bound of the sum of non-negative numbers along an axis, for any order of summation."""
    return up(np.sum(array, axis=axis) * (1 + gamma(array.shape[axis])))


def norm(array: Any, axis: int) -> Any:
    """An upper bound of the 2-norm along an axis."""
    return up(np.sqrt(total(array * array, axis)))


def frobenius(G: Any) -> Any:
    """An upper bound of ||G||_F, G (..., n, n)."""
    return norm(norm(G, -1), -1)


def ends(centre: Any, radius: Any) -> tuple[Any, Any]:
    """(lo, hi), an interval around the one of that centre and radius."""
    radius = up(radius + EPS * abs(centre))
    return centre - radius, centre + radius


def float_with_error(q: Fraction) -> tuple[float, float]:
    """The binary64 number nearest to q, and an upper bound of the distance; infinite if q is too large."""
    try:
        value = float(q)
        return value, 0.0 if Fraction(value) == q else up(float(abs(Fraction(value) - q)))
    except OverflowError:
        return np.inf, np.inf


def within(bounds: tuple[Fraction, Fraction], mid: Any, radius: Any) -> Any:
    """Elementwise: [mid - radius, mid + radius] certainly lies in the bounds."""
    (_, least), (most, _) = (ends(*float_with_error(q)) for q in bounds)
    lo, hi = ends(mid, radius)
    return (lo >= least) & (hi <= most)


def arb_with_error(x: arb) -> tuple[float, float]:
    """A binary64 number and an upper bound of its distance from every point of the ball x."""
    value = float(x.mid())
    return value, up(float((x - arb(value)).abs_upper()))


def atanh_with_error(q: Fraction) -> tuple[float, float]:
    """`atanh(q)` for a rational q in (-1, 1)."""
    return arb_with_error(arb(fmpq(q.numerator, q.denominator)).atanh())


def _table(values: Iterable[arb]) -> Array:
    """The binary64 numbers nearest to these values."""
    pairs = [arb_with_error(x) for x in values]
    # At 128 bits the midpoint rounds to within u |value| (1 + 2^-50) of the ball.
    if any(error > U * abs(value) * (1 + 2.0**-20) + 4 * TINY for value, error in pairs):
        raise ArithmeticError("a table entry is not accurate to one rounding")
    return np.array([value for value, _ in pairs])


ctx.prec = 128
_GRID = [arb(k) * _STEP for k in range(int(_ANGLE_END / _STEP) + 1)]
_TANHS = [x.tanh() for x in _GRID[: int(_TANH_END / _STEP) + 1]]
_TANH, _SECH2 = _table(_TANHS), _table(1 - t * t for t in _TANHS)
_SIN, _COS = _table(x.sin() for x in _GRID), _table(x.cos() for x in _GRID)
_EXP, _ATAN = _table(x.exp() for x in _GRID), _table(x.atan() for x in _GRID[: int(1 / _STEP) + 1])
_RIGHT_ANGLE, _ = arb_with_error(arb.pi() / 2)


def _split(y: Array, end: float) -> tuple[Any, Array]:
    """Index k and remainder d with y = k h + d exactly, for 0 <= y <= end: |d| <= h/2, or k = 0 and d = y <= h.

    k h has at most 11 bits. If k = 0, d = y. Otherwise y >= h, so d is a multiple of ulp(y) >= 2^-57 with
    |d| <= 2^-6: it has at most 51 bits, and the subtraction is exact.
    """
    k = np.where(y < _STEP, 0.0, np.rint(y * (1 / _STEP)))
    return k.astype(np.intp), y - k * _STEP


def tanh(y: Array) -> tuple[Array, Array]:
    """(t, e) with |tanh(y) - t| <= e for every finite y; NaN where y is not finite.

    With k and d from `_split`, `tanh(kh + d) = T + q`, `q = (1 - T^2) s / (1 + T s)`, T = tanh(kh), s = tanh(d).
    s = d - d^3/3 + 2 d^5/15 - 17 d^7/315 + 62 d^9/2835 + r: the series alternates and its terms decrease for |d| <= h,
    so |r| <= 1382/155925 |d|^11 < 0.08u |d|. What Horner's rule adds to d is below |d|/3000, so that its roundings
    are below 0.01u |d|: s is within 1.1u |s|. If k = 0, q = s exactly. Otherwise 1 - T^2 and T come with u each, and
    T s <= 2^-6: q is within (1 + 1.1 + 1)u + 1.1u + u < 6u of itself, and the last addition adds u (T + |q|): t is
    within 2u T + 7u |q|, and 2u |q| if k = 0. For y > 20 the value 1 is within 2^-56: 3u T + 8u |q| covers that. As
    tanh is concave, |q| <= |d| T/(kh) <= T/(2k): at most T/2, and T/4 where q < 0, since k >= 2 there. Either way
    3u T + 8u |q| <= 6.7u |T + q|. The claim is 7u |t|.
    """
    finite = np.isfinite(y)
    k, d = _split(np.fmin(np.abs(y), _TANH_END), _TANH_END)
    w = d * d
    s = d + d * (w * (-1 / 3 + w * (2 / 15 + w * (-17 / 315 + w * (62 / 2835)))))
    T = _TANH[k]
    t = np.where(finite, np.copysign(T + _SECH2[k] * s / (1 + T * s), y), np.nan)
    return t, 7 * U * np.abs(t) + TINY


def sin_cos(y: Array) -> tuple[Array, Array, Array, Array]:
    """(s, c, es, ec) with |sin(y) - s| <= es and |cos(y) - c| <= ec; NaN where y is not finite.

    sin(kh + d) = S cos(d) + C sin(d) and cos(kh + d) = C cos(d) - S sin(d) on the same grid. The Taylor polynomials of
    degree 9 and 8 leave out less than |d|^11 / 11! and |d|^10 / 10!, |d| <= h; as above, sin(d) and cos(d) are within
    1.1u of themselves. S and C come with u each: a product is within 3.2u of itself, and the sum adds u of both. The
    claim is 5u times the products' magnitudes. For |y| > 64: s = c = 0, es = ec = 1.
    """
    finite, near = np.isfinite(y), np.abs(y) <= _ANGLE_END
    k, d = _split(np.where(near, np.abs(y), 0.0), _ANGLE_END)
    w = d * d
    sd = d + d * (w * (-1 / 6 + w * (1 / 120 + w * (-1 / 5040 + w * (1 / 362880)))))
    cd = 1 + w * (-1 / 2 + w * (1 / 24 + w * (-1 / 720 + w * (1 / 40320))))
    S, C = _SIN[k], _COS[k]
    s = np.copysign(1.0, y) * (S * cd + C * sd)
    c = C * cd - S * sd
    s_error = 5 * U * (np.abs(S) + np.abs(C * sd)) + TINY
    c_error = 5 * U * (np.abs(C) + np.abs(S * sd)) + TINY
    pairs = ((s, 0.0), (c, 0.0), (s_error, 1.0), (c_error, 1.0))
    return tuple(np.where(finite, np.where(near, v, far), np.nan) for v, far in pairs)  # type: ignore[return-value]


def exp(y: Array) -> tuple[Array, Array]:
    """(v, e) with |exp(y) - v| <= e for finite y up to 64; NaN where y is larger or not finite.

    exp(kh + d) = E p, E = exp(kh), p = exp(d), for |y|, and its inverse for y < 0. The Taylor polynomial of degree 8
    leaves out less than 1.1 |d|^9 / 9!, |d| <= h: below 2^-63 and so 0.001u. What Horner's rule adds to 1 is below
    |d| (1 + h) and within 4u of itself, so p is within 1.2u of itself. E comes with u, the product adds u and the
    inverse another: v is within 4.3u of itself, and the claim is 6u. For y < -64: v = 0, e = 2^-92 > exp(-64).
    """
    with_table = np.abs(y) <= _EXP_END
    k, d = _split(np.where(with_table, np.abs(y), 0.0), _EXP_END)
    p = 1 / 5040 + d * (1 / 40320)
    for coefficient in (1 / 720, 1 / 120, 1 / 24, 1 / 6, 1 / 2, 1.0, 1.0):
        p = coefficient + d * p
    v = _EXP[k] * p
    v = np.where(y < 0, 1 / v, v)
    beyond = np.isfinite(y) & (y < 0)
    v, error = (
        np.where(with_table, near, np.where(beyond, far, np.nan)) for near, far in ((v, 0.0), (6 * U * v, 2.0**-92))
    )
    return v, error


def atan(y: Array) -> tuple[Array, Array]:
    """(v, e) with |atan(y) - v| <= e for every finite y; NaN where y is not finite.

    For |y| <= 1, atan(y) = A + atan(q), A = atan(kh), q = d / (1 + kh y), y = kh + d as in `_split`. q comes with 3.1u,
    or is d if k = 0. The Taylor polynomial of degree 11 leaves out less than |q|^13 / 13, |q| <= h: below 0.001u |q|;
    what Horner's rule adds to q is below |q|/3000. So atan(q) is within 4.2u of itself; A comes with u, and the last
    addition adds u (A + |q|): the claim is 3u A + 8u |q|. For |y| > 1, atan(|y|) = pi/2 - atan(1/|y|), where 1/|y| <= 1
    comes with u of itself, pi/2 with 2u, and the subtraction adds 2u: the claim is 6u more.
    """
    finite, size = np.isfinite(y), np.abs(y)
    large = size > 1
    w = np.where(finite, np.where(large, 1 / np.where(large, size, 1.0), size), 0.0)
    k, d = _split(w, 1.0)
    q = d / (1 + k * _STEP * w)
    s = q * q
    v = q + q * (s * (-1 / 3 + s * (1 / 5 + s * (-1 / 7 + s * (1 / 9 + s * (-1 / 11))))))
    A = _ATAN[k]
    v, error = A + v, 3 * U * A + 8 * U * np.abs(q) + TINY
    v, error = np.where(large, _RIGHT_ANGLE - v, v), np.where(large, error + 6 * U, error)
    return np.where(finite, np.copysign(v, y), np.nan), np.where(finite, error, np.nan)


def spectral_norm(W: Array) -> float:
    """An upper bound of ||W||_2 by repeated squaring.

    ||G||_2^2 = ||G'G||_2 <= ||fl(G'G)||_2 + gamma_k ||G||_F^2. Six squarings leave the Frobenius norm at the end,
    which is at most n^(1/128) times too large. G is divided by a power of two first, which is exact
    but for underflow.
    """
    G = W if W.shape[0] >= W.shape[1] else W.T
    steps: list[tuple[float, float]] = []
    for _ in range(6):
        size = float(frobenius(G))
        if not size < np.inf:
            return np.inf
        scale = math.ldexp(1.0, math.frexp(size)[1])
        G = G / scale
        steps.append((scale, up(gamma(G.shape[0]) * up((size / scale) ** 2)) + G.size * TINY))
        G = G.T @ G
    bound = float(frobenius(G))
    for scale, error in reversed(steps):
        bound = float(up(scale * up(np.sqrt(up(bound + error)))))
    return bound


def self_test() -> None:
    """Fail closed unless this machine rounds to nearest even and keeps subnormal numbers.

    Raises
    ------
    ArithmeticError : a rounding mode other than nearest, flushed subnormals, or a matrix product whose
        error exceeds its bound.
    """
    one, least = np.full(64, 1.0), np.full(64, 2.0**-1022)
    integers = np.array([k * 0x9E3779B97F4A7C15 % 2**54 - 2**53 for k in range(288)], dtype=object).reshape(2, 12, 12)
    A, B = integers.astype(np.float64)
    bounds = gamma(12) * norm(A, 1)[:, None] * norm(B, 0)[None, :]
    products = zip((A @ B).ravel(), (integers[0] @ integers[1]).ravel(), bounds.ravel(), strict=True)
    good = (
        np.all(one + U == 1.0)
        and np.all(one + 3 * U == 1.0 + 4 * U)
        and np.all(-one - U == -1.0)
        and np.all(one - U / 2 == 1.0)
        and np.all((least * 0.5) * 2 == least)
        and np.all(np.sqrt(one * 2) == float.fromhex("0x1.6a09e667f3bcdp+0"))
        and np.all(one / 3 == float.fromhex("0x1.5555555555555p-2"))
        and all(abs(int(product) - exact) <= bound for product, exact, bound in products)
    )
    if not good:
        raise ArithmeticError("this machine's binary64 arithmetic is not IEEE round-to-nearest with subnormals")
