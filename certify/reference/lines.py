"""Lines around functions of one number: |phi(y) - slope y - shift| <= gap for all y of a range.

phi(y) - slope y is largest and least at the ends of the range or at points inside, its turns. Its largest value is the
top and its least the bottom of what the lines have between them. A ball for an end holds the end, and a point that may
lie in the range counts.
"""

from __future__ import annotations

from collections.abc import Sequence

from flint import arb

from .balls import ONE, ZERO

Line = tuple[arb, arb, arb]  # slope, shift and gap
Turn = tuple[arb, arb]  # a point, and phi(y) - slope y there


def chord(lo: arb, hi: arb, at_lo: arb, at_hi: arb) -> arb:
    """A slope near the chord's, an exact number; none that is finite where the range may be a point."""
    return ((at_hi - at_lo) / (hi - lo)).mid()


def limited(slope: arb, least: arb, most: arb) -> arb:
    return least if slope < least else most if slope > most else slope


def around(slope: arb, lo: arb, hi: arb, at_lo: arb, at_hi: arb, turns: Sequence[Turn]) -> Line:
    """The lines of a slope, given phi at the ends; a turn that does not lie inside can only make the gap too wide."""
    first, last = at_lo - slope * lo, at_hi - slope * hi
    top, bottom = (last, first) if first < last else (first, last) if last < first else (first.union(last),) * 2
    for y, value in turns:
        if not (y < lo or y > hi):
            top = value if value > top else top.max(value)
            bottom = value if value < bottom else bottom.min(value)
    return slope, (top + bottom) / 2, (top - bottom) / 2


def tanh_between(lo: arb, hi: arb) -> Line:
    """tanh on [lo, hi]: the turns of tanh(y) - slope y are where tanh(y)^2 = 1 - slope."""
    at_lo, at_hi = lo.tanh(), hi.tanh()
    slope = chord(lo, hi, at_lo, at_hi)
    if not (slope > 0 and slope < 1):
        on_a_point = not slope.is_finite()  # where there is no chord
        slope = (1 - at_lo * at_lo).mid() if on_a_point else ONE if slope > 0 else ZERO
    turns: tuple[Turn, ...] = ()
    if slope > 0:
        t = (1 - slope).sqrt()
        y = t.atanh() if slope > 1e-9 else ((1 + t) / slope.sqrt()).log()  # of t near 1 it asks for 1 - t
        value = t - slope * y
        turns = (y, value), (-y, -value)
    return around(slope, lo, hi, at_lo, at_hi, turns)


def clipped(first: arb, last: arb, lo: arb, hi: arb) -> Line:
    """min(max(y, lo), hi) on [first, last].

    It is y where y certainly lies between them. Else it lies between two lines of a slope from 0 to 1: clip(y) - slope
    y rises between lo and hi and falls elsewhere, so it is least and greatest at the ends of the range of y, at lo or
    at hi; a corner that is certain to lie outside of the range does not count.
    """
    first, last = arb(first.lower()), arb(last.upper())
    if first >= lo and last <= hi:
        return ONE, ZERO, ZERO
    ends = first.max(lo).min(hi), last.max(lo).min(hi)
    slope = limited(((ends[1] - ends[0]) / (last - first)).mid() if first < last else ZERO, ZERO, ONE)
    away = [ends[0] - slope * first, ends[1] - slope * last]
    away += [(1 - slope) * corner for corner in (lo, hi) if not (corner < first or corner > last)]
    top = bottom = away[0]
    for v in away[1:]:
        top, bottom = top.max(v), bottom.min(v)
    return slope, (top + bottom) / 2, (top - bottom) / 2
