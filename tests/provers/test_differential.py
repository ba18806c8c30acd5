"""The same conditions to every engine, dReal where it is: never PROVED or TRUSTED against REFUTED."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from certify.certificates.claims.conditions import ring_condition
from certify.certificates.claims.queries import query
from certify.errors import BackendError
from certify.loop.plants import get_system
from certify.lyapunov import domain_limit
from certify.provers.base import Budget
from certify.provers.boxes.search import prove_outwards
from certify.provers.dreal.backend import Backend, decide, find_backend
from certify.provers.execution import ThreadRunner
from certify.provers.falsify import Witness, confirm, falsify
from tests.support import codac_prover
from tests.support.cases import Case, case_of
from tests.support.loops import chain, pendulum_network, scalar_clip, scalar_tanh, tank, valve
from tests.support.marks import slow_after

INNER = 0.05  # share of the limit below which the local proof speaks, and not these engines
CASES = {
    "scalar": scalar_tanh,
    "scalar, clipped": scalar_clip,
    "tank": tank,
    "valve": valve,
    "chain": lambda: chain(2, [-1, -2]),
    "pendulum 2-6-6-1": lambda: (get_system("pendulum"), pendulum_network((6, 6), seed=1)),
    "pendulum 2-16-1": lambda: (get_system("pendulum"), pendulum_network((16,))),
    "pendulum, output": lambda: (get_system("pendulum"), pendulum_network((16,), centre="output")),
}


@cache
def claims_of(name: str) -> tuple[Case, float]:
    """A closed loop, and the smaller of the domain's limit and the lowest violation of Vdot < 0."""
    case = case_of(*CASES[name]())
    limit = domain_limit(case.P, case.loop.system.domain)
    witness = falsify(case.problem, case.T, limit)
    return case, limit if witness is None else witness.level


@cache
def dreal() -> Backend | None:
    try:
        return find_backend()
    except BackendError:
        return None


def genuine(case: Case, x: np.ndarray | None, inner: float, outer: float) -> bool:
    """Vdot >= 0 at a state of the ring, shown in Arb."""
    if x is None:
        return False
    V = float(x @ case.P @ x)
    return bool(inner <= V <= outer and confirm(case.problem, Witness(x, V, "vdot")))


def by_bounds(case: Case, inner: float, outer: float) -> str:
    witness = falsify(case.problem, case.T, outer, samples=4000)
    if witness is not None and witness.kind == "vdot" and inner <= witness.level <= outer:
        return "REFUTED"
    proof = prove_outwards(case.problem, case.T, inner, outer, Budget(boxes=50_000), ThreadRunner())
    return "PROVED" if proof.outer >= outer else "UNKNOWN"


def by_codac(case: Case, inner: float, outer: float) -> str:
    status, x = codac_prover.decide(query(ring_condition(inner, outer), case.problem))
    if status == "unsat":
        return "PROVED"
    return "REFUTED" if x is not None and genuine(case, np.array(x), inner, outer) else "UNKNOWN"


def by_dreal(case: Case, inner: float, outer: float, backend: Backend) -> str:
    answer = decide(backend, query(ring_condition(inner, outer), case.problem), 1e-3, 1, 60.0)
    if answer.status == "unsat":
        return "TRUSTED"
    names = [s.name for s in case.loop.system.states]
    x = np.array([sum(answer.box[name]) / 2 for name in names]) if answer.status == "delta-sat" else None
    return "REFUTED" if genuine(case, x, inner, outer) else "UNKNOWN"


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("share", slow_after(1, [0.9, 1.05, 1.5, 0.3, 0.99]))
def test_bounds_and_codac_do_not_contradict_each_other(name: str, share: float) -> None:
    case, limit = claims_of(name)
    found = {by_bounds(case, INNER * limit, share * limit), by_codac(case, INNER * limit, share * limit)}
    assert found != {"PROVED", "REFUTED"}
    if share < 0.95:
        assert found == {"PROVED"}
    if name == "scalar" and share > 1:
        assert found == {"REFUTED"} or found == {"REFUTED", "UNKNOWN"}


@pytest.mark.skipif(dreal() is None, reason="dReal is neither importable (libibex.so of IBEX 2.7.4) nor on the PATH")
@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("share", [0.3, 0.9, 1.05, 1.5])
def test_dreal_contradicts_neither(name: str, share: float) -> None:
    backend = dreal()
    assert backend is not None
    case, limit = claims_of(name)
    inner, outer = INNER * limit, share * limit
    found = {by_bounds(case, inner, outer), by_codac(case, inner, outer), by_dreal(case, inner, outer, backend)}
    assert "REFUTED" not in found or not found & {"PROVED", "TRUSTED"}
    if share < 0.95:
        assert found == {"PROVED", "TRUSTED"}
