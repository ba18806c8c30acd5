"""The least residual with which measurements are consistent: the sizes that they refute, by bisection.

Where a size is refuted so is every smaller one, whose residuals are among those of the larger. A size at which no
contradiction was found is not shown to be consistent.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from fractions import Fraction
from math import sqrt

from certify.errors import InputError
from certify.loop.expressions import Operation, Symbol
from certify.loop.plants import Measurements, System
from certify.loop.plants.unknown import residual_name, residual_names
from certify.provers.data.identify import Contradiction, Identified, Search, misses, refuted_in
from certify.provers.data.models import Flows

_STEP, _MOST, _LEAST, _BISECTIONS = 4.0, 4.0**3, 4.0**-10, 4  # of the factors that are tried
Sizes = Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Least:
    """Sizes of residuals of some states' equations, by the states' names.

    Parameters
    ----------
    refuted : residuals of at most these sizes contradict the measurements; zeros if no size that was tried does.
    open : the least sizes that were tried without a contradiction; None if all of them have one.
    """

    refuted: Sizes
    open: Sizes | None


def residual_states(system: System) -> list[str]:
    """The states whose equations have a residual."""
    return [s.name for s in system.states if residual_names(s.name, system.ranges)]


def least_factors(system: System, measurements: Measurements, found: Identified) -> tuple[Least, ...]:
    """Factors of the bounds of residuals, with which the measurements leave the ranges `found`: one of all,
    then of each beside the others as they stand."""
    names, series = residual_states(system), (found.bounds.order, found.bounds.pieces)

    def least(group: list[str]) -> Least:
        return _least(
            dict.fromkeys(group, 1.0),
            lambda factor: refuted_in(
                measurements, Flows(_scaled(system, group, factor), measurements, *series), dict(found.ranges)
            ),
            1.0,
        )

    return tuple(least(group) for group in [names, *([name] for name in names if len(names) > 1)] if group)


def least_of_refuted(system: System, measurements: Measurements) -> tuple[Least, ...]:
    """Residuals that a plant must have at least which is refuted as it stands: one factor of the bounds in the table
    `residual`, or without one constant bounds, of each equation alone, or of all together where no one is enough.

    Equations that explain every transition at the middle of the priors are left out.
    """
    names = residual_states(system)
    if names:
        return (_least(dict.fromkeys(names, 1.0), _refuting(system, measurements, names), _MOST),)
    time = 1.0 if measurements.period is None else float(measurements.period[0])
    each = zip(system.states, misses(system, measurements).tolist(), strict=True)
    sizes = {state.name: 2 * miss / time for state, miss in each if miss > 0}

    def least(group: Sizes) -> Least:
        return _least(group, _refuting(_with_constants(system, group), measurements, group), 1.0)

    alone = tuple(least({name: size}) for name, size in sizes.items())
    return alone if len(sizes) < 2 or any(one.open for one in alone) else (*alone, least(sizes))


def _refuting(system: System, measurements: Measurements, names: Collection[str]) -> Callable[[float], bool]:
    """The question of whether the plant is refuted with the residuals of some states so many times as large."""

    def refutes(factor: float) -> bool:
        if not factor:
            return True  # it is known to be
        try:
            Search.of(_scaled(system, names, factor), measurements)
        except Contradiction:
            return True
        except InputError:  # the flow has no enclosure
            return False
        return False

    return refutes


def _least(sizes: Sizes, refutes: Callable[[float], bool], most: float) -> Least:
    """The least multiple of sizes without a contradiction that is found, and a smaller one with one."""

    def times(factor: float) -> Sizes:
        return {name: factor * size for name, size in sizes.items()}

    if not refutes(0.0):
        return Least(times(0.0), times(0.0))
    high = 1.0
    while refutes(high):
        if high >= most:
            return Least(times(high), None)
        high *= _STEP
    low = high / _STEP
    while not refutes(low):
        if low <= _LEAST:
            return Least(times(0.0), times(low))
        low, high = low / _STEP, low
    for _ in range(_BISECTIONS):
        middle = sqrt(low * high)
        low, high = (middle, high) if refutes(middle) else (low, middle)
    return Least(times(low), times(high))


def _scaled(system: System, names: Collection[str], factor: float) -> System:
    """The same plant with the residuals of some states so many times as large."""
    own = {name: system.ranges[name] for state in names for name in residual_names(state, system.ranges)}
    if not factor:
        return system.with_ranges(dict.fromkeys(own))
    return system.with_ranges({name: (lo * Fraction(factor), hi * Fraction(factor)) for name, (lo, hi) in own.items()})


def _with_constants(system: System, sizes: Sizes) -> System:
    """A plant with residuals of constant bounds in the equations of some states."""
    acting = {name: Symbol(residual_name(name)) for name in sizes}
    dynamics = [
        Operation("+", e, acting[s.name]) if s.name in acting else e
        for s, e in zip(system.states, system.dynamics, strict=True)
    ]
    ranges = {residual_name(name): (-Fraction(size), Fraction(size)) for name, size in sizes.items()}
    return replace(
        system,
        dynamics=tuple(dynamics),
        disturbances=(*system.disturbances, *acting.values()),
        ranges={**system.ranges, **ranges},
    )
