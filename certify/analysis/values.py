"""Arguments as Python gives them turned into values, with errors that say what an argument must be."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import declared
from certify.analysis.options import RoaOptions
from certify.errors import InputError
from certify.loop.plants import exact
from certify.loop.plants.equations import nearest
from certify.loop.policies.importers import Clip, ImportOptions

_NUMBERS = (Fraction, float, int, str, np.generic)


def options_in(given: Mapping[str, Any]) -> RoaOptions:
    """The options of a run, from values by keyword.

    Raises
    ------
    InputError : a value is of another type than it must be, or options do not go together.
    """
    options = declared(RoaOptions)
    return RoaOptions(**{name: _READERS[options[name].kind](value, name) for name, value in given.items()})


def changes_in(given: Mapping[str, Any]) -> PlantChanges:
    """The changes of a plant, from values by keyword.

    Raises
    ------
    InputError : a value is of another type than it must be.
    """
    options = declared(PlantChanges).items()
    found = {name: (option, given[option.keyword]) for name, option in options if option.keyword in given}
    return PlantChanges(**{name: _READERS[one.kind](value, one.keyword) for name, (one, value) in found.items()})


def import_options_in(given: ImportOptions | Mapping[str, Any] | None) -> ImportOptions:
    """What is known of a policy of another program, with numbers where the fields take tuples of rationals."""
    if given is None or isinstance(given, ImportOptions):
        return given if given is not None else ImportOptions()
    if not isinstance(given, Mapping):
        raise InputError(f"`importing` must be an ImportOptions or a mapping with its names; found {kind_of(given)}.")
    known = [f.name for f in fields(ImportOptions)]
    for name in given:
        if name not in known:
            close = nearest(str(name), known) or f"; known are {', '.join(known)}."
            raise InputError(f"`importing` has no {name!r}{close}")
    read: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    for name, value in read.items():
        where = f"importing[{name!r}]"
        if name == "states":
            read[name] = tuple(
                text(v, where) for v in (value.split(",") if isinstance(value, str) else _entries(value, where))
            )
        elif name == "ignore":
            read[name] = tuple(text(v, where) for v in ([value] if isinstance(value, str) else _entries(value, where)))
        elif name in ("action_scale", "action_offset"):
            read[name] = _rationals(value, where)
        elif name == "epsilon":
            read[name] = exact(value, where)
        elif name == "normaliser":
            read[name] = "none" if value == "none" else Path(path_in(value, where))
        elif name == "clip":
            read[name] = value if isinstance(value, Clip) else _clip(value, where)
        else:
            text(value, where)
    return ImportOptions(**read)


def _clip(value: Any, where: str) -> Clip:
    ends = _entries(value, where)
    if len(ends) != 2:
        raise InputError(f"`{where}` must be a pair (lo, hi) of numbers or of rows of numbers; found {value!r:.80}.")
    lo, hi = (_rationals(end, where) for end in ends)
    return Clip(lo, hi)


def _rationals(value: Any, where: str) -> tuple[Fraction, ...]:
    if isinstance(value, int | float | str | Fraction):
        return (exact(value, where),)
    return tuple(exact(v.item() if isinstance(v, np.generic) else v, where) for v in _entries(value, where))


def number(value: Any, name: str) -> float:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"`{name}` must be a number; found {value!r:.60}, {kind_of(value)}.")
    return float(value)


def text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise InputError(f"`{name}` must be text; found {value!r:.60}, {kind_of(value)}.")
    return value.strip()


def path_in(value: Any, name: str) -> str:
    if not isinstance(value, str | os.PathLike):
        raise InputError(f"`{name}` must be a path: text or a Path; found {kind_of(value)}.")
    path = os.fspath(value)
    if not isinstance(path, str) or not path:
        raise InputError(f"`{name}` must be a path in text that is not empty; found {path!r}.")
    return path


def require(holds: bool, name: str, what: str, value: object) -> None:
    if not holds:
        raise InputError(f"`{name}` must be {what}; found {kind_of(value)}.")


def kind_of(value: object) -> str:
    return "None" if value is None else f"a {type(value).__name__}"


def _named(given: Any, name: str, what: str) -> dict[str, Any]:
    require(given is None or isinstance(given, Mapping), name, f"a mapping from names to {what}", given)
    return {text(key, name): value for key, value in (given or {}).items()}


def _pair(value: Any, where: str) -> tuple[Fraction, Fraction]:
    ends = _entries(value, where)
    if len(ends) != 2:
        raise InputError(f"`{where}` must be a pair (lo, hi); found {value!r:.80}.")
    return _exact(ends[0], where), _exact(ends[1], where)


def _value_or_pair(value: Any, where: str) -> Fraction | tuple[Fraction, Fraction]:
    return _exact(value, where) if isinstance(value, _NUMBERS) else _pair(value, where)


def _ranges(value: Any, name: str) -> dict[str, Any]:
    """Pairs by name; half-widths as well, but not of parameters, which have values of their own."""
    reader, what = (_pair, "pairs") if name == "ranges" else (_value_or_pair, "half-widths or pairs")
    return {key: reader(ends, f"{name}[{key!r}]") for key, ends in _named(value, name, what).items()}


def _exact(value: Any, where: str) -> Fraction:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, Fraction | float | int | str):
        raise InputError(f"`{where}` must be a number, or text such as '0.15'; found {value!r:.60}, {kind_of(value)}.")
    return exact(value, where)


def _entries(value: Any, where: str) -> list[Any]:
    if isinstance(value, str | Mapping) or not hasattr(value, "__iter__"):
        raise InputError(f"`{where}` must be a sequence; found {kind_of(value)}.")
    return list(value)


def _row(value: Any, name: str) -> tuple[float, ...]:
    return tuple(number(v, name) for v in _entries(value, name))


def _flag(value: Any, name: str) -> bool:
    value = value.item() if isinstance(value, np.generic) else value
    if not isinstance(value, bool):
        raise InputError(f"`{name}` must be True or False; found {value!r:.60}, {kind_of(value)}.")
    return value


def _widths(value: Any, name: str) -> dict[str, float]:
    require(isinstance(value, Mapping), name, "a mapping from states to half-widths", value)
    return {text(key, name): number(width, name) for key, width in value.items()}


def _state(value: Any, name: str) -> dict[str, Fraction]:
    return {key: _exact(number, f"{name}[{key!r}]") for key, number in _named(value, name, "values").items()}


def _matrix(value: Any, name: str) -> Any:
    try:
        found = np.array(value, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(f"`{name}` must be a matrix of numbers, (n, n); found {kind_of(value)}: {error}.") from error
    if found.ndim != 2:
        raise InputError(f"`{name}` must be a matrix of numbers, (n, n); found shape {found.shape}.")
    return found


def _count(value: Any, name: str) -> int:
    value = value.item() if isinstance(value, np.generic) else value
    if isinstance(value, bool) or not isinstance(value, int):
        raise InputError(f"`{name}` must be a whole number; found {value!r:.60}, {kind_of(value)}.")
    return value


def _counts(value: Any, name: str) -> tuple[int, ...]:
    return tuple(_count(v, name) for v in _entries(value, name))


_READERS: Mapping[str, Callable[[Any, str], Any]] = {
    "word": text,
    "number": number,
    "whole": _count,
    "flag": _flag,
    "row": _row,
    "layers": _counts,
    "widths": _widths,
    "state": _state,
    "matrix": _matrix,
    "file": lambda value, _: value,
    "ranges": _ranges,
    "bounds": lambda value, name: _state(value, name) if isinstance(value, Mapping) else _exact(value, name),
    "period": _value_or_pair,
}
