"""The claim `invariant`: no trajectory gets out of {N <= n2}, for N falls along F wherever it is n2.

N is above n2 all over the boundary of the domain, as by rule `faces`. Further inside N may do what it likes, but F is
defined there, inputs keep their bounds, and expressions of `keep` are negative.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flint import arb_mat

from .batches import in_batches
from .document import Certificate
from .evidence import Covering
from .function import Models
from .keep import kept
from .leaves import Box, boxes
from .motion import Motion, Stage
from .outer import RULE, OverDomain, covered
from .refusal import Refused, require, under
from .taylor import Taylor, is_negative, kinks


def invariant(c: Certificate, covering: Covering, jobs: int) -> int:
    """Faces, T and the root, the whole tree, then its leaves; the number of these."""
    staying = Staying(c, covered(c, covering), covering)

    def check(some: list[Box]) -> None:
        enclosed = staying.enclose(some)
        for part in enclosed:
            staying.motion.keep_bounds(part)
        if c.keep is not None:
            for part in enclosed:
                kept(staying.motion, part, None, staying.slack(part))
        for part in enclosed:
            require(staying.holds(part), RULE, part.place, "N is not certain to fall where it is at its level")

    in_batches(c, c.n, (box for box in boxes(covering) if not staying.is_free(box)), check, jobs)
    return covering.tree.count(255)


class Along(Motion):
    """The loop on boxes; what has no model is refused under the rule for N."""

    rule = RULE


@dataclass(frozen=True)
class Part(Stage):
    """A leaf, and its states in its own symbols alone."""

    own: list[Taylor]


class Staying(OverDomain):
    """The leaves that may meet {N <= n2}."""

    def __init__(self, c: Certificate, models: Models, covering: Covering) -> None:
        super().__init__(c, models, covering)
        self.motion = Along(c, c.n, 1)

    def enclose(self, some: Sequence[Box]) -> list[Part]:
        """Each leaf with its states and the policy's enclosure."""
        each = [self.states(box) for box in some]
        rows = [[[v.c, *v.slopes(self.c.n)] for v in own] for own in each]
        beside = arb_mat([[entry for x in rows for entry in x[i]] for i in range(self.c.n)])
        u = self.motion.policy(beside, len(some))
        return [
            Part(f"outer leaf {box.number}", x, [row[b] for row in u], own)
            for b, (box, x, own) in enumerate(zip(some, rows, each, strict=True))
        ]

    def slack(self, part: Part) -> list[Taylor]:
        """n2 - N, which is not negative in the set; nothing where N may be undefined."""
        try:
            N = self.models.value([self.motion.affine(row) for row in part.x])
        except Refused:
            return []
        return [Taylor(self.models.level) + -N]

    def holds(self, part: Part) -> bool:
        """True if F and N have finite models, and N is certainly below n2, or N'F or N'F + k (n2 - N) certainly
        negative: where N is n2, k may have any sign."""
        F = self.motion.F(part)
        with under(RULE, part.place):
            if self.models.is_below(part.own):
                return True
            N, rate = self.models.moving([self.motion.affine(row) for row in part.x], F)
        slack = Taylor(self.models.level) + -N
        if not (N.is_finite() and rate.is_finite()):
            return False
        return is_negative(rate, []) or any((rate + slack.scaled(k)).is_negative() for k in kinks(rate, slack))
