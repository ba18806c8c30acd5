"""`certify_roa`: from a policy to a checked certificate. The one module that knows everybody.

Nothing is PROVED before the checker, run as a process of its own, has accepted the bytes that were written.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from certify.certificate import Certificate, PartitionTree, TrustedSolver, write_certificate
from certify.closed_loop import ClosedLoop
from certify.engines.falsify import Witness, falsify
from certify.engines.local import prove_local
from certify.errors import BackendError, InputError, SoundnessError
from certify.lyapunov import (
    Candidate,
    choose_candidate,
    diagonalising_coordinates,
    domain_limit,
    extents,
    semi_axes,
    volume,
)
from certify.obligations import Obligations
from certify.policies import TanhNetwork
from certify.systems import System
from certify.verdict import Verdict

if TYPE_CHECKING:
    from certify.engines.branch_and_bound import RingProgress
    from certify.engines.dreal_proof import Asked

Array = NDArray[np.float64]
Engine = Literal["bounds", "dreal", "both"]
Progress = Callable[[Literal["ring", "check"], "RingProgress | None"], None]
_SMALL_NETWORK = 10_000  # weights
_BELOW = 1e-9  # relative distance from a limit that is itself out of reach (the domain's open condition)


@dataclass(frozen=True, slots=True)
class RoaOptions:
    """How to certify.

    Parameters
    ----------
    candidate : where P comes from, see `choose_candidate`.
    Q, R : diagonals of the weights, shapes (n,) and (m,); None means ones.
    P : a Lyapunov matrix of one's own, (n, n); overrides the candidate.
    level : prove exactly this level; None finds the largest.
    engine : `bounds`, `dreal` (its word is trusted, not checked), or `both`: bounds prove, dReal is asked as well.
    dreal_precision, jobs : dReal's delta and threads.
    device : where boxes are bounded, `cpu` or `cuda`.
    time_limit : seconds for the ring, the falsifier included.
    max_boxes : boxes for the ring.
    """

    candidate: Candidate = "lyapunov"
    Q: tuple[float, ...] | None = None
    R: tuple[float, ...] | None = None
    P: Array | None = None
    level: float | None = None
    engine: Engine = "bounds"
    dreal_precision: float = 1e-3
    jobs: int = 1
    device: str = "cpu"
    time_limit: float = 600.0
    max_boxes: int = 4_000_000

    def __post_init__(self) -> None:
        if self.candidate not in get_args(Candidate):
            raise InputError(f"`candidate` must be one of {get_args(Candidate)}; found {self.candidate!r}.")
        if self.engine not in get_args(Engine):
            raise InputError(f"`engine` must be one of {get_args(Engine)}; found {self.engine!r}.")
        if not 0 < self.dreal_precision < 1 or self.jobs < 1:
            raise InputError("`dreal_precision` must lie between 0 and 1, and `jobs` be at least 1.")
        if self.level is not None and not (math.isfinite(self.level) and self.level > 0):
            raise InputError(f"`level` must be a positive number; found {self.level}.")
        if not self.time_limit > 0 or not self.max_boxes > 0:
            raise InputError("`time_limit` and `max_boxes` must be positive.")


@dataclass(frozen=True, slots=True)
class RoaResult:
    """What was proved. `reason` says what limits the level, or why nothing was proved.

    `candidate` is where P came from, `notice` why that is not what was asked for. `levels` has local (c1), roa (c2),
    sampled_limit and domain_limit; absent values are None. `checker` is what the checker said, None if it was not
    reached. `solver` has dReal's version and every query with its answer, None if it was not asked.
    """

    verdict: Verdict
    reason: str
    system: System
    network: TanhNetwork
    P: Array | None = None
    candidate: str | None = None
    notice: str | None = None
    levels: Mapping[str, float | None] = field(default_factory=dict)
    witness: Witness | None = None
    eigenvalues: tuple[str, ...] = ()
    boxes: int = 0
    leaves: int = 0
    seconds: Mapping[str, float] = field(default_factory=dict)
    certificate: Path | None = None
    checker: Mapping[str, Any] | None = None
    engine: Engine = "bounds"
    solver: Mapping[str, Any] | None = None

    def to_dict(self) -> dict[str, Any]:
        """The JSON object of `certify roa --json`."""
        level = self.levels.get("roa")
        P = self.P
        known = P is not None and level is not None
        return {
            "schema": "certify-roa/1",
            "verdict": self.verdict.value,
            "reason": self.reason,
            "system": self.system.name,
            "parameters": {name: str(q) for name, q in self.system.parameters.items()},
            "policy": {"sha256": self.network.sha256(), "layers": list(self.network.layers)},
            "lyapunov": {
                "P": None if P is None else P.tolist(), "candidate": self.candidate, "notice": self.notice,
            },
            "levels": {k: self.levels.get(k) for k in ("local", "roa", "sampled_limit", "domain_limit")},
            "witness": None if self.witness is None else {
                "x": self.witness.x.tolist(), "V": self.witness.level, "kind": self.witness.kind,
            },
            "eigenvalues": list(self.eigenvalues),
            "volume": volume(P, level) if known else None,  # type: ignore[arg-type]
            "semi_axes": semi_axes(P, level).tolist() if known else None,  # type: ignore[arg-type]
            "extents": extents(P, level).tolist() if known else None,  # type: ignore[arg-type]
            "engine": self.engine,
            "solver": None if self.solver is None else dict(self.solver),
            "boxes": self.boxes,
            "leaves": self.leaves,
            "seconds": {
                k: self.seconds.get(k) for k in ("load", "candidate", "local", "ring", "write", "check", "total")
            },
            "certificate": None if self.certificate is None else str(self.certificate),
            "checked": None if self.checker is None else self.checker.get("result"),
        }  # fmt: skip


class _Stopwatch:
    def __init__(self, load: float) -> None:
        self.seconds: dict[str, float] = {"load": load}
        self.start = time.perf_counter()
        self.load = load

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin

    def total(self) -> dict[str, float]:
        return {**self.seconds, "total": self.load + time.perf_counter() - self.start}


def certify_roa(
    system: System,
    network: TanhNetwork,
    out: Path,
    options: RoaOptions | None = None,
    *,
    load_seconds: float = 0.0,
    provenance: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
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
    RoaResult : PROVED only if the checker accepted the certificate, or, with engine `dreal`, answered TRUSTED.

    Raises
    ------
    InputError : the closed loop or an option cannot be used, or `out` cannot be written.
    BackendError : the checker process failed.
    SoundnessError : the checker rejects what the engine proved.
    """
    with _threads_for(network):
        return _certify(system, network, out, options or RoaOptions(), _Stopwatch(load_seconds), provenance, progress)


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


def _certify(
    system: System,
    network: TanhNetwork,
    out: Path,
    options: RoaOptions,
    watch: _Stopwatch,
    provenance: Mapping[str, Any] | None,
    progress: Progress | None,
) -> RoaResult:
    loop = ClosedLoop(system, network)
    _make_folder(out)

    with watch.stage("candidate"):
        A, _, _ = loop.linearise()
        unstable = _unstable(loop, A)
        if unstable is not None:
            verdict, reason, eigenvalues = unstable
            return RoaResult(verdict, reason, system, network, eigenvalues=eigenvalues, seconds=watch.total())
        P, name, notice = _candidate(loop, options)
        obligations = Obligations(loop, P, diagonalising_coordinates(P, A))
        limit = domain_limit(P, system.domain)
    levels: dict[str, float | None] = {"domain_limit": limit}

    def unfinished(verdict: Verdict, reason: str, witness: Witness | None = None, boxes: int = 0) -> RoaResult:
        return RoaResult(
            verdict, reason, system, network, P, name, notice, levels, witness,
            boxes=boxes, seconds=watch.total(), engine=options.engine,
        )  # fmt: skip

    if options.level is not None and options.level >= limit:
        return unfinished(
            Verdict.REFUTED if options.level > limit * (1 + _BELOW) else Verdict.UNKNOWN,
            f"domain: {{V <= {options.level:g}}} leaves the domain, whose limit is {limit:.12g}",
        )
    top = options.level if options.level is not None else limit * (1 - _BELOW)
    with watch.stage("ring"):
        witness = falsify(obligations, top)
    if witness is not None:
        levels["sampled_limit"] = witness.level
        if options.level is not None:
            return unfinished(Verdict.REFUTED, _describe(witness, system), witness)
        top = witness.level * (1 - 1e-3)
    with watch.stage("local"):
        inner = prove_local(obligations, top)
    if options.engine == "dreal":
        found = _ask_dreal(obligations, inner, top, options, out, watch, provenance, progress)
        if witness is not None and (found.witness is None or witness.level < found.witness.level):
            found = replace(found, witness=witness)
        found = replace(found, reason=_limit(found.reason, options, witness))
        known = {**levels, **{k: v for k, v in found.levels.items() if v is not None}}
        return replace(found, candidate=name, notice=notice, levels=known, seconds=watch.total())
    if inner is None:
        return unfinished(Verdict.UNKNOWN, "local: the linearisation does not dominate on any ball; try another --Q")

    import torch

    from certify.engines.branch_and_bound import Budget, prove_ring

    budget = Budget(boxes=options.max_boxes, seconds=options.time_limit - watch.seconds["ring"])
    with watch.stage("ring"):
        ring = prove_ring(
            obligations, inner, top, budget, torch.device(options.device),
            None if progress is None else lambda state: progress("ring", state),
        )  # fmt: skip
    if ring.witness is not None and (witness is None or ring.witness.level < witness.level):
        witness = ring.witness
        levels["sampled_limit"] = witness.level
    if options.level is not None and ring.level < options.level:
        levels["local"] = inner
        if witness is not None and witness.level <= options.level:
            return unfinished(Verdict.REFUTED, _describe(witness, system), witness, ring.boxes)
        missed = f"{ring.reason}: proved only up to V <= {ring.level:.12g}, not {options.level:g}"
        return unfinished(Verdict.UNKNOWN, missed, boxes=ring.boxes)
    reason = _limit(ring.reason, options, witness)
    levels |= {"local": inner, "roa": ring.level}
    certificate = Certificate(
        system, network, P, inner, ring.level, PartitionTree(obligations.T, ring.root, ring.tree), provenance or {}
    )
    path, answer = _write_and_check(out, certificate, "ACCEPTED", watch, progress)
    solver = _confirm(obligations, inner, ring.level, options, out) if options.engine == "both" else None
    return RoaResult(
        Verdict.PROVED, reason, system, network, P, name, notice, levels, witness, boxes=ring.boxes, leaves=ring.leaves,
        seconds=watch.total(), certificate=path, checker=answer, engine=options.engine, solver=solver,
    )  # fmt: skip


def _write_and_check(
    out: Path, certificate: Certificate, wanted: str, watch: _Stopwatch, progress: Progress | None
) -> tuple[Path, dict[str, Any]]:
    """The certificate's path and the checker's answer; it gets its name only when the answer is `wanted`.

    Raises
    ------
    SoundnessError : the checker says something else.
    """
    path, unchecked = out / "certificate.json", out / "certificate.unchecked.json"
    with watch.stage("write"):
        write_certificate(unchecked, certificate)
    if progress is not None:
        progress("check", None)
    try:
        with watch.stage("check"):
            answer = run_checker(unchecked)
    except KeyboardInterrupt:
        unchecked.unlink()
        raise
    if answer["result"] != wanted:
        raise SoundnessError(
            f"the checker rejects what the engine proved: {answer}. The certificate {unchecked} reproduces it."
        )
    unchecked.replace(path)
    return path, answer


def _limit(reason: str, options: RoaOptions, witness: Witness | None) -> str:
    """What limits a level, from what stopped its proof."""
    if reason != "requested" or options.level is not None:
        return reason
    return "domain" if witness is None else ("inputs" if witness.kind == "input" else "witness")


def _ask_dreal(
    obligations: Obligations, guess: float | None, top: float, options: RoaOptions, out: Path, watch: _Stopwatch,
    provenance: Mapping[str, Any] | None, progress: Progress | None,
) -> RoaResult:  # fmt: skip
    """Levels by dReal; the certificate says that it was trusted, and the checker checks what it can."""
    from certify.engines.dreal import find_backend
    from certify.engines.dreal_proof import DrealOptions, prove_with_dreal

    system, network, P = obligations.loop.system, obligations.loop.network, obligations.P
    result = RoaResult(Verdict.UNKNOWN, "", system, network, P, engine="dreal")
    try:
        backend = find_backend()
    except BackendError as error:
        return replace(result, reason=str(error))
    with watch.stage("ring"):
        proof = prove_with_dreal(
            obligations, 16 * guess if guess is not None else 1e-4 * top, top, backend,
            DrealOptions(options.dreal_precision, options.jobs, options.time_limit - watch.seconds["ring"]),
        )  # fmt: skip
    sampled = None if proof.witness is None else proof.witness.level
    result = replace(
        result, reason=proof.reason, witness=proof.witness, solver=_solver(backend.version, options, proof.asked),
        levels={"local": proof.inner, "roa": proof.level, "sampled_limit": sampled},
    )  # fmt: skip
    if proof.inner is None or proof.level is None:
        return result
    if options.level is not None and proof.level < options.level:
        result = replace(result, levels={"local": proof.inner, "sampled_limit": sampled})
        if proof.witness is not None and proof.witness.level <= options.level:
            return replace(result, verdict=Verdict.REFUTED, reason=_describe(proof.witness, system))
        return replace(result, reason=f"{proof.reason}: up to V <= {proof.level:.12g}, not {options.level:g}")
    evidence = TrustedSolver(
        "dreal", backend.version, options.dreal_precision,
        tuple((f"{asked.name}-{asked.level!r}", asked.answer.status) for asked in proof.asked),
    )  # fmt: skip
    certificate = Certificate(system, network, P, proof.inner, proof.level, evidence, provenance or {})
    path, answer = _write_and_check(out, certificate, "TRUSTED", watch, progress)
    return replace(result, verdict=Verdict.PROVED, certificate=path, checker=answer)


def _confirm(obligations: Obligations, inner: float, outer: float, options: RoaOptions, out: Path) -> dict[str, Any]:
    """dReal's answers about what the bounds engine proved.

    Raises
    ------
    SoundnessError : dReal points at a genuine violation of what was proved and checked.
    """
    from certify.engines.dreal import find_backend
    from certify.engines.dreal_proof import DrealOptions, confirm_with_dreal

    try:
        backend = find_backend()
    except BackendError as error:
        return {"solver": "dreal", "missing": str(error)}
    allowed = DrealOptions(options.dreal_precision, options.jobs, options.time_limit)
    asked, witness = confirm_with_dreal(obligations, inner, outer, backend, allowed)
    if witness is not None:
        path = out / "contradiction.json"
        stated = {"x": [v.hex() for v in witness.x.tolist()], "kind": witness.kind, "V": witness.level}
        path.write_text(json.dumps({"witness": stated, "certificate": "certificate.json"}) + "\n", encoding="utf-8")
        raise SoundnessError(f"dReal and Arb contradict a checked certificate; {path} has the witness.")
    return _solver(backend.version, options, asked)


def _solver(version: str, options: RoaOptions, asked: Sequence[Asked]) -> dict[str, Any]:
    """The record of every query."""
    rows = [
        {"query": a.name, "level": a.level, "answer": a.answer.status, "seconds": a.answer.seconds,
         "detail": a.answer.detail}
        for a in asked
    ]  # fmt: skip
    return {"solver": "dreal", "version": version, "precision": options.dreal_precision, "queries": rows}


def obligations_of(result: RoaResult) -> Obligations:
    """What a result was about, for asking another solver."""
    if result.P is None:
        raise InputError("there is no Lyapunov function: nothing was tried.")
    loop = ClosedLoop(result.system, result.network)
    return Obligations(loop, result.P, diagonalising_coordinates(result.P, loop.linearise()[0]))


def run_checker(path: Path) -> dict[str, Any]:
    """Run the checker on a file in a process of its own and return its JSON answer.

    Raises
    ------
    BackendError : it ended with neither ACCEPTED, nor TRUSTED, nor REJECTED.
    """
    command = [sys.executable, "-I", "-m", "certify.checker", str(path), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    try:
        answer = json.loads(done.stdout)
    except json.JSONDecodeError:
        answer = {}
    expected = {"ACCEPTED": 0, "REJECTED": 1, "TRUSTED": 3}.get(answer.get("result", ""))
    if expected is None or done.returncode != expected:
        raise BackendError(
            f"the checker ended with status {done.returncode} and no verdict: "
            f"{answer.get('error', done.stderr.strip()[-300:])}"
        )
    return dict(answer)


def _make_folder(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".certify-write-test"
        probe.write_bytes(b"")
        probe.unlink()
    except OSError as error:
        raise InputError(f"output folder {out} cannot be written: {error.strerror}.") from error


def _unstable(loop: ClosedLoop, A: Array) -> tuple[Verdict, str, tuple[str, ...]] | None:
    """REFUTED or UNKNOWN with the eigenvalues, or None if the spectrum is rigorously stable."""
    enclosures = loop.eigenvalues()
    if enclosures is None:
        approximate = tuple(f"{v:.6g}" for v in np.linalg.eigvals(A))
        if np.max(np.linalg.eigvals(A).real) < 0:
            return None  # nearly multiple eigenvalues: the local proof decides
        return Verdict.UNKNOWN, f"spectrum: eigenvalues {', '.join(approximate)} touch the axis", approximate
    shown = tuple(f"{complex(v.mid()):.6g}" for v in enclosures)
    if any(v.real > 0 for v in enclosures):
        return Verdict.REFUTED, f"unstable linearisation: eigenvalues {', '.join(shown)}", shown
    if not all(v.real < 0 for v in enclosures):
        return Verdict.UNKNOWN, f"spectrum: eigenvalues {', '.join(shown)} touch the axis", shown
    return None


def _candidate(loop: ClosedLoop, options: RoaOptions) -> tuple[Array, str, str | None]:
    """P, where it comes from, and a notice."""
    if options.P is None:
        chosen = choose_candidate(loop, options.candidate, options.Q, options.R)
        return chosen.P, chosen.name, chosen.notice
    n, P = loop.system.n, np.array(options.P, dtype=np.float64)
    if P.shape != (n, n) or not np.all(np.isfinite(P)) or not np.all(np.linalg.eigvalsh((P + P.T) / 2) > 0):
        raise InputError(f"`P` must be a symmetric positive definite matrix of shape ({n}, {n}).")
    return P, "given", None


@dataclass(frozen=True, slots=True)
class CandidateVolume:
    """What a candidate could give at most: `level` is the smaller of the domain's limit and the lowest violation found.

    Sampled, not proved, unless the candidate is the one that was proved.
    """

    candidate: str
    level: float
    limited_by: Literal["domain", "sampled"]
    volume: float


def compare_candidates(
    system: System, network: TanhNetwork, options: RoaOptions, known: Mapping[str, Array], names: Sequence[Candidate]
) -> tuple[CandidateVolume, ...]:
    """The volumes within reach of several candidates; `known` has those whose P is there already."""
    loop = ClosedLoop(system, network)
    A, _, _ = loop.linearise()
    result = []
    for name in names:
        P = known[name] if name in known else choose_candidate(loop, name, options.Q, options.R).P
        limit = domain_limit(P, system.domain)
        witness = falsify(Obligations(loop, P, diagonalising_coordinates(P, A)), limit, samples=4000)
        level = limit if witness is None else witness.level
        result.append(CandidateVolume(name, level, "domain" if witness is None else "sampled", volume(P, level)))
    return tuple(result)


def _describe(witness: Witness, system: System) -> str:
    names = ", ".join(f"{s} = {v:.6g}" for s, v in zip(system.states, witness.x, strict=True))
    what = "Vdot >= 0" if witness.kind == "vdot" else "the input leaves its bounds"
    return f"witness: {what} at {names} with V = {witness.level:.12g} (shown in Arb)"
