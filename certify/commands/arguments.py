"""Options of the command line turned into values, with errors that say what an option takes."""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

from certify.errors import InputError

if TYPE_CHECKING:
    from certify.policies import Policy
    from certify.systems import System


def plant_of(stored: Policy, name: str | None, params: list[str], bounds: list[str]) -> System:
    """The plant: the policy file's unless `name` says otherwise, with `--param` and `--domain` put in."""
    from certify.systems import exact, get_system

    plant = get_system(name if name is not None else stored.system)
    if name is None or name == stored.system:
        plant = plant.with_parameters(stored.parameters)
    plant = plant.with_parameters(dict(_assignment(p, "--param") for p in params))
    domain: dict[str, tuple[Fraction, Fraction]] = {}
    for text in bounds:
        state, value = _assignment(text, "--domain")
        lo, _, hi = value.rpartition(":")
        domain[state] = (exact(lo, state), exact(hi, state)) if lo else (-exact(hi, state), exact(hi, state))
    return plant.with_domain(domain)


def numbers(text: str | None, option: str) -> tuple[float, ...] | None:
    """Numbers separated by commas."""
    if text is None:
        return None
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"{option} takes numbers separated by commas, as in 1,1; found {text!r}.") from error


def _assignment(text: str, option: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name or not value:
        raise InputError(f"{option} takes NAME=VALUE; found {text!r}.")
    return name.strip(), value.strip()
