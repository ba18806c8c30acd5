"""Options of the command line turned into values, with errors that say what an option takes."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import TYPE_CHECKING

from certify.commands.terminal import tell
from certify.errors import InputError

if TYPE_CHECKING:
    from certify.policies import Policy
    from certify.systems import System


def plant_of(stored: Policy, name: str | None, params: list[str], bounds: list[str]) -> System:
    """The plant: the policy file's unless `name` says otherwise, with `--param` and `--domain` put in.

    A policy file names a plant that ships, never a file: a plant of one's own is named with `--system` each time. What
    is named there counts as it stands; where the policy was trained for other numbers, standard error says so.
    """
    from certify.systems import available_systems, chosen_system, shipped_system

    if name is None and stored.system not in available_systems():
        raise InputError(
            f"unknown system {stored.system!r}: the policy was trained for a plant that does not ship here. Name its "
            f"file, as in --system {stored.system if stored.system.isidentifier() else 'plant'}.toml."
        )
    plant = shipped_system(stored.system) if name is None else chosen_system(name)
    shipped = name is None or name == stored.system
    plant = with_params(plant.with_parameters(stored.parameters) if shipped else plant, params)
    if not shipped and (notice := _other_plant(stored, plant)):
        tell(notice)
    return _where_valid(stored, with_domains(plant, bounds))


def _where_valid(stored: Policy, plant: System) -> System:
    """The plant on the part of its domain where the policy's network is what it was made from; says what was cut."""
    if stored.valid is None:
        return plant
    if len(stored.valid) != plant.n:
        raise InputError(f"the policy is valid for {len(stored.valid)} states; {plant.name} has {plant.n}.")
    cut: dict[str, tuple[Fraction, Fraction]] = {}
    for symbol, (lo, hi), (low, high) in zip(plant.states, plant.domain, stored.valid.tolist(), strict=True):
        ends = (max(lo, Fraction(low)) if low > -math.inf else lo, min(hi, Fraction(high)) if high < math.inf else hi)
        if ends != (lo, hi):
            cut[symbol.name] = ends
    for name, (lo, hi) in cut.items():
        tell(f"the domain of {name} is cut to [{float(lo):.6g}, {float(hi):.6g}]: there its observation is not clipped")
    return plant.with_domain(cut)


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


def _other_plant(stored: Policy, plant: System) -> str | None:
    """A notice if the policy says that it was trained for another plant than this one."""
    if stored.system != plant.name:
        return f"the policy was trained for {stored.system!r}; it is used with {plant.name}"
    try:
        off = [f"{p} = {v}" for p, v in stored.parameters.items() if plant.parameters.get(p) != Fraction(v)]
    except (ValueError, TypeError, ArithmeticError):
        off = [f"{p} = {v}" for p, v in stored.parameters.items()]
    return f"the policy was trained with {', '.join(off)}; --system says otherwise, and counts" if off else None


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
