"""A practical claim in many states: the largest candidate and what lies between it and the one that is proved first."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

import certify.analysis.stages.candidate
import certify.provers.boxes.engine
from certify.analysis.options import RoaOptions
from certify.analysis.results import RoaResult
from certify.analysis.run import certify_roa
from certify.certificates.claims import Problem
from certify.effort import UNIT, Effort
from certify.loop.closed_loop import ClosedLoop
from certify.lyapunov import choose_candidate, diagonalising_coordinates
from certify.lyapunov.function import Quadratic
from certify.provers.base import Budget, Proof, Task
from certify.provers.boxes.engine import BoundsEngine
from certify.provers.execution import ThreadRunner
from tests.support.loops import chain, springs


def run(folder: Path) -> RoaResult:
    return certify_roa(*springs("0.1"), folder, RoaOptions(effort=0.05))


def test_a_blend_wins_where_the_largest_candidate_proves_nothing(tmp_path: Path) -> None:
    """Nor does the one that is made for the floor prove half as much."""
    found = run(tmp_path)
    assert found.verdict == "PROVED" and found.candidate is not None and " of peak" in found.candidate
    proved = {one.candidate: one.proved_volume for one in found.tried}
    assert proved["optimised"] is None
    assert found.volume is not None and found.volume > 2 * (proved["peak"] or 0.0) > 0


@pytest.mark.slow
def test_a_blend_does_not_win_by_a_weaker_claim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If all converge in the set that is proved first, a larger one in which that is not shown counts for nothing."""
    answers = iter([True])

    def asked(problem: Problem, proof: Proof, path: Path) -> bool:
        return next(answers, False)

    monkeypatch.setattr(certify.analysis.stages.candidate, "is_nearby", asked)
    found = run(tmp_path)
    assert found.candidate == "peak" and "the claim `practical` would have it" in (found.notice or "")


@pytest.mark.parametrize(("needed", "margins"), [(0.01, [0.02]), (0.03, [0.02, 0.0316, 0.0251, 0.0282]), (1.0, [])])
def test_a_margin_is_lowered_as_far_as_all_within_reach_is_proved(needed: float, margins: list[float]) -> None:
    """The least one first, then between one that is too small and one that is not; nothing where less is proved."""
    asked = list[float]()

    class Choice(certify.analysis.stages.candidate._Choice):
        def _made(self, make: Any, share: float = 0.0) -> Any:
            asked.extend(make.keywords["decays"])
            return SimpleNamespace(name="optimised", task=SimpleNamespace(target=1.0))

        def _enter_alone(self, trial: Any, share: float = 0.0) -> Any:
            self.effort.spent += UNIT
            level = 1.0 if asked[-1] >= needed else 0.5
            return SimpleNamespace(trial=trial, attempt=SimpleNamespace(level=level))

    sure: Any = SimpleNamespace(name="optimised", task=SimpleNamespace(target=1.0))
    best = SimpleNamespace(trial=sure, attempt=SimpleNamespace(level=0.5 if needed > 0.1 else 1.0))
    state: Any = SimpleNamespace(converging=False, loop=None)
    tools: Any = SimpleNamespace(whole=4 * UNIT)
    Choice(state, tools, Effort(4.0 * UNIT), cast(Any, SimpleNamespace(best=best)))._tighten(sure)
    assert asked == pytest.approx(margins, abs=1e-4)


@pytest.mark.parametrize(("n", "share"), [(3, 0.25), (4, 0.5)])
def test_the_ball_has_the_heat_of_the_leaves_where_none_follow(
    monkeypatch: pytest.MonkeyPatch, n: int, share: float
) -> None:
    """Half of its heat is for the ball, of which in few states half is kept for a proof by leaves alone."""
    granted = list[float]()

    def band(*_: object, effort: Effort, **__: object) -> None:
        granted.append(effort.left)

    monkeypatch.setattr(certify.provers.boxes.engine, "prove_band", band)
    loop = ClosedLoop(*chain(n, [-1.0, -2.0, -3.0, -4.0][:n]))
    P = choose_candidate(loop, "lyapunov").P
    T = diagonalising_coordinates(P, loop.mean_rate(), loop.step)
    task = Task(Problem(loop, Quadratic(P)), "practical", 0.1)
    BoundsEngine(T, ThreadRunner()).prove(task, Budget(Effort(UNIT), boxes=1))
    assert granted == [share * UNIT]
