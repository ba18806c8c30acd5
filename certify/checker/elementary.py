"""The functions of one variable and their expansions; only this module has them.

Taylor models and jets ask the same question. v lies within `radius` of a number v0 which is itself only known to lie
within `error` of c. What are phi, phi', phi''/2 and phi'''/6 at v0, and how far is phi(v) from the parabola and from
the cubic that they make? Taylor models take the one, jets the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .float64 import EPS, atan, exp, sin_cos, tanh, up

Four = tuple[Any, Any, Any, Any]
_THIRD, _TANH_FOURTH, _TANH_FIFTH, _ATAN_FOURTH = up(1 / 3), up(4.1 / 24), up(16 / 24), up(4.7 / 24)


@dataclass(frozen=True)
class Expansion:
    """phi, phi', phi''/2 and phi'''/6 at v0 within `e` of `f`. For all |v - v0| <= radius and D = v - v0, phi(v) lies
    within third |D|^3 of the first three terms of its series, and within fourth D^4 of the first four."""

    f: Four
    e: Four
    third: Any
    fourth: Any
    last: Any  # of what is left after four terms the derivative by D is at most last |D|^3


def derivative(phi: Expansion) -> Expansion:
    """phi' as far as Taylor models ask: `last` bounds what is left of it after three terms, by |D|^3."""
    (_, f1, f2, f3), (_, e1, e2, e3), unknown = phi.f, phi.e, np.nan
    return Expansion((f1, 2 * f2, 3 * f3, unknown), (e1, 2 * e2, 3 * e3, unknown), phi.last, unknown, unknown)


def elementary(name: str, c: Any, error: Any, radius: Any) -> Expansion:
    """The expansion of a function; NaN where it may be undefined or c is not finite.

    `third` and `fourth` bound |phi'''|/6 and |phi''''|/24, whose suprema are in FORMAT.md; but for 1/v the remainder is
    exactly -D^3 / (v0^3 v) and D^4 / (v0^4 v), and for the square root, with s^2 = v0 and w^2 = v, exactly
    D^3 (3 s + w) / (8 s^3 (s + w)^3) and -D^4 (5 s^2 + 4 s w + w^2) / (16 s^5 (s + w)^4). Nor is `last` sup|phi''''|/6
    for these: the derivatives of the remainder are D^3 (3 v + v0) / (v0^4 v^2) and, with s - w instead of
    D / (s + w), -D^3 (8 s^2 + 9 s w + 3 w^2) / (16 s^5 w (s + w)^3), which fall in magnitude as v rises.
    """
    if name == "tanh":
        t, e = tanh(c)
        e = up(e + error)
        slope = 1 - t * t
        wrong = up(2 * e * (1 + e) + EPS)
        half = -t * slope
        bent = up(e * up(slope + wrong) + np.abs(t) * wrong + EPS * np.abs(half))
        sixth = (t * t - 1 / 3) * slope  # its derivative by t is below 1.4, |t| <= 1
        here = np.abs(t * (2 - 3 * t * t) * slope) / 3  # |phi''''|/24 at c
        fourth = np.minimum(_TANH_FOURTH, up(here + EPS + _TANH_FIFTH * up(error + radius)))
        return Expansion((t, slope, half, sixth), (e, wrong, bent, up(1.4 * e + EPS)), _THIRD, fourth, up(4 * fourth))
    if name == "inv":
        # the least magnitude of v, then that of v0; NaN for both if v may vanish
        least = _rounded_down(np.abs(c) - up(error + radius))
        nearest = np.where(least > 0, _rounded_down(np.abs(c) - error), np.nan)
        square = up(1 / (nearest * nearest))
        cube = up(square / nearest)
        fourth = up(cube / nearest)
        f0 = 1 / c
        f = (f0, -f0 * f0, f0 * f0 * f0, -(f0 * f0) * (f0 * f0))
        moved = (square, 2 * cube, 3 * fourth, 4 * up(fourth / nearest))  # derivatives of f where v0 may be
        most = up(np.abs(c) + error)
        last = up(up(fourth / least) * up(up(3 * least + most) / least))
        return Expansion(f, _moved(f, error, moved), up(cube / least), up(fourth / least), last)
    if name == "exp":
        most = c + up(error + radius)
        f0, e0 = exp(c)
        worst, more = exp(most + EPS * np.abs(most))
        most = up(worst + more)
        e0 = up(e0 + error * most)
        return Expansion((f0, f0, f0 / 2, f0 / 6), (e0, e0, e0, e0), up(most / 6), up(most / 24), up(most / 6))
    if name == "atan":
        f0, e0 = atan(c)
        slope = np.where(np.isfinite(c), 1 / (1 + c * c), np.nan)
        half = -(c * slope) * slope
        sixth = slope * ((c * slope) * (c * slope) - slope * slope / 3)  # a difference of numbers up to 1/3
        # |phi'| and |phi'''|/2 are at most 1, |phi''| at most 0.65 and |phi''''|/6 at most 0.79
        e1, e2, e3 = (up(2 * EPS * np.abs(v) + error) for v in (slope, half, slope))
        return Expansion(
            (f0, slope, half, sixth), (up(e0 + error), e1, e2, e3), _THIRD, _ATAN_FOURTH, up(4 * _ATAN_FOURTH)
        )
    if name == "sqrt":
        # the least that v may be, then v0; NaN for both if v may not be positive
        least = _rounded_down(c - up(error + radius))
        nearest = np.where(least > 0, _rounded_down(c - error), np.nan)
        s = np.sqrt(c)
        f = (s, 0.5 / s, -0.125 / (c * s), 0.0625 / (c * c * s))
        p = up(1 / _rounded_down(np.sqrt(nearest)))  # 1/s where it is largest, and 1/(s + w)
        q = up(1 / _rounded_down(np.sqrt(nearest) + np.sqrt(least)))
        pp, pq, qq = up(p * p), up(p * q), up(q * q)
        cube = up(p * pp)
        fifth = up(cube * pp)
        moved = (p / 2, cube / 4, 0.1875 * fifth, 0.15625 * up(fifth * pp))  # derivatives of f where v0 may be
        # 3 s + w is 2 s + (s + w), and 5 s^2 + 4 s w + w^2 is 2 s^2 + 2 s (s + w) + (s + w)^2
        third = up(up(pq * pq) * up(2 * q + p) / 8)
        fourth = up(up(up(pq * pq) * p) * up(2 * qq + 2 * pq + pp) / 16)
        far, w = up(np.sqrt(up(c + error))), up(np.sqrt(least))
        bent = up(8 * up(far * far) + 9 * up(far * w) + 3 * up(w * w))
        last = up(up(bent * fifth) / 16 * up(up(1 / _rounded_down(np.sqrt(least))) * up(q * qq)))
        return Expansion(f, _moved(f, error, moved), third, fourth, last)
    if name not in ("sin", "cos"):
        raise ValueError(f"nothing is known of {name}")
    s, c, s_error, c_error = sin_cos(c)
    if name == "cos":  # the sine of v + pi/2
        s, c, s_error, c_error = c, -s, c_error, s_error
    s_error, c_error = up(s_error + error), up(c_error + error)
    third, fourth = (np.minimum(up(np.abs(v) + e + radius), 1.0) for v, e in ((c, c_error), (s, s_error)))
    return Expansion(
        (s, c, -s / 2, -c / 6), (s_error, c_error, s_error, c_error), up(third / 6), up(fourth / 24), up(fourth / 6)
    )


def _moved(f: Four, error: Any, most: Four) -> Four:
    """The distance of f from its values at v0: its roundings, and `error` times the largest derivative of each."""
    e0, e1, e2, e3 = (up(EPS * np.abs(v) + error * each) for v, each in zip(f, most, strict=True))
    return e0, e1, e2, e3


def _rounded_down(x: Any) -> Any:
    """NaN unless 0 < x < infinity."""
    return np.where((x > 0) & (x < np.inf), x * (1 - 2.0**-40), np.nan)
