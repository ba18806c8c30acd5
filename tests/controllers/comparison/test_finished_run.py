"""Runs that are followed to their floor: the rule against curves made by hand, and resuming where it is hardest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from certify.errors import InputError
from certify.loop.plants import get_system
from controllers.comparison import learners, runs
from controllers.comparison.finished_run import FinishedRun, follow, read_finished_run
from controllers.comparison.learners import learner_of
from controllers.comparison.learning_curve import CurvePoint, Measurement, best, read_curve
from controllers.comparison.methods import Run
from controllers.comparison.stopping import Fixed, Plan, Stopping
from controllers.options import preset
from tests.support.marks import slow_after

TINY = replace(preset("pendulum"), steps=60, warm_up=20, n_A=8, n_B=8, batch=4, actor=(4, 3), critic=(5,), seed=3)
PENDULUM = get_system("pendulum")
RULE = Stopping(budget=1000, every=10, patience=3, share=0.1, closing=0.5)


def curve(floors: Sequence[float], costs: Sequence[float] | None = None) -> list[CurvePoint]:
    costs = [1.0] * len(floors) if costs is None else costs
    return [CurvePoint(10 * k, f, c, 0, 1, 0.0, 0.0) for k, (f, c) in enumerate(zip(floors, costs, strict=True), 1)]


def test_a_run_ends_after_so_many_evaluations_without_an_improvement() -> None:
    """By a share, of either figure, against the smallest so far and not against the last."""
    assert RULE.turn(curve([5.0, 4.0, 3.7, 3.65])) is None  # 3.7 and 3.65 are less than a tenth below 4
    assert RULE.turn(curve([5.0, 4.0, 3.7, 3.65, 3.61])) == (50, "no improvement")
    assert RULE.turn(curve([5.0, 4.0, 3.9, 3.8, 3.2, 3.2, 3.2])) is None
    assert RULE.turn(curve([5.0, 4.0, 9.0, 8.0, 4.1])) == (50, "no improvement")  # better than the last is not enough
    assert RULE.turn(curve([4.0] * 4, [9.0, 9.0, 8.0, 8.0])) is None  # the cost improves
    assert RULE.end(curve([4.0] * 4)) == (40, 60)


def test_what_comes_after_the_turn_does_not_move_it() -> None:
    """The closing phase's evaluations are on the curve too, and may improve."""
    assert RULE.turn(curve([4.0] * 4 + [1.0, 0.5])) == (40, "no improvement")


def test_the_budget_ends_a_run_that_still_improves_and_divergence_is_no_improvement() -> None:
    halving = curve([2.0**-k for k in range(120)])
    assert RULE.turn(halving) == (1000, "budget")
    gone = curve([math.inf] * 4, [math.inf] * 4)
    assert RULE.turn(gone) == (40, "no improvement")
    assert RULE.turn(curve([math.nan] * 4, [math.nan] * 4)) == (40, "no improvement")


def test_an_evaluation_most_of_whose_trajectories_are_lost_counts_neither_way() -> None:
    """A policy that throws most of its trajectories out has no floor yet; half of them are not most."""
    rows = curve([4.0] * 12)
    lost = [replace(row, left_domain=51, states=100) for row in rows]
    half = [replace(row, left_domain=50, states=100) for row in rows]
    assert RULE.turn(half) == (40, "no improvement")
    assert RULE.turn(lost) is None
    assert RULE.turn([*lost[:6], *rows[6:]]) == (100, "no improvement")  # the first that is not lost is the first
    assert RULE.turn([*rows[:3], *lost[3:9], *rows[9:]]) == (100, "no improvement")  # two before, the third after
    assert RULE.turn([*rows[:2], replace(lost[2], floor=1.0), *rows[3:]]) == (50, "no improvement")  # no smallest value
    assert replace(RULE, budget=60).turn(lost) == (60, "budget")
    assert best([replace(lost[0], floor=1.0), rows[1]]) == rows[1]
    assert best(lost).step == 10


def test_the_best_is_the_smallest_floor_and_no_number_is_none() -> None:
    assert best(curve([math.nan, 2.0, 1.0, 1.0], [1.0, 0.0, 5.0, 4.0])).step == 40
    assert best(curve([math.inf, math.nan])).step == 10
    assert best(curve([math.nan, math.inf])).step == 10  # both are no floor at all: the first


@pytest.mark.parametrize(
    ("change", "message"),
    [({"budget": 0}, "`budget`"), ({"patience": 0}, "`patience`"), ({"share": 1.0}, r"`share` must be in \[0, 1\)")],
)
def test_rules_that_make_no_sense_are_refused(change: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(RULE, **change)  # type: ignore[arg-type]


class Cut(Exception):
    """The machine goes down."""


def followed(run: Run, plan: Plan, folder: Path, cut_at: int = 10**9) -> FinishedRun:
    """A run whose evaluations are numbers made of its policy; it is cut off in the evaluation `cut_at`."""
    learner, count = learner_of(run, PENDULUM, TINY, plan), 0

    def judge() -> Measurement:
        nonlocal count
        count += 1
        if count == cut_at:
            raise Cut
        u = learner.trained().mean(np.array([[0.5, -1.0], [0.1, 3.0]]))
        return Measurement(float(np.abs(u[0]).sum()), float(np.abs(u[1]).sum()), 0, 1)

    return follow(learner, plan, folder, judge)


@pytest.mark.parametrize(
    ("run", "plan"),
    slow_after(
        2,
        [
            ("ours", Fixed(steps=60, every=20)),
            ("sac", Stopping(budget=40, every=20, patience=9)),
            ("sb3-sac", Stopping(budget=40, every=20, patience=9)),
            ("sb3-ppo", Stopping(budget=160, every=80, patience=9, closing=0.9)),
        ],
    ),
)
def test_a_run_that_is_cut_off_again_and_again_equals_one_that_is_not(
    tmp_path: Path, run: Run, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In its policy to the byte, through the closing phase, whatever others draw between."""
    monkeypatch.setattr(learners, "ROLLOUT", 40)
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    expected = followed(run, plan, whole)
    for number in range(len(expected.rows) - 1):
        np.random.seed(number)  # noqa: NPY002  # what stable-baselines3 draws from
        torch.manual_seed(number)
        with pytest.raises(Cut):
            followed(run, plan, parts, cut_at=2)
    found = followed(run, plan, parts)
    assert [replace(row, wall=0, cpu=0) for row in found.rows] == [replace(row, wall=0, cpu=0) for row in expected.rows]
    assert (parts / "policy.pt").read_bytes() == (whole / "policy.pt").read_bytes()
    assert (found.why, found.kept, found.steps) == (expected.why, expected.kept, expected.steps)
    assert len({row.floor for row in expected.rows}) == len(expected.rows) >= 3  # it did learn between
    assert [row.cpu for row in found.rows] == sorted(row.cpu for row in found.rows) and found.rows[0].cpu > 0
    assert not (parts / "checkpoint.pt").exists() and read_finished_run(parts, plan) == found
    if isinstance(plan, Stopping):
        assert found.why == "budget" and found.steps >= (1 + plan.closing) * plan.budget
        assert found.kept == best(found.rows).step


def test_the_learning_rate_falls_to_zero_in_the_closing_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    """In it the policy still moves, after it no more: for our trainer and for both of stable-baselines3."""
    monkeypatch.setattr(learners, "ROLLOUT", 40)
    x = np.array([[0.5, -1.0]])
    for run, (begin, end, after) in {
        "sac": (40, 60, 80),
        "sb3-sac": (40, 60, 80),
        "sb3-ppo": (40, 120, 200),
    }.items():
        learner = learner_of(run, PENDULUM, TINY, Stopping(budget=end, every=10))  # type: ignore[arg-type]
        learner.close(begin, end)
        learner.advance(begin, lambda done: None)
        before = learner.trained().mean(x)
        learner.advance(end, lambda done: None)
        closed = learner.trained().mean(x)
        learner.advance(after, lambda done: None)
        assert (before != closed).all(), run
        np.testing.assert_array_equal(learner.trained().mean(x), closed, err_msg=run)


def test_damaged_records_of_a_run_are_refused(tmp_path: Path) -> None:
    followed("ours", Fixed(steps=60, every=20), tmp_path)
    plan = Fixed(steps=60, every=20)
    for name, message in (("curve.csv", "no curve of a run"), ("course.json", "is damaged")):
        content = (tmp_path / name).read_text()
        (tmp_path / name).write_text(content.replace("2", "x").replace("step", "stop"))
        with pytest.raises(InputError, match=message):
            read_finished_run(tmp_path, plan)
        (tmp_path / name).write_text(content)
    (tmp_path / "curve.csv").write_text((tmp_path / "curve.csv").read_text().splitlines()[0])
    assert read_curve(tmp_path / "curve.csv") == []
    with pytest.raises(InputError, match="must have a row"):
        read_finished_run(tmp_path, plan)


LONG = Stopping(budget=80, every=20, patience=3, closing=0.5)


def cut_off(plan: Stopping, folder: Path, floors: Sequence[float]) -> None:
    """A run with these floors, cut off in the evaluation after them."""
    learner, told = learner_of("sac", PENDULUM, TINY, plan), iter(floors)

    def judge() -> Measurement:
        floor = next(told, None)
        if floor is None:
            raise Cut
        return Measurement(floor, 1.0, 0, 1)

    with pytest.raises(Cut):
        follow(learner, plan, folder, judge)


def test_a_run_does_not_go_on_by_a_rule_that_would_have_ended_it_before(tmp_path: Path) -> None:
    """Its closing phase would be skipped, and its record would say that there was one."""
    cut_off(LONG, tmp_path, [3.0, 3.0, 3.0])
    hasty = replace(LONG, patience=1)
    with pytest.raises(
        InputError, match=r"another plan: after 60 steps its closing phase is not begun, .* from 40 to 60"
    ):
        follow(learner_of("sac", PENDULUM, TINY, hasty), hasty, tmp_path, lambda: Measurement(1.0, 1.0, 0, 1))
    assert not (tmp_path / "course.json").exists()


def test_a_run_in_its_closing_phase_is_not_taken_for_one_that_learns(tmp_path: Path) -> None:
    hasty, patient = replace(LONG, patience=2, closing=0.9), replace(LONG, patience=9, closing=0.9)
    cut_off(hasty, tmp_path, [3.0, 3.0, 3.0, 3.0])
    with pytest.raises(InputError, match="its closing phase is that from 60 to 114, and by this plan not begun"):
        follow(learner_of("sac", PENDULUM, TINY, patient), patient, tmp_path, lambda: Measurement(1.0, 1.0, 0, 1))


def test_a_rule_that_has_not_come_to_another_answer_yet_may_change(tmp_path: Path) -> None:
    cut_off(LONG, tmp_path, [3.0, 2.0])
    patient = replace(LONG, patience=9)
    assert (
        follow(learner_of("sac", PENDULUM, TINY, patient), patient, tmp_path, lambda: Measurement(1.0, 1.0, 0, 1)).steps
        == 120
    )


def test_a_rule_without_the_curve_has_nothing_to_go_by(tmp_path: Path) -> None:
    cut_off(LONG, tmp_path, [3.0, 3.0])
    whole = (tmp_path / "curve.csv").read_text()
    for less in (None, whole[: whole.index("\n40,") + 1]):
        (tmp_path / "curve.csv").unlink() if less is None else (tmp_path / "curve.csv").write_text(less)
        with pytest.raises(InputError, match=r"curve\.csv must have the evaluation after 40 steps"):
            follow(learner_of("sac", PENDULUM, TINY, LONG), LONG, tmp_path, lambda: Measurement(1.0, 1.0, 0, 1))


@pytest.mark.parametrize("run", slow_after(2, ["ours", "sac", "sb3-sac", "sb3-ppo"]))
def test_a_run_that_ends_in_writing_its_first_files_goes_on(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy that is there without a checkpoint is somebody's; one of a run has its checkpoint from the beginning."""
    monkeypatch.setattr(learners, "ROLLOUT", 40)
    monkeypatch.setattr(learners, "measure", lambda *_: Measurement(1.0, 1.0, 0, 1))
    plan = Fixed(steps=80, every=40)
    training = replace(TINY, steps=80)
    expected = runs.obtain(run, PENDULUM, training, tmp_path / "whole", plan)
    kind = type(learner_of(run, PENDULUM, training, plan))
    keep = kind.keep

    def fail(self: object, folder: Path) -> None:
        keep(self, folder)  # type: ignore[arg-type]
        raise Cut

    monkeypatch.setattr(kind, "keep", fail)
    with pytest.raises(Cut):
        runs.obtain(run, PENDULUM, training, tmp_path / "parts", plan)
    monkeypatch.setattr(kind, "keep", keep)
    found = runs.obtain(run, PENDULUM, training, tmp_path / "parts", plan)
    x = np.array([[0.5, -1.0]])
    np.testing.assert_array_equal(found.trained.mean(x), expected.trained.mean(x))


def test_a_record_of_another_curve_is_refused(tmp_path: Path) -> None:
    """Two processes in one folder, or files moved between folders."""
    plan = Fixed(steps=60, every=20)
    followed("ours", plan, tmp_path)
    lines = (tmp_path / "curve.csv").read_text().splitlines(keepends=True)
    (tmp_path / "curve.csv").write_text("".join(lines[:-1]))
    with pytest.raises(InputError, match=r"after 60 of 60 steps was kept, and the curve ends after 40"):
        read_finished_run(tmp_path, plan)
    (tmp_path / "curve.csv").write_text("".join(lines))
    record = (tmp_path / "course.json").read_text()
    for old, new in (('"kept": 60', '"kept": 50'), ('"why": "steps"', '"why": "tired"')):
        (tmp_path / "course.json").write_text(record.replace(old, new))
        with pytest.raises(InputError, match=r"must be of the run of curve\.csv beside it"):
            read_finished_run(tmp_path, plan)
