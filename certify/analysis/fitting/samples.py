"""Samples of an unknown right-hand side on a grid, and what is declared of it: bounds of its second derivatives.

Numbers are the decimals of the file, as exact fractions: nothing here is rounded.
"""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import product
from math import prod
from pathlib import Path

from certify.errors import InputError
from certify.loop.plants.equations import decimal
from certify.loop.plants.source import PlantFile, number_at

Point = tuple[Fraction, ...]
_MOST_SAMPLES = 200_000


@dataclass(frozen=True, slots=True)
class Unknown:
    """A state whose derivative, in discrete time next value, is a function g of some variables that nobody wrote down.

    Parameters
    ----------
    state : its name.
    variables : names of the states and inputs that g depends on, and of no others.
    curvature : bounds of the absolute second derivatives of g on the domain and the input bounds, (d, d), symmetric.
    """

    state: str
    variables: tuple[str, ...]
    curvature: tuple[Point, ...]


@dataclass(frozen=True, slots=True)
class Grid:
    """Samples of g at all points of a grid.

    Parameters
    ----------
    axes : the values of each variable, ascending.
    values : g at each point, by the point; each is off by at most the noise.
    """

    axes: tuple[Point, ...]
    values: Mapping[Point, Fraction]


def unknowns_in(file: PlantFile, names: Sequence[str], states: Sequence[str]) -> tuple[Unknown, ...]:
    """The tables `unknown.STATE` of a structure, whose entries are as in `"theta*u" = 0.5`.

    Raises
    ------
    InputError : there is none, a name is unknown, a number is negative, or a pair of variables has no bound.
    """
    file.require_known("unknown", list(states), "state")
    found = tuple(_unknown(file, state, names) for state in file.table("unknown"))
    if not found:
        raise file.refuse("there must be a table [unknown.STATE] with bounds of second derivatives; found none.")
    return found


def _unknown(file: PlantFile, state: str, names: Sequence[str]) -> Unknown:
    table, bounds = file.table("unknown")[state], dict[frozenset[str], Fraction]()
    if not isinstance(table, dict) or not table:
        raise file.refuse('must be a table with entries as in "x*u" = 0.5; found none.', "unknown", state)
    for key, value in table.items():
        pair = [name.strip() for name in key.split("*")]
        if len(pair) != 2 or not set(pair) <= set(names):
            raise file.refuse(
                f"must be two states or inputs with * between them, of {', '.join(names)}; found {key!r}.",
                "unknown",
                state,
            )
        bound = number_at(file, value, "unknown", state, key)
        if bound < 0 or frozenset(pair) in bounds:
            raise file.refuse(
                f"the bound of {key} must be at least 0, and stand once; found {value}.", "unknown", state
            )
        bounds[frozenset(pair)] = bound
    variables = tuple(name for name in names if any(name in pair for pair in bounds))
    missing = [(a, b) for a in variables for b in variables if frozenset((a, b)) not in bounds]
    if missing:
        raise file.refuse(
            f"there must be a bound for each pair of {', '.join(variables)}; found none for {'*'.join(missing[0])}.",
            "unknown",
            state,
        )
    rows = tuple(tuple(bounds[frozenset((a, b))] for b in variables) for a in variables)
    return Unknown(state, variables, rows)


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


def _number(row: Sequence[str], at: int, path: Path, line: int) -> Fraction:
    try:
        return Fraction(decimal(row[at].strip()))
    except (IndexError, ValueError) as error:
        raise InputError(f"samples {path}, line {line}: entry {at + 1} must be a decimal number.") from error


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
