"""Files of measured numbers as columns by name, read once; nothing in them is dropped.

CSV and parquet have columns by the names of states and inputs. An npz file has such columns too, or arrays: `states`
(E, T + 1, n) and `inputs` (E, T, m), or `x` (N, n), `u` (N, m) and what belongs to each row, `x_next` or `x_rate`
(N, n).
"""

from __future__ import annotations

import csv
import hashlib
import io
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from certify.errors import InputError

RUN, NEXT, RATE = "run", "_next", "_rate"


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of a file.

    Parameters
    ----------
    path : the file.
    columns : entries by the column's name, text of CSV and numbers of other files.
    places : the place of each row in the file, in words.
    sha256 : of the file's bytes.
    inputs : names of the columns of inputs, where the file's form says which they are.
    """

    path: Path
    columns: Mapping[str, Sequence[Any]]
    places: Sequence[str]
    sha256: str
    inputs: tuple[str, ...] = ()

    def require(self, names: Sequence[str]) -> None:
        """Refuse a file in which a column is missing."""
        missing = [name for name in names if name not in self.columns]
        if missing:
            raise InputError(
                f"data file {self.path} must have the columns {', '.join(names)}; {', '.join(missing)} is missing "
                f"among {', '.join(self.columns)}."
            )

    def entries(self, name: str) -> Iterator[tuple[Any, str]]:
        """The entries of a column, and where each stands, for a message."""
        for entry, place in zip(self.columns[name], self.places, strict=True):
            yield entry, f"data file {self.path}, {place}, column {name}"

    def stretches(self) -> Iterator[tuple[int, int]]:
        """First and behind the last row of each run."""
        names = self.columns.get(RUN, [""] * len(self.places))
        edges = [0, *(k for k in range(1, len(names)) if names[k] != names[k - 1]), len(names)]
        seen = set[Any]()
        for first, last in pairwise(edges):
            name, what = names[first], f"data file {self.path}, {self.places[first]}"
            if name in seen:
                raise InputError(f"{what}: rows of a run must stand together; run {name!r} begins for the second time.")
            if last - first < 2:
                raise InputError(f"{what}: a run must have two rows at least, of two times; run {name!r} has one.")
            seen.add(name)
            yield first, last


def read_table(path: Path, states: Sequence[str] = (), inputs: Sequence[str] = ()) -> Table:
    """Read the columns of a file, from the bytes whose hash is given.

    Parameters
    ----------
    states, inputs : names of the columns of an npz file's arrays; x1, x2, ... and u1, u2, ... without them.

    Raises
    ------
    InputError : the file cannot be read, has no rows or two columns of a name, or arrays of another shape or not
        finite.
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"data file {path} cannot be read: {error.strerror}.") from error
    if not raw:
        raise InputError(f"data file {path} must have measured numbers; it is empty.")
    if path.suffix.lower() == ".npz":
        return _npz(raw, path, states, inputs)
    kinds = {".csv": _csv, ".parquet": _parquet}
    if path.suffix.lower() not in kinds:
        raise InputError(f"data file {path} must be one of .csv, .npz, .parquet; found {path.suffix or 'no ending'!r}.")
    header, columns, places = kinds[path.suffix.lower()](raw, path)
    twice = next((name for name in header if header.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"data file {path}: columns must differ; found {twice!r} twice.")
    if not places:
        raise InputError(f"data file {path} must have rows below its header; it has none.")
    return Table(path, dict(zip(header, columns, strict=True)), places, _hash(raw))


def _hash(raw: bytes) -> str:
    return hashlib.sha256(raw).hexdigest()


def _csv(raw: bytes, path: Path) -> tuple[list[str], list[list[Any]], list[str]]:
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
    return header, [[row[k].strip() for row in rows[1:]] for k in range(len(header))], places


def _parquet(raw: bytes, path: Path) -> tuple[list[str], list[list[Any]], list[str]]:
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise InputError(f"data file {path} needs pyarrow: pip install 'certify[parquet]'; or write CSV.") from error
    try:
        table = pyarrow.parquet.read_table(pyarrow.BufferReader(raw))
    except (pyarrow.ArrowException, OSError) as error:
        raise InputError(f"data file {path} is no parquet file: {str(error).splitlines()[0]:.200}") from error
    places = [f"row {number}" for number in range(1, table.num_rows + 1)]
    return list(table.column_names), [column.to_pylist() for column in table.columns], places


def _npz(raw: bytes, path: Path, states: Sequence[str], inputs: Sequence[str]) -> Table:
    try:
        with np.load(io.BytesIO(raw), allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise InputError(f"data file {path} is no npz file of numbers: {error}.") from error
    if arrays and all(array.ndim == 1 for array in arrays.values()):
        found: Columns = arrays, (), [f"row {k}" for k in range(max(map(len, arrays.values())))]
    elif "states" in arrays:
        found = _runs(arrays, path, states, inputs)
    else:
        found = _rows(arrays, path, states, inputs)
    columns, acting, places = found
    for name, column in columns.items():
        _require_numbers(column, (None,), f"data file {path}, array {name}")
    counts = {name: len(column) for name, column in columns.items()}
    if {*counts.values()} != {len(places)} or not places:
        raise InputError(f"data file {path}: arrays must have as many rows, 1 at least; found {counts}.")
    return Table(path, {name: column.tolist() for name, column in columns.items()}, places, _hash(raw), acting)


Columns = tuple[dict[str, NDArray[Any]], tuple[str, ...], list[str]]
"""Columns by name, the names of those that are inputs, and places."""


def _runs(arrays: Mapping[str, NDArray[Any]], path: Path, states: Sequence[str], inputs: Sequence[str]) -> Columns:
    """The columns of `states` (E, T + 1, n) and `inputs` (E, T, m); the last input of a run stands at its last state
    again, where it is not read."""
    x, u = _given(arrays, ("states", "inputs"), path)
    named = _named(x, states, "x"), _named(u, inputs, "u")
    for name, array, names in zip(("states", "inputs"), (x, u), named, strict=True):
        _require_numbers(array, (None, None, len(names)), f"data file {path}, array {name}")
    if x.shape[0] != u.shape[0] or x.shape[1] != u.shape[1] + 1 or not u.size:
        raise InputError(
            f"data file {path}: states must have shape (E, T + 1, {len(named[0])}) and inputs (E, T, "
            f"{len(named[1])}); found {x.shape} and {u.shape}."
        )
    count, steps, _ = x.shape
    u = np.concatenate([u, u[:, -1:]], axis=1)
    columns = dict(zip(chain(*named), [*x.reshape(-1, x.shape[2]).T, *u.reshape(-1, u.shape[2]).T], strict=True))
    places = [f"run {e}, step {t}" for e in range(count) for t in range(steps)]
    return columns | {RUN: np.repeat(np.arange(count), steps)}, tuple(named[1]), places


def _rows(arrays: Mapping[str, NDArray[Any]], path: Path, states: Sequence[str], inputs: Sequence[str]) -> Columns:
    """The columns of `x` (N, n), `u` (N, m) and of `x_next` or `x_rate` (N, n)."""
    of_rows = [name for name in (f"x{NEXT}", f"x{RATE}") if name in arrays] or [f"x{NEXT}"]
    x, u, *more = _given(arrays, ("x", "u", *of_rows), path)
    own, acting = _named(x, states, "x"), _named(u, inputs, "u")
    columns = dict[str, NDArray[Any]]()
    for name, array, names in (
        ("x", x, own),
        ("u", u, acting),
        *((name, array, [f"{s}{name[1:]}" for s in own]) for name, array in zip(of_rows, more, strict=True)),
    ):
        _require_numbers(array, (None, len(names)), f"data file {path}, array {name}")
        columns |= dict(zip(names, array.T, strict=True))
    return columns, tuple(acting), [f"row {k}" for k in range(len(x))]


def _given(arrays: Mapping[str, NDArray[Any]], wanted: Sequence[str], path: Path) -> list[NDArray[Any]]:
    missing = [name for name in wanted if name not in arrays]
    if missing:
        raise InputError(
            f"data file {path} must have the arrays states and inputs, or x, u and x_next or x_rate, or columns by "
            f"their names; {', '.join(missing)} is missing among {', '.join(arrays) or 'none'}."
        )
    return [arrays[name] for name in wanted]


def _named(array: NDArray[Any], names: Sequence[str], letter: str) -> list[str]:
    return list(names) or [f"{letter}{k + 1}" for k in range(array.shape[-1] if array.ndim > 1 else 1)]


def _require_numbers(array: NDArray[Any], shape: tuple[int | None, ...], where: str) -> None:
    """Refuse an array of another shape or kind, or with a number that is not finite."""
    shown = tuple("any" if k is None else k for k in shape)
    if array.ndim != len(shape) or shape[-1] not in (None, array.shape[-1]):
        raise InputError(f"{where}: the shape must be {shown}; found {array.shape}.".replace("'", ""))
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        raise InputError(f"{where}: there must be numbers of at most 64 bits; found {array.dtype}.")
    odd = np.argwhere(~np.isfinite(array))
    if len(odd):
        raise InputError(f"{where}: numbers must be finite; found {array[tuple(odd[0])]} at {odd[0].tolist()}.")
