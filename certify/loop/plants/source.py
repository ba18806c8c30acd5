"""The text of a plant's file beside its values, so that an error can name the line.

tomllib gives values without their lines. This module finds them again in the text. If that fails, as it may in an
inline table, the error names the table's line, or else none.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Any

from certify.errors import InputError
from certify.loop.plants.equations import decimal, nearest
from certify.loop.plants.system import Interval, exact

_TABLE = re.compile(r"\s*\[([^\[\]]+)\]")
_ENTRY = re.compile(r"""\s*((?:["']?[A-Za-z0-9_-]+["']?\s*\.\s*)*["']?[A-Za-z0-9_-]+["']?)\s*=""")


@dataclass(frozen=True, slots=True)
class PlantFile:
    """A TOML file of a plant or a study: its values and their lines.

    Parameters
    ----------
    path : the file's path, for messages.
    data : the document; decimal numbers are exact fractions.
    lines : line of each key, by its dotted path.
    """

    path: Path
    data: Mapping[str, Any]
    lines: Mapping[str, int] = field(repr=False)

    def refuse(self, message: str, *keys: str) -> InputError:
        """The error with `message` at this key: file, line, key, and fault."""
        line = next((self.lines[k] for k in _upwards(keys) if k in self.lines), None)
        where = f"{self.path}, line {line}" if line is not None else str(self.path)
        return InputError(f"{where}{': ' + '.'.join(keys) if keys else ''}: {message}")

    def table(self, name: str) -> Mapping[str, Any]:
        """The table `name`, empty if there is none.

        Raises
        ------
        InputError : it is something else.
        """
        found = self.data.get(name, {})
        if not isinstance(found, dict):
            raise self.refuse(f"must be a table, [{name}] with an entry a line; found {found!r}.", name)
        return found

    def require_known(self, name: str, known: Mapping[str, str] | list[str], what: str) -> None:
        """Reject entries of the table `name` that are not in `known`; `what` names these in the message."""
        for key in self.table(name):
            if key not in known:
                close = nearest(key, known) or f"; known are {', '.join(known) or 'none'}."
                raise self.refuse(f"{key!r} is no {what}{close}", name, key)


def read_plant_file(path: Path, what: str = "system file") -> PlantFile:
    """Read a TOML file; `what` names it in messages.

    Raises
    ------
    InputError : it is missing, not TOML, or holds a number that is no finite decimal.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError as error:
        raise InputError(f"{what} {path} cannot be read: there is no such file. Check its name and folder.") from error
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{what} {path} must be TOML, which is UTF-8 text; {error}.") from error
    odd: list[str] = []

    def number(literal: str) -> Any:
        try:
            return decimal(literal)  # decimal text goes to Fraction unrounded
        except InputError:
            odd.append(literal)
            raise

    try:
        data = tomllib.loads(text, parse_float=number)
    except tomllib.TOMLDecodeError as error:
        line = int(found[1]) if (found := re.search(r"at line (\d+)", str(error))) else 0
        content = "".join(text.splitlines()[line - 1 : line]).strip()
        hint = _hint(content)
        shown = f" in {content[:60]!r}" if content else ""
        raise InputError(f"{what} {path} is not valid TOML: {error}{shown}.{hint}") from error
    except InputError as error:
        line = next(i for i, content in enumerate(text.splitlines(), 1) if odd[0] in content)
        raise InputError(f"{path}, line {line}: {error}") from error
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(f"{what} {path} cannot be read: {error}.") from error
    return PlantFile(path, data, _lines(text))


def interval_at(file: PlantFile, table: str, name: str) -> Interval:
    """The interval [lo, hi] of an entry.

    Raises
    ------
    InputError : there is none, or lo is not below hi.
    """
    value = file.table(table).get(name)
    if name not in file.table(table):
        raise file.refuse(f"there must be bounds of {name}; none were found. Write {name} = [lo, hi].", table)
    return interval_in(file, value, table, name)


def interval_in(file: PlantFile, value: Any, *keys: str) -> Interval:
    """The interval that a value [lo, hi] at this key of a file is.

    Raises
    ------
    InputError : it is none, or lo is not below hi.
    """
    name = keys[-1]
    if not isinstance(value, list) or len(value) != 2:
        is_half = isinstance(value, int | Fraction) and not isinstance(value, bool)
        found = f"{float(value):g}; write {name} = [-{float(value):g}, {float(value):g}]" if is_half else repr(value)
        raise file.refuse(f"the bounds of {name} must be a pair [lo, hi]; found {found}.", *keys)
    lo, hi = (number_at(file, end, *keys) for end in value)
    if not lo < hi:
        raise file.refuse(f"the bounds of {name} must satisfy lo < hi; found [{float(lo):g}, {float(hi):g}].", *keys)
    return lo, hi


def number_at(file: PlantFile, value: Any, *keys: str) -> Fraction:
    """The exact number at this key of a file.

    Raises
    ------
    InputError : it is none, or beyond all floats.
    """
    if isinstance(value, bool) or not isinstance(value, int | str | Fraction):
        raise file.refuse(f"must be a number such as 0.15 or the text '3/20'; found {value!r}.", *keys)
    try:
        found = exact(value, keys[-1])
        float(found)
    except InputError as error:
        raise file.refuse(str(error), *keys) from error
    except OverflowError as error:
        raise file.refuse(f"must be a number below 1.8e308 in size; found {value!s:.80}.", *keys) from error
    return found


def _hint(line: str) -> str:
    """The likely repair of a line that is no TOML: text or a fraction without quotes; empty for another fault.

    >>> _hint("name = ball"), _hint("x = [1, 2")
    (' Put text and equations in quotes: name = "ball".', '')
    >>> _hint("parameters = { k = 2/3, m = 1 }")
    ' Put fractions in quotes: "2/3".'
    """
    if fraction := re.search(r"[=,[]\s*(-?\d+\s*/\s*\d+)\s*(?:[],}#]|$)", line):
        return f' Put fractions in quotes: "{fraction[1]}".'
    name, equals, value = (part.strip() for part in line.partition("="))
    if not equals or not value or value[0] in "\"'[{":
        return ""
    return f' Put text and equations in quotes: {name} = "{value.partition("#")[0].strip()}".'


def _lines(text: str) -> dict[str, int]:
    found: dict[str, int] = {}
    table: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if header := _TABLE.match(line):
            table = _parts(header.group(1))
            found.setdefault(".".join(table), number)
        elif entry := _ENTRY.match(line):
            keys = table + _parts(entry.group(1))
            for k in range(len(table) + 1, len(keys) + 1):
                found.setdefault(".".join(keys[:k]), number)
    return found


def _parts(dotted: str) -> list[str]:
    return [part.strip().strip("\"'") for part in dotted.split(".")]


def _upwards(keys: tuple[str, ...]) -> list[str]:
    return [".".join(keys[:k]) for k in range(len(keys), 0, -1)]
