"""The rules for a set {N <= n2} that is never left: N falls where it is n2, whatever it does further inside."""

from __future__ import annotations

import numpy as np

from .boxes import Leaves, middle
from .near import Array
from .outer import Beyond


class Staying(Beyond):
    """The bounds that rule `outer` asks for of a claim without V."""

    def examine(self, first: int, lo: Array, hi: Array) -> Leaves:
        """The leaves with these corners, numbered from `first`, that may meet the set: N falls there where it is n2,
        and constraints are negative where it is n2 or less.

        On a leaf on which N is certainly below n2 its bound counts as -inf. Elsewhere any multiple of n2 - N, which is
        0 where N falls, may be added.
        """
        x = self.states(*middle(lo, hi))
        left = self.close(x, np.zeros(lo.shape[1], dtype=bool))
        course = self.course(x[:, left])
        bound = self.least_bound(course.rise, [course.below.at], -np.inf)
        bound[self.function.is_below(course.x, self.level)] = -np.inf
        hold, kept = (bound < 0) & course.finite, self.kept([course.states], course.held, [course.below.at])
        return Leaves(self, first + left, "outer leaf ", course.inputs, bound, hold, kept)
