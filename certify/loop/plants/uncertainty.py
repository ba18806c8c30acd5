"""The uncertainty of a plant: input errors, the corners of the box of ranges, the plant at some of its values."""

from __future__ import annotations

import itertools
import random
from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Literal

from certify.errors import InputError
from certify.loop.expressions import Expression, Number, Operation, Symbol, nodes, substitute, symbols, symbols_of
from certify.loop.plants.system import System

Kind = Literal["parameter", "disturbance", "input error"]


def with_input_errors(system: System, bounds: Mapping[str, Fraction]) -> System:
    """The same plant with u + e instead of u, |e| at most the bound, for the inputs that are named."""
    by_name, names = {s.name: s for s in system.inputs}, list[str]()
    moved: dict[Expression, Expression] = {}
    for name, bound in bounds.items():
        if name not in by_name or not bound > 0:
            raise InputError(
                f"an input error must be a positive bound for one of {', '.join(by_name)}; found {name} = {bound}."
            )
        names.append(f"error_{name}")
        moved[by_name[name]] = Operation("+", by_name[name], Symbol(names[-1]))
    ranges = {error: (-bound, bound) for error, bound in zip(names, bounds.values(), strict=True)}
    units = {error: system.units[name] for error, name in zip(names, bounds, strict=True) if name in system.units}
    return replace(
        system,
        dynamics=tuple(substitute(e, moved) for e in system.dynamics),
        constraints={name: substitute(e, moved) for name, e in system.constraints.items()},
        disturbances=(*system.disturbances, *symbols(names)),
        ranges={**system.ranges, **ranges},
        units={**system.units, **units},
    )


def input_errors(system: System) -> Mapping[str, str]:
    """The input errors: each uncertain quantity's name, by the name of its input.

    An uncertain error_u is an input error if u and error_u occur in the equations only as u + error_u. The name
    alone does not suffice: a file may give it to anything.
    """
    found = {}
    for u in system.inputs:
        error = Symbol(f"error_{u.name}")
        acting = Operation("+", u, error)
        free = symbols_of(*(substitute(e, {acting: Number(0)}) for e in system.dynamics))
        acts = acting in nodes(*system.dynamics)
        if error.name in system.ranges and acts and not free & {u, error}:
            found[u.name] = error.name
    return found


def kind_of(system: System, name: str) -> Kind:
    """The kind of the uncertain quantity with this name."""
    if name in input_errors(system).values():
        return "input error"
    return "parameter" if name in system.parameters else "disturbance"


def at_values(system: System, values: Mapping[str, Fraction]) -> System:
    """The plant without uncertainty, where parameters and disturbances have these values.

    u_eq stays that of the nominal parameters: it belongs to the policy, which does not know these values.
    """
    known = {name: q for name, q in values.items() if name in system.parameters}
    held = {s: Number(values.get(s.name, Fraction(0))) for s in system.disturbances}
    dynamics = tuple(substitute(e, held) for e in system.dynamics)
    constraints = {name: substitute(e, held) for name, e in system.constraints.items()}
    u_eq = tuple(map(Number, system.exact_u_eq()))
    plant = system.with_parameters(known)
    return replace(
        plant,
        dynamics=dynamics,
        constraints=constraints,
        u_eq=u_eq,
        disturbances=(),
        ranges={},
        measurements=None,
        samples=None,
    )


def corners(system: System, most: int = 64) -> tuple[dict[str, Fraction], ...]:
    """The vertices of the box of ranges, in a fixed order; if there are more than `most`, some of them."""
    vertices = list(itertools.islice(itertools.product((0, 1), repeat=len(system.ranges)), most))
    if 2 ** len(system.ranges) > most:
        drawn = random.Random(0)
        vertices = [tuple(drawn.randint(0, 1) for _ in system.ranges) for _ in range(most)]
    return tuple(
        {name: ends[side] for (name, ends), side in zip(system.ranges.items(), vertex, strict=True)}
        for vertex in vertices
    )
