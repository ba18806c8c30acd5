"""What is given up of a claim, and in which order, where the checker refuses its certificate."""

from __future__ import annotations

import json
from base64 import b64decode
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from certify.analysis.acceptance import Clerk, _lowered
from certify.certificates import Certificate, Contraction, LocalBall, OuterTree, PartitionTree, TrustedSolver
from certify.certificates.claims import Asymptotic, Claim, Enlarged, Nearby, Outer, Practical, Problem, Reached
from certify.loop.closed_loop import ClosedLoop
from certify.loop.expressions import symbols
from certify.lyapunov.function import Quadratic
from certify.lyapunov.symbolic import Symbolic
from tests.support.loops import scalar_tanh

V = Quadratic(np.eye(1))
x = symbols("x")
OUTER = Outer(Symbolic(x[0] ** 2, (x[0],)), 9.0)
ONE = np.eye(1)
WHOLE = PartitionTree(
    ONE, np.ones(1), b"\xff", contraction=Contraction(ONE, np.ones(1), ONE), outer=OuterTree(ONE, np.ones(1), b"", ())
)
ON_RING, ELSEWHERE = {"rule": "ring", "at": "leaf 0"}, {"rule": "tube", "at": "slab 0"}
OF_EQUILIBRIUM = {"rule": "contraction", "at": "contraction"}


def weaker(claim: Claim, answer: dict[str, Any]) -> Iterator[Certificate]:
    """The certificates that follow each other under one refusal, after two tries below the refused leaf."""
    system, network = scalar_tanh()
    problem = Problem(ClosedLoop(system, network), V)
    found: Certificate | None = Certificate(system, network, V, claim, WHOLE)
    for tries in range(2, 12):
        if found is not None:
            found = _lowered(found, answer, problem, tries)
        if found is not None:
            yield found


@pytest.mark.parametrize(
    ("claim", "answer", "left"),
    [
        (Asymptotic(4.0, 1.0), ON_RING, ["roa 2", "roa 1.41421", "roa 1.18921", "local", "local"]),
        (Asymptotic(4.0, 1.0), ELSEWHERE, ["local", "local"]),
        (Asymptotic(4.0, 1.0, outer=OUTER), ELSEWHERE, ["outer", "local", "local"]),
        (Enlarged(4.0, 1.0, V), ELSEWHERE, ["tube", "local"]),
        (Reached(4.0, 1.0, V, (1.0,)), ON_RING, ["tube", "roa 2", "roa 1.41421", "local"]),
        (Practical(4.0, 1.0, 0.5), ELSEWHERE, ["floor 0.75"]),
        (Practical(4.0, 1.0, 0.5), ON_RING, ["roa 2", "roa 1.41421", "roa 1.18921"]),
        (Practical(4.0, 1.0, 0.5, outer=OUTER), ELSEWHERE, ["outer", "floor 0.75"]),
        (Nearby(4.0, 1.0, 0.5), ELSEWHERE, ["equilibrium", "floor 0.75"]),
        (Nearby(4.0, 1.0, 0.5), ON_RING, ["roa 2", "roa 1.41421", "roa 1.18921", "equilibrium"]),
        (Nearby(4.0, 1.0, 0.5, outer=OUTER), OF_EQUILIBRIUM, ["equilibrium", "outer", "floor 0.75"]),
    ],
)
def test_what_is_given_up_and_in_which_order(claim: Claim, answer: dict[str, Any], left: list[str]) -> None:
    found, before = [], claim
    for certificate in weaker(claim, answer):
        found.append(_difference(before, certificate))
        before = certificate.claim
    assert found[: len(left)] == left
    assert set(found[len(left) :]) <= ({"local"} if claim.at_rest else set())


def _difference(before: Claim, certificate: Certificate) -> str:
    """What a certificate says less than the claim before, with the evidence that goes with it."""
    after, evidence = certificate.claim, certificate.evidence
    assert isinstance(evidence, PartitionTree)
    if before.outer is not None and after.outer is None:
        assert after == replace(before, outer=None) and evidence.outer is None
        return "outer"
    if before.start is not None:
        assert after == Asymptotic(before.roa, before.local) and evidence.tube == ()
        return "tube"
    if before.one_equilibrium and not after.one_equilibrium:
        assert after.levels == before.levels and evidence.contraction is None
        return "equilibrium"
    if after.floor != before.floor:
        return f"floor {after.floor:g}"
    if after.local != before.local or after.roa == after.local:
        assert after.roa == after.local
        return "local"
    return f"roa {after.roa:g}"


def test_a_rate_is_kept() -> None:
    for certificate in weaker(Asymptotic(4.0, 1.0, rate=0.5), ON_RING):
        assert certificate.claim.rate == 0.5


def test_a_solver_s_word_is_not_weakened() -> None:
    system, network = scalar_tanh()
    word = TrustedSolver("dReal", "4", 1e-3, ())
    certificate = Certificate(system, network, V, Asymptotic(4.0, 1.0), word)
    assert _lowered(certificate, ON_RING, Problem(ClosedLoop(system, network), V), 0) is None


def test_refused_leaves_are_split_three_times_and_then_left_outside(tmp_path: Path) -> None:
    """All that are named, at once; only then the level is lowered, below them."""
    system, network = scalar_tanh()
    problem, asked = Problem(ClosedLoop(system, network), V), list[tuple[int, float]]()
    evidence = PartitionTree(ONE, np.array([2.5]), bytes([0, 255, 255]), local=LocalBall(ONE, np.ones((3, 1)), ONE))

    def check(path: Path) -> dict[str, Any]:
        data = path.read_bytes()
        said = json.loads(data)
        levels = {name: float.fromhex(level) for name, level in said["levels"].items()}
        asked.append((len(b64decode(said["evidence"]["tree"])), levels["roa"]))
        result = "ACCEPTED" if len(asked) == 5 else "REJECTED"
        every = {"every": ["leaf 0", "leaf 1"]}
        return {"certificate_sha256": sha256(data).hexdigest(), "levels": levels, "result": result, **ON_RING, **every}

    clerk = Clerk(tmp_path / "c.json", lambda _: nullcontext(), lambda: None, lambda _: None, check)
    found = clerk.accepted(Certificate(system, network, V, Asymptotic(4.0, 1.0), evidence), problem)
    assert [size for size, _ in asked] == [3, 31, 59, 87, 87]
    *levels, lower = (level for _, level in asked)
    assert levels == [4.0] * 4 and lower < 4.0
    assert found.certificate.roa == lower and "the level is" in (found.mended or "")
