"""Having a certificate accepted: written, checked, and mended where the checker refuses it.

A certificate gets its name only once the checker, run as a process of its own, has accepted the very bytes that were
written. Whatever it refuses, a run ends with what it accepts: a refused leaf is split again, or the level lowered.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from certify.certificate import Certificate, PartitionTree, TrustedSolver, write_beside
from certify.claims import Asymptotic, Enlarged, Nearby, Practical, Problem, Reached
from certify.engines.bounds.mend import below_leaf, split_again
from certify.engines.contraction import contraction
from certify.errors import BackendError, InputError, SoundnessError

_SPLITS, _LOWERINGS = 3, 9  # of what the checker refuses
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
class Clerk:
    """Writes certificates to `path` and has them checked.

    Parameters
    ----------
    left : seconds that may still be spent on a leaf that was refused; after that only the level is lowered.
    stage : times the stages `write` and `check`.
    tell : called before each check.
    show : called with the bytes of a certificate that the run ends with if they are accepted, before they are checked.
    check : the checker's answer about a file.
    cluster : the address of those whose boxes are among what is proved; they may not have done what they were asked.
    """

    path: Path
    left: Callable[[], float]
    stage: Callable[[str], AbstractContextManager[None]]
    tell: Callable[[], None]
    show: Callable[[bytes], None]
    check: Callable[[Path], Mapping[str, Any]]
    cluster: str | None = None

    def accepted(self, certificate: Certificate, problem: Problem) -> Accepted:
        """This certificate, or one with a refused leaf split again or a lower level.

        Raises
        ------
        InputError : the checker takes none of this size.
        SoundnessError : the checker refuses what cannot be mended so.
        BackendError : the same, where a cluster had a part in it.
        """
        splits = lowerings = 0
        mended, first = None, certificate
        while True:
            data, answer = self.ask(certificate, final=True)
            if answer["result"] == _wanted(certificate):
                return Accepted(certificate, self.path, data, answer, mended)
            finer = None
            if splits < _SPLITS and self.left() > 0:
                finer = _finer(certificate, problem, answer)
            if finer is not None:
                splits += 1
                certificate = replace(certificate, evidence=finer)
            elif (lower := _lowered(certificate, answer, problem, lowerings)) is not None and lowerings < _LOWERINGS:
                lowerings += 1
                certificate = lower
            elif answer.get("rule") == "limits":
                raise InputError(
                    f"the checkers take no certificate of this size: {answer['detail']} (rule limits, {answer['at']}). "
                    "Try a lower --level, a smaller policy, or fewer ranges and cells."
                )
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
            mended = f"the checker refused {answer.get('at')} (rule {answer.get('rule')}): " + (
                _what_is_lower(first, certificate) if lowerings else "split again, it is accepted"
            )
            if self.cluster is not None and lowerings:
                mended += f"; boxes were bounded by the workers of {self.cluster}, who may be at fault"

    def ask(self, certificate: Certificate, *, final: bool = False) -> tuple[bytes, Mapping[str, Any]]:
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
                for what, said, meant in (
                    ("bytes", answer["certificate_sha256"], hashlib.sha256(data).hexdigest()),
                    ("levels", answer["levels"], dict(certificate.claim.levels)),
                ):
                    if said != meant:
                        raise SoundnessError(f"the checker's answer is about other {what} than {meant}: {answer}.")
                unchecked.replace(self.path)
        finally:
            unchecked.unlink(missing_ok=True)
        return data, answer


def _what_is_lower(first: Certificate, certificate: Certificate) -> str:
    said = []
    if first.claim.outer is not None and certificate.claim.outer is None:
        said.append("the set beyond the ellipsoid is left out")
    if first.kind != certificate.kind:
        what = "that trajectories converge to one equilibrium" if isinstance(first.claim, Nearby) else "it"
        said.append(f"{what} is left out" + ("" if isinstance(first.claim, Nearby) else " with its tube"))
    floors = [c.claim.floor for c in (certificate, first) if isinstance(c.claim, Practical)]
    if len(floors) == 2 and floors[0] > floors[1]:
        said.append(f"the floor is {floors[0]:.6g} in the place of {floors[1]:.6g}")
    if certificate.roa < first.roa:
        said.append(f"the level is {certificate.roa:.6g} in the place of {first.roa:.6g}")
    return ", ".join(said)


def _wanted(certificate: Certificate) -> str:
    return "TRUSTED" if isinstance(certificate.evidence, TrustedSolver) else "ACCEPTED"


def _leaf_of(answer: Mapping[str, Any]) -> int | None:
    """The number of the leaf that the checker refuses; None if it refuses something else."""
    found = re.fullmatch(r"leaf (\d+)", str(answer.get("at", "")))
    return int(found[1]) if found and answer.get("rule") in ("ring", "inputs", "flow") else None


def _finer(certificate: Certificate, problem: Problem, answer: Mapping[str, Any]) -> PartitionTree | None:
    """The evidence with the leaf split that the checker refuses, of the tree, of an outer set's tree or of a face; None
    if it refuses something else."""
    from certify.engines.outer import mend as outer

    evidence, claim, leaf = certificate.evidence, certificate.claim, _leaf_of(answer)
    if not isinstance(evidence, PartitionTree):
        return None
    if leaf is not None:
        return split_again(problem, evidence, claim, leaf)
    found = re.fullmatch(r"(?:outer|face (\d+)) leaf (\d+)", str(answer.get("at", "")))
    if found is None or evidence.outer is None:
        return None
    if found[1] is None:
        return replace(evidence, outer=outer.split_again(problem, evidence.outer, claim, int(found[2])))
    return replace(evidence, outer=outer.split_face_again(problem, evidence.outer, claim, int(found[1]), int(found[2])))


def _lowered(certificate: Certificate, answer: Mapping[str, Any], problem: Problem, tries: int) -> Certificate | None:
    """The certificate with a lower level: below the refused leaf at first, then halfway to the inner level, then at it,
    and then an inner level that is lower itself; None if there is nothing to lower."""
    claim, evidence, leaf = certificate.claim, certificate.evidence, _leaf_of(answer)
    if not isinstance(evidence, PartitionTree):
        return None
    if claim.outer is not None:
        return replace(certificate, claim=replace(claim, outer=None), evidence=replace(evidence, outer=None))
    if isinstance(claim, Nearby) and leaf is None:
        floor = _HIGHER * claim.floor
        closer = (
            contraction(problem, evidence.T, floor) if answer.get("rule") == "local" and floor < claim.local else None
        )
        if closer is None:
            return _without_equilibrium(certificate, claim, evidence)
        return replace(certificate, claim=replace(claim, floor=floor), evidence=replace(evidence, contraction=closer))
    if isinstance(claim, Enlarged | Reached):  # without its tube, what is refused may not be asked any more
        return replace(certificate, claim=Asymptotic(claim.roa, claim.local), evidence=replace(evidence, tube=()))
    if leaf is None or claim.inner == claim.roa:
        if isinstance(claim, Practical):
            floor = _HIGHER * claim.floor
            return replace(certificate, claim=replace(claim, floor=floor)) if floor < claim.local else None
        if not isinstance(claim, Asymptotic):
            return None
        return _local_only(certificate, claim.local / (2 if claim.inner == claim.roa else 1))

    level = below_leaf(problem, evidence, leaf) if tries < 2 else math.sqrt(claim.inner * claim.roa)
    if claim.inner < level < claim.roa and tries < 5:
        return replace(certificate, claim=replace(claim, roa=level))
    if isinstance(claim, Nearby):
        return _without_equilibrium(certificate, claim, evidence)
    return _local_only(certificate, claim.local) if isinstance(claim, Asymptotic) else None


def _without_equilibrium(certificate: Certificate, claim: Nearby, evidence: PartitionTree) -> Certificate:
    weaker = Practical(claim.roa, claim.local, claim.floor, rate=claim.rate)
    return replace(certificate, claim=weaker, evidence=replace(evidence, contraction=None))


def _local_only(certificate: Certificate, level: float) -> Certificate:
    """A claim of the local set alone, of which no leaf is asked."""
    return replace(certificate, claim=Asymptotic(roa=level, local=level, rate=certificate.claim.rate))
