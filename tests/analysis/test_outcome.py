"""The limit that a proved result names."""

from __future__ import annotations

from dataclasses import replace

import pytest

from certify.analysis.facts import Levels
from certify.analysis.outcome import limited
from certify.analysis.results import RoaResult
from certify.certificates.verdict import Stop, Verdict
from certify.provers.base import Task
from tests.support.cases import case_of
from tests.support.loops import scalar_tanh


@pytest.mark.parametrize("ended", [Stop.EFFORT, Stop.TIME, Stop.BOXES, Stop.SMALL])
def test_a_search_that_ends_a_little_below_the_domain_is_limited_by_it(ended: Stop) -> None:
    case = case_of(*scalar_tanh())
    loop, task = case.loop, Task(case.problem, "asymptotic", 1.0)

    def found(level: float) -> RoaResult:
        levels = Levels(roa=level, domain_limit=1.0)
        return RoaResult(Verdict.UNKNOWN, ended, loop.system, loop.network, detail="kept", levels=levels)

    assert limited(found(1 - 3.4e-7), task).reason == "domain"
    near = limited(found(0.998), task)
    assert near.stop is Stop.DOMAIN and near.reason.endswith(" 0.2 % below its limit")
    for far in (limited(found(0.98), task), limited(found(0.998), replace(task, exactly=True))):
        assert far.stop is ended and far.detail == "kept"
