"""A study: the policies, plants, values, candidates and options that a TOML file crosses.

A list always means "each of these", in every table, so that every entry can be varied, and nobody has to remember
which. A value that is a list by nature, such as the diagonal of Q or an interval, is therefore written as on the
command line, as text: `Q = "1,1"`, `m = "0.135..0.165"`. Values stay text, in decimals or as a fraction, from the file
to the very run: nothing is rounded on the way, and a case's name, its folder and its column say what was run.
"""

from __future__ import annotations

import glob
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import product
from pathlib import Path
from typing import Any

from certify.analysis.arguments import comparisons, read_option
from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import declared
from certify.analysis.inputs import named_plant
from certify.analysis.options import RoaOptions
from certify.analysis.studies.case import OPTIONS, PLANT_OPTIONS, TABLES, Case, File, readable_ids
from certify.errors import InputError
from certify.loop.plants import System, available_systems, exact
from certify.loop.plants.equations import nearest
from certify.loop.plants.source import PlantFile, number_at, read_plant_file
from certify.loop.policies import load_policy

_LISTS = ("policies", "systems", "candidates")
_TABLES = (*TABLES, "options")
_RANGE = ("from", "to", "points")
_MOST_CASES, _MOST_POINTS = 100_000, 10_000
_FILE_OPTION = "lyapunov"
KNOWN = (*OPTIONS, *PLANT_OPTIONS)


@dataclass(frozen=True, slots=True)
class Axis:
    """An entry of the file with its values, in which cases differ, or which they share.

    Parameters
    ----------
    key : the entry's, as in `parameters.m`; `policies`, `systems`, `candidates`.
    values : text, in the file's order; numbers exactly.
    listed : True if the file gives them as a list or a range: only then they are part of a case's name.
    """

    key: str
    values: tuple[str, ...]
    listed: bool

    @property
    def is_numeric(self) -> bool:
        """True if all values are numbers."""
        return self.key not in _LISTS and all(map(_is_number, self.values))


@dataclass(frozen=True, slots=True)
class Study:
    """The content of a study's file; `files` holds the bytes of all files that it names, by their names there."""

    name: str
    axes: tuple[Axis, ...]
    files: Mapping[str, bytes] = field(repr=False)

    @property
    def varied(self) -> tuple[Axis, ...]:
        """The axes with more than one value."""
        return tuple(axis for axis in self.axes if len(axis.values) > 1)

    def cases(self) -> tuple[Case, ...]:
        """Every combination, in the order of the file, the last entry fastest."""
        listed = [axis.key for axis in self.axes if axis.listed]
        coordinates = [
            dict(zip((axis.key for axis in self.axes), values, strict=True))
            for values in product(*(axis.values for axis in self.axes))
        ]
        return tuple(
            Case(
                name,
                where,
                self._file(where["policies"]),
                where["systems"] if where.get("systems") in available_systems() else self._file(where.get("systems")),
                self._file(where.get(f"options.{_FILE_OPTION}")),
            )
            for name, where in zip(readable_ids(coordinates, listed), coordinates, strict=True)
        )

    def _file(self, named: str | None) -> Any:
        return None if named is None else File(Path(named).name, self.files[named])


def read_study(path: Path) -> Study:
    """Read a study; paths in it are relative to its own folder.

    Raises
    ------
    InputError : the file, or one that it names, is missing; it is not TOML; a key is unknown, a value is none of what
        it must be, or a plant has no such parameter, disturbance or state. The message names file, line and entry.
    """
    file = read_plant_file(path, "study")
    for key in file.data:
        if key not in (*_LISTS, *_TABLES):
            close = nearest(key, (*_LISTS, *_TABLES)) or f"; known are {', '.join((*_LISTS, *_TABLES))}."
            raise file.refuse(f"unknown keys are refused: {key!r} is none of a study's{close}", key)
    if "policies" not in file.data:
        raise file.refuse('missing keys: a study must have policies, as in policies = ["seeds/*.pt"].')
    files: dict[str, bytes] = {}
    policies = _policies(file, files)
    systems = _names(file, "systems", lambda text: _system(file, text, files))
    candidates = _names(file, "candidates", lambda text: _options_with(file, "candidates", candidate=text))
    axes = [policies, *(axis for axis in (systems, candidates) if axis is not None)]
    for table in _TABLES:
        axes += [_axis(file, table, name, files) for name in file.table(table)]
    count = 1
    for axis in axes:
        count *= len(axis.values)
    if count > _MOST_CASES:
        raise file.refuse(f"a study must have at most {_MOST_CASES:,} cases; found {count:,}. Divide it.")
    _require_names(file, policies, systems)
    return Study(path.stem, tuple(axes), files)


def plain(value: Fraction) -> str:
    """A number without rounding, to be read back by `exact`: in decimals where few say it, else as a fraction.

    >>> plain(Fraction(3, 20)), plain(Fraction(2)), plain(Fraction(1, 3))
    ('0.15', '2', '1/3')
    """
    try:
        shown = repr(float(value)).removesuffix(".0")
    except OverflowError:
        return str(value)
    return shown if Fraction(shown) == value else str(value)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(exact(text)))
    except (InputError, OverflowError):
        return False


def _policies(file: PlantFile, files: dict[str, bytes]) -> Axis:
    """The policy files: paths, and patterns with * and ?, whose matches come in alphabetical order."""
    found: list[str] = []
    patterns, listed = _texts(file, "policies")
    for pattern in patterns:
        folder = file.path.parent
        magic = glob.has_magic(pattern)
        matches = sorted(glob.glob(pattern, root_dir=folder, recursive=True)) if magic else [pattern]
        if not matches:
            raise file.refuse(f"there must be a file for each pattern; none matches {pattern!r}.", "policies")
        for match in matches:
            if match in found:
                raise file.refuse(f"each policy must be there once; found {match} twice.", "policies")
            found.append(match)
            files[match] = _content(file, match, "policies")
    return Axis("policies", tuple(found), listed or len(found) > 1)


def _system(file: PlantFile, text: str, files: dict[str, bytes]) -> None:
    """A plant that ships, or the file of one; a study runs no code, and names no file that does."""
    if text.endswith(".toml"):
        files[text] = _content(file, text, "systems")
    elif text not in available_systems():
        known = nearest(text, available_systems()).replace("?", ",") or (
            f"; known are {', '.join(available_systems())},"
        )
        raise file.refuse(f"there is no plant {text!r}{known} or name the TOML file of one.", "systems")


def _content(file: PlantFile, name: str, *keys: str) -> bytes:
    try:
        return (file.path.parent / name).read_bytes()
    except OSError as error:
        raise file.refuse(f"{name} cannot be read: {error.strerror}.", *keys) from error


def _names(file: PlantFile, key: str, require: Callable[[str], None]) -> Axis | None:
    if key not in file.data:
        return None
    texts, listed = _texts(file, key)
    for text in texts:
        require(text)
    return Axis(key, _once(file, texts, key), listed)


def _texts(file: PlantFile, key: str) -> tuple[list[str], bool]:
    """Text or a list of texts, and whether it is a list."""
    value = file.data[key]
    texts = value if isinstance(value, list) else [value]
    if not texts or not all(isinstance(text, str) and text for text in texts):
        raise file.refuse(f"must be text, or a list of texts; found {value!r:.80}.", key)
    return texts, isinstance(value, list)


def _axis(file: PlantFile, table: str, name: str, files: dict[str, bytes]) -> Axis:
    """An entry of a table: a value, a list of values, or a range."""
    value = file.table(table)[name]
    if table == "options" and name not in KNOWN:
        if name == "candidate":
            raise file.refuse('candidates stand at the top, as in candidates = ["lyapunov"].', table, name)
        close = nearest(name, KNOWN) or f"; known are {', '.join(KNOWN)}."
        raise file.refuse(f"{name!r} is no option of a study{close}", table, name)
    if isinstance(value, dict):
        values = _range(file, value, table, name)
    else:
        values = [_text(file, one, table, name) for one in (value if isinstance(value, list) else [value])]
    for text in values:
        _require_readable(file, text, table, name)
        if (table, name) == ("options", _FILE_OPTION):
            files[text] = _content(file, text, table, name)
    return Axis(f"{table}.{name}", _once(file, values, table, name), isinstance(value, list | dict))


def _range(file: PlantFile, value: Mapping[str, Any], *keys: str) -> list[str]:
    """Points from one end to the other, both included, at exactly equal distances."""
    if set(value) != set(_RANGE):
        raise file.refuse(
            f"a range must be {{ from = 0.1, to = 0.2, points = 5 }}; found the keys {', '.join(value) or 'none'}.",
            *keys,
        )
    lo, hi = (number_at(file, value[end], *keys) for end in ("from", "to"))
    points = value["points"]
    if isinstance(points, bool) or not isinstance(points, int) or not 2 <= points <= _MOST_POINTS:
        raise file.refuse(f"`points` must be a whole number from 2 to {_MOST_POINTS:,}; found {points!r}.", *keys)
    return [plain(lo + (hi - lo) * k / (points - 1)) for k in range(points)]


def _text(file: PlantFile, value: Any, *keys: str) -> str:
    """A value as it would stand on the command line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int | Fraction):
        return plain(Fraction(value))
    if not isinstance(value, str) or not value.strip():
        raise file.refuse(
            f"must be a number, text, a list of these, or {{ from = 0.1, to = 0.2, points = 5 }}; found {value!r:.80}.",
            *keys,
        )
    try:
        return plain(exact(value.strip()))  # "3/20" and 0.15 are one value, and have one name
    except InputError:
        return value.strip()


def _once(file: PlantFile, values: list[str], *keys: str) -> tuple[str, ...]:
    if not values:
        raise file.refuse("a list must have at least one value; found none.", *keys)
    twice = next((value for value, count in Counter(values).items() if count > 1), None)
    if twice is not None:
        raise file.refuse(f"each value must be there once; found {twice} twice.", *keys)
    return tuple(values)


def _require_readable(file: PlantFile, text: str, table: str, name: str) -> None:
    """Refuse what no run could read; whether the plant can have it is for the run to say."""
    try:
        if name in OPTIONS and name != _FILE_OPTION and table == "options":
            _options_with(file, f"options.{name}", **{OPTIONS[name]: read_option(OPTIONS[name], text)})
        elif table != "options" or name in PLANT_OPTIONS:
            if name in PLANT_OPTIONS and declared(PlantChanges)[name].kind == "comparisons":
                comparisons([text], name)
                return
            separator = ":" if table == "domain" and ".." not in text else ".."
            parts = [text.rpartition("=")[2]] if name == "input_error" else text.split(separator)
            if len(parts) > 2:
                raise InputError(f"must be a number, or an interval LO{separator}HI; found {text!r}.")
            for part in parts:
                exact(part.strip(), name)
    except InputError as error:
        if str(file.path) in str(error):
            raise
        raise file.refuse(str(error), table, name) from error


def _options_with(file: PlantFile, key: str, **given: Any) -> None:
    try:
        RoaOptions(**given)
    except InputError as error:
        raise file.refuse(str(error), *key.split(".")) from error


def _require_names(file: PlantFile, policies: Axis, systems: Axis | None) -> None:
    """Refuse parameters, disturbances and states that a plant of the study has not: a slip, in every one of its cases.

    Of a policy or plant that cannot be read nothing is said here: it is a case that fails, and no others with it.
    """
    for plant in _plants(file, policies, systems):
        states = [s.name for s in plant.states]
        file.require_known("parameters", list(plant.parameters), f"parameter of {plant.name}")
        file.require_known("disturbances", [s.name for s in plant.disturbances], f"disturbance of {plant.name}")
        file.require_known("domain", states, f"state of {plant.name}")


def _plants(file: PlantFile, policies: Axis, systems: Axis | None) -> Iterator[System]:
    seen: set[tuple[str | None, str]] = set()
    folder = file.path.parent
    for policy in policies.values:
        for system in (None,) if systems is None else systems.values:
            try:
                stored = load_policy(folder / policy)
                key = system, "" if system is not None else stored.system
                if key not in seen:
                    seen.add(key)
                    of_file = system is not None and system not in available_systems()
                    yield named_plant(stored, str(folder / str(system)) if of_file else system)[0]
            except InputError:
                continue
