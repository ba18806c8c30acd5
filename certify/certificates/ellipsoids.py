"""Ellipsoids of a certificate, and boxes of states in them: decided in rationals."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from certify.lyapunov import are_inside

Array = NDArray[np.float64]
Box = tuple[tuple[Fraction, Fraction], ...]


@dataclass(frozen=True, slots=True)
class Ellipsoid:
    """{(x - c)'P(x - c) <= level} with its name; P (n, n), c = `centre` (n,), empty for 0."""

    name: str
    P: Array
    level: float
    centre: tuple[float, ...] = ()

    def around(self, box: Box) -> Box:
        """A box as deviations from the centre."""
        shift = [Fraction(v) for v in self.centre] or [Fraction(0)] * len(box)
        return tuple((lo - c, hi - c) for (lo, hi), c in zip(box, shift, strict=True))

    def holds(self, points: Iterable[Sequence[Fraction | float]]) -> list[bool]:
        """True for each state that lies in the ellipsoid."""
        return are_inside(self.P, self.level, points, self.centre)

    def covers(self, box: Box) -> bool:
        """True if a bound of (x - c)'P(x - c) shows that the whole box lies in the ellipsoid."""
        return _largest(self.P, self.around(box)) <= Fraction(float(self.level))


def sublevel_set(P: Array, roa: float) -> Ellipsoid:
    """{V <= c2}, V = x'Px."""
    return Ellipsoid("{V <= c2}", P, roa)


def tube_start(P: Array, centre: tuple[float, ...] | None = None) -> Ellipsoid:
    """The set from which a tube leads to {V <= c2}."""
    return Ellipsoid("the tube's start", P, 1.0, centre or ())


def _symmetric(P: Array) -> list[list[Fraction]]:
    rows = [[Fraction(float(v)) for v in row] for row in P]
    return [[(rows[i][j] + rows[j][i]) / 2 for j in range(len(rows))] for i in range(len(rows))]


def _middle(box: Box) -> tuple[list[Fraction], list[Fraction]]:
    return [(lo + hi) / 2 for lo, hi in box], [(hi - lo) / 2 for lo, hi in box]


def _largest(P: Array, box: Box) -> Fraction:
    """A bound of x'Px on a box: with x = c + d, |d| <= r, `c'Pc + 2 |Pc| r + r'|P|r`."""
    S, (c, r) = _symmetric(P), _middle(box)
    Sc = [sum((s * v for s, v in zip(row, c, strict=True)), Fraction(0)) for row in S]
    curved = sum(
        (abs(s) * a * b for row, a in zip(S, r, strict=True) for s, b in zip(row, r, strict=True)), Fraction(0)
    )
    return sum((v * g + 2 * abs(g) * w for v, g, w in zip(c, Sc, r, strict=True)), Fraction(0)) + curved


def steepest(ellipsoid: Ellipsoid, box: Box) -> tuple[Fraction, ...]:
    """The corner to which (x - c)'P(x - c) rises at the middle of the box."""
    S, (c, _) = _symmetric(ellipsoid.P), _middle(ellipsoid.around(box))
    slopes = [sum((s * v for s, v in zip(row, c, strict=True)), Fraction(0)) for row in S]
    return tuple(hi if slope >= 0 else lo for (lo, hi), slope in zip(box, slopes, strict=True))
