"""Rounding that only some certificates need: exp, atan, roots, inverses, functions by polynomials, and the lines around
clips and products. The rules for every bound are those of near.py.

exp and atan use a table of values as tanh does.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb
from typing import Any

import numpy as np
from flint import arb, arb_series, ctx

from .near import STEP, Above, Array, Form, Near, U, entry, lower, near_ball, size, split, table

_RIGHT_ANGLE = near_ball(arb.pi() / 2).value
_EXP_END = 64.0  # beyond, nothing is known of exp; below -64 it lies between 0 and 2^-92
_FAR, _FAR_POINTS, _FAR_ERROR, _DEGREE = 40.0, 1280, 2.0**-48, 9


def _exp(y: Array) -> Near:
    """exp(y) for finite y up to 64; NaN where y is larger or not finite.

    exp(kh + d) = E p, E = exp(kh), p = exp(d), for |y|, and its inverse for y < 0. The Taylor polynomial of degree 8
    leaves out less than 1.1 |d|^9 / 9!, |d| <= h: below 2^-63 and so 0.001u. What Horner's rule adds to 1 is below
    |d| (1 + h) and within 4u of itself, so p is within 1.2u of itself. E comes with u, the product adds u and the
    inverse another: v is within 4.3u of itself, and the claim is 6u. For y < -64: v = 0, e = 2^-92 > exp(-64).
    """
    with_table = np.abs(y) <= _EXP_END
    k, d = split(np.where(with_table, np.abs(y), 0.0), _EXP_END)
    p = 1 / 5040 + d * (1 / 40320)
    for coefficient in (1 / 720, 1 / 120, 1 / 24, 1 / 6, 1 / 2, 1.0, 1.0):
        p = coefficient + d * p
    v = table(arb.exp, _EXP_END)[k] * p
    v = np.where(y < 0, 1 / v, v)
    beyond = np.isfinite(y) & (y < 0)
    error = size(v) * (6 * U)
    v, bound = (np.where(with_table, a, np.where(beyond, b, np.nan)) for a, b in ((v, 0.0), (error.v, 2.0**-92)))
    return Near(v, Above(bound, error.k))


def _atan(y: Array) -> Near:
    """atan(y) for every finite y; NaN where y is not finite.

    For |y| <= 1, atan(y) = A + atan(q), A = atan(kh), q = d / (1 + kh y), y = kh + d as in `split`. q comes with 3.1u,
    or is d if k = 0. The Taylor polynomial of degree 11 leaves out less than |q|^13 / 13, |q| <= h: below 0.001u |q|;
    what Horner's rule adds to q is below |q|/3000. So atan(q) is within 4.2u of itself; A comes with u, and the last
    addition adds u (A + |q|): the claim is 3u A + 8u |q|. For |y| > 1, atan(|y|) = pi/2 - atan(1/|y|), where 1/|y| <= 1
    comes with u of itself, pi/2 with 2u, and the subtraction adds 2u: the claim is 6u more.
    """
    finite, far = np.isfinite(y), np.abs(y)
    large = far > 1
    w = np.where(finite, np.where(large, 1 / np.where(large, far, 1.0), far), 0.0)
    k, d = split(w, 1.0)
    q = d / (1 + k * STEP * w)
    s = q * q
    v = q + q * (s * (-1 / 3 + s * (1 / 5 + s * (-1 / 7 + s * (1 / 9 + s * (-1 / 11))))))
    A = table(arb.atan, 1.0)[k]
    v, error = A + v, size(A) * (3 * U) + size(q) * (8 * U)
    v = np.copysign(np.where(large, _RIGHT_ANGLE - v, v), y)
    error = (error + 6 * U).where(large, error)
    return Near(np.where(finite, v, np.nan), Above(np.where(finite, error.v, np.nan), error.k))


class Polynomials:
    """A function phi whose coefficients `phi^(j)(y)/j!` come from Taylor polynomials around the points of the grid.

    Parameters
    ----------
    formula : phi of a power series, in Arb. Beyond |y| = _FAR phi must be within 2^-48 of 0 on the left and of y on the
        right, its derivative of 0 and 1, and `phi^(j)/j!` of 0 for 2 <= j <= 4.

    `sup[j]` bounds `|phi^(j)/j!|` on all numbers, j from 1 to 5.
    """

    def __init__(self, formula: Callable[[arb_series], arb_series]) -> None:
        with ctx.workprec(128):
            self._make(formula)

    def _make(self, formula: Callable[[arb_series], arb_series]) -> None:
        points = [arb(k) * STEP for k in range(-_FAR_POINTS, _FAR_POINTS + 1)]
        cells = [_coefficients(formula, arb(g, STEP / 2)) for g in points]
        each = np.array([[near_ball(abs(cell[j])).ends[1] for cell in cells] for j in range(_DEGREE + 1)])
        largest = np.maximum(np.max(each, axis=1), _FAR_ERROR)  # NaN stays, which Python's max may lose
        largest[1] = np.maximum(largest[1], 1 + _FAR_ERROR)
        self.sup = [Above(v) for v in largest]
        entries = [_coefficients(formula, g)[:_DEGREE] for g in points]
        self.tables = [
            np.array([[entry(comb(i, j) * at[i], 2.0**-90) for at in entries] for i in range(j, _DEGREE)])
            for j in range(5)
        ]
        powers = 2.0 ** (-6 * np.arange(_DEGREE))
        self.sizes = [(size(t[1:]) * powers[: len(t) - 1, None]).sum().top for t in self.tables]
        self.rests = [
            self.sup[_DEGREE] * float(comb(_DEGREE, j)) * 2.0 ** (-6 * (_DEGREE - j)) + 2.0**-80 for j in range(5)
        ]

    def at(self, y: Array, j: int) -> Near:
        """`phi^(j)(y)/j!` for every finite y; NaN where y is not finite.

        y = kh + d with |d| <= h/2, exactly: k = rint(y/h), and y - kh has no rounding, by `split` where |y| >= h, by
        Sterbenz' lemma for h/2 <= |y| < h, and for k = 0. Lagrange's remainder is at most C(K, j) |d|^(K-j) times the
        largest |phi^(K)/K!| between grid points. Entries of the tables come with u and 2^-90 each, which `rests` has,
        and Horner's rule with at most 2K roundings: (2K + 2) u (|t_0| + |d| sum_(i>=1) |t_i| (h/2)^(i-1)).
        """
        close = np.abs(y) <= _FAR
        inner = np.where(close, y, 0.0)
        k = np.rint(inner * (1 / STEP))
        d, at, v = inner - k * STEP, k.astype(np.intp) + _FAR_POINTS, 0.0
        for t in reversed(self.tables[j]):
            start = t[at]
            v = start + d * v
        error = (size(start) + size(d) * self.sizes[j][at]).ulps(2 * _DEGREE) + self.rests[j]
        far = np.where(np.isfinite(y), np.where(y > 0, (y, 1.0)[j] if j < 2 else 0.0, 0.0), np.nan)
        return Near(np.where(close, v, far), Above(np.where(close, error.top, _FAR_ERROR + 0 * far)))


def _coefficients(formula: Callable[[arb_series], arb_series], at: arb) -> list[arb]:
    """`phi^(j)/j!` at a number, or all numbers of a ball, j from 0 to K."""
    series = formula(arb_series([at, 1], prec=_DEGREE + 1))
    return [series[j] for j in range(_DEGREE + 1)]


def atan(x: Near) -> Near:
    return _atan(x.value).wider(x.error)


def exp(x: Near) -> Near:
    """exp; its slope is at most its value at the upper end."""
    return _exp(x.value).wider(x.error * _exp(x.ends[1]).size)


def sqrt(x: Near) -> Near:
    """Square roots; NaN unless x is certainly positive. |s - w| = |s^2 - w^2| / (s + w), and s + w is at least s."""
    least = lower(x)
    root = np.sqrt(np.where(x.value > 0, x.value, np.nan))
    return Near(root, size(root).ulps(1) + x.error.over(lower(Near(np.sqrt(least), size(np.sqrt(least)).ulps(1)))))


def inverse(x: Near) -> Near:
    """1/x; NaN unless x is certainly not 0. |1/x - 1/y| = |x - y| / |x y|."""
    least, value = lower(x), 1 / x.value
    return Near(value, size(value).ulps(1) + x.error.over(least).over(least))


def least_share(x: Any, of: Above) -> Any:
    """Lower bounds of min(1, x/y) for exact x > 0 and all 0 <= y <= `of`: 1 only where y is certainly below x, 0 where
    x is not positive or nothing is known of y. A quotient above 2^-1000 has one rounding, 1 - 2^-50 another one."""
    most = of.top
    found = np.where((x > 0) & (x < np.inf) & (most >= x), x, 0.0) / np.where(most > 0, most, 1.0) * (1 - 2.0**-50)
    return np.where((x > 0) & (most < x), 1.0, np.where(found > 2.0**-1000, found, 0.0))


def halfway(lower: Array, upper: Array) -> tuple[Array, Above]:
    """(m, gap) with |y - m| <= gap for lower <= y <= upper."""
    m = 0.5 * (upper + lower)
    return m, (Near(upper) - Near(m)).size.most((Near(lower) - Near(m)).size)


def clip_of(v: Near, least: Array, most: Array) -> tuple[Array, Array, Above]:
    """(s, m, gap) with |min(max(v, least), most) - s v - m| <= gap for all numbers v between the ends of these.

    clip(v) - s v is linear between the corners of clip, so that its extremes over the range of v lie at the range's
    ends or at corners in it; s is *any* number in [0, 1], here near the chord's slope.
    """
    lo, hi = v.ends
    width = np.clip(hi, least, most) - np.clip(lo, least, most)
    s = np.clip(width / (hi - lo), 0.0, 1.0)
    at = np.array([lo, hi, np.clip(least, lo, hi), np.clip(most, lo, hi)])
    away = Near(np.clip(at, least, most)) - Near(at) * Near(s)
    lows, highs = away.ends
    return s, *halfway(np.min(lows, axis=0), np.max(highs, axis=0))


def lines_around_product(V: Form, of_V: Above, W: Form, of_W: Above, same: bool) -> tuple[Array, Above]:
    """(m, gap) with |(V + v)(W + w) - m| <= gap for all |v| <= of_V, |w| <= of_W, V and W being exact forms whose first
    coefficient is 0; `same` says that V + v and W + w are the same number.

    For any p > 0 it is p/4 ((X + Y/p)^2 - (X - Y/p)^2), X = V + v, Y = W + w, and so between -p/4 s^2 and p/4 t^2,
    s and t being the sums of the magnitudes of the coefficients of V -+ W/p and of of_V + of_W/p. It is also at most
    |X||Y|. p = sup|Y|/sup|X|, where that is a positive number, makes the former the better ones. A square is not
    negative.
    """
    x, y = V.size + of_V, W.size + of_W
    most = x * y
    if same:
        least = Above(0 * most.v)
    else:
        with np.errstate(all="ignore"):
            p = (y.top + 0 * x.top) / x.top
        p = np.where((p > 2.0**-500) & (p < 2.0**500), p, 1.0)
        scaled, errors = W.over(p), of_V + of_W.over(p)
        least, top = (((V + part).size + errors) for part in (-scaled, scaled))
        least, top = ((s * s * (p * 0.25)).least(most) for s in (least, top))
        most = top
    return halfway(-least.top, most.top)
