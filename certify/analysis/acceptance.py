"""Having a certificate accepted: written, checked, and mended where the checker refuses it.

A certificate gets its name only once the checker, run as a process of its own, has accepted the very bytes that were
written. Whatever it refuses, a run ends with what it accepts: a refused leaf is split again, or the level lowered.
"""

from __future__ import annotations

import hashlib
import math
import os
import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from certify.certificates import (
    AnyCertificate,
    Certificate,
    PartitionTree,
    TrustedSolver,
    run_checker,
    write_beside,
)
from certify.certificates.claims import Claim, Problem
from certify.errors import BackendError, SoundnessError
from certify.provers.ball.contraction import contraction
from certify.provers.boxes.mend import below_leaves, split_again
from certify.provers.ranks import without_leaf

_SPLITS, _LOWERINGS = 3, 9  # the most splits and lowerings for leaves that the checker refuses
_BELOW_LEAVES, _LEVELS = 2, 5  # weaker certificates: below a refused leaf so long, and with a lower level at all
_MOST_LEAVES = 1000  # that are split again
_LONG = 1_000_000  # bytes of a certificate, from which on several processes check it
_MOST_JOBS = 64
_QUICK, _LEAVES, _BYTES = 5, 200, 200_000  # seconds of the reference; where there is more to examine it needs longer
_NEWEST, _MINUTE = (b'"directions"', b'"samples"'), 60  # certificates by the newest rules, and seconds for them
_HIGHER = 1.5  # the next floor, after one that is refused


@dataclass(frozen=True, slots=True)
class Accepted:
    """A certificate that the checker accepts (or trusts), its path and bytes, the answer, and what was mended."""

    certificate: Certificate
    path: Path
    data: bytes
    answer: Mapping[str, Any]
    mended: str | None


@dataclass(frozen=True, slots=True)
class Desk:
    """The place where certificates are checked.

    Parameters
    ----------
    jobs : processes of the checker; by default one for each core where there is much to do, as with ranks.
    """

    jobs: int | None
    ranked: bool

    def checked(self, path: Path) -> Mapping[str, Any]:
        """The checker's answer about a file; where there are many leaves, several processes share them.

        Where the checker accepts and the reference is quick, the reference is asked too: the answer then has its own as
        `reference`, or is its refusal, and says so.
        """
        cores = len(os.sched_getaffinity(0)) if self.ranked or path.stat().st_size > _LONG else 1
        answer = run_checker(path, jobs=self.jobs or min(cores, _MOST_JOBS), every=True)
        return self._twice(path, answer) if answer["result"] == "ACCEPTED" else answer

    def _twice(self, path: Path, answer: Mapping[str, Any]) -> Mapping[str, Any]:
        """The checker's answer with the reference's, or that alone if it refuses; the checker's if it needs long.

        Of kinks on a ball and samples, the newest rules, the reference is asked although it may need a minute.
        """
        raw, leaves = path.read_bytes(), sum(answer["rules"][rule] for rule in ("ring", "outer", "faces", "ranks"))
        newest = any(mark in raw for mark in _NEWEST)
        if not newest and (leaves > _LEAVES or len(raw) > _BYTES):
            return answer
        try:
            second = run_checker(path, program="reference", seconds=_MINUTE if newest else _QUICK)
        except TimeoutError:
            return answer
        return {**answer, "reference": second} if second["result"] == "ACCEPTED" else {**second, "by": "reference"}


@dataclass(frozen=True, slots=True)
class Clerk:
    """Writes certificates to `path` and has them checked.

    Parameters
    ----------
    stage : times the stages `write` and `check`.
    tell : called before each check.
    show : called with the bytes of a certificate that the run ends with if they are accepted, before they are checked.
    check : the checker's answer about a file.
    cluster : the address of those whose boxes are among what is proved; they may not have done what they were asked.
    """

    path: Path
    stage: Callable[[str], AbstractContextManager[None]]
    tell: Callable[[], None]
    show: Callable[[bytes], None]
    check: Callable[[Path], Mapping[str, Any]]
    cluster: str | None = None

    def accepted(self, certificate: Certificate, problem: Problem) -> Accepted:
        """This certificate, or one with refused leaves split again or a lower level.

        Raises
        ------
        SoundnessError : the checker refuses what cannot be mended so.
        BackendError : the same, where a cluster had a part in it.
        """
        splits = lowerings = 0
        mended, first = None, certificate
        while True:
            data, answer = self.ask(certificate, final=True)
            if answer["result"] == _wanted(certificate):
                return Accepted(certificate, self.path, data, answer, mended)
            finer = _finer(certificate, problem, answer) if splits < _SPLITS else None
            if finer is not None:
                splits += 1
                certificate = replace(certificate, evidence=finer)
            elif (lower := _lowered(certificate, answer, problem, lowerings)) is not None and lowerings < _LOWERINGS:
                lowerings += 1
                certificate = lower
            else:
                reproduces = write_beside(self.path, first.to_json().encode(), ".unchecked.json")
                if self.cluster is not None:
                    raise BackendError(
                        f"the checker rejects what was proved with the workers of {self.cluster}, who may be at fault: "
                        f"{answer}. The certificate {reproduces} reproduces it; run without the cluster."
                    )
                raise SoundnessError(
                    f"the checker rejects what the engine proved: {answer}. The certificate {reproduces} reproduces it."
                )
            mended = f"the {answer.get('by', 'checker')} refused {answer.get('at')} (rule {answer.get('rule')}): " + (
                _what_is_lower(first, certificate) if lowerings else "split again, it is accepted"
            )
            if self.cluster is not None and lowerings:
                mended += f"; boxes were bounded by the workers of {self.cluster}, who may be at fault"

    def ask(self, certificate: AnyCertificate, *, final: bool = False) -> tuple[bytes, Mapping[str, Any]]:
        """The certificate's bytes and the checker's answer; the file gets its name only if that is not a refusal.

        `final` : whether the run ends with this certificate if it is accepted.

        Raises
        ------
        SoundnessError : the checker speaks of other bytes or levels.
        """
        with self.stage("write"):
            data = certificate.to_json().encode()
            unchecked = write_beside(self.path, data, ".unchecked.json")
        self.tell()
        if final and _wanted(certificate) == "ACCEPTED":
            self.show(data)
        try:
            with self.stage("check"):
                answer = self.check(unchecked)
            if answer["result"] == _wanted(certificate):
                for one in (answer, answer.get("reference", answer)):
                    _require_about(one, data, certificate)
                unchecked.replace(self.path)
        finally:
            unchecked.unlink(missing_ok=True)
        return data, answer

    def tried(self, certificate: AnyCertificate) -> Mapping[str, Any]:
        """The checker's answer about a certificate that is not kept."""
        _, answer = self.ask(certificate)
        self.path.unlink(missing_ok=True)
        return answer


def _require_about(answer: Mapping[str, Any], data: bytes, certificate: AnyCertificate) -> None:
    """Raise SoundnessError unless an answer is about these bytes and levels."""
    for what, said, meant in (
        ("bytes", answer["certificate_sha256"], hashlib.sha256(data).hexdigest()),
        ("levels", answer["levels"], dict(certificate.claim.levels)),
    ):
        if said != meant:
            raise SoundnessError(f"the checker's answer is about other {what} than {meant}: {answer}.")


def _what_is_lower(first: Certificate, certificate: Certificate) -> str:
    said = []
    if first.claim.ranks is not None and certificate.claim.ranks is None:
        said.append("the boxes with ranks are left out")
    if first.claim.outer is not None and certificate.claim.outer is None:
        said.append("the set beyond the ellipsoid is left out")
    if first.claim.one_equilibrium and not certificate.claim.one_equilibrium:
        said.append("that trajectories converge to one equilibrium is left out")
    if first.claim.start is not None and certificate.claim.start is None:
        said.append("it is left out with its tube")
    floor, lower = certificate.claim.floor, first.claim.floor
    if floor is not None and lower is not None and floor > lower:
        said.append(f"the floor is {floor:.6g} instead of {lower:.6g}")
    if certificate.roa < first.roa:
        said.append(f"the level is {certificate.roa:.6g} instead of {first.roa:.6g}")
    return ", ".join(said)


def _wanted(certificate: AnyCertificate) -> str:
    return "TRUSTED" if isinstance(certificate.evidence, TrustedSolver) else "ACCEPTED"


def _leaves_of(answer: Mapping[str, Any]) -> list[int]:
    """The numbers of the leaves that the checker refuses, the lowest first; none if it refuses something else."""
    if answer.get("rule") not in ("ring", "inputs", "flow", "keep"):
        return []
    found = (re.fullmatch(r"leaf (\d+)", str(at)) for at in answer.get("every", (answer.get("at"),)))
    return sorted({int(one[1]) for one in found if one is not None})


def _finer(certificate: Certificate, problem: Problem, answer: Mapping[str, Any]) -> PartitionTree | None:
    """The evidence with the leaf split that the checker refuses, of the tree, of an outer set's tree or of a face, or
    without one of ranks; None if it refuses something else."""
    from certify.provers.outer import mend as outer

    evidence, claim, leaves = certificate.evidence, certificate.claim, _leaves_of(answer)
    if not isinstance(evidence, PartitionTree):
        return None
    if leaves:
        return split_again(problem, evidence, claim, leaves) if len(leaves) <= _MOST_LEAVES else None
    refused = re.fullmatch(r"rank leaf (\d+)", str(answer.get("at", "")))
    if refused is not None and evidence.ranks is not None:
        lower = without_leaf(evidence.ranks, int(refused[1]))
        return None if lower is None else replace(evidence, ranks=lower)
    found = re.fullmatch(r"(?:outer|face (\d+)) leaf (\d+)", str(answer.get("at", "")))
    if found is None or evidence.outer is None:
        return None
    if found[1] is None:
        return replace(evidence, outer=outer.split_again(problem, evidence.outer, claim, int(found[2])))
    return replace(evidence, outer=outer.split_face_again(problem, evidence.outer, claim, int(found[1]), int(found[2])))


@dataclass(frozen=True, slots=True)
class _Refused:
    """A certificate that the checker refuses under a `rule`, at `leaves` of the ring or elsewhere, after `tries` weaker
    ones."""

    certificate: Certificate
    evidence: PartitionTree
    problem: Problem
    rule: str
    leaves: list[int]
    tries: int

    @property
    def claim(self) -> Claim:
        return self.certificate.claim

    def with_claim(self, claim: Claim | None, **evidence: Any) -> Certificate | None:
        """The certificate with a weaker claim and less evidence; None without such a claim."""
        if claim is None:
            return None
        if claim.ranks is None:
            evidence = {"ranks": None, **evidence}
        return replace(self.certificate, claim=claim, evidence=replace(self.evidence, **evidence))


def _without_outer(refused: _Refused) -> Certificate | None:
    return refused.with_claim(refused.claim.without_outer(), outer=None)


def _with_higher_floor(refused: _Refused) -> Certificate | None:
    """Not for a leaf of the ring, and to one equilibrium only where trajectories still come closer."""
    claim = refused.claim
    higher = None if claim.floor is None or refused.leaves else claim.with_floor(_HIGHER * claim.floor)
    if higher is None or higher.floor is None or not claim.one_equilibrium:
        return refused.with_claim(higher)
    if refused.rule != "local":
        return None
    closer = contraction(refused.problem, refused.evidence.T, higher.floor)
    return None if closer is None else refused.with_claim(higher, contraction=closer)


def _without_tube(refused: _Refused) -> Certificate | None:
    """The claim without its tube, for which the refused condition may not be needed."""
    return refused.with_claim(refused.claim.without_tube(), tube=())


def _with_lower_level(refused: _Refused) -> Certificate | None:
    """Below the refused leaves at first, then halfway to the inner level."""
    claim = refused.claim
    if not refused.leaves or refused.tries >= _LEVELS:
        return None
    if refused.tries < _BELOW_LEAVES:
        return refused.with_claim(claim.lowered(below_leaves(refused.problem, refused.evidence, refused.leaves)))
    return refused.with_claim(claim.lowered(math.sqrt(claim.inner * claim.roa)))


def _without_equilibrium(refused: _Refused) -> Certificate | None:
    return refused.with_claim(refused.claim.without_equilibrium(), contraction=None)


def _without_contraction(refused: _Refused) -> Certificate | None:
    """The claim without its one equilibrium, if just that is refused: the set beyond the ellipsoid and a tube stay."""
    return _without_equilibrium(refused) if refused.rule == "contraction" else None


def _local_only(refused: _Refused) -> Certificate | None:
    """At the inner level, and then at one that is lower itself."""
    claim = refused.claim
    return refused.with_claim(claim.local_only(claim.local / (2 if claim.inner == claim.roa else 1)))


def _without_ranks(refused: _Refused) -> Certificate | None:
    """The claim without boxes with ranks, if it is refused under their rules, as where the loop has no such angles."""
    if refused.rule not in ("angles", "ranks"):
        return None
    return refused.with_claim(refused.claim.without_ranks(), ranks=None)


_CONCESSIONS = (
    _without_ranks,
    _without_contraction,
    _without_outer,
    _with_higher_floor,
    _without_tube,
    _with_lower_level,
    _without_equilibrium,
    _local_only,
)
"""The parts that can be given up for the rest to be accepted, in this order."""


def _lowered(certificate: Certificate, answer: Mapping[str, Any], problem: Problem, tries: int) -> Certificate | None:
    """The certificate with the first concession that can be made to the checker's answer; None if there is none."""
    evidence, claim = certificate.evidence, certificate.claim
    if not isinstance(evidence, PartitionTree):
        return None
    leaves = _leaves_of(answer) if claim.inner < claim.roa else []
    refused = _Refused(certificate, evidence, problem, str(answer.get("rule")), leaves, tries)
    return next((weaker for concede in _CONCESSIONS if (weaker := concede(refused)) is not None), None)
