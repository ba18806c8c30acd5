"""Options of the command line turned into values, with errors that say what an option takes."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

from certify.commands.terminal import tell
from certify.errors import InputError
from certify.inputs import named_plant, tell_of_other, where_valid

if TYPE_CHECKING:
    from certify.policies import Policy
    from certify.systems import System


def plant_of(stored: Policy, name: str | None, params: list[str], bounds: list[str]) -> System:
    """The plant: the policy file's unless `name` says otherwise, with `--param` and `--domain` put in.

    What is named there counts as it stands; where the policy was trained for other numbers, standard error says so.
    """
    plant, own = named_plant(stored, name)
    plant = with_params(plant, params)
    if not own:
        tell_of_other(stored, plant, tell)
    return where_valid(stored, with_domains(plant, bounds), tell)


def with_params(plant: System, params: list[str]) -> System:
    """The plant with what `--param` says put in."""
    return plant.with_parameters(dict(_assignment(p, "--param") for p in params))


def with_domains(plant: System, bounds: list[str]) -> System:
    """The plant on the box that `--domain` says: half-widths around x_eq, or intervals of the states' values."""
    from certify.systems import exact

    domain: dict[str, tuple[Fraction, Fraction]] = {}
    at = plant.operating_point()
    for text in bounds:
        state, value = _assignment(text, "--domain")
        lo, _, hi = value.rpartition(":")
        shift = at.get(state, Fraction(0)) if lo else Fraction(0)
        ends = (exact(lo, state), exact(hi, state)) if lo else (-exact(hi, state), exact(hi, state))
        domain[state] = (ends[0] - shift, ends[1] - shift)
    return plant.with_domain(domain)


def numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    """Numbers separated by commas."""
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} takes numbers separated by commas, as in 1,1; found {text!r}.") from error


def widths(text: str | None, option: str) -> dict[str, float] | None:
    """Numbers by name, separated by commas."""
    if text is None:
        return None
    pairs = dict(_assignment(part, option) for part in text.split(","))
    try:
        return {name: float(value) for name, value in pairs.items()}
    except ValueError as error:
        raise InputError(
            f"{option} takes NAME=NUMBER separated by commas, as in x=0.4,phi=0.2; found {text!r}."
        ) from error


def state(text: str, option: str) -> dict[str, Fraction]:
    """Exact numbers by name, separated by commas."""
    from certify.systems import exact

    pairs = dict(_assignment(part, option) for part in text.split(","))
    return {name: exact(value, name) for name, value in pairs.items()}


def _assignment(text: str, option: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name or not value:
        raise InputError(f"{option} takes NAME=VALUE; found {text!r}.")
    return name.strip(), value.strip()
