"""Starts from which the target is never reached: states of the box that rest, or end at a saddle.

Where two starts take a different number of swings, runs between them take ever longer, and one of them never arrives:
it ends at an equilibrium that all its neighbours leave. No splitting of the box removes such a state, and no simulation
meets it. Floats look for it; nothing is said of it before Arb has shown it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint
import numpy as np
from numpy.typing import NDArray

from certify.analysis.reaching.runs import LONG, Simulation
from certify.analysis.reaching.saddle import Saddle, saddle_at
from certify.certificates.ellipsoids import Box
from certify.effort import Effort
from certify.loop.closed_loop import ClosedLoop
from certify.loop.equilibrium import rest_in
from certify.loop.expressions import Expression
from certify.loop.rigorous import Balls, ball, evaluate_arb, precision, step_on

Array = NDArray[np.float64]
_BITS, _MORE = 200, 4  # of the numbers along a line of starts, and for each step, with which errors grow
_NEWTON, _APART, _ZERO = 40, 1e-6, 1e-9  # steps; of the domain: states for slopes, and what is nothing
_SMALL = Fraction(1, 2**40)  # radius of the balls around a state that rests, of the domain
_RESTS = 6  # such states that are tried
_LINE, _FINER = 257, 33  # starts on a line, and on a part of it
_SHORT, _LONG = 2.0**-40, 2.0**-18  # lengths of lines, of the domain: floats know the shortest no better
_TOGETHER = 0.1  # of the domain: runs that are farther apart have parted


@dataclass(frozen=True, slots=True)
class Stay:
    """A start that never arrives, within `error` of `x` in each state, in deviations. From `steps` on it stays within
    `radius` of `at`; with `steps` 0 it rests."""

    x: tuple[Fraction, ...]
    error: float
    at: tuple[Fraction, ...]
    radius: float
    steps: int


@dataclass(frozen=True, slots=True)
class Search:
    """The search for a start in the box `begin` from which the `target`, where all expressions are at most 0, is never
    reached. `simulation` is of the same loop; `effort` is for its runs."""

    loop: ClosedLoop
    target: Sequence[Expression]
    begin: Box
    simulation: Simulation
    effort: Effort

    def found(self, near: Array) -> Stay | None:
        """Such a start, looked for around states (N, n) and on lines through the first; None if none is shown."""
        with np.errstate(all="ignore"), precision(_BITS):
            return self._resting(near) or next(filter(None, map(self._ending, self._lines(near[0]))), None)

    @property
    def _wide(self) -> list[int]:
        """The numbers of the states that the box does not fix."""
        return [i for i, (lo, hi) in enumerate(self.begin) if lo < hi]

    @property
    def _widths(self) -> Array:
        """Widths of the domain, (n,)."""
        return np.asarray(self.simulation.flow.hi - self.simulation.flow.lo)

    def _missed(self, x: Balls) -> bool:
        """True if no state of these balls is in the target."""
        values = dict(zip(self.loop.system.states, x, strict=True))
        return any(bool(evaluate_arb(t, values) > 0) for t in self.target)

    def _resting(self, near: Array) -> Stay | None:
        """A state of the box that rests."""
        lo, hi = (np.array([float(pair[k]) for pair in self.begin]) for k in (0, 1))
        states = self._still(near, self._wide)
        states = states[np.all((states >= lo) & (states <= hi), 1)]
        first = np.unique(np.round(states / self._widths, 6), axis=0, return_index=True)[1]
        radii = [Fraction(width) * _SMALL for width in self._widths.tolist()]
        for x in states[np.sort(first)][:_RESTS]:
            rest = rest_in(self.loop, self._within(x), self._wide, radii)
            if rest is not None and self._holds(rest) and self._missed(rest):
                at, error = _middle(rest)
                return Stay(at, error, at, error, 0)
        return None

    def _still(self, x: Array, free: list[int]) -> Array:
        """States near x (N, n), as many as are found, that a step does not change, by Newton's method in the states
        `free`, in floats."""
        apart = _APART * np.diag(self._widths)[free]
        change = still = np.full((len(x), len(free)), np.inf)
        for _ in range(_NEWTON if free else 0):
            moved = np.concatenate([x, *(x + each for each in apart)])
            self.effort.charge(self.simulation.operations(len(moved)))
            if self.effort.over or not len(x):
                return x[:0]
            away = (self.simulation.later(moved) - moved).reshape(1 + len(free), len(x), -1)
            slopes = np.moveaxis((away[1:] - away[0]) / apart[:, free].max(1)[:, None, None], 0, -1)
            known = np.isfinite(slopes).all((1, 2))
            x, slopes, still = x[known].copy(), slopes[known], away[0][known]
            change = -(np.linalg.pinv(slopes) @ still[:, :, None])[:, :, 0]
            x[:, free] += change
        near = np.all(np.abs(change) < _ZERO * self._widths[free], 1)
        return x[near & np.all(np.abs(still) < _ZERO * self._widths, 1)] if free else x[:0]

    def _lines(self, x: Array) -> Iterator[tuple[Array, Array]]:
        """Lines of starts through the state x, one end on either side of those that arrive last, (n,) each, shorter and
        shorter: the longest that serves is the farthest from what floats do not know."""
        for i in self._wide:
            lo, hi = map(float, self.begin[i])
            shares = np.linspace(lo, hi, _LINE)
            while len(shares) > 2 and shares[-1] - shares[0] > _SHORT * self._widths[i]:
                starts = np.repeat(x[None], len(shares), 0)
                starts[:, i] = shares
                steps = self._arrivals(starts)
                if steps is None:
                    return
                first = last = int(steps.argmax())
                while last + 1 < len(steps) and steps[last + 1] == steps[first]:
                    last += 1
                first, last = max(first - 1, 0), min(last + 1, len(steps) - 1)
                if shares[last] - shares[first] < _LONG * self._widths[i]:
                    yield starts[first], starts[last]
                shares = np.unique(np.linspace(shares[first], shares[last], _FINER))

    def _arrivals(self, x: Array) -> Array | None:
        """The number of steps after which runs from states x (N, n) are in the target; None if the effort is over."""
        steps, alive = np.full(len(x), LONG), np.arange(len(x))
        for k in range(LONG):
            there = self.simulation.beyond(x, self.simulation.flow.policy(x), ()).max(-1) <= 0
            steps[alive[there]] = k
            x, alive = x[~there], alive[~there]
            self.effort.charge(self.simulation.operations(len(x)))
            if self.effort.over or not len(x):
                break
            x = self.simulation.later(x)
        return None if self.effort.over else steps

    def _ending(self, line: tuple[Array, Array]) -> Stay | None:
        """A start on the line that stays beside a saddle from some step on."""
        runs = [np.array(line)]
        while len(runs) < LONG and np.all(np.abs(runs[-1][0] - runs[-1][1]) < _TOGETHER * self._widths):
            self.effort.charge(self.simulation.operations(2))
            if self.effort.over:
                return None
            runs.append(self.simulation.later(runs[-1]))
        course = np.array(runs)
        slow = (np.abs(np.diff(course, axis=0)) / self._widths).max((1, 2))
        states = self._still(course[int(slow.argmin())], list(range(course.shape[2]))) if len(slow) else course[0, :0]
        for x in states[:1]:
            saddle = saddle_at(self.loop, x, self._widths)
            k = None if saddle is None else saddle.crossed_after(course)
            if saddle is None or k is None or not self._missed(saddle.X):
                continue
            if self._crosses(line, saddle, k):
                ends = list(map(self._within, line))
                at, radius = _middle(saddle.X)
                return Stay(ends[0], _up(max(abs(a - b) for a, b in zip(*ends, strict=True))), at, radius, k)
        return None

    def _crosses(self, line: tuple[Array, Array], saddle: Saddle, k: int) -> bool:
        """True if no state of the line is in the target in the first k steps, after which it crosses N.

        The states are m + D t, -1 <= t <= 1, for some D of its balls that may depend on t, by the mean value theorem.
        """
        with precision(_BITS + _MORE * k):
            a, b = (list(map(ball, self._within(end))) for end in line)
            m, D = [(v + w) / 2 for v, w in zip(a, b, strict=True)], [(w - v) / 2 for v, w in zip(a, b, strict=True)]
            for step in range(k + 1):
                X = [v + w * flint.arb(0, 1) for v, w in zip(m, D, strict=True)]
                if not self._missed(X):
                    return False
                if step < k:
                    after, J = step_on(self.loop, X)
                    m = step_on(self.loop, m)[0]
                    D = [row[0] for row in (J * flint.arb_mat([[v] for v in D])).tolist()]
                    if not all(v.is_finite() for v in (*after, *m, *D)):
                        return False
            return saddle.is_crossed(m, D)

    def _within(self, x: Array) -> tuple[Fraction, ...]:
        """A state of the box, which floats may lie beside."""
        each = zip(x.tolist(), self.begin, strict=True)
        return tuple(min(max(Fraction(v), lo), hi) for v, (lo, hi) in each)

    def _holds(self, x: Balls) -> bool:
        """True if these balls lie in the box, in the states that it does not fix."""
        ends = ((x[i], *map(ball, self.begin[i])) for i in self._wide)
        return all(bool(v >= lo) and bool(v <= hi) for v, lo, hi in ends)


def _middle(x: Balls) -> tuple[tuple[Fraction, ...], float]:
    """Binary64 numbers near the middles of balls, and a bound of how far a state in them is from these."""
    middle = [float(v.mid()) for v in x]
    away = [v - m for v, m in zip(x, middle, strict=True)]
    return tuple(map(Fraction, middle)), max(float(v.abs_upper()) for v in away) * (1 + 1e-9)


def _up(q: Fraction) -> float:
    return float(q) * (1 + 1e-9)
