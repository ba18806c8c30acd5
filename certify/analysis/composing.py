"""Make one certificate of two: where a practical claim ends, another about the same loop takes over.

A fitted function describes a black box far from the origin within an error that leaves a floor; near the origin its
linear part describes it within an error that vanishes there. Each gives a certificate, and the two give one asymptotic
claim about the plants that both describe (`docs/mathematics/handover.md`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from certify.analysis.acceptance import Desk
from certify.certificates import Certificate, parse_certificate, read_raw, sole_writer, write_beside
from certify.certificates.handover import joined, require_joinable, share
from certify.certificates.verdict import Verdict
from certify.errors import SoundnessError
from certify.loop.plants import System
from certify.lyapunov import volume
from certify.report.sampled import described


@dataclass(frozen=True, slots=True)
class ComposeResult:
    """The certificate of two, or the reason why there is none.

    Parameters
    ----------
    outer, inner : the practical one, and the one that takes over.
    share : the largest V' on the floor of the first, by the level of the second; above 1 it does not take over.
    certificate, raw, checker : the file, its bytes, and the checker's answer about them; None where there is none.
    """

    verdict: Verdict
    reason: str
    outer: Certificate
    inner: Certificate
    share: float
    certificate: Path | None = None
    raw: bytes | None = field(default=None, repr=False)
    checker: Mapping[str, Any] | None = None

    def to_dict(self) -> dict[str, Any]:
        """The JSON object."""
        checker = self.checker or {}
        return {
            "verdict": self.verdict.value,
            "reason": self.reason,
            "claim": {"kind": self.outer.kind, "then": {"kind": self.inner.kind}},
            "system": self.outer.system.name,
            "then": {"system": self.inner.system.name, "levels": dict(self.inner.claim.levels)},
            "levels": dict(self.outer.claim.levels),
            "states": [s.name for s in self.outer.system.states],
            "time": self.outer.system.time,
            "samples": self._samples(),
            "volume": volume(self.outer.P, self.outer.roa),
            "share": self.share,
            "policy": {"sha256": self.outer.network.sha256()},
            "certificate": None if self.certificate is None else str(self.certificate),
            "certificate_sha256": checker.get("certificate_sha256"),
            "checked": checker.get("result"),
            "reference": checker.get("reference", {}).get("result"),
        }

    def _samples(self) -> dict[str, Any] | None:
        """The samples of both, if every plant with functions that the second describes is one of the first as well."""
        outer, inner = described(self.outer.system), described(self.inner.system)
        if outer is None or inner is None or any(f["vanishes"] for f in outer["functions"]):
            return None
        return inner if _known(self.outer.system, outer) == _known(self.inner.system, inner) != {} else None


def _known(system: System, found: Mapping[str, Any]) -> dict[str, Any]:
    """The parts of a plant with sampled functions by which its plants are known, the sampled numbers among them;
    nothing where other quantities are uncertain."""
    samples = system.samples
    if samples is None or {*system.ranges} - {name for f in found["functions"] for name in f["quantities"]}:
        return {}
    equations: dict[str, Any] = {s.name: e for s, e in zip(system.states, system.uncertain_dynamics(), strict=True)}
    functions = {one.state: (one, samples.noise[one.state], samples.taken[one.state]) for one in samples.unknowns}
    return {"sha256": samples.sha256, **equations, **functions}


def compose(outer: Path | str, inner: Path | str, out: Path | str, jobs: int | None = None) -> ComposeResult:
    """Join two certificates, have the file checked, and write it as `certificate.json` into a folder.

    Parameters
    ----------
    outer, inner : certificates: of a practical claim, and of the asymptotic or nearby one that takes over.
    out : folder for the result.
    jobs : processes of the checker.

    Raises
    ------
    InputError : the two cannot be joined, or the folder cannot be written.
    SoundnessError : the checker refuses the file although each of the two was accepted before.
    """
    first, second = (read_raw(Path(path)) for path in (outer, inner))
    one, other = parse_certificate(first, str(outer)), parse_certificate(second, str(inner))
    require_joinable(one, other)
    most = share(one, other)
    if not most < 1:
        reason = (
            f"the floor of {outer} reaches {most:.4g} times the level of {inner}: prove a lower floor, or a larger set "
            "near the origin"
        )
        return ComposeResult(Verdict.UNKNOWN, reason, one, other, most)
    folder, data = Path(out), joined(first, second)
    with sole_writer(folder):
        unchecked = write_beside(folder / "certificate.json", data, ".unchecked.json")
        try:
            answer = Desk(jobs, False).checked(unchecked)
            if answer["result"] == "ACCEPTED":
                if answer["certificate_sha256"] != hashlib.sha256(data).hexdigest():
                    raise SoundnessError(f"the checker's answer is about other bytes than were written: {answer}.")
                unchecked.replace(folder / "certificate.json")
        finally:
            unchecked.unlink(missing_ok=True)
    found = ComposeResult(Verdict.UNKNOWN, "", one, other, most, checker=answer)
    return _ended(found, folder / "certificate.json", data)


def _ended(found: ComposeResult, path: Path, data: bytes) -> ComposeResult:
    """The result with its verdict by the checker's answer."""
    answer = found.checker or {}
    if answer.get("result") == "ACCEPTED":
        return replace(found, verdict=Verdict.PROVED, certificate=path, raw=data)
    who, rule, at = answer.get("by", "checker"), answer.get("rule"), answer.get("at")
    return replace(found, reason=f"the {who} refuses it under rule {rule} at {at}: {answer.get('detail')}")
