"""The functions of one variable, expanded to second order: the one place that knows what they are.

Taylor models and jets ask the same question. v lies within `radius` of a number v0 which is itself only known to lie
within `error` of c. What are phi, phi' and phi''/2 at v0, and how far is phi(v) from the parabola that they make?
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .float64 import EPS, atan, exp, sin_cos, tanh, up

Triple = tuple[Any, Any, Any]


def elementary(name: str, c: Any, error: Any, radius: Any) -> tuple[Triple, Triple, Any]:
    """(f, e, third) with phi, phi' and phi''/2 at v0 within e of f, and, for all |v - v0| <= radius,
    |phi(v) - phi(v0) - phi'(v0) D - phi''(v0)/2 D^2| <= third |D|^3, D = v - v0.

    NaN where phi may be undefined or c is not finite. sin and cos have no derivative above 1; `third` bounds
    |phi'''|/6, as 2/6 does for tanh and atan and exp(v)/6 for exp, but for 1/v what is left is exactly -D^3 / (v0^3 v),
    and for the square root, with s^2 = v0 and w^2 = v, exactly D^3 (3 s + w) / (8 s^3 (s + w)^3).
    """
    if name == "tanh":
        t, e = tanh(c)
        e = up(e + error)
        slope = 1 - t * t
        wrong = up(2 * e * (1 + e) + EPS)
        half = -t * slope
        bent = up(e * up(slope + wrong) + np.abs(t) * wrong + EPS * np.abs(half))
        return (t, slope, half), (e, wrong, bent), up(1 / 3)
    if name == "inv":
        # the least magnitude of v, then that of v0; NaN for both if v may vanish
        least = _rounded_down(np.abs(c) - up(error + radius))
        nearest = np.where(least > 0, _rounded_down(np.abs(c) - error), np.nan)
        square = up(1 / (nearest * nearest))
        cube = up(square / nearest)
        f0 = 1 / c
        f = (f0, -f0 * f0, f0 * f0 * f0)
        moved = (square, 2 * cube, 3 * up(cube / nearest))  # |phi'|, |phi''|, |phi'''|/2 where v0 may be
        e0, e1, e2 = (up(EPS * np.abs(v) + error * most) for v, most in zip(f, moved, strict=True))
        return f, (e0, e1, e2), up(cube / least)
    if name == "exp":
        most = c + up(error + radius)
        f, e = exp(c)
        worst, more = exp(most + EPS * np.abs(most))
        e = up(e + error * up(worst + more))
        return (f, f, f / 2), (e, e, e), up(up(worst + more) / 6)
    if name == "atan":
        f0, e0 = atan(c)
        slope = np.where(np.isfinite(c), 1 / (1 + c * c), np.nan)
        half = -(c * slope) * slope
        # |phi'| and |phi'''|/2 are at most 1, and |phi''| at most 0.65
        e1, e2 = (up(2 * EPS * np.abs(v) + error) for v in (slope, half))
        return (f0, slope, half), (up(e0 + error), e1, e2), up(1 / 3)
    if name == "sqrt":
        # the least that v may be, then v0; NaN for both if v may not be positive
        least = _rounded_down(c - up(error + radius))
        nearest = np.where(least > 0, _rounded_down(c - error), np.nan)
        s = np.sqrt(c)
        f = (s, 0.5 / s, -0.125 / (s * s * s))
        p = up(1 / _rounded_down(np.sqrt(nearest)))  # 1/s where it is largest, and 1/(s + w)
        q = up(1 / _rounded_down(np.sqrt(nearest) + np.sqrt(least)))
        cube = up(p * up(p * p))
        moved = (p / 2, cube / 4, 0.1875 * up(cube * up(p * p)))  # |phi'|, |phi''|, |phi'''|/2 where v0 may be
        e0, e1, e2 = (up(EPS * np.abs(v) + error * most) for v, most in zip(f, moved, strict=True))
        return f, (e0, e1, e2), up(up(up(p * q) * up(p * q)) * up(2 * q + p) / 8)
    if name not in ("sin", "cos"):
        raise ValueError(f"nothing is known of {name}")
    s, c, s_error, c_error = sin_cos(c)
    if name == "cos":  # the sine of v + pi/2
        s, c, s_error, c_error = c, -s, c_error, s_error
    third = up(np.minimum(np.abs(c) + c_error + error + radius, 1.0) / 6)
    s_error = up(s_error + error)
    return (s, c, -s / 2), (s_error, up(c_error + error), s_error), third


def _rounded_down(x: Any) -> Any:
    """NaN unless 0 < x < infinity."""
    return np.where((x > 0) & (x < np.inf), x * (1 - 2.0**-40), np.nan)
