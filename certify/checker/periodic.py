"""The rule for angles: the loop is the same after a full turn, but for the turn itself.

Every number has a winding for each angle: by how many turns it grows where the angle grows by one. Sums and products
with integers keep that; sin and cos do not see it; all else is asked only of numbers that do not wind.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from operator import add

from .case import Case, Failures, given
from .expression import Tape, evaluate
from .networks import Affine, OnNumbers
from .wiring import Clip, NumberSteps, Observe

MOST_TURNS = 2**32  # so that no product of many integers takes hours


class Winds(Exception):
    """A number that winds where none may, or too often."""


@dataclass(frozen=True)
class Winding:
    """The turns of a number, one integer for each angle, and its value if it is a rational that stands there."""

    turns: tuple[int, ...]
    value: Fraction | None = None

    def __post_init__(self) -> None:
        if any(abs(k) > MOST_TURNS for k in self.turns):
            raise Winds

    def __add__(self, other: Winding) -> Winding:
        return Winding(tuple(a + b for a, b in zip(self.turns, other.turns, strict=True)))

    def __neg__(self) -> Winding:
        return Winding(tuple(-a for a in self.turns))

    def __mul__(self, other: Winding) -> Winding:
        for factor, v in ((self, other), (other, self)):
            if factor.value is not None and factor.value.denominator == 1:
                return v.times(factor.value)
        return self.still() + other.still()

    def times(self, k: Fraction) -> Winding:
        """The product with a number, an integer unless nothing winds."""
        if k.denominator != 1:
            return self.still()
        return Winding(tuple(k.numerator * a for a in self.turns))

    def still(self) -> Winding:
        """A number that is a function of this one, which must not wind."""
        if any(self.turns):
            raise Winds
        return Winding(self.turns)

    def function(self, name: str) -> Winding:
        """phi(v) for a function phi of the table."""
        return Winding((0,) * len(self.turns)) if name in ("sin", "cos") else self.still()


class Windings(OnNumbers, NumberSteps):
    """Networks of such numbers."""

    def affine(self, step: Affine, v: list[Winding]) -> list[Winding]:
        nothing = Winding((0,) * len(v[0].turns))
        turning = [(i, x) for i, x in enumerate(v) if any(x.turns)]
        rows = step.weight.tolist()
        return [reduce(add, (x.times(Fraction(row[i])) for i, x in turning), nothing) for row in rows]

    def clip(self, step: Clip, v: list[Winding]) -> list[Winding]:
        return [x.still() for x in v]

    def observe(self, step: Observe, v: list[Winding]) -> list[Winding]:
        return windings(step.tape, v)


def windings(tape: Tape, variables: Sequence[Winding]) -> list[Winding]:
    """The windings of expressions."""
    still = (0,) * len(variables[0].turns)
    return evaluate(tape, lambda q: Winding(still, q), variables, Windings().entries)


def is_periodic(case: Case) -> Failures:
    """`angles`: policy, constraints, target and equations do not see a full turn; in discrete time a step adds it."""
    c, angles = case.c, given(case.c.ranks).angles
    n = len(c.states)
    states = [Winding(tuple(int(i == j) for j in angles)) for i in range(n)]
    still = Winding((0,) * len(angles))
    others = [still] * (len(c.inputs) + len(c.uncertain))

    def value(tape: Tape, read: list[Winding]) -> list[tuple[int, ...] | None]:
        try:
            return [v.turns for v in windings(tape, read)]
        except Winds:
            return [None]

    try:
        u = [v.still() for v in Windings().run(c.policy.network, states)]
    except Winds:
        yield "policy", "the policy must be periodic in each angle"
        return 0
    for name, tape, read in (("keep", c.keep, [*states, *others]), ("target", c.target, states)):
        if tape is not None and any(turns != still.turns for turns in value(tape, read)):
            yield f"claim.{name}", "must be periodic in each angle"
    found = value(c.dynamics, [*states, *others])
    wanted = [v.turns if c.discrete else still.turns for v in states]
    for name, turns, asked in zip(c.states, found if len(found) == n else [None] * n, wanted, strict=True):
        if turns != asked:
            yield f"plant.dynamics, {name}", "must be periodic in each angle, but for the turn itself in discrete time"
    return len(angles) + len(u)
