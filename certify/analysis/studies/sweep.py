"""The sweep: cases that are done are kept, missing ones are done, and the table is written however it ends.

A case is done once its row lies in its folder and its facts are found out again. Rows are written one by one, so that
a sweep that is interrupted, is killed, or loses its cluster resumes where it was; a case whose run could not even be
tried is tried again.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from certify.analysis.studies.case import Case
from certify.analysis.studies.judging import forget, judged, kept
from certify.analysis.studies.rows import Row, failed
from certify.analysis.studies.study import Study
from certify.analysis.studies.tables import write_tables
from certify.analysis.studies.work import answer_in, work
from certify.certificates import sole_writer
from certify.certificates.verdict import Verdict
from certify.errors import BackendError, InputError, SoundnessError
from certify.provers.execution.tasks import Outcome, Piece, Place, Processes

SCHEMA = "certify-sweep/1"
Watch = Callable[[Row, int, int], None]


@dataclass(frozen=True, slots=True)
class Sweep:
    """The result of a sweep: a row for each case that is done, in the study's order.

    Parameters
    ----------
    cases : the number of all.
    kept : the number of those done before.
    files : the table, by kind (`csv`, `parquet`, `html`).
    seconds : the time that this run took.
    """

    study: Study
    rows: tuple[Row, ...]
    cases: int
    kept: int
    files: dict[str, Path]
    seconds: float

    @property
    def verdicts(self) -> dict[str, int]:
        """The number of cases with each verdict."""
        found = Counter(row.verdict for row in self.rows)
        return {verdict.value: found[verdict] for verdict in Verdict}

    @property
    def errors(self) -> int:
        """The number of cases that could not be run; their verdict is UNKNOWN."""
        return sum(row.failed for row in self.rows)

    @property
    def exit_status(self) -> int:
        """1 if a case is REFUTED, 0 if all are PROVED, else 3."""
        found = self.verdicts
        if found["REFUTED"]:
            return Verdict.REFUTED.exit_status
        return Verdict.PROVED.exit_status if found["PROVED"] == self.cases else Verdict.UNKNOWN.exit_status

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "schema": SCHEMA,
            "study": self.study.name,
            "cases": self.cases,
            "done": len(self.rows),
            "kept": self.kept,
            "verdicts": self.verdicts,
            "errors": self.errors,
            "seconds": self.seconds,
            "files": {kind: str(path) for kind, path in self.files.items()},
            "rows": [row.to_dict() for row in self.rows],
        }


def run_sweep(study: Study, out: Path, place: Place, watch: Watch = lambda row, done, cases: None) -> Sweep:
    """Do the cases of a study that are not done, and write the table.

    Parameters
    ----------
    out : folder of the table and of `cases/NAME/`, with a case's certificate and row; made if it is not there.
    place : where the work is done.
    watch : called for each case that was done, with how many are, and of how many.

    Raises
    ------
    InputError : the folder cannot be written, or is another run's.
    BackendError : the place is gone; the table is written all the same.
    SoundnessError : two rigorous results contradict each other; the table is written all the same.
    """
    start, cases = time.perf_counter(), study.cases()
    with sole_writer(out):
        rows, before, files = dict[str, Row](), 0, dict[str, Path]()
        try:
            for row in _kept(cases, out):
                rows[row.case] = row
            before = len(rows)
            for case in cases:
                if case.name not in rows:
                    forget(out, case)
            for row in _done([case for case in cases if case.name not in rows], out, place):
                rows[row.case] = row
                watch(row, len(rows), len(cases))
        finally:
            found = tuple(rows[case.name] for case in cases if case.name in rows)
            files = write_tables(study, found, len(cases), out)
        return Sweep(study, found, len(cases), before, files, time.perf_counter() - start)


def _kept(cases: Sequence[Case], out: Path) -> Iterator[Row]:
    """The rows of cases that are done, each as soon as it is found out again; several checkers run at a time."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as checks:
        waiting = [checks.submit(kept, out, case) for case in cases]
        try:
            yield from (row for future in waiting if (row := future.result()) is not None)
        except BaseException:
            checks.shutdown(cancel_futures=True)
            raise


def _done(cases: Sequence[Case], out: Path, place: Place) -> Iterator[Row]:
    """The rows of cases, as they are done. A refutation by somebody else's worker is tried again here: unlike a proof,
    it comes without anything that could be checked."""
    own, again = _is_own(place), list[Case]()
    for case, row in _judged(cases, out, place, own):
        if not own and row.verdict is Verdict.REFUTED:
            again.append(case)
            continue
        row.write(out)
        yield row
    for _, row in _judged(again, out, Processes(1), True):
        row.write(out)
        yield row


def _is_own(place: Place) -> bool:
    """True if this program does the work there, on this machine."""
    return isinstance(place, Processes)


def _judged(cases: Sequence[Case], out: Path, place: Place, own: bool) -> Iterator[tuple[Case, Row]]:
    """Cases with their rows. Checkers run beside each other, and beside the work: it is not to wait for them."""
    named = {case.name: case for case in cases}
    waiting: set[Future[tuple[Case, Row]]] = set()
    most = os.cpu_count() or 1
    pieces = (Piece(case.name, work, (case,)) for case in cases)
    with ThreadPoolExecutor(most) as checks, closing(place.run(pieces)) as outcomes:
        try:
            for outcome in outcomes:
                if outcome is not None:
                    waiting.add(checks.submit(_row, named[outcome.key], outcome, out, own))
                yield from _taken(waiting, None if len(waiting) > 2 * most else 0.0)
            while waiting:
                yield from _taken(waiting, None)
        except (KeyboardInterrupt, BackendError, SoundnessError):
            found = [future.result() for future in waiting if future.exception() is None]  # came before the end
            yield from ((case, row) for case, row in found if not row.failed)  # a checker may have ended with the rest
            raise


def _taken(waiting: set[Future[tuple[Case, Row]]], patience: float | None) -> Iterator[tuple[Case, Row]]:
    """Take finished futures out of `waiting`, after `patience` seconds at most."""
    done, _ = wait(waiting, patience, FIRST_COMPLETED)
    for future in done:
        waiting.remove(future)
        yield future.result()


def _row(case: Case, outcome: Outcome, out: Path, own: bool) -> tuple[Case, Row]:
    if outcome.result is None:
        return case, failed(case, outcome.reason)
    try:
        answer = answer_in(outcome.result)
    except InputError as error:
        return case, failed(case, str(error))
    return case, judged(case, answer, out, own=own)
