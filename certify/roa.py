"""`certify_roa`: choose a candidate, falsify, prove, have it checked. One pipeline for every claim and engine.

Nothing is PROVED before the checker, run as a process of its own, has accepted the very bytes that were written.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from certify.certificate import (
    Certificate,
    TrustedSolver,
    require_short,
    require_within_limits,
    run_checker,
    sole_writer,
    write_beside,
)
from certify.claims import Asymptotic, Claim, Problem
from certify.closed_loop import ClosedLoop
from certify.engines.base import Budget, Engine, Progress, Proof, Task
from certify.engines.falsify import Witness, falsify, refutes
from certify.errors import BackendError, InputError, SoundnessError
from certify.lyapunov import (
    choose_candidate,
    diagonalising_coordinates,
    domain_limit,
    is_positive_definite,
    leaves_domain,
)
from certify.lyapunov.function import Quadratic
from certify.options import RoaOptions
from certify.policies import TanhNetwork
from certify.results import Levels, RoaResult
from certify.rigorous import eigenvalues
from certify.systems import System
from certify.verdict import Stop, Verdict

if TYPE_CHECKING:
    from certify.engines.dreal.proof import DrealOptions

Array = NDArray[np.float64]
__all__ = ["RoaOptions", "RoaResult", "certify_roa"]
Report = Callable[[Literal["ring", "check"], Progress | None], None]
_SMALL_NETWORK = 10_000  # weights
_BELOW = 1e-9  # relative distance from a limit that is itself out of reach (the domain's open condition)
_BELOW_WITNESS = 1e-3
_SMALLEST = 1e-120  # of levels: squares of states and products of bounds must not underflow


def certify_roa(
    system: System,
    network: TanhNetwork,
    out: Path,
    options: RoaOptions | None = None,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Report | None = None,
) -> RoaResult:
    """Certify a region of attraction of `system` under `network`.

    Parameters
    ----------
    system, network : the closed loop.
    out : folder for `certificate.json`; it is made if it is not there.
    options : see `RoaOptions`.
    load_seconds : time already spent on reading, for the report.
    provenance : entries for the certificate that the checker ignores.
    progress : called with ("ring", where the pass stands) after every batch, and with ("check", None).

    Returns
    -------
    RoaResult : PROVED only if the checker accepted the certificate; TRUSTED where a solver's word stands for it.

    Raises
    ------
    InputError : the closed loop or an option cannot be used, or `out` cannot be written or is another run's.
    BackendError : the checker process failed.
    SoundnessError : the checker rejects what the engine proved.
    """
    with _threads_for(network), sole_writer(out):
        return _Run(system, network, out, options or RoaOptions(), load_seconds, provenance or {}, progress).result()


@contextmanager
def _threads_for(network: TanhNetwork) -> Iterator[None]:
    """One thread for small networks: their operations are shorter than the threads' handshakes."""
    import torch

    threads = torch.get_num_threads()
    if sum(W.size for W in network.weights) < _SMALL_NETWORK:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


@dataclass
class _Run:
    """One run: what was asked for, and the stopwatch."""

    system: System
    network: TanhNetwork
    out: Path
    options: RoaOptions
    load: float
    provenance: Mapping[str, Any]
    progress: Report | None
    seconds: dict[str, float] = field(default_factory=dict)

    def result(self) -> RoaResult:
        start = time.perf_counter()
        result = self._decide()
        total = self.load + time.perf_counter() - start
        return replace(result, seconds={"load": self.load, **self.seconds, "total": total})

    def _decide(self) -> RoaResult:
        """Choose, falsify, prove, check."""
        options, loop = self.options, ClosedLoop(self.system, self.network)
        require_within_limits(self.system, self.network)
        result = RoaResult(
            Verdict.UNKNOWN, Stop.REQUESTED, self.system, self.network, options.claim, engine=options.engine
        )
        with self._stage("candidate"):
            if options.claim == "asymptotic":
                loop.require_rest()
                unstable = _unstable(loop)
                if unstable is not None:
                    verdict, stop, shown = unstable
                    detail = f"eigenvalues {', '.join(shown)}" + (" touch the axis" if stop is Stop.SPECTRUM else "")
                    return replace(result, verdict=verdict, stop=stop, detail=detail, eigenvalues=shown)
            V, name, notice = _candidate(loop, options)
            require_short(V.P)
            problem = Problem(loop, V)
            T = diagonalising_coordinates(V.P, loop.linearise()[0])
            limit = domain_limit(V.P, self.system.domain)
        result = replace(result, problem=problem, candidate=name, notice=notice, levels=Levels(domain_limit=limit))
        if options.level is not None and leaves_domain(V.P, options.level, self.system.domain):
            detail = f"{{V <= {options.level:g}}} leaves the domain, whose limit is {limit:.12g}"
            return replace(result, verdict=Verdict.REFUTED, stop=Stop.DOMAIN, detail=detail)

        if not _SMALLEST < (options.level or limit) < 1 / _SMALLEST:
            raise InputError(
                f"levels of V must lie between {_SMALLEST:g} and {1 / _SMALLEST:g}; found {options.level or limit:g}. "
                "Scale the states or P."
            )
        task = Task(problem, options.claim, options.level or limit * (1 - _BELOW), options.level is not None)
        if options.claim == "asymptotic":
            with self._stage("ring"):
                task = replace(task, witness=falsify(problem, T, task.target))
            if task.witness is not None and not task.exactly:
                task = replace(task, target=task.witness.level * (1 - _BELOW_WITNESS))
        if task.exactly and _refuted(task, task.witness):
            return _with_witness(result, task, task.witness)
        budget = Budget(max(1e-3, options.time_limit - self.seconds.get("ring", 0.0)), options.max_boxes)
        on_ring = None if self.progress is None else lambda state: self.progress("ring", state)  # type: ignore[misc]
        proof = self._engine(T).prove(task, budget, on_ring)
        for stage, spent in proof.seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
        return self._conclude(result, task, proof)

    def _engine(self, T: Array) -> Engine:
        if self.options.engine == "dreal":
            from certify.engines.dreal.proof import DrealEngine

            return DrealEngine(T, self.options.dreal_precision, self.options.jobs)
        import torch

        from certify.engines.bounds.engine import BoundsEngine
        from certify.running import ThreadRunner

        return BoundsEngine(T, ThreadRunner(torch.device(self.options.device)))

    def _conclude(self, result: RoaResult, task: Task, proof: Proof) -> RoaResult:
        """The verdict on what the engine says, the only place that gives one after the search."""
        witness = _lowest(task.witness, proof.witness)
        result = replace(
            _with_levels(result, proof.partial, witness),
            stop=proof.stop,
            detail=proof.detail,
            witness=witness,
            boxes=proof.boxes,
            solver=proof.solver,
        )
        claim = proof.claim
        if claim is None or (task.exactly and claim.roa < task.target):
            if task.exactly and _refuted(task, witness):
                return _with_witness(result, task, witness)
            if claim is None:
                return result
            if isinstance(claim, Asymptotic):
                result = replace(result, levels=replace(result.levels, local=claim.local))
            missed = f"proved only up to V <= {claim.roa:.12g}, not {task.target:g}"
            return replace(result, detail=f"{proof.detail}; {missed}" if proof.detail else missed)
        certificate = Certificate(self.system, self.network, task.problem.V, claim, proof.evidence, self.provenance)  # type: ignore[arg-type]
        path, data, answer = self._write_and_check(certificate)
        trusted = isinstance(proof.evidence, TrustedSolver)
        if not trusted and self.options.engine == "both":
            result = replace(result, solver=self._confirm(task.problem, claim))
        return replace(
            _with_levels(result, claim.levels, witness),
            verdict=Verdict.TRUSTED if trusted else Verdict.PROVED,
            stop=_limit(proof.stop, task, witness),
            leaves=proof.leaves,
            certificate=path,
            raw=data,
            checker=answer,
        )

    def _write_and_check(self, certificate: Certificate) -> tuple[Path, bytes, dict[str, Any]]:
        """The certificate's path, its bytes and the checker's answer, without which it does not get its name.

        Raises
        ------
        SoundnessError : the checker says something else, or speaks of other bytes.
        """
        path = self.out / "certificate.json"
        wanted = "TRUSTED" if isinstance(certificate.evidence, TrustedSolver) else "ACCEPTED"
        with self._stage("write"):
            data = certificate.to_json().encode()
            unchecked = write_beside(path, data, ".unchecked.json")
        if self.progress is not None:
            self.progress("check", None)
        try:
            with self._stage("check"):
                answer = run_checker(unchecked)
        except (KeyboardInterrupt, BackendError):
            unchecked.unlink()
            raise
        if answer["result"] != wanted:
            raise SoundnessError(
                f"the checker rejects what the engine proved: {answer}. The certificate {unchecked} reproduces it."
            )
        if answer["certificate_sha256"] != hashlib.sha256(data).hexdigest():
            raise SoundnessError(f"the checker's answer is about other bytes than those of {unchecked}: {answer}.")
        unchecked.replace(path)
        return path, data, answer

    def _confirm(self, problem: Problem, claim: Claim) -> dict[str, Any]:
        """dReal's answers about what the bounds engine proved.

        Raises
        ------
        SoundnessError : dReal points at a genuine violation of what was proved and checked.
        """
        from certify.engines.dreal.backend import find_backend
        from certify.engines.dreal.proof import DrealOptions, confirm_with_dreal, record_of

        try:
            backend = find_backend()
        except BackendError as error:
            return {"solver": "dreal", "missing": str(error)}
        allowed: DrealOptions = DrealOptions(self.options.dreal_precision, self.options.jobs, self.options.time_limit)
        asked, witness = confirm_with_dreal(problem, claim, backend, allowed)
        if witness is not None:
            path = self.out / "contradiction.json"
            stated = {"x": [v.hex() for v in witness.x.tolist()], "kind": witness.kind, "V": witness.level}
            path.write_text(json.dumps({"witness": stated, "certificate": "certificate.json"}) + "\n", encoding="utf-8")
            raise SoundnessError(f"dReal and Arb contradict a checked certificate; {path} has the witness.")
        return record_of(backend.version, allowed, asked)

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


def _refuted(task: Task, witness: Witness | None) -> bool:
    return witness is not None and task.kind == "asymptotic" and refutes(task.problem, witness, task.target)


def _with_witness(result: RoaResult, task: Task, witness: Witness | None) -> RoaResult:
    if witness is None:
        return result
    detail = witness.describe(result.system)
    levels = replace(result.levels, sampled_limit=witness.level)
    return replace(result, verdict=Verdict.REFUTED, stop=Stop.WITNESS, detail=detail, witness=witness, levels=levels)


def _with_levels(result: RoaResult, levels: Mapping[str, float], witness: Witness | None) -> RoaResult:
    sampled = None if witness is None else witness.level
    return replace(result, levels=replace(result.levels, sampled_limit=sampled, **levels))


def _lowest(*witnesses: Witness | None) -> Witness | None:
    return min((w for w in witnesses if w is not None), key=lambda w: w.level, default=None)


def _limit(stop: Stop, task: Task, witness: Witness | None) -> Stop:
    """What limits a level, from what stopped its proof."""
    if stop is not Stop.REQUESTED or task.exactly:
        return stop
    return Stop.DOMAIN if witness is None else (Stop.INPUTS if witness.kind == "input" else Stop.WITNESS)


def _unstable(loop: ClosedLoop) -> tuple[Verdict, Stop, tuple[str, ...]] | None:
    """REFUTED or UNKNOWN with the eigenvalues, or None if the spectrum is rigorously stable."""
    enclosures = eigenvalues(loop)
    if enclosures is None:
        approximate = np.linalg.eigvals(loop.linearise()[0])
        if np.max(approximate.real) < 0:
            return None  # nearly multiple eigenvalues: the local proof decides
        return Verdict.UNKNOWN, Stop.SPECTRUM, tuple(f"{v:.6g}" for v in approximate)
    shown = tuple(f"{complex(v.mid()):.6g}" for v in enclosures)
    if any(v.real > 0 for v in enclosures):
        return Verdict.REFUTED, Stop.UNSTABLE, shown
    if not all(v.real < 0 for v in enclosures):
        return Verdict.UNKNOWN, Stop.SPECTRUM, shown
    return None


def _candidate(loop: ClosedLoop, options: RoaOptions) -> tuple[Quadratic, str, str | None]:
    """V, where its P comes from, and a notice."""
    if options.P is None:
        chosen = choose_candidate(loop, options.candidate, options.Q, options.R)
        return Quadratic(chosen.P), chosen.name, chosen.notice
    n, V = loop.system.n, Quadratic(options.P)
    if V.n != n or not is_positive_definite(V.P):
        raise InputError(f"`P` must be a symmetric positive definite matrix of shape ({n}, {n}).")
    return V, "given", None
