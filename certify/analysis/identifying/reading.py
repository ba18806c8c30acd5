"""Files of measured states and inputs, read once; nothing in them is dropped, and numbers are binary64.

CSV and parquet have columns by the names of states and inputs: rows in time order, with a column `run` where there are
several runs, or single transitions, with a column `NAME_next` for every state. An npz file has arrays `states`
(E, T + 1, n) and `inputs` (E, T, m), or `x` (N, n), `u` (N, m) and `x_next` (N, n).
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError
from certify.loop.plants import Run, System, domain_of_values

Array = NDArray[np.float64]
RUN, NEXT = "run", "_next"
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
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"data file {path} cannot be read: {error.strerror}.") from error
    if not raw:
        raise InputError(f"data file {path} must have measured transitions; it is empty.")
    kinds = {".csv": _csv, ".npz": _npz, ".parquet": _parquet}
    if path.suffix.lower() not in kinds:
        raise InputError(f"data file {path} must be one of {', '.join(kinds)}; found {path.suffix or 'no ending'!r}.")
    found = kinds[path.suffix.lower()](raw, path, system)
    runs, turned = _unwrapped(found.runs, system)
    notes = (*found.notes, *_notes(runs, turned, system))
    return replace(found, runs=runs, sha256=hashlib.sha256(raw).hexdigest(), notes=notes)


@dataclass(frozen=True, slots=True)
class _Table:
    """Columns by name, and the place of each row in the file, in words."""

    columns: Mapping[str, Sequence[Any]]
    places: Sequence[str]


def _csv(raw: bytes, path: Path, system: System) -> Readings:
    try:
        text = raw.decode("utf-8-sig")
        rows = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"data file {path} must be CSV, which is UTF-8 text: {error}.") from error
    while rows and not rows[-1]:
        rows.pop()
    if not rows:
        raise InputError(f"data file {path} must have a header and rows; it has none.")
    header = [name.strip() for name in rows[0]]
    for number, row in enumerate(rows[1:], 2):
        if len(row) != len(header):
            raise InputError(
                f"data file {path}, line {number}: there must be {len(header)} entries, as in the header; found "
                f"{len(row)}."
            )
    places = [f"line {number}" for number in range(2, len(rows) + 1)]
    columns = [[row[k].strip() for row in rows[1:]] for k in range(len(header))]
    return _of_table(header, columns, places, path, system)


def _parquet(raw: bytes, path: Path, system: System) -> Readings:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise InputError(f"data file {path} needs pyarrow: pip install 'certify[parquet]'; or write CSV.") from error
    try:
        table = pyarrow.parquet.read_table(pyarrow.BufferReader(raw))
    except (pyarrow.ArrowException, OSError) as error:
        raise InputError(f"data file {path} is no parquet file: {str(error).splitlines()[0]:.200}") from error
    columns = [column.to_pylist() for column in table.columns]
    places = [f"row {number}" for number in range(1, table.num_rows + 1)]
    return _of_table(list(table.column_names), columns, places, path, system)


def _of_table(
    header: Sequence[str], columns: Sequence[Sequence[Any]], places: Sequence[str], path: Path, system: System
) -> Readings:
    """The runs of a table: transitions if there are columns `_next`, else rows in time order."""
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"data file {path}: columns must differ; found {twice!r} twice.")
    if not places:
        raise InputError(f"data file {path} must have rows below its header; it has none.")
    table = _Table(dict(zip(header, columns, strict=True)), places)
    states, inputs = [s.name for s in system.states], [u.name for u in system.inputs]
    after = [f"{s}{NEXT}" for s in states]
    single = any(name in table.columns for name in after)
    wanted = [*states, *inputs, *(after if single else ())]
    missing = [name for name in wanted if name not in table.columns]
    if missing:
        raise InputError(
            f"data file {path} must have the columns {', '.join(wanted)}; {', '.join(missing)} is missing among "
            f"{', '.join(header)}."
        )
    x, u = _numbers(table, states, path), _numbers(table, inputs, path)
    if single:
        y = _numbers(table, after, path)
        runs, begins = [Run(np.stack([a, c]), b[None]) for a, b, c in zip(x, u, y, strict=True)], list(places)
    else:
        runs, begins = [], []
        for first, last in _stretches(table, path):
            runs.append(Run(x[first:last], u[first : last - 1]))
            begins += places[first : last - 1]
    unread = [name for name in header if name not in wanted and (single or name != RUN)]
    notes = (f"columns that are not read: {', '.join(unread)}",) if unread else ()
    return Readings(tuple(runs), tuple(begins), "", notes)


def _numbers(table: _Table, names: Sequence[str], path: Path) -> Array:
    """The numbers (N, k) of columns."""
    found = np.empty((len(table.places), len(names)))
    for k, name in enumerate(names):
        for row, value in enumerate(table.columns[name]):
            found[row, k] = _number(value, f"data file {path}, {table.places[row]}, column {name}")
    return found


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


def _stretches(table: _Table, path: Path) -> Iterator[tuple[int, int]]:
    """First and behind the last row of each run."""
    names = table.columns.get(RUN, [""] * len(table.places))
    edges = [0, *(k for k in range(1, len(names)) if names[k] != names[k - 1]), len(names)]
    seen = set[Any]()
    for first, last in pairwise(edges):
        name, what = names[first], f"data file {path}, {table.places[first]}"
        if name in seen:
            raise InputError(f"{what}: rows of a run must stand together; run {name!r} begins for the second time.")
        if last - first < 2:
            raise InputError(f"{what}: a run must have two rows at least, of two times; run {name!r} has one.")
        seen.add(name)
        yield first, last


def _npz(raw: bytes, path: Path, system: System) -> Readings:
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"data file {path} is no npz file of numbers: {error}.") from error
    n, m = system.n, system.m
    runs = {"states": (None, None, n), "inputs": (None, None, m)}
    single = {"x": (None, n), "u": (None, m), "x_next": (None, n)}
    wanted = runs if "states" in arrays else single
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise InputError(
            f"data file {path} must have the arrays states and inputs, or x, u and x_next; {', '.join(missing)} is "
            f"missing among {', '.join(arrays) or 'none'}."
        )
    for name, shape in wanted.items():
        _require_numbers(arrays[name], shape, f"data file {path}, array {name}")
    found = {name: arrays[name].astype(np.float64) for name in wanted}
    if wanted is runs:
        x, u = found["states"], found["inputs"]
        if x.shape[0] != u.shape[0] or x.shape[1] != u.shape[1] + 1 or not u.size:
            raise InputError(
                f"data file {path}: states must have shape (E, T + 1, {n}) and inputs (E, T, {m}); found {x.shape} and "
                f"{u.shape}."
            )
        places = [f"run {e}, step {t}" for e in range(u.shape[0]) for t in range(u.shape[1])]
        return Readings(tuple(map(Run, x, u)), tuple(places), "")
    counts = {name: len(array) for name, array in found.items()}
    if len(set(counts.values())) > 1 or not counts["x"]:
        raise InputError(f"data file {path}: x, u and x_next must have as many rows; found {counts}.")
    each = zip(found["x"], found["u"], found["x_next"], strict=True)
    places = [f"row {k}" for k in range(counts["x"])]
    return Readings(tuple(Run(np.stack([a, c]), b[None]) for a, b, c in each), tuple(places), "")


def _require_numbers(array: NDArray[Any], shape: tuple[int | None, ...], where: str) -> None:
    """Refuse an array of another shape or kind, or with a number that is not finite."""
    shown = tuple("any" if k is None else k for k in shape)
    if array.ndim != len(shape) or array.shape[-1] != shape[-1]:
        raise InputError(f"{where}: the shape must be {shown}; found {array.shape}.".replace("'", ""))
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise InputError(f"{where}: there must be numbers of at most 64 bits; found {array.dtype}.")
    odd = np.argwhere(~np.isfinite(array))
    if len(odd):
        raise InputError(f"{where}: numbers must be finite; found {array[tuple(odd[0])]} at {odd[0].tolist()}.")


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
