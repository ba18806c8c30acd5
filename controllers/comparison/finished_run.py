"""A training run followed to its floor: evaluated as it goes, ended by a stated rule, resumable to the bit.

A comparison with a baseline that was not trained to its end proves nothing, and nobody knows beforehand how many steps
its end takes. So a run is evaluated every so many steps, and the rule follows from these evaluations alone: where
neither floor nor cost has become better by a share for so many evaluations in a row, or the budget is spent, the
learning rate falls to zero over a further share of the steps, as ours does at its end, and the run is over. An
evaluation most of whose trajectories leave the domain is none of these: such a policy has no floor yet, and its run
continues. The policy of a run is that of the evaluation with the smallest floor, the choice that is kindest to it. A
run of a fixed number of steps is evaluated alike and ends with the policy it has.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol, get_args

from certify.certificates import write_atomically
from certify.errors import InputError, OptionError
from controllers.comparison.learning_curve import CurvePoint, Measurement, best, curve_csv, read_curve
from controllers.comparison.run_files import CHECKPOINT, CURVE, ENDED
from controllers.comparison.stopping import Fixed, Plan, Stopping, Why
from controllers.storage import make_folder, read


class Learner(Protocol):
    """A run of any algorithm on any plant."""

    @property
    def steps_done(self) -> int:
        """Environment steps so far."""

    @property
    def closing(self) -> tuple[int, int] | None:
        """The two steps of `close`; None before it."""

    def advance(self, steps: int, tell: Callable[[int], None]) -> None:
        """Take steps until at least so many are made in all; `tell` gets the number after each."""

    def close(self, begin: int, end: int) -> None:
        """Let the learning rate fall linearly to zero between these two steps."""

    def keep(self, folder: Path) -> None:
        """Write the files that hold the policy as it is."""

    def snapshot(self) -> bytes:
        """The bytes of a checkpoint, with everything that the rest of the run depends on."""

    def restore(self, checkpoint: bytes) -> None:
        """Continue from `snapshot()`; raises InputError if it is of another run."""


@dataclass(frozen=True, slots=True)
class FinishedRun:
    """A run that is over.

    Parameters
    ----------
    rows : its evaluations.
    why : the reason of its end.
    kept : the step of the policy that was kept.
    """

    rows: tuple[CurvePoint, ...]
    why: Why
    kept: int

    @property
    def steps(self) -> int:
        """Steps that were made in all."""
        return self.rows[-1].step


def follow(
    learner: Learner,
    plan: Plan,
    folder: Path,
    measure: Callable[[], Measurement],
    tell: Callable[[int], None] = lambda done: None,
) -> FinishedRun:
    """Take a run to its end, from the checkpoint in `folder` if one is there.

    Parameters
    ----------
    measure : evaluates the learner's policy as it is; draws none of its random numbers.
    tell : gets the number of steps that are done, after each.

    Raises
    ------
    InputError : the checkpoint or the curve is damaged, of another run or by another plan, or the folder cannot be
        written.
    """
    make_folder(folder)
    rows = list[CurvePoint]()
    if (folder / CHECKPOINT).is_file():
        learner.restore(read(folder / CHECKPOINT))
        if (folder / CURVE).is_file():  # its last row may be of a step after the checkpoint, and is made again
            rows = [row for row in read_curve(folder / CURVE) if row.step <= learner.steps_done]
        _require_same_plan(plan, rows, learner, folder)
    else:  # from here on the folder says that a run is under way in it
        write_atomically(folder / CHECKPOINT, learner.snapshot())
    wall, cpu = (rows[-1].wall, rows[-1].cpu) if rows else (0.0, 0.0)
    began = time.perf_counter(), time.process_time()
    while (last := _next(plan, rows, learner)) > learner.steps_done:
        learner.advance(last, tell)
        found = measure()
        spent = wall + time.perf_counter() - began[0], cpu + time.process_time() - began[1]
        rows.append(CurvePoint(learner.steps_done, found.floor, found.cost, found.left_domain, found.states, *spent))
        if isinstance(plan, Fixed) or best(rows) is rows[-1]:
            learner.keep(folder)
        write_atomically(folder / CURVE, curve_csv(rows))
        write_atomically(folder / CHECKPOINT, learner.snapshot())
    turn = plan.turn(rows) if isinstance(plan, Stopping) else None
    why: Why = "steps" if turn is None else turn[1]
    finished = FinishedRun(tuple(rows), why, rows[-1].step if isinstance(plan, Fixed) else best(rows).step)
    record = {"plan": plan_record(plan), "why": finished.why, "kept": finished.kept, "steps": finished.steps}
    write_atomically(folder / ENDED, (json.dumps(record, indent=1) + "\n").encode())
    (folder / CHECKPOINT).unlink(missing_ok=True)
    return finished


def read_finished_run(folder: Path, plan: Plan) -> FinishedRun | None:
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
    mine = plan_record(plan)
    if theirs != mine:
        name = next(name for name in (*mine, *theirs) if mine.get(name) != theirs.get(name))
        raise OptionError(
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
    return FinishedRun(tuple(rows), why, kept)


def _next(plan: Plan, rows: Sequence[CurvePoint], learner: Learner) -> int:
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


def _require_same_plan(plan: Plan, rows: Sequence[CurvePoint], learner: Learner, folder: Path) -> None:
    """Refuse a checkpoint that this plan would not have led to: another patience would end a run in its past.

    Raises
    ------
    InputError : the rule lacks an evaluation, or would have closed the run elsewhere.
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
            f"{_phase(learner.closing)}, and by this plan {_phase(expected)}. Resume it by its plan, or use another "
            "folder of runs."
        )


def _phase(closing: tuple[int, int] | None) -> str:
    return "not begun" if closing is None else f"that from {closing[0]} to {closing[1]}"


def plan_record(plan: Plan) -> dict[str, Any]:
    """A plan as plain values."""
    return {"kind": "to the floor" if isinstance(plan, Stopping) else "fixed", **asdict(plan)}
