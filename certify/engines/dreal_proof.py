"""The paper's way: levels by bisection, each step one query to dReal.

The local level grows from a guess as long as its query is unsatisfiable; the ring is asked from the local level to the
target at once, and by bisection only if that fails. A "delta-sat" is looked at in Arb: if its box holds a genuine
violation, that caps the level (or refutes the one that was asked for), else nothing is known there.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from certify.engines.dreal import Answer, Backend, decide
from certify.engines.falsify import Witness, confirm
from certify.obligations import Obligations, Query, domain_queries, input_queries, local_query, queries, ring_query

Array = NDArray[np.float64]
_LOCAL_RATIO, _RING_RATIO = 1.05, 1.002  # at which bisection stops
_BELOW_WITNESS = 1e-3
_LOCAL_SHARE = 0.3  # of the time, after which a local level that is there will do


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


@dataclass(frozen=True, slots=True)
class DrealProof:
    """`inner` and `level` are the levels that dReal confirmed, None if it confirmed none.

    `reason` says what stopped it, `witness` is a violation shown in Arb, `asked` has every query.
    """

    inner: float | None
    level: float | None
    reason: str
    witness: Witness | None
    asked: tuple[Asked, ...]


def prove_with_dreal(
    obligations: Obligations,
    guess: float,
    target: float,
    backend: Backend,
    options: DrealOptions,
    progress: Callable[[str, float], None] | None = None,
) -> DrealProof:
    """Find a local level near the largest, and the largest level up to `target` on which every query is unsatisfiable.

    Parameters
    ----------
    guess : where the local level is looked for first.
    progress : called with (query, level) before each query.
    """
    session = _Session(obligations, backend, options, progress)
    inner = session.local(guess, target)
    if inner is None:
        return session.result(None, None, "local: dReal confirms no local level")
    top = target
    if not session.all_unsat(domain_queries, top):
        top *= 1 - 4 * options.precision  # a set that touches the domain is delta-sat; the checker decides it exactly
    inner = min(inner, top)
    # The local query is about Vdot alone, and the ring may add nothing to it.
    if not obligations.inputs_bounded_by_form and not session.all_unsat(input_queries, inner):
        return session.result(inner, None, "inputs: dReal does not confirm their bounds on the local level")
    level, reason = session.ring(inner, top)
    return session.result(min(inner, level), level, "requested" if level >= target else reason)


def confirm_with_dreal(
    obligations: Obligations, inner: float, outer: float, backend: Backend, options: DrealOptions
) -> tuple[tuple[Asked, ...], Witness | None]:
    """Ask dReal for every claim of a proof that was found otherwise; a witness contradicts that proof."""
    session = _Session(obligations, backend, options, None)
    for query in queries(obligations, inner, outer):
        session.ask(query, inner if query.name == "local" else outer)
    return tuple(session.asked), session.witness


@dataclass
class _Session:
    obligations: Obligations
    backend: Backend
    options: DrealOptions
    progress: Callable[[str, float], None] | None
    asked: list[Asked] = field(default_factory=list)
    witness: Witness | None = None

    def __post_init__(self) -> None:
        self.deadline = time.monotonic() + self.options.seconds

    def result(self, inner: float | None, level: float | None, reason: str) -> DrealProof:
        return DrealProof(inner, level, reason, self.witness, tuple(self.asked))

    def left(self) -> float:
        return self.deadline - time.monotonic()

    def ask(self, query: Query, level: float) -> bool:
        """True only for "unsat"."""
        if self.progress is not None:
            self.progress(query.name, level)
        if self.left() <= 0:
            return False
        allowed = min(self.left(), 0.5 * _LOCAL_SHARE * self.options.seconds if query.name == "local" else math.inf)
        answer = decide(self.backend, query, self.options.precision, self.options.jobs, allowed)
        self.asked.append(Asked(query.name, level, answer))
        if answer.status == "delta-sat" and (query.name == "ring" or query.name.startswith("inputs")):
            self._look(answer, "vdot" if query.name == "ring" else "input", level)
        return answer.status == "unsat"

    def all_unsat(self, make: Callable[[Obligations, float], list[Query]], level: float) -> bool:
        return all(self.ask(q, level) for q in make(self.obligations, level))

    def local(self, guess: float, target: float) -> float | None:
        """Geometric bisection from the guess."""
        low, high = None, None
        level = min(guess, target)
        while level > 1e-12 * target:
            enough = low is not None and self.left() < (1 - _LOCAL_SHARE) * self.options.seconds
            if self.left() <= 0 or enough:
                break
            if self.ask(local_query(self.obligations, level), level):
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

    def ring(self, inner: float, target: float) -> tuple[float, str]:
        """(largest level on which ring and inputs are unsatisfiable, what stopped it)."""
        low, high, level = inner, target, target
        while high > _RING_RATIO * low or level == target:
            if self.left() <= 0:
                return low, "time"
            ring = level <= low or self.ask(ring_query(self.obligations, low, level), level)
            if ring and (self.obligations.inputs_bounded_by_form or self.all_unsat(input_queries, level)):
                low = level
                if level >= target:
                    return level, "requested"
            else:
                high = level
            if self.witness is not None and self.witness.level < high:
                high = self.witness.level * (1 - _BELOW_WITNESS)
            level = math.sqrt(low * high)
        return low, "witness" if self.witness is not None else "solver: dReal gives no answer above"

    def _look(self, answer: Answer, kind: str, level: float) -> None:
        """Points of the answer's box, in Arb: a genuine violation below the level becomes the witness."""
        names = [s.name for s in self.obligations.loop.system.states]
        box = np.array([answer.box.get(name, (math.nan, math.nan)) for name in names])
        if not np.all(np.isfinite(box)):
            return
        generator = np.random.default_rng(0)
        shares = np.concatenate([[0.5 * np.ones(len(box))], generator.random((15, len(box)))])
        for x in box[:, 0] + shares * (box[:, 1] - box[:, 0]):
            V = float(x @ self.obligations.P @ x)
            witness = Witness(x, V, kind)
            lower = self.witness is None or self.witness.level > V
            if level >= V and lower and confirm(self.obligations, witness):
                self.witness = witness
