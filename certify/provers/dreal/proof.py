"""The paper's way: levels by bisection, each step one query to dReal.

The local level grows from a guess as long as its query is unsatisfiable; the ring is asked from the local level to the
target at once, and by bisection only if that fails. A "delta-sat" is looked at in Arb: if its box holds a genuine
violation, that caps the level (or refutes the one that was asked for), else nothing is known there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from certify.certificates import TrustedSolver
from certify.certificates.claims import Asymptotic, Claim, Condition, OfInput, Problem, Vdot, conditions
from certify.certificates.claims.conditions import (
    clip_conditions,
    domain_conditions,
    input_conditions,
    local_condition,
    ring_condition,
    root_conditions,
)
from certify.certificates.claims.queries import query
from certify.certificates.verdict import Stop
from certify.effort import UNIT
from certify.errors import BackendError, InputError
from certify.provers.ball.local import prove_local
from certify.provers.base import Attempt, Budget, Engine, Once, Proof, Task
from certify.provers.dreal.backend import Answer, Backend, decide, find_backend
from certify.provers.falsify import Witness, confirm

Array = NDArray[np.float64]
_LOCAL_RATIO, _RING_RATIO = 1.05, 1.002  # ratios of levels at which bisection stops
_BELOW_WITNESS = 1e-3
_LEAST = 1e-12  # share of the guess below which no local level is looked for
_MARGIN = 4  # dReal's deltas that a set keeps from the domain
_SECONDS = 600.0
_LOCAL_SHARE = 0.3  # share of dReal's seconds after which a local level that is there will do


@dataclass(frozen=True, slots=True)
class DrealOptions:
    """`precision` is dReal's delta, `jobs` its threads, `seconds` for all queries together."""

    precision: float = 1e-3
    jobs: int = 1
    seconds: float = 600.0


@dataclass(frozen=True, slots=True)
class Asked:
    """A query, the level it was about, and the answer."""

    name: str
    level: float
    answer: Answer


class DrealEngine(Engine):
    """The claim `asymptotic` by queries; T (n, n) gives the coordinates in which the first local level is guessed."""

    def __init__(self, T: Array, precision: float, jobs: int) -> None:
        self.T, self.precision, self.jobs = T, precision, jobs

    def begin(self, task: Task) -> Attempt:
        """An attempt at a local level near the largest, and the largest one up to the target, by queries.

        Raises
        ------
        InputError : the claim is another than `asymptotic`.
        """
        if task.kind != "asymptotic":
            raise InputError(f"engine dreal proves the claim asymptotic only, not {task.kind}. Use engine bounds.")
        return Once(lambda budget, _: self._ask(task, budget))

    def _ask(self, task: Task, budget: Budget) -> Proof:
        start = time.perf_counter()
        try:
            backend = find_backend()
        except BackendError as error:
            return Proof(None, None, Stop.SOLVER, str(error))
        guess = prove_local(task.problem, self.T, task.target)
        local = time.perf_counter() - start
        options = DrealOptions(
            self.precision, self.jobs, _SECONDS if budget.effort.left == math.inf else budget.effort.left / UNIT
        )
        session = _Session(task.problem, backend, options)
        first = 16 * guess if guess is not None else 1e-4 * task.target
        inner, level, stop, detail = session.levels(first, task.target)
        seconds = {"local": local, "ring": time.perf_counter() - start - local}
        reached = {} if inner is None else {"local": inner} | ({} if level is None else {"roa": level})
        record = record_of(backend.version, options, session.asked)
        proof = Proof(None, None, stop, detail, session.witness, partial=reached, solver=record, seconds=seconds)
        if inner is None or level is None:
            return proof
        answers = tuple((f"{a.name}-{a.level!r}", a.answer.status) for a in session.asked)
        evidence = TrustedSolver("dreal", backend.version, self.precision, answers)
        return replace(proof, claim=Asymptotic(roa=level, local=min(inner, level)), evidence=evidence)


def confirm_with_dreal(
    problem: Problem, claim: Claim, backend: Backend, options: DrealOptions
) -> tuple[tuple[Asked, ...], Witness | None]:
    """Ask dReal for every condition of a claim that was proved otherwise; a witness contradicts that proof."""
    session = _Session(problem, backend, options, floor=0.0 if claim.at_rest else claim.inner)
    for condition in conditions(claim, problem):
        session.ask(condition, condition.guards[-1].level)
    return tuple(session.asked), session.witness


def record_of(version: str, options: DrealOptions, asked: Sequence[Asked]) -> dict[str, Any]:
    """The record of every query, for JSON."""
    rows = [
        {
            "query": a.name,
            "level": a.level,
            "answer": a.answer.status,
            "meaning": a.answer.meaning,
            "seconds": a.answer.seconds,
            "detail": a.answer.detail,
        }
        for a in asked
    ]
    return {"solver": "dreal", "version": version, "precision": options.precision, "queries": rows}


@dataclass
class _Session:
    problem: Problem
    backend: Backend
    options: DrealOptions
    asked: list[Asked] = field(default_factory=list)
    witness: Witness | None = None
    floor: float = 0.0  # the level below which nothing is claimed

    def __post_init__(self) -> None:
        self.deadline = time.monotonic() + self.options.seconds

    def levels(self, guess: float, target: float) -> tuple[float | None, float | None, Stop, str]:
        """(local level, largest level, what stopped it, details)."""
        inner = self.local(guess, target)
        if inner is None and self.left() <= 0:
            return None, None, Stop.TIME, "dReal confirmed no local level until then"
        if inner is None:
            return None, None, Stop.LOCAL, "dReal confirms no local level"
        top, share = target, 1 - _MARGIN * self.options.precision
        if not self.all_unsat(domain_conditions(self.problem, top)):
            top *= share  # a set that touches the domain is delta-sat; the checker decides it exactly
        inner = min(inner, top)
        # The local query is about Vdot alone, and the ring may add nothing to it.
        if not self.all_unsat(root_conditions(self.problem, inner)):
            return inner, None, Stop.SOLVER, "dReal does not confirm that the equations' roots are defined there"
        if not self.all_unsat(input_conditions(self.problem, inner)):
            return inner, None, Stop.INPUTS, "dReal does not confirm their bounds on the local level"
        level, stop, detail = self.ring(inner, top)
        if level < target and stop is Stop.REQUESTED:
            detail = f"dReal does not tell close to the domain from beyond it; asked up to {share:.12g} of its level"
            return inner, level, Stop.MARGIN, detail
        return inner, level, stop, detail

    def left(self) -> float:
        return self.deadline - time.monotonic()

    def ask(self, condition: Condition, level: float) -> bool:
        """True only for "unsat"."""
        if self.left() <= 0:
            return False
        allowed = min(self.left(), 0.5 * _LOCAL_SHARE * self.options.seconds if condition.name == "local" else math.inf)
        asked = query(condition, self.problem)
        answer = decide(self.backend, asked, self.options.precision, self.options.jobs, allowed)
        self.asked.append(Asked(condition.name, level, answer))
        if answer.status == "delta-sat" and not condition.punctured and isinstance(condition.margin, Vdot | OfInput):
            self._look(answer, condition)
        return answer.status == "unsat"

    def all_unsat(self, wanted: Sequence[Condition]) -> bool:
        return all(self.ask(c, c.guards[-1].level) for c in wanted)

    def local(self, guess: float, target: float) -> float | None:
        """Geometric bisection from the guess, which may be as far below the target as it likes."""
        low, high = None, None
        level = min(guess, target)
        least = _LEAST * level
        while level > least:
            enough = low is not None and self.left() < (1 - _LOCAL_SHARE) * self.options.seconds
            if self.left() <= 0 or enough:
                break
            wanted = clip_conditions(self.problem, level)
            if self.ask(local_condition(level), level) and self.all_unsat(wanted):
                low = level
                if level >= target:
                    break
                level = min(4 * level, target) if high is None else math.sqrt(low * high)
            else:
                high = level
                level = level / 4 if low is None else math.sqrt(low * high)
            if low is not None and high is not None and high < _LOCAL_RATIO * low:
                break
        return low

    def ring(self, inner: float, target: float) -> tuple[float, Stop, str]:
        """(largest level on which ring and inputs are unsatisfiable, what stopped it, details)."""
        low, high, level = inner, target, target
        while high > _RING_RATIO * low or level == target:
            if self.left() <= 0:
                return low, Stop.TIME, ""
            ring = level <= low or self.ask(ring_condition(low, level), level)
            rest = (*root_conditions(self.problem, level), *input_conditions(self.problem, level))
            if ring and self.all_unsat(rest):
                low = level
                if level >= target:
                    return level, Stop.REQUESTED, ""
            else:
                high = level
            if self.witness is not None and self.witness.level < high:
                high = self.witness.level * (1 - _BELOW_WITNESS)
            level = math.sqrt(low * high)
        if self.witness is not None:
            return low, Stop.WITNESS, ""
        return low, Stop.SOLVER, "dReal gives no answer above"

    def _look(self, answer: Answer, condition: Condition) -> None:
        """Points of the answer's box, in rationals and in Arb: a violation that the claim forbids is the witness.

        Below a ring lies the local level, where Vdot >= 0 contradicts an asymptotic claim too; `floor` is the level
        below which nothing is claimed.
        """
        kind: Literal["vdot", "input"] = "vdot" if isinstance(condition.margin, Vdot) else "input"
        names = [s.name for s in self.problem.loop.system.states]
        box = np.array([answer.box.get(name, (math.nan, math.nan)) for name in names])
        if not np.all(np.isfinite(box)):
            return
        generator = np.random.default_rng(0)
        shares = np.concatenate([[0.5 * np.ones(len(box))], generator.random((15, len(box)))])
        for x in box[:, 0] + shares * (box[:, 1] - box[:, 0]):
            V = float(self.problem.V(x))
            witness = Witness(x, V, kind)
            lower = self.witness is None or self.witness.level > V
            exact = self.problem.V.exactly(x)
            inside = all(guard.holds(exact) for guard in condition.guards if guard.side == "inside")
            claimed = inside and (kind == "input" or exact >= Fraction(self.floor))
            if lower and claimed and confirm(self.problem, witness):
                self.witness = witness
