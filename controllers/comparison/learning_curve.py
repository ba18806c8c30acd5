"""The learning curve of a run: its evaluations, in the order of their steps."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from certify.errors import InputError
from controllers.storage import read


@dataclass(frozen=True, slots=True)
class Measurement:
    """The figures of one evaluation, under the mean action, held, from `states` initial states.

    `floor` is the median of the largest ||x|| in the last second, `cost` that of the accumulated cost, and
    `left_domain` counts trajectories.
    """

    floor: float
    cost: float
    left_domain: int
    states: int


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """A row of the curve: the figures after `step` steps, and seconds of wall and processor time until then, with those
    of the evaluations."""

    step: int
    floor: float
    cost: float
    left_domain: int
    states: int
    wall: float
    cpu: float

    @property
    def lost(self) -> bool:
        """True if most trajectories left the domain."""
        return 2 * self.left_domain > self.states


def best(rows: Sequence[CurvePoint]) -> CurvePoint:
    """The evaluation with the smallest floor, of equal ones that with the smallest cost, then the first; one that is
    lost only where all are."""
    return min(rows, key=lambda row: (row.lost, *(math.inf if math.isnan(v) else v for v in (row.floor, row.cost))))


def read_curve(path: Path) -> list[CurvePoint]:
    """The evaluations of a run, from its `curve.csv`.

    Raises
    ------
    InputError : there is no such file, or it is damaged.
    """
    try:
        table = list(csv.DictReader(io.StringIO(read(path).decode())))
        return [
            CurvePoint(
                int(row["step"]),
                float(row["floor"]),
                float(row["cost"]),
                int(row["left_domain"]),
                int(row["states"]),
                float(row["wall"]),
                float(row["cpu"]),
            )
            for row in table
        ]
    except (KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path} is no curve of a run: {error}.") from error


def curve_csv(rows: Sequence[CurvePoint]) -> bytes:
    """The rows as the bytes of `curve.csv`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(CurvePoint)])
    writer.writerows(astuple(row) for row in rows)
    return text.getvalue().encode()
