"""Options as people write them turned into values, with errors that say what an option takes.

The command line and a study's file speak the same language, and mean the same by it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import TYPE_CHECKING

from certify.errors import InputError
from certify.inputs import (
    Tell,
    named_plant,
    tell_of_other,
    where_valid,
    with_acting,
    with_bounded_errors,
    with_period,
    with_uncertain_parameters,
)

if TYPE_CHECKING:
    from certify.policies import Policy
    from certify.systems import System


def plant_of(
    stored: Policy,
    name: str | None,
    params: list[str],
    bounds: list[str],
    disturbances: Sequence[str],
    error: str | None,
    period: str | None,
    tell: Tell,
) -> System:
    """The plant: the policy file's unless `name` says otherwise, with `--param`, `--domain`, `--disturbance`,
    `--input-error` and `--sample-time` put in.

    What is named there counts as it stands; where the policy was trained for other numbers, `tell` is told so.
    """
    plant, own = named_plant(stored, name)
    plant = with_params(plant, params)
    if not own:
        tell_of_other(stored, plant, tell)
    plant = with_errors(with_disturbances(with_domains(plant, bounds), disturbances), error)
    return where_valid(stored, with_samples(plant, period), tell)


def with_params(plant: System, params: list[str]) -> System:
    """The plant with what `--param` says put in: values, and ranges LO..HI of those that are uncertain."""
    given = dict(_assignment(p, "--param") for p in params)
    ranges = {name: _range(value, name) for name, value in given.items() if ".." in value}
    exact_ones = {name: value for name, value in given.items() if name not in ranges}
    return with_uncertain_parameters(plant.with_parameters(exact_ones), ranges)


def with_disturbances(plant: System, given: Sequence[str]) -> System:
    """The plant with the ranges that `--disturbance` says: half-widths or LO..HI."""
    from certify.systems import exact

    pairs = dict(_assignment(text, "--disturbance") for text in given)
    return with_acting(
        plant, {name: _range(value, name) if ".." in value else exact(value, name) for name, value in pairs.items()}
    )


def with_errors(plant: System, error: str | None) -> System:
    """The plant with u + e in the place of u, as `--input-error` bounds |e|: one number for all inputs, or by name."""
    from certify.systems import exact

    if error is None:
        return plant
    return with_bounded_errors(plant, state(error, "--input-error") if "=" in error else exact(error, "--input-error"))


def with_samples(plant: System, period: str | None) -> System:
    """The plant whose inputs are held as `--sample-time` says: a period, or any between LO..HI."""
    from certify.systems import exact

    if period is None:
        return plant
    ends = _range(period, "--sample-time") if ".." in period else exact(period, "--sample-time")
    return with_period(plant, ends)


def _range(text: str, name: str) -> tuple[Fraction, Fraction]:
    from certify.systems import exact

    lo, hi = ends_of(text)
    return exact(lo, name), exact(hi, name)


def ends_of(text: str) -> list[str]:
    """The ends of a range LO..HI, as text, or of LO:HI, as ranges once were written; one text where it is no range.

    >>> ends_of("-1..3"), ends_of("-1:3"), ends_of("2")
    (['-1', '3'], ['-1', '3'], ['2'])
    """
    return [end.strip() for end in text.split(".." if ".." in text else ":", 1)]


def with_domains(plant: System, bounds: list[str]) -> System:
    """The plant on the box that `--domain` says: half-widths around x_eq, or intervals of the states' values."""
    from certify.systems import exact

    domain: dict[str, tuple[Fraction, Fraction]] = {}
    at = plant.operating_point()
    for text in bounds:
        state, value = _assignment(text, "--domain")
        if len(ends_of(value)) == 2:
            (lo, hi), shift = _range(value, state), at.get(state, Fraction(0))
            domain[state] = (lo - shift, hi - shift)
        else:
            domain[state] = (-exact(value, state), exact(value, state))
    return plant.with_domain(domain)


def region(text: str, plant: System, option: str, deviations: bool = False) -> tuple[tuple[Fraction, Fraction], ...]:
    """A state or a box, NAME=VALUE or NAME=LO..HI separated by commas or spaces, as intervals of deviations from x_eq,
    (n,).

    Numbers are the states' values, as for `--domain NAME=LO..HI`, unless they are `deviations`; text means its decimal
    value. A state that is not named is at rest.

    Raises
    ------
    InputError : a name is no state or comes twice, a number is none, or an interval has lo > hi.
    """
    from certify.systems import exact

    names, at = [s.name for s in plant.states], plant.operating_point()
    found: dict[str, tuple[Fraction, Fraction]] = {}
    for name, value in _assignments(text, option):
        if name not in names:
            raise InputError(f"{plant.name} has no state {name!r}; it has: {', '.join(names)}.")
        if name in found:
            raise InputError(f"{option} must name each state once; found {name} twice.")
        given, shift = ends_of(value), Fraction(0) if deviations else at.get(name, Fraction(0))
        ends = exact(given[0], name) - shift, exact(given[-1], name) - shift
        if ends[0] > ends[1]:
            raise InputError(f"{option} takes intervals LO..HI with LO <= HI; found {f'{name}={value}'!r}.")
        found[name] = ends
    return tuple(found.get(name, (Fraction(0), Fraction(0))) for name in names)


def numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    """Numbers separated by commas."""
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} takes numbers separated by commas, as in 1,1; found {text!r}.") from error


def layers(text: str, option: str) -> tuple[int, ...]:
    """Widths of layers, separated by commas."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} takes widths separated by commas, as in 16,16; found {text!r}.") from error


def widths(text: str | None, option: str) -> dict[str, float] | None:
    """Numbers by name, separated by commas or spaces."""
    if text is None:
        return None
    pairs = dict(_assignments(text, option))
    try:
        return {name: float(value) for name, value in pairs.items()}
    except ValueError as error:
        raise InputError(
            f"{option} takes NAME=NUMBER separated by commas, as in x=0.4,phi=0.2; found {text!r}."
        ) from error


def state(text: str, option: str) -> dict[str, Fraction]:
    """Exact numbers by name, separated by commas or spaces."""
    from certify.systems import exact

    return {name: exact(value, name) for name, value in _assignments(text, option)}


def _assignments(text: str, option: str) -> Iterator[tuple[str, str]]:
    """The names and values of NAME=VALUE,NAME=VALUE or NAME=VALUE NAME=VALUE."""
    joined = re.sub(r"\s*(=|\.\.|,)\s*", r"\1", text.strip())
    return (_assignment(part, option) for part in re.split(r"[,\s]", re.sub(r"\s+", " ", joined)))


def _assignment(text: str, option: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name or not value:
        raise InputError(f"{option} takes NAME=VALUE; found {text!r}.")
    return name.strip(), value.strip()
