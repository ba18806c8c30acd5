"""The plant that somebody typed, and how it is trained: a plant that ships, or one in a file with its `[training]`."""

from __future__ import annotations

from dataclasses import fields, replace
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args, get_origin, get_type_hints

from certify.errors import InputError
from controllers.options import Plant, TrainingOptions, available_plants, get_plant

if TYPE_CHECKING:
    from certify.loop.plants import System
    from certify.loop.plants.source import PlantFile
    from certify.loop.policies import Policy
from controllers.plants.defaults import default_plant

_BOX = ("initial_states", "positions")


def chosen_plant(name: str) -> tuple[System, Plant]:
    """The plant that somebody typed: its name, `FILE.toml` or `FILE.py:NAME`, and how it is trained.

    Raises
    ------
    InputError : no such plant; its own file bears the name of one that ships; it has no operating
        point inside its domain; or its options cannot be used.
    """
    from certify.loop.plants import (
        available_systems,
        chosen_system,
        get_system,
        require_no_jumps,
        require_origin_inside,
    )

    if name in available_plants():
        return get_system(name), get_plant(name)
    if name in available_systems():
        return get_system(name), get_plant(name)  # its error says that there are no options for it
    if not (name.endswith(".toml") or name.rpartition(":")[0].endswith(".py")):
        get_plant(name)  # its error says that there is none of this name
    system = chosen_system(name)
    if system.name in available_systems():
        raise InputError(
            f"the plant of {name} must not bear the name of one that ships, {system.name!r}: a policy is told by "
            "the name of its plant. Give it another `name`."
        )
    require_origin_inside(system)
    require_no_jumps(system)
    plant = default_plant(system)
    if name.endswith(".toml"):
        from certify.loop.plants.source import read_plant_file

        return system, _with_table(plant, system, read_plant_file(Path(name)))
    plant.check(system)
    return system, plant


def plant_of(policy: Policy, chosen: tuple[System, Plant] | None = None) -> tuple[System, Plant]:
    """The plant that a policy is for, with the policy's parameters: the one that it names, unless one was `chosen`.

    Raises
    ------
    InputError : the policy names no plant that ships.
    """
    return chosen if chosen is not None else (system_of(policy), get_plant(policy.system))


def system_of(policy: Policy) -> System:
    """The equations that a policy names, with the policy's parameters.

    Raises
    ------
    InputError : the policy names no plant that ships.
    """
    from certify.loop.plants import shipped_system

    return shipped_system(policy.system).with_parameters(policy.parameters)


def _with_table(plant: Plant, system: System, file: PlantFile) -> Plant:
    """The plant with what its file's table `[training]` chooses."""
    table, hints = file.table("training"), get_type_hints(TrainingOptions)
    known = [option.name for option in fields(TrainingOptions)]
    file.require_known("training", [*known, *_BOX], "option of a training")
    chosen: dict[str, Any] = {}
    for name, value in table.items():
        if name not in _BOX:
            chosen[name] = _value(value, hints[name], file, name)
    box: dict[str, Any] = {}
    if "start" in chosen:  # simulations start where episodes do
        share = chosen["start"] / plant.preset.start
        box["initial_states"] = tuple(share * width for width in plant.initial_states)
    if "initial_states" in table:
        box["initial_states"] = _value(table["initial_states"], tuple[float, ...], file, "initial_states")
    if "positions" in table:
        box["positions"] = _value(table["positions"], tuple[str, ...], file, "positions")
    try:
        found = replace(plant, preset=replace(plant.preset, **chosen), **box)
        found.check(system)
    except InputError as error:
        raise file.refuse(str(error), "training") from error
    return found


def _value(value: Any, kind: Any, file: PlantFile, name: str) -> Any:
    """A value of the table as the option's kind: numbers of a TOML file are integers and exact fractions."""
    if get_origin(kind) is tuple:
        if not isinstance(value, list):
            raise file.refuse(f"must be a list, as in [1, 2]; found {value!r}.", "training", name)
        return tuple(_value(part, get_args(kind)[0], file, name) for part in value)
    allowed = {int: (int,), float: (int, Fraction)}.get(kind, (str,))
    if isinstance(value, bool) or not isinstance(value, allowed):
        wanted = {int: "an integer", float: "a number"}.get(kind, "text")
        raise file.refuse(f"must be {wanted}; found {value!r}.", "training", name)
    return float(value) if kind is float else value
