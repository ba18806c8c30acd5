"""Decide in Arb which states lie in {N <= n2} within the domain, for a network or an expression N.

At a rational state N is an Arb ball that shrinks with the precision. The state is decided as soon as the ball does not
contain the level. Where N equals the level that never happens, unless N is a rational function: then its value is a
rational number. An undecided state counts neither as inside nor as outside.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction

import flint

from certify.errors import InputError
from certify.loop.expressions import evaluate_exactly
from certify.loop.plants.system import Interval
from certify.loop.rigorous import ball, precision
from certify.lyapunov.neural import Neural
from certify.lyapunov.rigorous import evaluate_function, function_on
from certify.lyapunov.symbolic import Symbolic

_BITS = (80, 160, 320, 640, 1280, 2560, 5120)  # of the balls at a state, one after the other
_BOX_BITS = 80  # on boxes, which are much wider than their rounding


@dataclass(frozen=True, slots=True)
class Seen:
    """A look at a box: `covered` if all of it was shown to lie in the set, and the `axis` along which N varies most.

    `axis` is None if the box is a single state.
    """

    covered: bool
    axis: int | None


@dataclass(frozen=True, slots=True)
class Sublevel:
    """The states of the domain box at which N is at most `level`, in deviations from the operating point.

    Parameters
    ----------
    function : N.
    level : n2, exactly its binary64 value.
    domain : the closed box, an interval for each state.

    Raises
    ------
    InputError : the domain has another number of states than N.
    """

    function: Neural | Symbolic
    level: float
    domain: tuple[Interval, ...]

    def __post_init__(self) -> None:
        if len(self.domain) != self.function.n:
            raise InputError(f"the domain must have {self.function.n} states, as N has; found {len(self.domain)}.")

    @property
    def name(self) -> str:
        """The set's name."""
        return "{N <= n2} within the domain"

    def holds(self, points: Iterable[Sequence[Fraction | float]]) -> list[bool]:
        """True for each state that is shown to lie in the set; a float means its binary value."""
        return [self._side(point) is True for point in points]

    def excludes(self, points: Iterable[Sequence[Fraction | float]]) -> list[bool]:
        """True for each state that is shown to lie outside."""
        return [self._side(point) is False for point in points]

    def look(self, box: Sequence[Interval]) -> Seen:
        """Try to show that a whole box lies in the domain and that N is at most the level on it.

        N is bounded by its value on balls around the box, and, where it is differentiable on all of them, by the mean
        value theorem from the middle of the box.
        """
        width = [hi - lo for lo, hi in box]
        wide = [i for i, w in enumerate(width) if w]
        if not wide:
            return Seen(self._side([lo for lo, _ in box]) is True, None)
        widest = max(wide, key=lambda i: width[i] / (self.domain[i][1] - self.domain[i][0]))
        inside = all(a <= lo and hi <= b for (lo, hi), (a, b) in zip(box, self.domain, strict=True))
        with precision(_BOX_BITS):
            around = [ball(lo).union(ball(hi)) for lo, hi in box]
            middle = [ball((lo + hi) / 2) for lo, hi in box]
            whole, slopes = function_on(self.function, around)
            if not (whole.is_finite() and all(slope.is_finite() for slope in slopes)):
                return Seen(False, widest)
            moves = [g * (x - m) for g, x, m in zip(slopes, around, middle, strict=True)]
            mean, level = sum(moves, evaluate_function(self.function, middle)), flint.arb(self.level)
            covered = inside and bool(whole <= level or mean <= level)
            sizes = [float(move.abs_upper()) for move in moves]
        return Seen(covered, max(wide, key=lambda i: sizes[i]))

    def _side(self, point: Sequence[Fraction | float]) -> bool | None:
        """True if a state lies in the set, False if not, None if undecided."""
        x = [Fraction(v) for v in point]
        if not all(lo <= v <= hi for v, (lo, hi) in zip(x, self.domain, strict=True)):
            return False
        found = (self._compared(x, bits) for bits in _BITS)
        first = next(found)
        exactly = self._exactly(x) if first is None else first
        return next((side for side in found if side is not None), None) if exactly is None else exactly

    def _compared(self, x: Sequence[Fraction], bits: int) -> bool | None:
        with precision(bits):
            value, level = evaluate_function(self.function, [ball(v) for v in x]), flint.arb(self.level)
            return True if value <= level else False if value > level else None

    def _exactly(self, x: Sequence[Fraction]) -> bool | None:
        """The same in rationals; None where they have no name for N."""
        if isinstance(self.function, Neural):
            return None
        try:
            value = evaluate_exactly(self.function.expression, dict(zip(self.function.states, x, strict=True)))
        except InputError:
            return None
        return value <= Fraction(self.level)
