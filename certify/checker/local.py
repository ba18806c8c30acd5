"""The local rule: D + 2 lambda V < 0 on a ball around the origin that holds {V <= c1}, with no hole; under a practical
claim as far as c0 <= V, below which a step must not lead out of {V <= c0}."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from fractions import Fraction
from functools import cached_property

import numpy as np
from flint import fmpq_mat

from .ball import Ball
from .case import Case, Failures
from .decrease import Inequality, Level, Models, Multipliers, are_finite, are_usable
from .document import Intervals
from .exact import contains_ball, exactly, fraction, is_definite, rational
from .jets import Jet


@dataclass(frozen=True)
class Local(Ball):
    """The ball of the section `local`."""

    margins: list[float] = field(default_factory=list, kw_only=True)  # 1 - the largest share of the decay that the rest
    # takes at a corner, in floats for people

    @staticmethod
    def of(case: Case) -> Local:
        """The ball of a certificate."""
        kind = Local
        if case.c.step:
            from .stepping import kind_of

            kind = kind_of(case)
        return kind(case, case.local.J, "local ball", directions=case.local.directions)

    @property
    def at_rest(self) -> bool:
        """True if F vanishes at the origin, and so everything that is built from it."""
        return not self.case.c.practical

    def courses(self) -> Iterator[tuple[list[Jet], list[Jet]]]:
        """States and uncertain quantities as they may be at any time."""
        for cell in self.case.cells:
            yield self.states, self.symbols(cell)

    def G(self, cell: Intervals) -> list[Jet] | None:
        """F, or the increment of x in a step over its length; None if nothing is known of it."""
        return self.change(cell)

    def models(self, cell: Intervals) -> Models | None:
        """The models of G; None if there are no finite ones."""
        G = self.G(cell)
        return Models(self.J, G, self.at_rest) if G is not None and are_finite(G) else None

    @cached_property
    def terms(self) -> tuple[fmpq_mat, fmpq_mat, Multipliers, Level | None]:
        """P, R, the multipliers and the level of the inequality."""
        P, part, c = exactly(self.case.c.P), self.case.local, self.case.c
        level = None if self.at_rest else Level(rational(c.c0), rational(part.edge))
        return P, 2 * rational(c.rate) * P, Multipliers.of(part), level

    def inequality(self, models: Models) -> Inequality:
        return Inequality(models, *self.terms)

    def sides(self) -> Iterator[tuple[fmpq_mat, fmpq_mat] | None]:
        """For each corner of each cell the decay, and what has to stay below it; None, at the end, where G has no
        finite model."""
        for cell in self.case.cells:
            models = self.models(cell)
            if models is None:
                yield None
                return
            self.note_kinks(models)
            for corner in models.corners(self.case.c.P):
                decay, rest = self.inequality(corner).sides()
                yield (decay if self.cone is None else self.cone.within(decay, rest)), rest


def _margin(decay: fmpq_mat, rest: fmpq_mat) -> float:
    try:
        left, right = (np.array([[float(fraction(v)) for v in row] for row in M.tolist()]) for M in (decay, rest))
        return float(1 - np.max(np.linalg.eigvals(np.linalg.solve(left, right)).real))
    except (np.linalg.LinAlgError, OverflowError):
        return float("nan")


def is_large_enough(ball: Ball, place: str, name: str, level: float) -> Failures:
    """The trees of directions are trees; the ball contains {V <= level}."""
    if ball.directions:
        from .kinks import are_whole

        yield from are_whole(ball.directions, len(ball.J), f"evidence.{ball.at.split()[0]}.directions")
    if not contains_ball(exactly(ball.J), exactly(ball.case.c.P), Fraction(level)):
        yield place, f"the ball must contain {{V <= {name}}}"
    return 0


def fits(local: Local) -> Failures:
    """`local`: the ball contains {V <= c1}, and multipliers may be used."""
    c = local.case.c
    yield from is_large_enough(local, "levels.local", "c1", c.c1)
    if not are_usable(Multipliers.of(local.case.local)):
        yield "evidence.local", "no multiplier may be negative, none of g 0 where some beta is"
    if c.step > 0 and Fraction(local.case.local.edge) * c.step > 1:
        yield "evidence.local.edge", "a step may lead out of {V <= c0}: the edge must be at most 1/h"
    return 0


def decreases(local: Local) -> Failures:
    """`local`: D + 2 lambda V < 0 on the ball without its centre, or as far as V >= c0."""
    count = 0
    for both in (both for part in local.on_cones() for both in part.sides()):
        if both is None:
            yield "levels.local", "F has no finite model on the local ball"
            return count
        count, (decay, rest) = count + 1, both
        local.margins.append(_margin(decay, rest))
        if not is_definite(decay - rest):
            share = 1 - local.margins[-1]
            yield "levels.local", f"the decrease is not shown on the local ball: {share:.3g} of the decay"
    return count
