"""The rules for a set {N <= n2} that is never left: N falls where it is n2, whatever it does further inside."""

from __future__ import annotations

import numpy as np

from .boxes import Leaves, keeps_constraints, keeps_inputs, middle
from .near import Array
from .outer import Beyond, falls


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
        kept = [self.least_bound(g, [course.below.at]) < 0 for g in self.constraints(course.states, course.held)]
        held_back = np.array(kept, dtype=bool).reshape(len(kept), len(left))
        hold = (bound < 0) & course.finite
        return Leaves(self, first + left, "outer leaf ", course.inputs.range, bound, hold, held_back)


ON_LEAVES = (("inputs", keeps_inputs), ("keep", keeps_constraints), ("outer", falls))
