"""The level that a pass of the ring moves, outwards or inwards, and how boxes grow at it."""

from __future__ import annotations

import copy
import math
from abc import ABC, abstractmethod

import numpy as np

from certify.certificates.claims import Problem
from certify.provers.bounds.arrays import Array, Mask, chosen
from certify.provers.boxes.ahead import Growth
from certify.provers.boxes.halving import Halves
from certify.provers.boxes.rule import BoxBounds, VdotBound
from certify.provers.falsify import Witness, descend

_SLACK = 1e-9  # relative distance kept from every level, so that the checker's own rounding agrees
_BESIDE_WITNESS = 1e-3  # relative distance kept from a violation
_SHELL = 16.0  # a batch reaches up to this multiple of the nearest open level


class Sweep(ABC):
    """The moving level of a pass: `inner` or `outer` gives way to what cannot be proved.

    Boxes proved before it moved stay proved: the ring only shrinks, and the rule's multipliers do not depend on it.
    """

    down = False  # whether the level that gives way is the inner one

    def __init__(self, problem: Problem, T: Array, inner: float, outer: float) -> None:
        self.problem, self.T = problem, T
        self.inner, self.outer = inner, outer
        self.witness: Witness | None = None

    @abstractmethod
    def key(self, lowest: Array, highest: Array) -> Array:
        """Ascending in the order in which boxes are taken, from the bounds of V on them (B,)."""

    @abstractmethod
    def wanted(self, lowest: Array, highest: Array) -> Mask:
        """True for boxes (B,) that still have to be decided."""

    @abstractmethod
    def reach(self, least: float) -> float:
        """The key up to which a batch may go, where `least` is the smallest."""

    @abstractmethod
    def last(self) -> float:
        """The key beyond which open boxes no longer count."""

    @abstractmethod
    def violated(self, centres: Array, level: Array) -> bool:
        """Move the level off violations at `centres` (n, B), V being `level` (infinite elsewhere); True if it moved."""

    @abstractmethod
    def stuck(self, lowest: Array, highest: Array) -> bool:
        """Move the level off boxes that are too small to halve; True if it moved."""

    @abstractmethod
    def reached(self, least: float) -> tuple[float, float]:
        """(inner, outer) between which all is proved, `least` being the smallest open key; maybe nothing is."""

    @abstractmethod
    def stand(self, least: float) -> tuple[float, float, float]:
        """(level reached, level aimed at, share of the ring's volume that lies between)."""

    def share(self, a: float, b: float) -> float:
        """The volume of `a <= V <= b` as a share of the ring's."""
        power = len(self.T) / 2
        a, b, inner, outer = (max(0.0, v) ** power for v in (a, b, self.inner, self.outer))
        return min(1.0, max(0.0, (b - a) / (outer - inner))) if outer > inner else 1.0


class Outwards(Sweep):
    def key(self, lowest: Array, highest: Array) -> Array:
        return lowest

    def wanted(self, lowest: Array, highest: Array) -> Mask:
        return (lowest <= self.outer * (1 + _SLACK)) & (highest >= self.inner * (1 - _SLACK))

    def reach(self, least: float) -> float:
        return _SHELL * max(least, self.inner)

    def last(self) -> float:
        return self.outer * (1 + _SLACK)

    def violated(self, centres: Array, level: Array) -> bool:
        lowest = float(level.min())
        if lowest > self.outer:
            return False
        found = descend(self.problem, self.T, centres[:, level.argmin()])
        if found is not None and (self.witness is None or found.level < self.witness.level):
            self.witness = found
        known = math.inf if self.witness is None else self.witness.level
        self.outer = min(lowest, known) * (1 - _BESIDE_WITNESS)
        return True

    def stuck(self, lowest: Array, highest: Array) -> bool:
        bottom = float(lowest.min()) if len(lowest) else math.inf
        if not bottom < self.outer:
            return False
        self.outer = bottom * (1 - _SLACK)
        return True

    def reached(self, least: float) -> tuple[float, float]:
        return self.inner, min(self.outer, least * (1 - 2 * _SLACK))

    def stand(self, least: float) -> tuple[float, float, float]:
        level = max(self.inner, min(least, self.outer))
        return level, max(self.inner, self.outer), self.share(self.inner, level)


class Inwards(Sweep):
    down = True

    def key(self, lowest: Array, highest: Array) -> Array:
        return -highest

    def wanted(self, lowest: Array, highest: Array) -> Mask:
        return lowest <= self.outer * (1 + _SLACK)

    def reach(self, least: float) -> float:
        return least / _SHELL

    def last(self) -> float:
        return math.inf

    def violated(self, centres: Array, level: Array) -> bool:
        highest = float(np.where(level <= self.outer, level, -math.inf).max())
        if not highest >= self.inner:
            return False
        self.inner = highest * (1 + _BESIDE_WITNESS)
        return True

    def stuck(self, lowest: Array, highest: Array) -> bool:
        top = float(highest.max()) if len(highest) else -math.inf
        if not top >= self.inner:
            return False
        self.inner = top * (1 + 2 * _SLACK)
        return True

    def reached(self, least: float) -> tuple[float, float]:
        return max(self.inner, -least * (1 + 2 * _SLACK)), self.outer

    def stand(self, least: float) -> tuple[float, float, float]:
        level = max(self.inner, min(-least, self.outer))
        return level, self.inner, self.share(level, self.outer)


class RingGrowth(Growth):
    """The ring's rule at a sweep's levels."""

    def __init__(self, sweep: Sweep, rule: VdotBound, half: Array) -> None:
        super().__init__(rule, half)
        self.sweep, self.rule = sweep, rule

    @property
    def levels(self) -> tuple[float, float]:
        return self.sweep.inner, self.sweep.outer

    def at(self, inner: float, outer: float) -> RingGrowth:
        sweep = copy.copy(self.sweep)
        sweep.inner, sweep.outer = inner, outer
        return RingGrowth(sweep, self.rule, self.half)

    def gives_way(self, lo: Array, hi: Array, found: BoxBounds) -> Mask:
        levels = self.levels_of(0.5 * lo + 0.5 * hi, found)
        inside: Mask = (levels <= self.sweep.outer) & (levels >= self.sweep.inner)
        return inside

    def opened(self, halves: Halves, found: BoxBounds, key: Array) -> tuple[Mask, Array]:
        lowest, highest = self.rule.levels(halves.lo, halves.hi)
        return self.sweep.wanted(lowest, highest), self.sweep.key(lowest, highest)

    def levels_of(self, centres: Array, found: BoxBounds) -> Array:
        """V at violations, infinite elsewhere; where a step leads from within the outer level to a higher V, that, but
        no more than just above the outer level."""
        levels = np.where(found.violated, self.rule.levels_at(centres), math.inf)
        index = chosen(levels <= self.sweep.outer)
        if not (self.rule.inside and self.rule.step) or not len(index):
            return levels
        after = np.minimum(self.rule.levels_after(centres.take(index, -1), self.sweep.outer), self.sweep.outer)
        levels[index] = np.maximum(levels[index], after)
        return levels
