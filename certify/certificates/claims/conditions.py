"""The conditions of a claim, in one form: *where these guards are not negative, this margin is negative*.

The bounds engine proves the ring and the inputs box by box, a solver searches for a point at which a condition fails,
and the checker has a rule for each. Two conditions have no margin and are shown along the way: P is positive definite
(in rationals), and F is locally Lipschitz on {V <= c2} (an enclosure of F without a pole).
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Literal

from certify.certificates.claims.claim import Claim, Problem
from certify.loop.expressions import Expression, Operation, nodes, symbols_of
from certify.loop.policies import bounded_by_form


@dataclass(frozen=True, slots=True)
class Guard:
    """`level - V >= 0` (side `inside`), or `V - level >= 0` (side `outside`)."""

    side: Literal["inside", "outside"]
    level: float

    def holds(self, V: Fraction) -> bool:
        """Decided in rationals."""
        return Fraction(self.level) >= V if self.side == "inside" else Fraction(self.level) <= V


@dataclass(frozen=True, slots=True)
class Vdot:
    """The margin `2 x'P F(x)`."""


@dataclass(frozen=True, slots=True)
class OfState:
    """The margin `x_index - bound` (side `above`), or `bound - x_index` (side `below`)."""

    index: int
    side: Literal["below", "above"]
    bound: Fraction


@dataclass(frozen=True, slots=True)
class OfInput:
    """The margin `pi_index(x) - bound` (side `above`), or `bound - pi_index(x)` (side `below`)."""

    index: int
    side: Literal["below", "above"]
    bound: Fraction


@dataclass(frozen=True, slots=True)
class BeforeClip:
    """The margin `v_index - bound` (side `above`), or `bound - v_index` (side `below`), v = pi before its clip."""

    index: int
    side: Literal["below", "above"]
    bound: Fraction


@dataclass(frozen=True, slots=True)
class Radicand:
    """The margin `-v`, v the index-th of the equations' `radicands`: the radicand is positive."""

    index: int


@dataclass(frozen=True, slots=True)
class Condition:
    """For all x in the domain box where every guard holds, `margin < 0` (`strict`) or `margin <= 0`.

    With `punctured` the origin is excluded: there Vdot is 0, and a proof needs the rate at which it leaves 0.
    """

    name: str
    guards: tuple[Guard, ...]
    margin: Vdot | OfState | OfInput | BeforeClip | Radicand
    strict: bool = True
    punctured: bool = False


def conditions(claim: Claim, problem: Problem) -> tuple[Condition, ...]:
    """All conditions of `claim`: domain, clip, local, ring, roots, inputs.

    The domain's conditions are about the box itself: {V <= c2} is connected and holds the origin, so it leaves the
    interior of the box only through a side.
    """
    found = domain_conditions(problem, claim.roa)
    if claim.at_rest:
        found += (*clip_conditions(problem, claim.local), local_condition(claim.local))
    if claim.inner < claim.roa or not claim.at_rest:
        found += (ring_condition(claim.inner, claim.roa),)
    return found + root_conditions(problem, claim.roa) + input_conditions(problem, claim.roa)


def domain_conditions(problem: Problem, level: float) -> tuple[Condition, ...]:
    """{V <= level} lies in the interior of the domain: one condition per side."""
    system = problem.loop.system
    return tuple(
        Condition(f"domain-{symbol.name}-{side}", (Guard("inside", level),), OfState(i, side, bound))
        for i, (symbol, (lo, hi)) in enumerate(zip(system.states, system.domain, strict=True))
        for side, bound in _sides(lo, hi)
    )


def local_condition(level: float) -> Condition:
    """Vdot < 0 for 0 < V <= level."""
    return Condition("local", (Guard("inside", level),), Vdot(), punctured=True)


def clip_conditions(problem: Problem, level: float) -> tuple[Condition, ...]:
    """The policy's clip is inactive on {V <= level}, as the local condition needs; none without a clip."""
    clip = problem.loop.network.clip
    if clip is None:
        return ()
    ends = zip(problem.loop.system.inputs, *clip, strict=True)
    return tuple(
        Condition(f"clip-{symbol.name}-{side}", (Guard("inside", level),), BeforeClip(j, side, bound))
        for j, (symbol, lo, hi) in enumerate(ends)
        for side, bound in _sides(Fraction(float(lo)), Fraction(float(hi)))
    )


def ring_condition(inner: float, outer: float) -> Condition:
    """Vdot < 0 for inner <= V <= outer."""
    return Condition("ring", (Guard("outside", inner), Guard("inside", outer)), Vdot())


def root_conditions(problem: Problem, level: float) -> tuple[Condition, ...]:
    """The radicands in the equations are positive on {V <= level}: one condition per square root.

    The bounds of F on boxes show it along the way. A solver needs it, since it may search only where roots are defined.
    """
    count = len(radicands(problem))
    return tuple(Condition(f"root-{k}", (Guard("inside", level),), Radicand(k)) for k in range(count))


def radicands(problem: Problem) -> tuple[Expression, ...]:
    """The expressions under square roots in the equations, inner roots before outer ones."""
    found: dict[Expression, None] = {}
    for expression in problem.loop.system.uncertain_dynamics():
        for node in nodes(expression):
            if isinstance(node, Operation) and node.operator == "sqrt" and symbols_of(node):
                found[node.operands[0]] = None
    return tuple(found)


def input_conditions(problem: Problem, level: float) -> tuple[Condition, ...]:
    """The inputs lie in their bounds on {V <= level}; none if the squash alone keeps them there."""
    system = problem.loop.system
    if bounded_by_form(problem.loop.network, system.input_bounds):
        return ()
    return tuple(
        Condition(f"inputs-{symbol.name}-{side}", (Guard("inside", level),), OfInput(j, side, bound), strict=False)
        for j, (symbol, (lo, hi)) in enumerate(zip(system.inputs, system.input_bounds, strict=True))
        for side, bound in _sides(lo, hi)
    )


def _sides(lo: Fraction, hi: Fraction) -> tuple[tuple[Literal["below", "above"], Fraction], ...]:
    return (("below", lo), ("above", hi))
