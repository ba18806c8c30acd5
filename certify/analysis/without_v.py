"""Shared by runs whose claims have no V: parts of their results, the stopwatch, the acceptance of a certificate."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from certify.analysis.acceptance import Clerk, Desk
from certify.analysis.stages.state import Report, StageName, timed
from certify.certificates import AnyCertificate, RankTree, parse_any
from certify.certificates.claims import UNPROVED, Ranks
from certify.certificates.drawn import nonlinearity_of
from certify.certificates.tree import LEAF
from certify.certificates.verdict import Verdict
from certify.errors import BackendError, InputError, SoundnessError
from certify.loop.plants import System
from certify.loop.policies import PolicyNetwork
from certify.provers.base import Progress

AS_THEY_STAND = (
    "the plant's ranges are taken as they stand: no claim of this kind has the measurements or samples on which they "
    "rest yet"
)
Array = NDArray[np.float64]
C = TypeVar("C", bound=AnyCertificate)


@dataclass(frozen=True, slots=True)
class ResultWithoutV(ABC):
    """The part that results of these runs share. `reason` says in words why a run ends so.

    Parameters
    ----------
    boxes : looked at.
    constraints : those that are kept, in words by their names.
    certificate, raw, checker : the file, its bytes, and the checker's answer about them; None where there is none.
    """

    verdict: Verdict
    reason: str
    system: System
    network: PolicyNetwork
    boxes: int = field(default=0, kw_only=True)
    constraints: Mapping[str, str] = field(default_factory=dict, kw_only=True)
    notice: str | None = field(default=None, kw_only=True)
    seconds: Mapping[str, float] = field(default_factory=dict, kw_only=True)
    certificate: Path | None = field(default=None, kw_only=True)
    raw: bytes | None = field(default=None, repr=False, kw_only=True)
    checker: Mapping[str, Any] | None = field(default=None, kw_only=True)

    @abstractmethod
    def to_dict(self) -> dict[str, Any]:
        """The JSON object."""

    def about_the_run(self) -> dict[str, Any]:
        """The entries of the loop, the work and the certificate, at the end of the JSON object."""
        system, checker = self.system, self.checker
        return {
            "time": system.time,
            "system": system.name,
            "parameters": {name: str(q) for name, q in system.parameters.items()},
            "uncertain": {name: [str(lo), str(hi)] for name, (lo, hi) in system.ranges.items()},
            "states": [{"name": s.name, "unit": system.units.get(s.name, "")} for s in system.states],
            "policy": {
                "sha256": self.network.sha256(),
                "layers": list(self.network.layers),
                "words": self.network.words,
            },
            "nonlinearity": self._nonlinearity(),
            "boxes": self.boxes,
            "notice": self.notice,
            "seconds": dict(self.seconds),
            "certificate": None if self.certificate is None else str(self.certificate),
            "certificate_sha256": None if checker is None else checker.get("certificate_sha256"),
            "checked": None if checker is None else checker.get("result"),
            "reference": None if checker is None else checker.get("reference", {}).get("result"),
        }

    def _nonlinearity(self) -> dict[str, Any] | None:
        """The policy's nonlinearity, sampled on the set; None without a certificate."""
        found = None if self.raw is None else nonlinearity_of(parse_any(self.raw, str(self.certificate)))
        return None if found is None else found.to_dict()


@dataclass
class Tools:
    """The stopwatch of a run, and those who are told of it."""

    progress: Report | None
    seconds: dict[str, float] = field(default_factory=dict)
    remarks: list[str] = field(default_factory=list)

    def timing(self, stage: str) -> AbstractContextManager[None]:
        """Add the seconds of the block to those of a stage."""
        return timed(self.seconds, stage)

    def tell(self, stage: StageName, progress: Progress | None = None) -> None:
        """Say which stage is at work, and where it stands."""
        if self.progress is not None:
            self.progress(stage, progress)

    def notice(self, system: System) -> str | None:
        """The notice about a run for a plant."""
        rests = [] if system.measurements is None and system.samples is None else [AS_THEY_STAND]
        return "; ".join(dict.fromkeys([*rests, *self.remarks])) or None

    def clerk(self, path: Path, jobs: int | None, many: bool, cluster: str | None = None) -> Clerk:
        """Somebody who writes certificates and has them checked; by several processes where leaves are `many`."""
        checked = Desk(jobs, many).checked
        return Clerk(path, self.timing, lambda: self.tell("check"), lambda _: None, checked, cluster)


def accepted(
    certificate: C, clerk: Clerk, mended: Callable[[C, str], C | None], most: int
) -> tuple[C, bytes, Mapping[str, Any]]:
    """The certificate, or one that is mended at most so many times where the checker refuses it, its bytes and the
    checker's answer; `mended` gets the place, and gives None where nothing helps.

    Raises
    ------
    SoundnessError : the checker refuses what cannot be mended.
    BackendError : the same, where a cluster had a part in it.
    """
    for _ in range(most):
        raw, answer = clerk.ask(certificate)
        if answer["result"] == "ACCEPTED":
            return certificate, raw, answer
        other = mended(certificate, str(answer.get("at", "")))
        if other is None:
            break
        certificate = other
    if clerk.cluster is not None:
        raise BackendError(
            f"the checker rejects what was proved with the workers of {clerk.cluster}, who may be at fault: {answer}. "
            "Run without the cluster."
        )
    raise SoundnessError(f"the checker rejects what the engine proved: {answer}.")


def require_periodic(
    system: System,
    angles: tuple[str, ...],
    root: tuple[Array, Array],
    certificate: Callable[[RankTree, Ranks], AnyCertificate],
    clerk: Clerk,
) -> None:
    """Refuse a loop or a region that is not the same after a full turn of an angle, as the checker sees it.

    Parameters
    ----------
    root : corners (n,) of the box of boxes with ranks.
    certificate : makes a certificate with these.

    Raises
    ------
    InputError : it is not.
    """
    if not angles:
        return
    nothing = RankTree(*root, bytes([LEAF]), np.array([UNPROVED], np.uint16), np.zeros(1, np.uint16))
    answer = clerk.tried(certificate(nothing, Ranks(angles, 1)))
    if answer.get("rule") == "angles":
        raise InputError(
            f"the loop, the region and the constraints must be the same after a full turn of {', '.join(angles)}"
            f", an angle of {system.name}: {answer['at']}, {answer['detail']}. Write them with sin and cos of it, or "
            "take the angle out of the plant's `angles`."
        )
