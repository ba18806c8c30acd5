"""The states' values, in which people write a plant, and deviations from its operating point x_eq."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from certify.loop.expressions import Expression, Number, Operation, Symbol, as_expression, substitute
from certify.loop.plants.system import Interval, System, Time
from certify.loop.plants.validation import require_origin_inside


def in_deviations(
    equations: Sequence[Expression | Fraction],
    states: Sequence[Symbol],
    x_eq: Sequence[Expression | Fraction],
    time: Time = "continuous",
) -> tuple[Expression, ...]:
    """Equations in the states' values as equations in deviations from x_eq: each state s becomes `x_eq_s + s`.

    A rate is the same there; the state one step later is a deviation as well. Where x_eq is 0 nothing changes.

    >>> h, h0 = Symbol("h"), Symbol("h0")
    >>> in_deviations([1 - h0 / h], [h], [h0])
    (1 - h0/(h0 + h),)
    """
    none = Number(0)
    shifts = [None if at is none else at for at in map(as_expression, x_eq)]
    values = {s: Operation("+", at, s) for s, at in zip(states, shifts, strict=True) if at is not None}
    moved = [substitute(as_expression(e), values) for e in equations]
    if time == "continuous":
        return tuple(moved)
    return tuple(e if at is None else Operation("+", e, -at) for e, at in zip(moved, shifts, strict=True))


def with_origin(system: System, origin: Sequence[Fraction], u: Sequence[Fraction]) -> System:
    """The same plant in deviations from another point, `origin` (n,) in today's deviations, with u_eq = u, (m,),
    the inputs there: the operating point and the box keep their places.

    Raises
    ------
    InputError : the point does not lie in the interior of the domain.
    """
    by = map(Number, origin)
    x_eq = tuple(q if e == Number(0) else e + q if q.value else e for e, q in zip(system.x_eq, by, strict=True))
    held = tuple(constraints_of_values(system).values())
    moved = replace(
        system,
        dynamics=in_deviations(dynamics_of_values(system), system.states, x_eq, system.time),
        u_eq=tuple(map(Number, u)),
        x_eq=x_eq,
        constraints=dict(zip(system.constraints, in_deviations(held, system.states, x_eq), strict=True)),
        domain=tuple((lo - q, hi - q) for (lo, hi), q in zip(system.domain, origin, strict=True)),
    )
    require_origin_inside(moved)
    return moved


def dynamics_of_values(system: System) -> tuple[Expression, ...]:
    """f over the states' values x_eq + x, as people write it, with the parameters by name."""
    found = system.dynamics
    if system.time == "discrete":
        found = tuple(_without(e, at) for e, at in zip(found, system.x_eq, strict=True))
    return _of_values(system, found)


def constraints_of_values(system: System) -> dict[str, Expression]:
    """The constraints' g by name over the states' values x_eq + x, with the parameters by name."""
    return dict(zip(system.constraints, _of_values(system, tuple(system.constraints.values())), strict=True))


def _of_values(system: System, found: Sequence[Expression]) -> tuple[Expression, ...]:
    """Expressions in deviations from x_eq as expressions of the states' values."""
    shifts = [(s, at) for s, at in zip(system.states, system.x_eq, strict=True) if at != Number(0)]
    whole = {Operation("+", at, s): Symbol(f" {s.name}") for s, at in shifts}
    rest = {s: Operation("+", s, -at) for s, at in shifts}
    plain = {Symbol(f" {s.name}"): s for s, _ in shifts}
    return tuple(substitute(substitute(substitute(e, whole), rest), plain) for e in found)


def domain_of_values(system: System) -> tuple[Interval, ...]:
    """The domain's intervals of the states' values x_eq + x."""
    return tuple((lo + q, hi + q) for (lo, hi), q in zip(system.domain, system.exact_x_eq(), strict=True))


def _without(equation: Expression, at: Expression) -> Expression:
    """The equation of a state's value one step later, from that of its deviation from `at`."""
    if at == Number(0):
        return equation
    if isinstance(equation, Operation) and equation.operator == "+" and equation.operands[1:] == (-at,):
        return equation.operands[0]
    return Operation("+", equation, at)
