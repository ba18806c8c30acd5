"""The table of a sweep: CSV for everybody, Parquet for programs, and a page for people.

A column is an entry of the study, by its key, or a field of a row. Numbers that were swept are numbers in both files,
rounded to the nearest double; a case's `row.json` has them exactly.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from certify.analysis.studies.page import page_of
from certify.analysis.studies.rows import Row
from certify.analysis.studies.study import Axis, Study
from certify.certificates import write_atomically
from certify.loop.plants import exact

_TEXTS = ("verdict", "claim", "candidate", "volume_unit", "stop", "reason", "certificate", "certificate_sha256")
_TEXTS_LAST = ("checked", "notice", "error")
_LEVELS = ("local", "floor", "roa", "sampled_limit", "domain_limit")


def write_tables(study: Study, rows: Sequence[Row], cases: int, out: Path) -> dict[str, Path]:
    """Write the table of the rows that there are, of so many cases; the files by their kind.

    Without pyarrow there is no Parquet file, and one of an earlier run does not stay.

    Raises
    ------
    InputError : a file cannot be written.
    """
    columns = {name: [flat(row, study.axes)[name] for row in rows] for name in names(study.axes)}
    contents = {
        "csv": _csv(columns),
        "parquet": _parquet(columns, study.axes),
        "html": page_of(study, rows, cases).encode(),
    }
    files = {kind: out / f"sweep.{kind}" for kind in contents}
    for kind, content in contents.items():
        if content is None:
            files.pop(kind).unlink(missing_ok=True)
        else:
            write_atomically(files[kind], content)
    return files


def names(axes: Sequence[Axis]) -> list[str]:
    """The columns, in their order."""
    measured = ["volume", *(f"level_{name}" for name in _LEVELS), "semi_axes", "extents", "states"]
    work = ["boxes", "leaves", "seconds"]
    found = ["case", *(axis.key for axis in axes), *_TEXTS[:3], measured[0], _TEXTS[3], *measured[1:], *work]
    return [*found, *_TEXTS[4:], *_TEXTS_LAST]


def flat(row: Row, axes: Sequence[Axis]) -> dict[str, Any]:
    """A row by its columns."""
    found: dict[str, Any] = {"case": row.case}
    for axis in axes:
        text = row.coordinates[axis.key]
        found[axis.key] = float(exact(text)) if axis.is_numeric else text
    found |= {name: getattr(row, name) for name in (*_TEXTS, *_TEXTS_LAST, "volume", "boxes", "leaves", "seconds")}
    found |= {name: list(getattr(row, name)) for name in ("semi_axes", "extents", "states")}
    found |= {f"level_{name}": getattr(row.levels, name) for name in _LEVELS}
    return found | {"verdict": row.verdict.value}


def _csv(columns: dict[str, list[Any]]) -> bytes:
    """An absent number is empty; a list is one of JSON."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    for cells in zip(*columns.values(), strict=True):
        writer.writerow(["" if c is None else json.dumps(c) if isinstance(c, list) else c for c in cells])
    return text.getvalue().encode()


def _parquet(columns: dict[str, list[Any]], axes: Sequence[Axis]) -> bytes | None:
    """The same with types; None without pyarrow."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        return None
    numbers = {axis.key for axis in axes if axis.is_numeric} | {"volume", "seconds", *(f"level_{n}" for n in _LEVELS)}
    kinds = dict.fromkeys(columns, pyarrow.string()) | dict.fromkeys(numbers, pyarrow.float64())
    kinds |= dict.fromkeys(("boxes", "leaves"), pyarrow.int64())
    kinds |= dict.fromkeys(("semi_axes", "extents"), pyarrow.list_(pyarrow.float64()))
    kinds |= {"states": pyarrow.list_(pyarrow.string())}
    table = pyarrow.table(columns, schema=pyarrow.schema([(name, kinds[name]) for name in columns]))
    buffer = io.BytesIO()
    pyarrow.parquet.write_table(table, buffer)
    return buffer.getvalue()
