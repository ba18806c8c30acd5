"""Angles, compared exactly: numbers q + 2 pi w with a rational q and an integer w.

pi is irrational, so that such a number with w other than 0 equals no rational: enough digits of pi decide every
comparison. With w = 0 it is one of rationals.
"""

from __future__ import annotations

import math
from fractions import Fraction

import flint

from certify.loop.rigorous import precision

Turned = tuple[Fraction, int]
"""q and w, for q + 2 pi w."""
_FIRST_BITS = 80


def sign_against(value: Turned, other: Fraction) -> int:
    """-1, 0 or 1, as the number lies below, at or above another, which is rational.

    >>> sign_against((Fraction(0), 1), Fraction(6)), sign_against((Fraction(7), -1), Fraction(1))
    (1, -1)
    """
    q, w = value
    if w == 0:
        return (q > other) - (q < other)
    ratio, bits = (other - q) / (2 * w), _FIRST_BITS  # q + 2 pi w > other: pi > ratio if w > 0
    while True:
        lo, hi = _pi(bits)
        if ratio <= lo or ratio >= hi:
            return 1 if (ratio <= lo) is (w > 0) else -1
        bits *= 2


def turns_into(q: Fraction, lo: Fraction, hi: Fraction) -> range:
    """The integers w with lo <= q + 2 pi w <= hi."""
    bits = _FIRST_BITS + 2 * sum(v.numerator.bit_length() for v in (q, lo, hi))
    about, _ = _pi(bits)
    first, last = math.floor((lo - q) / (2 * about)), math.ceil((hi - q) / (2 * about))
    first += next(k for k in range(3) if sign_against((q, first + k), lo) >= 0)
    last -= next(k for k in range(3) if sign_against((q, last - k), hi) <= 0)
    return range(first, last + 1)


def bounds_of(value: Turned) -> tuple[Fraction, Fraction]:
    """Rationals between which the number lies, within 2^-80 of its turns; equal without any."""
    q, w = value
    lo, hi = sorted(2 * w * pi for pi in _pi(_FIRST_BITS + abs(w).bit_length()))
    return (q + lo, q + hi) if w else (q, q)


def _pi(bits: int) -> tuple[Fraction, Fraction]:
    """Rationals just below and above pi."""
    with precision(bits):
        lo, hi = (end.man_exp() for end in (flint.arb.pi().lower(), flint.arb.pi().upper()))
    return tuple(Fraction(int(m)) * Fraction(2) ** int(e) for m, e in (lo, hi))  # type: ignore[return-value]
