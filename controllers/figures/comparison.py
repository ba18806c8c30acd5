"""The figures and the table of a comparison, written into a folder."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import astuple, fields, replace
from pathlib import Path
from typing import Any

from certify.certificates import write_atomically
from controllers.comparison.comparison import Comparison
from controllers.comparison.table import Row
from controllers.figures.cost_and_norm import draw_over_time
from controllers.figures.learning_curves import draw_curves
from controllers.figures.paths import draw_space
from controllers.figures.positions import draw_positions
from controllers.figures.states import draw_states


def write_comparison(comparison: Comparison, out: Path) -> dict[str, Any]:
    """Write the figures as PNG, and the table as CSV and JSON; the table and the names of the files as plain values.

    Raises
    ------
    InputError : a file cannot be written.
    """
    drawings = _drawings(comparison)
    ablations = {method.run for method in comparison.options.methods} & {"before", "uncentred"}
    stem = comparison.system.name + ("-ablations" if ablations else "")
    result: dict[str, Any] = comparison.as_json()
    result["files"] = {name: str(out / f"{stem}-{name}.png") for name in drawings}
    for name, content in drawings.items():
        write_atomically(out / f"{stem}-{name}.png", content)
    for kind, content in (("csv", _csv(comparison.rows)), ("json", (json.dumps(result, indent=1) + "\n").encode())):
        write_atomically(out / f"{stem}-table.{kind}", content)
        result["files"][kind] = str(out / f"{stem}-table.{kind}")
    return result


def _drawings(comparison: Comparison) -> dict[str, bytes]:
    """The figures by their names."""
    system, dt, responses = comparison.system, comparison.dt, comparison.responses
    drawings = {
        "cost": draw_over_time("cost", system, dt, responses, comparison.rows),
        "norm": draw_over_time("norm", system, dt, responses, comparison.rows),
        "positions": draw_positions(system, dt, responses),
        "states": draw_states(system, dt, responses),
        "curves": draw_curves(system, [(one.run, one.training.seed, done.rows) for one, done in comparison.runs]),
    }
    space = draw_space(system, dt, responses)
    return drawings if space is None else {**drawings, "space": space}


def _csv(rows: Sequence[Row]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(Row)])
    for row in rows:
        writer.writerow(astuple(replace(row, seed="all") if row.seed is None else row))  # type: ignore[arg-type]
    return text.getvalue().encode()
