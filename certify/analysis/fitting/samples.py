"""Samples of an unknown right-hand side on a grid, from a file.

Numbers are the decimals of the file, as exact fractions: nothing here is rounded.
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from itertools import chain, product
from math import prod
from pathlib import Path

from certify.errors import InputError
from certify.loop.plants.equations import decimal
from certify.loop.plants.samples import Grid, Samples, Unknown
from certify.loop.plants.system import Interval, System

_MOST_SAMPLES, _MOST_BITS = 200_000, 2**7  # bits of a number, as the checkers read them
_LENGTH = "some 35 digits at most"


def read_samples(path: Path, unknowns: Sequence[Unknown], suffix: str) -> tuple[dict[str, Grid], str]:
    """The grid of each unknown, by its state, from a CSV file; and the sha256 of the file.

    A column `NAME_rate` (`suffix`; in discrete time `NAME_next`) has the values of each unknown.

    Raises
    ------
    InputError : the file cannot be read, a column or a number is missing, or the points are no grid.
    """
    try:
        raw = path.read_bytes()
        rows = [row for row in csv.reader(io.StringIO(raw.decode("utf-8-sig"), newline=""), strict=True) if row]
    except OSError as error:
        raise InputError(f"samples {path} cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"samples {path} must be CSV, which is UTF-8 text: {error}.") from error
    if not 2 <= len(rows) <= _MOST_SAMPLES + 1:
        raise InputError(f"samples {path} must have a header and 1 to {_MOST_SAMPLES:,} rows; found {len(rows)} lines.")
    header = [name.strip() for name in rows[0]]
    wanted = {name for one in unknowns for name in (*one.variables, f"{one.state}{suffix}")}
    odd = next((name for name in sorted(wanted) if header.count(name) != 1), None)
    if odd is not None:
        raise InputError(f"samples {path} must have the column {odd} once; its columns are {', '.join(header)}.")
    columns = {
        name: [_number(row, header.index(name), path, k) for k, row in enumerate(rows[1:], 2)] for name in wanted
    }
    grids = {one.state: _grid(one, columns, f"{one.state}{suffix}", path) for one in unknowns}
    return grids, hashlib.sha256(raw).hexdigest()


def require_covered(system: System, one: Unknown, grid: Grid, noise: Fraction, which: str) -> None:
    """Reject samples that do not reach over the domain, the input bounds and 0, or bounds of too long numbers."""
    bounds = bounds_of(system)
    if any(map(_is_long, (noise, *chain(*one.curvature)))):
        raise InputError(f"bounds of the noise and of second derivatives of {one.state} must have {_LENGTH}.")
    for name, axis in zip(one.variables, grid.axes, strict=True):
        lo, hi = bounds[name]
        if not (axis[0] <= min(lo, Fraction(0)) and max(hi, Fraction(0)) <= axis[-1]):
            raise InputError(
                f"samples {which} must reach over all of {name} in [{float(lo):g}, {float(hi):g}]; they reach over "
                f"[{float(axis[0]):g}, {float(axis[-1]):g}]. Take more, or make the domain smaller."
            )


def bounds_of(system: System) -> dict[str, Interval]:
    """The domain and the input bounds, by the names of states and inputs."""
    both = zip((*system.states, *system.inputs), (*system.domain, *system.input_bounds), strict=True)
    return {s.name: interval for s, interval in both}


def with_samples(system: System, samples: Samples, path: Path) -> System:
    """A plant whose file has a table `samples`, with the samples of that file.

    Raises
    ------
    InputError : the file is another one or cannot be read.
    """
    grids, sha256 = read_samples(path, samples.unknowns, suffix_of(system))
    if sha256 != samples.sha256:
        raise InputError(
            f"data file {path} must be the one to which the plant was fitted, of sha256 {samples.sha256}; found "
            f"{sha256}. For other samples run certify fit again."
        )
    return replace(system, samples=replace(samples, grids=grids))


def suffix_of(system: System) -> str:
    """The end of the name of a column of values."""
    return "_next" if system.time == "discrete" else "_rate"


def _number(row: Sequence[str], at: int, path: Path, line: int) -> Fraction:
    try:
        found = Fraction(decimal(row[at].strip()))
    except (IndexError, ValueError) as error:
        raise InputError(f"samples {path}, line {line}: entry {at + 1} must be a decimal number.") from error
    if _is_long(found):
        raise InputError(f"samples {path}, line {line}: entry {at + 1} must have {_LENGTH}.")
    return found


def _is_long(q: Fraction) -> bool:
    return max(q.numerator.bit_length(), q.denominator.bit_length()) > _MOST_BITS


def _grid(one: Unknown, columns: Mapping[str, Sequence[Fraction]], name: str, path: Path) -> Grid:
    points = list(zip(*(columns[v] for v in one.variables), strict=True))
    axes = tuple(tuple(sorted(set(columns[v]))) for v in one.variables)
    if len(points) != prod(map(len, axes)) or len(set(points)) != len(points):
        shape = " x ".join(str(len(axis)) for axis in axes)
        raise InputError(
            f"samples {path} must be a grid in {', '.join(one.variables)}: each combination of their values in one "
            f"row; {shape} values need {prod(map(len, axes)):,} rows, found {len(points):,}."
        )
    values = dict(zip(points, columns[name], strict=True))
    thin = next((v for v, axis in zip(one.variables, axes, strict=True) if len(axis) < 2), None)
    if thin is not None or set(product(*axes)) != set(values):
        raise InputError(f"samples {path} must have two values or more of each of {', '.join(one.variables)}.")
    return Grid(axes, values)
