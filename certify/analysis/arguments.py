"""Options as people write them turned into values, with errors that say what an option takes.

The command line and a study's file speak the same language, and mean the same by it; `certify.analysis.values` reads
what Python gives.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.analysis.changes import PlantChanges
from certify.analysis.declaration import declared
from certify.analysis.inputs import Tell, ellipsoid_beside, ellipsoid_trained, function_in
from certify.analysis.options import RoaOptions
from certify.errors import InputError, OptionError

if TYPE_CHECKING:
    from certify.analysis.identifying.linear import LinearStructure
    from certify.loop.plants import System
    from certify.loop.policies import Policy

_LISTS = "without", "inputs", "states"


def options_of(texts: Mapping[str, Any], plant: System, tell: Tell, policy: Policy | None = None) -> RoaOptions:
    """The options of a run from texts by their fields; the file of a second function is read for this plant.

    Parameters
    ----------
    policy : one for this very plant; where nothing else is said of P, it is that of its training, if its record has it.

    Raises
    ------
    InputError : a text is not what its option takes, or options do not go together.
    """
    read = {name: read_option(name, text) for name, text in texts.items() if name != "lyapunov"}
    if "lyapunov" in texts:
        from certify.lyapunov import StoredLyapunov

        beyond = function_in(str(texts["lyapunov"]), plant, tell)
        read["lyapunov"] = beyond.function if isinstance(beyond, StoredLyapunov) else beyond
        shaped = read.get("candidate", "auto") == "auto" and not {"Q", "R", "level"} & read.keys()
        if shaped and read.get("claim") != "invariant" and isinstance(beyond, StoredLyapunov):
            read["P"] = ellipsoid_beside(beyond, plant)
    elif policy is not None and not {"Q", "R", "level", "candidate", "claim", "rate"} & read.keys():
        read["P"] = ellipsoid_trained(policy, plant) if read.get("engine", "bounds") == "bounds" else None
        if read["P"] is not None:
            tell("P is that of the policy's training, from its record; --candidate auto tries others")
    return RoaOptions(**read)


def read_option(name: str, text: Any) -> Any:
    """The value of an option of a run; a flag of the command line is one already.

    Raises
    ------
    InputError : the text is not what the option takes.
    """
    return text if isinstance(text, bool) else _READERS[declared(RoaOptions)[name].kind](text, name)


def changes_of(texts: Mapping[str, Any]) -> PlantChanges:
    """The changes of a plant from texts by their fields: one, or for a table one for each entry, NAME=VALUE.

    Raises
    ------
    InputError : a text is not what it must be.
    """
    options = declared(PlantChanges)
    return PlantChanges(**{name: _READERS[options[name].kind](text, name) for name, text in texts.items()})


def linear_from(texts: Mapping[str, Any]) -> LinearStructure | None:
    """A plant without a model from texts by the fields of `LinearStructure`; None without any.

    Raises
    ------
    InputError : a text is not what it must be, or no state has a bound `second`.
    """
    from certify.analysis.identifying.linear import LinearStructure

    given = {name: value for name, value in texts.items() if value}
    if not given:
        return None
    read: dict[str, Any] = {
        name: _ranges(given[name], name) for name in ("domain", "input_bounds", "prior") if name in given
    }
    read |= {name: [part.strip() for part in given[name].split(",")] for name in _LISTS if name in given}
    return LinearStructure(second=dict(_assignment(e, "`second`") for e in given.get("second", ())), **read)


def _ranges(entries: Sequence[str], name: str) -> dict[str, Any]:
    pairs = dict(_assignment(entry, f"`{name}`") for entry in entries)
    return {key: _entry(key, value, name) for key, value in pairs.items()}


def _entry(key: str, text: str, name: str) -> Fraction | tuple[Fraction, Fraction]:
    """The value or range of `key` in an option, which errors name with it."""
    try:
        found = value_or_range(text, key)
    except OptionError as error:
        raise OptionError(
            f"`{name}` takes a finite number such as {key}=0.15 or {key}=3/20, or a range {key}=LO..HI; "
            f"found {key}={text}."
        ) from error
    if isinstance(found, tuple) and not found[0] < found[1]:
        raise OptionError(f"`{name}` takes a range LO..HI with LO < HI; found {key}={text}.")
    return found


def value_or_range(text: str, name: str) -> Fraction | tuple[Fraction, Fraction]:
    """An exact number, or two of them as LO..HI."""
    ends = [_exact(end, name) for end in ends_of(text)]
    return ends[0] if len(ends) == 1 else (ends[0], ends[1])


def ends_of(text: str) -> list[str]:
    """The ends of a range LO..HI, as text, or of LO:HI, as ranges once were written; one text where it is no range.

    >>> ends_of("-1..3"), ends_of("-1:3"), ends_of("2")
    (['-1', '3'], ['-1', '3'], ['2'])
    """
    return [end.strip() for end in text.split(".." if ".." in text else ":", 1)]


def region(text: str, plant: System, option: str, deviations: bool = False) -> tuple[tuple[Fraction, Fraction], ...]:
    """A state or a box, NAME=VALUE or NAME=LO..HI separated by commas or spaces, as intervals of deviations from x_eq,
    (n,).

    Numbers are the states' values, as for `--domain NAME=LO..HI`, unless they are `deviations`; text means its decimal
    value. A state that is not named is at rest.

    Raises
    ------
    InputError : a name is no state or comes twice, a number is none, or an interval has lo > hi.
    """
    names, at = [s.name for s in plant.states], plant.operating_point()
    found: dict[str, tuple[Fraction, Fraction]] = {}
    for name, value in _assignments(text, option):
        if name not in names:
            raise InputError(f"{plant.name} has no state {name!r}; it has: {', '.join(names)}.")
        if name in found:
            raise InputError(f"{option} must name each state once; found {name} twice.")
        given, shift = ends_of(value), Fraction(0) if deviations else at.get(name, Fraction(0))
        ends = _exact(given[0], name) - shift, _exact(given[-1], name) - shift
        if ends[0] > ends[1]:
            raise InputError(f"{option} takes intervals LO..HI with LO <= HI; found {f'{name}={value}'!r}.")
        found[name] = ends
    return tuple(found.get(name, (Fraction(0), Fraction(0))) for name in names)


def comparisons(texts: Sequence[str], name: str) -> tuple[str, ...]:
    """Comparisons, of which one text may have several, separated by semicolons.

    >>> comparisons(["p <= 1; v <= 2", "F <= 3"], "keep")
    ('p <= 1', 'v <= 2', 'F <= 3')
    """
    found = [part.strip() for text in texts for part in text.split(";")]
    if not all(found):
        raise OptionError(f"`{name}` takes a comparison, such as 'p <= 1.5'; found nothing in {'; '.join(texts)!r}.")
    return tuple(found)


def numbers(text: str, name: str) -> tuple[float, ...]:
    """Numbers separated by commas."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise OptionError(f"`{name}` takes numbers separated by commas, as in 1,1; found {text!r}.") from error


def layers(text: str, name: str) -> tuple[int, ...]:
    """Widths of layers, separated by commas."""
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError as error:
        raise OptionError(f"`{name}` takes widths separated by commas, as in 16,16; found {text!r}.") from error


def widths(text: str, name: str) -> dict[str, float]:
    """Numbers by name, separated by commas or spaces."""
    try:
        return {key: float(value) for key, value in _assignments(text, f"`{name}`")}
    except ValueError as error:
        raise OptionError(
            f"`{name}` takes NAME=NUMBER separated by commas, as in x=0.4,phi=0.2; found {text!r}."
        ) from error


def state(text: str, name: str) -> dict[str, Fraction]:
    """Exact numbers by name, separated by commas or spaces."""
    return _by_name(text, name, _exact)


def box(text: str, name: str) -> dict[str, Fraction | tuple[Fraction, Fraction]]:
    """Exact numbers or ranges by name, separated by commas or spaces."""
    return _by_name(text, name, value_or_range)


def bound_or_bounds(text: str, name: str) -> Fraction | dict[str, Fraction]:
    """An exact number, or several by name."""
    return state(text, name) if "=" in text else _exact(text, name)


def _by_name(text: str, name: str, read: Callable[[str, str], Any]) -> dict[str, Any]:
    """Values by name, each of which comes once."""
    found = dict[str, Any]()
    for key, value in _assignments(text, f"`{name}`"):
        if key in found:
            raise OptionError(f"`{name}` must name each number once; found {key} twice.")
        found[key] = read(value, key)
    return found


def _number(text: str, name: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float(_exact(text, name))


def _whole(text: str, name: str) -> int:
    value = _exact(text, name)
    if value.denominator != 1:
        raise OptionError(f"`{name}` must be a whole number; found {text}.")
    return int(value)


def _flag(text: str, name: str) -> bool:
    if text not in ("true", "false"):
        raise OptionError(f"`{name}` must be true or false; found {text!r}.")
    return text == "true"


def _exact(text: str, name: str) -> Fraction:
    from certify.loop.plants import exact

    try:
        found = exact(text, name)
        float(found)
    except InputError as error:
        raise OptionError(str(error)) from error
    except OverflowError as error:
        raise OptionError(f"`{name}` must be a number below 1.8e308 in size; found {text:.80}.") from error
    return found


_READERS: Mapping[str, Callable[[Any, str], Any]] = {
    "word": lambda text, _: text,
    "number": _number,
    "whole": _whole,
    "flag": _flag,
    "row": numbers,
    "layers": layers,
    "widths": widths,
    "box": box,
    "file": lambda text, _: Path(text),
    "ranges": _ranges,
    "bounds": bound_or_bounds,
    "period": value_or_range,
    "comparisons": lambda text, name: comparisons([text] if isinstance(text, str) else text, name),
}


def _assignments(text: str, option: str) -> Iterator[tuple[str, str]]:
    """The names and values of NAME=VALUE,NAME=VALUE or NAME=VALUE NAME=VALUE."""
    joined = re.sub(r"\s*(=|\.\.|,)\s*", r"\1", text.strip())
    return (_assignment(part, option) for part in re.split(r"[,\s]", re.sub(r"\s+", " ", joined)))


def _assignment(text: str, option: str) -> tuple[str, str]:
    name, equals, value = text.partition("=")
    if not equals or not name or not value:
        raise OptionError(f"{option} takes NAME=VALUE; found {text!r}.")
    return name.strip(), value.strip()
