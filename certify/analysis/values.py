"""Arguments as Python gives them turned into values, with errors that say what an argument must be."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import fields
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from certify.analysis.arguments import comparisons
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
    """The facts on a policy of another program, with numbers where the fields take tuples of rationals."""
    if given is None or isinstance(given, ImportOptions):
        return given if given is not None else ImportOptions()
    if not isinstance(given, Mapping):
        raise InputError(f"`importing` must be an ImportOptions or a mapping with its names; found {kind_of(given)}.")
    known = [f.name for f in fields(ImportOptions)]
    for name in given:
        if name not in known:
            close = nearest(str(name), known) or f"; known are {', '.join(known)}."
            raise InputError(f"`importing` has no {name!r}{close}")
    read: dict[str, Any] = {
        name: (_OF_IMPORTING.get(name) or text)(value, f"importing[{name!r}]")
        for name, value in given.items()
        if value is not None
    }
    return ImportOptions(**read)


def _clip(value: Any, where: str) -> Clip:
    if isinstance(value, Clip):
        return value
    ends = _entries(value, where)
    if len(ends) != 2:
        raise InputError(f"`{where}` must be a pair (lo, hi) of numbers or of rows of numbers; found {value!r:.80}.")
    return Clip(_rationals(ends[0], where), _rationals(ends[1], where))


def _rationals(value: Any, where: str) -> tuple[Fraction, ...]:
    values = (value,) if isinstance(value, int | float | str | Fraction) else _entries(value, where)
    return tuple(exact(_plain(v), where) for v in values)


def _texts(value: Any, where: str) -> tuple[str, ...]:
    return tuple(text(v, where) for v in (value.split(",") if isinstance(value, str) else _entries(value, where)))


_OF_IMPORTING: Mapping[str, Callable[[Any, str], Any]] = {
    "states": _texts,
    "ignore": lambda value, where: _texts([value] if isinstance(value, str) else value, where),
    "action_scale": _rationals,
    "action_offset": _rationals,
    "epsilon": exact,
    "norm_epsilon": exact,
    "normaliser": lambda value, where: "none" if value == "none" else Path(path_in(value, where)),
    "clip": _clip,
}


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _must_be(kinds: Any, what: str, value: Any, name: str) -> Any:
    value = _plain(value)
    if not isinstance(value, kinds) or (isinstance(value, bool) and kinds is not bool):
        raise InputError(f"`{name}` must be {what}; found {value!r:.60}, {kind_of(value)}.")
    return value


def number(value: Any, name: str) -> float:
    """A number.

    Raises
    ------
    InputError : it is none.
    """
    return float(_must_be((int, float), "a number", value, name))


def text(value: Any, name: str) -> str:
    """Text without blanks around it.

    Raises
    ------
    InputError : it is no text.
    """
    return str(_must_be(str, "text", value, name)).strip()


def path_in(value: Any, name: str) -> str:
    """A path as text.

    Raises
    ------
    InputError : it is none, or empty.
    """
    require(isinstance(value, str | os.PathLike), name, "a path: text or a Path", value)
    path = os.fspath(value)
    if not isinstance(path, str) or not path:
        raise InputError(f"`{name}` must be a path in text that is not empty; found {path!r}.")
    return path


def require(holds: bool, name: str, what: str, value: object) -> None:
    """Refuse an argument that is of another kind than it must be.

    Raises
    ------
    InputError : it does not hold.
    """
    if not holds:
        raise InputError(f"`{name}` must be {what}; found {kind_of(value)}.")


def kind_of(value: object) -> str:
    """The type of a value, in words."""
    return "None" if value is None else f"a {type(value).__name__}"


def _entries(value: Any, where: str) -> list[Any]:
    require(hasattr(value, "__iter__") and not isinstance(value, str | Mapping), where, "a sequence", value)
    return list(value)


def _named(value: Any, name: str, what: str, reader: Callable[[Any, str], Any]) -> dict[str, Any]:
    require(isinstance(value, Mapping), name, f"a mapping from names to {what}", value)
    return {text(key, name): reader(each, f"{name}[{key!r}]") for key, each in value.items()}


def _exact(value: Any, where: str) -> Fraction:
    return exact(_must_be((Fraction, float, int, str), "a number, or text such as '0.15'", value, where), where)


def _pair(value: Any, where: str) -> tuple[Fraction, Fraction]:
    ends = _entries(value, where)
    if len(ends) != 2:
        raise InputError(f"`{where}` must be a pair (lo, hi); found {value!r:.80}.")
    return _exact(ends[0], where), _exact(ends[1], where)


def bounds_in(value: Any, name: str) -> Fraction | dict[str, Fraction]:
    """An exact number, or several by name.

    Raises
    ------
    InputError : it is something else.
    """
    return _named(value, name, "values", _exact) if isinstance(value, Mapping) else _exact(value, name)


def period_in(value: Any, where: str) -> Fraction | tuple[Fraction, Fraction]:
    """An exact number, or a pair of them.

    Raises
    ------
    InputError : it is something else.
    """
    return _exact(value, where) if isinstance(value, _NUMBERS) else _pair(value, where)


def _box(value: Any, name: str) -> dict[str, Fraction | tuple[Fraction, Fraction]]:
    return _named(value, name, "values or pairs", period_in)


def _ranges(value: Any, name: str) -> dict[str, Any]:
    if name == "ranges":  # ranges of parameters, which have values of their own
        return _named(value, name, "pairs", _pair)
    return _named(value, name, "half-widths or pairs", period_in)


def _matrix(value: Any, name: str) -> Any:
    try:
        found = np.array(value, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise InputError(f"`{name}` must be a matrix of numbers, (n, n); found {kind_of(value)}: {error}.") from error
    if found.ndim != 2:
        raise InputError(f"`{name}` must be a matrix of numbers, (n, n); found shape {found.shape}.")
    return found


_whole = partial(_must_be, int, "a whole number")
_READERS: Mapping[str, Callable[[Any, str], Any]] = {
    "word": text,
    "number": number,
    "whole": _whole,
    "flag": partial(_must_be, bool, "True or False"),
    "row": lambda value, name: tuple(number(v, name) for v in _entries(value, name)),
    "layers": lambda value, name: tuple(_whole(v, name) for v in _entries(value, name)),
    "widths": lambda value, name: _named(value, name, "half-widths", number),
    "box": _box,
    "matrix": _matrix,
    "file": lambda value, _: value,
    "ranges": _ranges,
    "bounds": bounds_in,
    "period": period_in,
    "comparisons": lambda value, name: comparisons(
        [text(v, name) for v in ([value] if isinstance(value, str) else _entries(value, name))], name
    ),
}
