"""A plant's file with the ranges that measurements leave: the structure's own text, and a table `data` at its end.

Ends are decimals, rounded outwards; the file is read again before it is written, and must be the same plant.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import fields
from fractions import Fraction
from pathlib import Path

from certify.certificates import write_atomically
from certify.errors import InputError
from certify.loop.plants import Measurements, System, load_system
from certify.loop.plants.axes import along_axes, sums_of
from certify.loop.plants.source import PlantFile, read_plant_file
from certify.loop.plants.system import Interval

_COST = Fraction(1, 10**5)  # of a range's width, which rounding may add
_FINER = 10**10  # rounding of an end just beyond its prior's
_ENTRY = re.compile(r"(\s*[^=]+=\s*)\[[^\[\]]*\](\s*(?:#.*)?)")
_MOST_DIGITS = 400


def rounded(ranges: Mapping[str, Interval], priors: Mapping[str, Interval]) -> dict[str, Interval]:
    """Ranges with ends of few decimal digits that hold those that are given, within the priors where these do.

    An end of a prior that is no binary64 number, such as 0.05, and was not moved lies just inside the range, which
    holds the binary64 number beyond it.
    """
    found = dict[str, Interval]()
    for name, (lo, hi) in ranges.items():
        digits = 0
        while Fraction(2, 10**digits) > _COST * (hi - lo) and digits < _MOST_DIGITS:
            digits += 1
        scale = 10**digits
        low, high = Fraction(lo * scale // 1, scale), Fraction(-(-hi * scale // 1), scale)
        least, most = priors[name]
        near = scale * _FINER
        found[name] = (
            max(least, low) if least <= lo else Fraction(lo * near // 1, near),
            min(most, high) if hi <= most else Fraction(-(-hi * near // 1), near),
        )
    return found


def write_known(path: Path, structure: Path, known: System, source: str) -> None:
    """Write the plant `known`, which is that of the file `structure` but for its ranges and its measurements.

    Parameters
    ----------
    source : the name of the file of measurements.

    Raises
    ------
    InputError : a range does not stand on a line of its own, or the text would not be this plant.
    """
    data = known.measurements
    if data is None:
        raise InputError("there must be measurements on which ranges rest; found none.")
    if path.resolve() == structure.resolve():
        raise InputError(f"the plant that is found must not be written over its structure, {structure}.")
    text = _text(read_plant_file(structure), structure, known, data, source)
    with tempfile.TemporaryDirectory(prefix="certify-") as folder:
        copy = Path(folder) / structure.name
        copy.write_text(text, encoding="utf-8")
        found = load_system(copy)
    odd = [name for name in _differing(found, along_axes(known)) if name]
    if odd:
        raise InputError(
            f"{structure} cannot be written with new ranges: {', '.join(odd)} would be others. Write each range of "
            "[parameters] on a line of its own, as in m = [0.1, 0.3]."
        )
    write_atomically(path, text.encode())


def _text(file: PlantFile, structure: Path, known: System, data: Measurements, source: str) -> str:
    lines = structure.read_text(encoding="utf-8").splitlines()
    for name in data.priors:
        number = file.lines.get(f"parameters.{name}")
        entry = None if number is None else _ENTRY.fullmatch(lines[number - 1])
        if number is None or entry is None:
            raise file.refuse(
                f"the range must stand on a line of its own, as in {name} = [0.1, 0.3].", "parameters", name
            )
        lines[number - 1] = f"{entry[1]}{pair_text(known.ranges[name])}{entry[2]}"
    return "\n".join([*lines, "", *_table(known, data, source), ""])


def _table(known: System, data: Measurements, source: str) -> Iterator[str]:
    """The table `data`, line by line."""
    yield "[data] # on which the ranges rest of the parameters that have a prior"
    name = source.replace("\\", "\\\\").replace('"', '\\"')
    yield f'file = "{name}"'
    yield f'sha256 = "{data.sha256}"'
    if data.period is not None:
        lo, hi = data.period
        yield f"period = {decimal_text(lo) if lo == hi else pair_text(data.period)}"
    yield ""
    yield "[data.noise] # each measured state is within these of the true one"
    yield from (f"{s.name} = {decimal_text(w)}" for s, w in zip(known.states, data.noise, strict=True))
    yield ""
    yield "[data.priors] # ranges that were assumed"
    yield from (f"{p} = {pair_text(pair)}" for p, pair in data.priors.items())
    if data.axes:
        names = ", ".join(axis.name for axis in data.axes)
        yield f"\n[data.axes] # the value in the middle, and times {names}, each in [-1, 1]"
        for p, row in zip(data.priors, sums_of(data.axes), strict=True):
            yield f"{p} = [{', '.join(map(decimal_text, row))}]"


def pair_text(pair: Interval) -> str:
    return f"[{decimal_text(pair[0])}, {decimal_text(pair[1])}]"


def decimal_text(value: Fraction) -> str:
    """A number of TOML that is exactly this one: a decimal, or else a fraction as text."""
    digits = next((k for k in range(_MOST_DIGITS) if 10**k % value.denominator == 0), None)
    if digits is None:
        return f'"{value}"'
    whole = abs(value.numerator) * 10**digits // value.denominator
    shown = f"{whole:0{digits + 1}d}"
    sign = "-" if value < 0 else ""
    return sign + (f"{shown[:-digits]}.{shown[-digits:]}" if digits else shown)


def _differing(found: System, known: System) -> Iterator[str]:
    """The fields in which two plants differ."""
    for each in fields(System):
        if each.name != "measurements" and getattr(found, each.name) != getattr(known, each.name):
            yield each.name
    left, right = found.measurements, known.measurements
    if left is None or right is None:
        yield "data"
        return
    for name in ("priors", "period", "noise", "sha256", "axes"):
        mine, yours = getattr(left, name), getattr(right, name)
        if (list(mine.items()) if name == "priors" else mine) != (list(yours.items()) if name == "priors" else yours):
            yield f"data.{name}"
