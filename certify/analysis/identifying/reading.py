"""Measured runs of a plant, from a file of states and inputs as binary64.

Rows are in time order, with a column `run` where there are several runs, or single transitions, with a column
`NAME_next` for every state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.analysis.tables import NEXT, RUN, Table, read_table
from certify.errors import InputError
from certify.loop.plants import Run, System, domain_of_values

Array = NDArray[np.float64]
_TURN = 2 * math.pi


@dataclass(frozen=True, slots=True)
class Readings:
    """Measured runs of a file.

    Parameters
    ----------
    runs : the states' own values, angles unwrapped, and inputs.
    places : for each transition, in order, the place in the file where it begins.
    sha256 : of the file's bytes.
    notes : remarks for a person.
    """

    runs: tuple[Run, ...]
    places: tuple[str, ...]
    sha256: str
    notes: tuple[str, ...] = ()


def read_data(path: Path, system: System) -> Readings:
    """Read measured transitions of a plant, from the bytes whose hash is given.

    Raises
    ------
    InputError : the file cannot be read, or a column, a row or a number is missing, of another shape or not finite.
    """
    found = _of_table(read_table(path, [s.name for s in system.states], [u.name for u in system.inputs]), system)
    runs, turned = _unwrapped(found.runs, system)
    return replace(found, runs=runs, notes=(*found.notes, *_notes(runs, turned, system)))


def _of_table(table: Table, system: System) -> Readings:
    """The runs of a table: transitions if there are columns `_next`, else rows in time order."""
    states, inputs = [s.name for s in system.states], [u.name for u in system.inputs]
    after = [f"{s}{NEXT}" for s in states]
    single = any(name in table.columns for name in after)
    wanted = [*states, *inputs, *(after if single else ())]
    table.require(wanted)
    x, u = numbers(table, states), numbers(table, inputs)
    if single:
        y = numbers(table, after)
        runs, begins = [Run(np.stack([a, c]), b[None]) for a, b, c in zip(x, u, y, strict=True)], list(table.places)
    else:
        runs, begins = [], []
        for first, last in table.stretches():
            runs.append(Run(x[first:last], u[first : last - 1]))
            begins += table.places[first : last - 1]
    unread = [name for name in table.columns if name not in wanted and (single or name != RUN)]
    notes = (f"columns that are not read: {', '.join(unread)}",) if unread else ()
    return Readings(tuple(runs), tuple(begins), table.sha256, notes)


def numbers(table: Table, names: Sequence[str]) -> Array:
    """The numbers (N, k) of columns.

    Raises
    ------
    InputError : an entry is no finite number.
    """
    columns = [[_number(entry, where) for entry, where in table.entries(name)] for name in names]
    return np.array(columns, dtype=np.float64).reshape(len(names), len(table.places)).T


def _number(value: Any, where: str) -> float:
    try:
        if value is None or isinstance(value, bool) or (isinstance(value, str) and "_" in value):
            raise ValueError(value)
        number = float(value)
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{where}: there must be a number; found {value!r:.40}.") from error
    if not math.isfinite(number):
        raise InputError(f"{where}: a number must be finite; found {value}. Leave out what was not measured.")
    return number


def _unwrapped(runs: Sequence[Run], system: System) -> tuple[tuple[Run, ...], int]:
    """Runs in which no angle moves by more than half a turn in a transition, and the number of turns that were added.

    An angle whose values span more than a turn and a half is not wrapped, and stays. To add turns in floats moves a
    value by a few units in its last place, which the noise has to cover.
    """
    span, count = np.ptp(np.concatenate([run.states for run in runs]), axis=0), 0
    at = [k for k, s in enumerate(system.states) if s.name in system.angles and span[k] <= 1.5 * _TURN]
    if not at:
        return tuple(runs), 0
    found = list[Run]()
    for states, inputs in runs:
        turns = np.round(np.diff(states[:, at], axis=0) / _TURN)
        count += int(np.count_nonzero(turns))
        moved = states.copy()
        moved[1:, at] -= _TURN * np.cumsum(turns, axis=0)
        found.append(Run(moved, inputs))
    return tuple(found), count


def _notes(runs: Sequence[Run], turned: int, system: System) -> Iterator[str]:
    """Remarks on angles that were unwrapped, and on numbers beyond the plant's bounds."""
    if turned:
        yield (
            f"{turned:,} differences of {', '.join(system.angles)} were unwrapped to the nearest turn: it is assumed "
            "that none moved by more than half a turn"
        )
    x, u = np.concatenate([run.states for run in runs]), np.concatenate([run.inputs for run in runs])
    if not (np.all(np.isfinite(x)) and np.all(np.isfinite(u))):
        raise InputError("measured numbers must stay finite when angles are unwrapped.")
    for symbols, values, bounds, what in (
        (system.states, x, domain_of_values(system), "values of {} lie outside its domain, where equations count too"),
        (system.inputs, u, system.input_bounds, "values of {} lie beyond its bounds: data must have what acted"),
    ):
        for symbol, column, (lo, hi) in zip(symbols, values.T, bounds, strict=True):
            beyond = int(np.count_nonzero((column < float(lo)) | (column > float(hi))))
            if beyond:
                yield f"{beyond:,} {what.format(symbol.name)}"
