"""Constraints of a plant: those that a person adds to its file's, and all of them as claims have them.

A claim has inequalities g < 0. Where abs, max or min stand in g so that g grows with them, several inequalities without
them say the same: `abs(F) - 4 < 0` is `F - 4 < 0` and `-F - 4 < 0`. Those have models around a point at which the
argument of abs is 0, which is where most loops rest.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Iterable
from dataclasses import replace

from certify.errors import InputError, OptionError
from certify.loop.expressions import (
    Expression,
    Number,
    Operation,
    Symbol,
    constant_of,
    substitute,
    symbols_of,
    total,
)
from certify.loop.plants.deviations import constraints_of_values, in_deviations
from certify.loop.plants.equations import difference, parse_comparison
from certify.loop.plants.system import System

_MOST_PARTS = 16  # inequalities that one is divided into
_LONGEST = 60  # letters of a name, before the number of a part


def with_constraints(system: System, keep: Iterable[str], avoid: Iterable[str]) -> System:
    """The plant with more constraints, comparisons of the states' values: those of `keep` must always hold, and where
    one of `avoid` holds no trajectory may pass. `NAME: comparison` gives one a name.

    Raises
    ------
    OptionError : a text is no comparison over the plant's names, or depends on no state and no input.
    """
    found = dict(system.constraints)
    for option, texts in (("keep", keep), ("avoid", avoid)):
        for text in texts:
            name, smaller, larger = _read(system, option, text)
            if option == "avoid":
                smaller, larger = larger, smaller
            g = difference(smaller, larger)
            name = name or _unused(option, found)
            if name in found:
                raise OptionError(f"`{option}` {text!r}: {system.name} has a constraint {name} already; name another.")
            (found[name],) = in_deviations([g], system.states, system.x_eq)
    return replace(system, constraints=found)


def _unused(name: str, found: Collection[str]) -> str:
    """The name, or if there is one, the name with the first number, from 2 on, that is not there."""
    others = (f"{name}{number}" for number in itertools.count(2))
    return next(one for one in itertools.chain([name], others) if one not in found)


def _read(system: System, option: str, text: str) -> tuple[str, Expression, Expression]:
    """The name, which may be empty, and the smaller and the larger side of a comparison as a person writes it."""
    named = re.fullmatch(r"\s*([A-Za-z_]\w*)\s*:(.*)", text, re.DOTALL)
    name, said = (named[1], named[2]) if named else ("", text)
    everything = [*system.states, *system.inputs, *system.disturbances, *map(Symbol, system.parameters)]
    try:
        sides = parse_comparison(said, {s.name: s for s in everything})
    except InputError as error:
        raise OptionError(f"`{option}`: {error}") from error
    example = "'p <= 1.5'" if option == "keep" else "'(x - 1)**2 + y**2 < 0.25'"
    if sides is None:
        raise OptionError(
            f"`{option}` takes a comparison by <=, <, >= or >, such as {example}; found {' '.join(text.split())!r}."
        )
    moving = {*system.states, *system.inputs}
    if not symbols_of(*sides) & moving:
        names = ", ".join(s.name for s in everything if s in moving)
        raise OptionError(f"`{option}` must be of states and inputs, {names}; found {' '.join(text.split())!r}.")
    return name, *sides


def kept_constraints(system: System) -> dict[str, Expression]:
    """The inequalities g < 0 of a claim, g by name, with uncertain quantities free, like states and inputs; each once.

    The parts of a constraint have its name and a number.
    """
    found, seen = dict[str, Expression](), set[Expression]()
    for name, g in system.uncertain_constraints().items():
        parts = in_parts(g)
        for count, part in enumerate(parts, 1):
            called = name if len(parts) == 1 else f"{name[:_LONGEST]}_{count}"
            while called in found:
                called += "_"
            if part not in seen:
                found[called] = part
                seen.add(part)
    return found


def in_parts(g: Expression) -> tuple[Expression, ...]:
    """Expressions without some of its abs, max and min that are all negative exactly where g is.

    >>> F = Symbol("F")
    >>> in_parts(abs(F) - 4), in_parts(4 - abs(F))
    ((F - 4, -F - 4), (4 - abs(F),))
    """
    return _ends(g, largest=True)


def _ends(e: Expression, largest: bool) -> tuple[Expression, ...]:
    """Expressions of which e is everywhere the largest, or the smallest; e alone where there are no others."""
    found: list[Expression] = [e]
    match e:
        case Operation(operator="+", operands=terms):
            found = _sums([_ends(term, largest) for term in terms])
        case Operation(operator="-", operands=(term,)):
            found = [-one for one in _ends(term, not largest)]
        case Operation(operator="*", operands=(factor, term)) if (k := constant_of(factor)) is not None:
            found = [factor * one for one in _ends(term, largest == (k > 0))] if k else [e]
        case Operation(operator="*" | "/", operands=(term, factor)) if (k := constant_of(factor)) is not None:
            ends = _ends(term, largest == (k > 0)) if k else ()
            found = [one * factor if e.operator == "*" else one / factor for one in ends] or [e]
        case Operation(operator="abs", operands=(inner,)) if largest:
            found = [*_ends(inner, True), *(-one for one in _ends(inner, False))]
        case Operation(operator="max" | "min" as name, operands=several) if largest == (name == "max"):
            found = [one for inner in several for one in _ends(inner, largest)]
    return tuple(found) if 1 < len(found) <= _MOST_PARTS else (e,)


def _sums(terms: list[tuple[Expression, ...]]) -> list[Expression]:
    """Every sum of one of each."""
    return [total(each) for each in itertools.islice(itertools.product(*terms), _MOST_PARTS + 1)]


def in_words(system: System) -> dict[str, str]:
    """The constraints by name, over the states' values, as in `p - 1.5 < 0`; with numbers for the parameters on which
    the operating point depends, which stand in a claim's constraints as numbers already."""
    numbers = {s: Number(system.parameters[s.name]) for s in symbols_of(*system.x_eq)}
    if numbers:
        held = {name: substitute(g, numbers) for name, g in system.constraints.items()}
        system = replace(system, x_eq=tuple(substitute(e, numbers) for e in system.x_eq), constraints=held)
    return {name: f"{g} < 0" for name, g in constraints_of_values(system).items()}
