"""A certificate under examination: data that several rules need, each computed on first use."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property
from importlib import import_module
from itertools import product
from typing import Any, TypeVar

from flint import fmpq_mat

from .document import Certificate, Intervals, LocalBall, Partition
from .exact import exactly, inverse_diagonal
from .network import Folded, fold
from .schema import Array

T = TypeVar("T")
AT_CORNERS = 6  # uncertain quantities of which rule `local` decides every corner

Failures = Generator[tuple[str, str], None, int]  # a rule: each failure's (place, detail); the rule's count


@dataclass(frozen=True)
class Case:
    """The empty list stands for the inverse of a matrix that is not positive definite: no rule can use it."""

    c: Certificate
    jobs: int = 1  # processes that examine the leaves

    @property
    def partition(self) -> Partition:
        """The evidence, of a certificate that has a tree."""
        if not isinstance(self.c.evidence, Partition):
            raise TypeError("this rule is about a partition tree")
        return self.c.evidence

    @property
    def local(self) -> LocalBall:
        """The evidence of rule `local`, of a certificate that has it."""
        return given(self.partition.local)

    @property
    def cells(self) -> Iterator[Intervals]:
        """The boxes that the ranges of the uncertain quantities are cut into; one of no extent if there are none."""
        cut = [
            [(lo + (hi - lo) * Fraction(i, count), lo + (hi - lo) * Fraction(i + 1, count)) for i in range(count)]
            for (lo, hi), count in zip(self.c.ranges, self.partition.cells, strict=True)
        ]
        return product(*cut)

    @property
    def covered(self) -> bool:
        """True if there is a local ball, so that leaves inside {V < c1} need nothing."""
        return self.partition.local is not None

    @cached_property
    def P_inverse(self) -> list[Fraction]:
        """The diagonal of P^-1."""
        return inverse_diagonal(exactly(self.c.P))

    @cached_property
    def S(self) -> fmpq_mat:
        """T'PT."""
        return self.seen_from(self.partition.T)

    def seen_from(self, T: Array) -> fmpq_mat:
        """T'PT, for V in coordinates z, x = T z."""
        exact = exactly(T)
        return exact.transpose() * exactly(self.c.P) * exact

    @cached_property
    def S_inverse(self) -> list[Fraction]:
        """The diagonal of S^-1."""
        return inverse_diagonal(self.S)

    @cached_property
    def net(self) -> Folded:
        """The policy with its centring folded in."""
        return fold(self.c.policy, self.c.u_eq)

    @cached_property
    def bounded(self) -> bool:
        """True if each input lies in its bounds by form: by the range that squash, centring and clip leave it."""
        policy, bounds = self.c.policy, self.c.input_bounds
        known = policy.squash == "tanh" and policy.centre != "output"
        offset, scale = ([Fraction(v) for v in numbers.tolist()] for numbers in (policy.offset, policy.scale))
        ranges = [(o - abs(s), o + abs(s)) for o, s in zip(offset, scale, strict=True)]
        if policy.clip:
            limits = list(zip(*([Fraction(v) for v in end.tolist()] for end in policy.clip), strict=True))
            clipped = zip(ranges, limits, strict=True)
            ranges = [(min(max(a, lo), hi), min(max(b, lo), hi)) for (a, b), (lo, hi) in clipped] if known else limits
        elif not known:
            return False
        return all(lo <= a and b <= hi for (a, b), (lo, hi) in zip(ranges, bounds, strict=True))


def given(value: T | None) -> T:
    """The part that a rule is about, of a certificate that has it."""
    if value is None:
        raise TypeError("this rule is about what the certificate has not")
    return value


def only_where(has: Callable[[Certificate], object], module: str, name: str) -> Callable[[Any], Failures]:
    """The rule of this name in a module that only some certificates need; it looks at nothing of others."""

    def rule(subject: Any) -> Failures:
        if not has(subject.case.c):
            return 0
        found: Callable[[Any], Failures] = getattr(import_module(f".{module}", __package__), name)
        return (yield from found(subject))

    return rule
