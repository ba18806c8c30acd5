"""The logs of a run: rows for episodes and for evaluations, and their CSV files."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path


@dataclass(frozen=True, slots=True)
class Episode:
    """One finished episode, a row of the log.

    `distance` is ||J_mu(0) + K||, NaN as long as there is no gain; `offset` is ||mu(0) - u_eq||.
    """

    step: int
    kind: str
    length: int
    total: float
    outcome: str
    distance: float
    offset: float


@dataclass(frozen=True, slots=True)
class Monitored:
    """The policy after `step` steps: a row of the second log.

    `distance` and `offset` are those of `Episode`, `curvature` is that of `controllers.evaluation`. `settled` is the
    share of the initial states from which the policy as it would ship settles in the sense of `MONITORING`, and
    `cost` the median of their costs; both are NaN for a plant without a box of initial states. `A_error`, `B_error`,
    `K_error` are the relative errors of `controllers.identification`; NaN as long as there is no gain.
    """

    step: int
    distance: float
    offset: float
    curvature: float
    settled: float
    cost: float
    A_error: float = math.nan  # rows of earlier checkpoints end before it
    B_error: float = math.nan
    K_error: float = math.nan


class Log:
    """Episodes or other rows of a run as CSV; a resumed run begins with those of its checkpoint.

    Parameters
    ----------
    path : file that is written anew when the log is entered as a context.
    row : the dataclass whose fields are the columns.
    """

    def __init__(self, path: Path, row: type[Episode] | type[Monitored]) -> None:
        self._path, self._row = path, row
        self._written = 0

    def __enter__(self) -> Log:
        self._file = self._path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file)
        self._writer.writerow([column.name for column in fields(self._row)])
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def extend(self, rows: Sequence[Episode] | Sequence[Monitored]) -> None:
        """Write the rows that are not written yet."""
        for row in rows[self._written :]:
            self._writer.writerow(astuple(row))
        if len(rows) > self._written:
            self._file.flush()
        self._written = len(rows)
