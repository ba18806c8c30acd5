"""The page of a sweep: verdicts at a glance, the figures, and a table that can be sorted; nothing is loaded from afar.

The one script stands in the page and only sorts: without it the table is the same, in the study's order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from certify.analysis.studies.figures import draw, label_of, word_of
from certify.analysis.studies.rows import Row
from certify.analysis.studies.study import Study
from certify.loop.plants import exact
from certify.report.sheet import filled
from certify.report.words import ABSENT, below, number, seconds, volume_name

_SIGNS = {"proved": "✓", "trusted": "T", "refuted": "✗", "unknown": "?", "error": "!"}


@dataclass(frozen=True, slots=True)
class Cell:
    """A cell of the table: its text, by what it is sorted, and where it leads."""

    text: str
    key: str | float = ""
    link: str = ""
    kind: str = ""


def page_of(study: Study, rows: Sequence[Row], cases: int) -> str:
    """The page about the rows that there are, of so many cases."""
    drawn = draw(study.varied, rows)
    units = {name: unit for row in rows for name, unit in row.units.items()}
    sizes = {volume_name(len(row.states)) for row in rows if row.states}
    size = sizes.pop() if len(sizes) == 1 else "volume"
    varied = study.varied or study.axes[:1]
    one_unit = {row.volume_unit for row in rows if row.volume is not None}
    unit = one_unit.pop() if len(one_unit) == 1 else ""
    counts = Counter(map(word_of, rows))
    return filled(
        "certify.analysis.studies",
        "sweep.html",
        one_plane=False,
        name=study.name,
        cases=cases,
        done=len(rows),
        counts=[(_SIGNS[word], counts[word], word) for word in _SIGNS if counts[word]],
        all_proved=counts["proved"] == cases,
        refuted=counts["refuted"],
        shared=[
            (label_of(axis.key, units), axis.values[0]) for axis in study.axes if axis not in varied
        ],
        pictures=drawn.pictures,
        left_out=drawn.left_out,
        heads=[
            *((label_of(axis.key, units), axis.is_numeric) for axis in varied),
            ("verdict", False),
            (f"{size} ({unit})" if unit else size, True),
            ("c₂", True),
            ("claim", False),
            ("P from", False),
            ("limited by, or why not", False),
            ("boxes", True),
            ("leaves", True),
            ("time", True),
            ("certificate", False),
        ],
        rows=[_cells(row, [(axis.key, axis.is_numeric) for axis in varied]) for row in rows],
        errors=[(row.case, row.error) for row in rows if row.failed],
    )  # fmt: skip


def _cells(row: Row, varied: Sequence[tuple[str, bool]]) -> list[Cell]:
    word = word_of(row)
    where = [
        Cell(text := row.coordinates[key], float(exact(text)) if numeric else text, kind="num" if numeric else "")
        for key, numeric in varied
    ]
    return [
        *where,
        Cell(f"{_SIGNS[word]} {word.upper()}", word, kind=word),
        _number(row.volume),
        _number(row.levels.roa),
        Cell(row.claim or ABSENT, row.claim or ""),
        Cell(row.candidate or ABSENT, row.candidate or ""),
        Cell(row.error or row.reason, row.reason),
        Cell(number(float(row.boxes)), row.boxes, kind="num"),
        Cell(number(float(row.leaves)), row.leaves, kind="num"),
        Cell(seconds(row.seconds), _or_least(row.seconds), kind="num"),
        Cell(ABSENT) if row.certificate is None else Cell(row.checked or "", row.checked or "", row.certificate),
    ]


def _number(value: float | None) -> Cell:
    return Cell(ABSENT if value is None else below(value), _or_least(value), kind="num")


def _or_least(value: Any) -> float:
    """A number to sort by; an absent value comes before all numbers."""
    return -1.0 if value is None else float(value)
