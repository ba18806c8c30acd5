"""A training run followed to its floor: evaluated as it goes, ended by a stated rule, resumable to the bit.

A comparison with a baseline that was not trained to its end proves nothing, and nobody knows beforehand how many steps
its end takes. So a run is evaluated every so many steps, and the rule is a function of these evaluations alone: where
neither floor nor cost has become better by a share for so many evaluations in a row, or the budget is spent, the
learning rate falls to zero over a further share of the steps, as ours does at its end, and the run is over. An
evaluation most of whose trajectories leave the domain is none of these: such a policy has no floor yet, and its run
goes on. The policy of a run is that of the evaluation with the smallest floor, the choice that is kindest to it. A run
of a fixed number of steps is evaluated alike and ends with the policy it has.

In a run's folder lie `curve.csv`, a row an evaluation; from its beginning until it is over `checkpoint.pt`, then
`course.json`, which says why it ended; and from the first evaluation on the files of the policy that is kept.
"""

from __future__ import annotations

import csv
import io
import json
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

from certify.errors import InputError
from controllers.files import make_folder, read, write_atomically

CURVE, CHECKPOINT, ENDED = "curve.csv", "checkpoint.pt", "course.json"

Why = Literal["no improvement", "budget", "steps"]


class Learner(Protocol):
    """What can be followed: a run of any algorithm on any plant."""

    @property
    def steps_done(self) -> int:
        """Environment steps so far."""

    @property
    def closing(self) -> tuple[int, int] | None:
        """The two steps of `close`; None before it."""

    def advance(self, steps: int, tell: Callable[[int], None]) -> None:
        """Go on until at least so many steps are made in all; `tell` is told the number after each."""

    def close(self, begin: int, end: int) -> None:
        """Let the learning rate fall linearly to zero between these two steps."""

    def keep(self, folder: Path) -> None:
        """Write the files that hold the policy as it is."""

    def snapshot(self) -> bytes:
        """Everything that the rest of the run depends on."""

    def restore(self, checkpoint: bytes) -> None:
        """Go on from `snapshot()`; raises InputError if it is of another run."""


@dataclass(frozen=True, slots=True)
class Judged:
    """What an evaluation finds: `floor`, the median over states of the largest ||x|| in the last second under held mean
    actions; `cost`, the median accumulated cost; from how many states, and how many trajectories left the domain."""

    floor: float
    cost: float
    left_domain: int
    states: int


@dataclass(frozen=True, slots=True)
class Evaluated:
    """A row of the curve: what was found after `step` steps, and seconds of wall and processor time until then, with
    those of the evaluations."""

    step: int
    floor: float
    cost: float
    left_domain: int
    states: int
    wall: float
    cpu: float

    @property
    def lost(self) -> bool:
        """Whether most trajectories left the domain."""
        return 2 * self.left_domain > self.states


@dataclass(frozen=True, slots=True, kw_only=True)
class Stopping:
    """When a run has reached its floor.

    Parameters
    ----------
    budget : steps after which it ends whatever it does, before the closing phase.
    every : steps between evaluations.
    patience : evaluations in a row without an improvement that end it, those not counted that are lost.
    share : by which floor or cost has to fall below its smallest value so far to count as an improvement.
    closing : share of the steps made so far that the closing phase takes.
    """

    budget: int
    every: int
    patience: int = 8
    share: float = 0.05
    closing: float = 0.2

    def __post_init__(self) -> None:
        for name in ("budget", "every", "patience"):
            if getattr(self, name) < 1:
                raise InputError(f"`{name}` must be at least 1; found {getattr(self, name)}.")
        for name in ("share", "closing"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"`{name}` must be in [0, 1); found {getattr(self, name)}.")

    def turn(self, rows: Sequence[Evaluated]) -> tuple[int, Why] | None:
        """The step after which learning ends, and why; None while it goes on."""
        floor = cost = math.inf
        since, first = 0, True
        for row in rows:
            if not row.lost:
                better = first or row.floor < (1 - self.share) * floor or row.cost < (1 - self.share) * cost
                since, first = 0 if better else since + 1, False
                floor, cost = min(floor, row.floor), min(cost, row.cost)
            if row.step >= self.budget:
                return row.step, "budget"
            if since >= self.patience:
                return row.step, "no improvement"
        return None

    def end(self, rows: Sequence[Evaluated]) -> tuple[int, int] | None:
        """First and last step of the closing phase; None while the run learns."""
        turn = self.turn(rows)
        return None if turn is None else (turn[0], turn[0] + round(self.closing * turn[0]))


@dataclass(frozen=True, slots=True, kw_only=True)
class Fixed:
    """A run of a fixed number of steps, evaluated every so many."""

    steps: int
    every: int

    def __post_init__(self) -> None:
        for name in ("steps", "every"):
            if getattr(self, name) < 1:
                raise InputError(f"`{name}` must be at least 1; found {getattr(self, name)}.")


Plan = Stopping | Fixed


@dataclass(frozen=True, slots=True)
class Course:
    """A run that is over.

    Parameters
    ----------
    rows : its evaluations.
    why : what ended it.
    kept : the step of the policy that was kept.
    """

    rows: tuple[Evaluated, ...]
    why: Why
    kept: int

    @property
    def steps(self) -> int:
        """Steps that were made in all."""
        return self.rows[-1].step


def best(rows: Sequence[Evaluated]) -> Evaluated:
    """The evaluation with the smallest floor, of equal ones that with the smallest cost, then the first; one that is
    lost only where all are."""
    return min(rows, key=lambda row: (row.lost, *(math.inf if math.isnan(v) else v for v in (row.floor, row.cost))))


def follow(
    learner: Learner,
    plan: Plan,
    folder: Path,
    judge: Callable[[], Judged],
    tell: Callable[[int], None] = lambda done: None,
) -> Course:
    """Take a run to its end, from the checkpoint in `folder` if one is there.

    Parameters
    ----------
    judge : evaluates the learner's policy as it is; draws none of its random numbers.
    tell : told of the number of steps that are done, after each.

    Raises
    ------
    InputError : the checkpoint or the curve is damaged, of another run or by another plan, or the folder cannot be
        written.
    """
    make_folder(folder)
    rows = list[Evaluated]()
    if (folder / CHECKPOINT).is_file():
        learner.restore(read(folder / CHECKPOINT))
        if (folder / CURVE).is_file():  # its last row may be of a step after the checkpoint, and is made again
            rows = [row for row in read_curve(folder / CURVE) if row.step <= learner.steps_done]
        _require_same_course(plan, rows, learner, folder)
    else:  # from here on the folder says that a run is under way in it
        write_atomically(folder / CHECKPOINT, learner.snapshot())
    wall, cpu = (rows[-1].wall, rows[-1].cpu) if rows else (0.0, 0.0)
    began = time.perf_counter(), time.process_time()
    while (last := _next(plan, rows, learner)) > learner.steps_done:
        learner.advance(last, tell)
        found = judge()
        spent = wall + time.perf_counter() - began[0], cpu + time.process_time() - began[1]
        rows.append(Evaluated(learner.steps_done, found.floor, found.cost, found.left_domain, found.states, *spent))
        if isinstance(plan, Fixed) or best(rows) is rows[-1]:
            learner.keep(folder)
        write_atomically(folder / CURVE, _table(rows))
        write_atomically(folder / CHECKPOINT, learner.snapshot())
    turn = plan.turn(rows) if isinstance(plan, Stopping) else None
    why: Why = "steps" if turn is None else turn[1]
    course = Course(tuple(rows), why, rows[-1].step if isinstance(plan, Fixed) else best(rows).step)
    record = {"plan": _plan(plan), "why": course.why, "kept": course.kept, "steps": course.steps}
    write_atomically(folder / ENDED, (json.dumps(record, indent=1) + "\n").encode())
    (folder / CHECKPOINT).unlink(missing_ok=True)
    return course


def read_course(folder: Path, plan: Plan) -> Course | None:
    """The run in `folder`, if it is over.

    Raises
    ------
    InputError : it went by another plan, or its files are damaged.
    """
    path = folder / ENDED
    if not path.is_file():
        return None
    try:
        record = json.loads(read(path))
        theirs, why = dict(record["plan"]), record["why"]
        kept, steps = int(record["kept"]), int(record["steps"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} is damaged: {error}.") from error
    mine = _plan(plan)
    if theirs != mine:
        name = next(name for name in (*mine, *theirs) if mine.get(name) != theirs.get(name))
        raise InputError(
            f"{folder} is a run by another plan: its `{name}` is {theirs.get(name)}, and {mine.get(name)} is asked "
            "for. Compare by its plan, or in another folder of runs."
        )
    rows = read_curve(folder / CURVE)
    if not rows:
        raise InputError(f"{folder / CURVE} must have a row; it has none.")
    if why not in get_args(Why) or rows[-1].step != steps or kept not in {row.step for row in rows}:
        raise InputError(
            f"{path} must be of the run of {CURVE} beside it; it says that the policy after {kept} of {steps} steps "
            f"was kept, and the curve ends after {rows[-1].step}. Move the folder away, and the run is made again."
        )
    return Course(tuple(rows), why, kept)


def read_curve(path: Path) -> list[Evaluated]:
    """The evaluations of a run, from its `curve.csv`.

    Raises
    ------
    InputError : there is no such file, or it is damaged.
    """
    try:
        table = list(csv.DictReader(io.StringIO(read(path).decode())))
        return [
            Evaluated(
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


def _next(plan: Plan, rows: Sequence[Evaluated], learner: Learner) -> int:
    """The step of the next evaluation; none is left once the learner is there."""
    done = learner.steps_done
    following = (done // plan.every + 1) * plan.every
    if isinstance(plan, Fixed):
        return min(following, plan.steps)
    end = plan.end(rows)
    if end is None:
        return min(following, max(plan.budget, done + 1))
    learner.close(*end)
    return min(following, end[1])


def _require_same_course(plan: Plan, rows: Sequence[Evaluated], learner: Learner, folder: Path) -> None:
    """Refuse a checkpoint that this plan would not have led to: another patience would end a run in its past.

    Raises
    ------
    InputError : the rule has nothing to go by, or would have closed the run elsewhere.
    """
    expected = None
    if isinstance(plan, Stopping) and learner.steps_done:
        if not rows or rows[-1].step != learner.steps_done:
            raise InputError(
                f"{folder / CURVE} must have the evaluation after {learner.steps_done} steps, where {CHECKPOINT} "
                "stands: when the run ends follows from all of them. Move the folder away, and the run is made again."
            )
        expected = plan.end(rows[:-1])  # the last one was made on the way there
    if learner.closing != expected:
        raise InputError(
            f"{folder} is a run by another plan: after {learner.steps_done} steps its closing phase is "
            f"{_phase(learner.closing)}, and by this plan {_phase(expected)}. Go on by its plan, or in another folder "
            "of runs."
        )


def _phase(closing: tuple[int, int] | None) -> str:
    return "not begun" if closing is None else f"that from {closing[0]} to {closing[1]}"


def _plan(plan: Plan) -> dict[str, Any]:
    return {"kind": "to the floor" if isinstance(plan, Stopping) else "fixed", **asdict(plan)}


def _table(rows: Sequence[Evaluated]) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow([column.name for column in fields(Evaluated)])
    writer.writerows(astuple(row) for row in rows)
    return text.getvalue().encode()
