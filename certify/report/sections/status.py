"""The boxes at the head of the page: the certificate's status, and requests that were missed.

Only this module decides whether a page may speak of a proof; all other sections get a `Status`, or the checker's answer
if it accepts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from certify.certificates import AnyCertificate, OuterTree, PartitionTree, RanksAlone, ReachCertificate, TrustedSolver
from certify.errors import SoundnessError
from certify.report.claims import CHECKED_ALWAYS, words_for
from certify.report.words import place, state_or_box


@dataclass(frozen=True, slots=True)
class Status:
    """A certificate's status: kind is ACCEPTED, TRUSTED, REJECTED or NOT CHECKED; note says why.

    `modules` are those of the checker's files that were used, if it accepted or trusted; empty if its answer has none.
    """

    kind: str
    note: str
    modules: tuple[str, ...] = ()

    @property
    def accepted(self) -> bool:
        """True if the page may speak of a proof."""
        return self.kind == "ACCEPTED"


_REPLAYED = PartitionTree | RanksAlone | OuterTree


def status_of(certificate: AnyCertificate, sha256: str, answer: Mapping[str, Any] | None) -> Status:
    """The status that the checker's answer gives the certificate whose bytes have this hash.

    Raises
    ------
    SoundnessError : the answer accepts or trusts another certificate than this one.
    """
    if answer is None:
        return Status("NOT CHECKED", "The checker was not asked. Until it accepts the file, nothing here is proved.")
    kind = answer.get("result")
    if kind == "REJECTED":
        where = f"rule {answer.get('rule', '?')} at {answer.get('at', '?')}"
        detail = f": {answer['detail']}" if answer.get("detail") else ""
        return Status("REJECTED", f"The checker refuses the certificate by {where}{detail}. Nothing here is proved.")
    if kind not in ("ACCEPTED", "TRUSTED"):
        return Status("NOT CHECKED", "The checker gave no verdict. Nothing here is proved.")
    levels = answer.get("levels")
    given = dict(levels) if isinstance(levels, Mapping) else {}
    beyond, ranks = answer.get("outer"), certificate.claim.ranks
    stated = None if isinstance(certificate, ReachCertificate) else certificate.claim.outer
    beyond = beyond if beyond is None or (isinstance(beyond, Mapping) and "level" in beyond) else {"level": "none"}
    for what, found, wanted in (
        ("bytes with sha256", answer.get("certificate_sha256"), sha256),
        ("policy with sha256", answer.get("policy_sha256"), certificate.network.sha256()),
        ("levels", given, dict(certificate.claim.levels)),
        (
            "level of the outer set",
            None if beyond is None else [beyond["level"]],
            None if stated is None else [stated.level],
        ),
        ("steps of ranks", _steps(answer.get("ranks")), None if ranks is None else ranks.steps),
        ("evidence to replay", kind == "ACCEPTED", isinstance(certificate.evidence, _REPLAYED)),
    ):
        if found != wanted:
            raise SoundnessError(
                f"the checker's answer must be about the certificate that the report shows; {what}: the answer has "
                f"{found}, the certificate {wanted}. Read the file once and check the bytes that were read."
            )
    if isinstance(certificate.evidence, TrustedSolver):
        solver = f"{certificate.evidence.solver} {certificate.evidence.version}"
        return Status(
            "TRUSTED",
            f"The checker checked what is exact: {_checked(certificate.kind)}. All else, above all that V̇ "
            f"is negative, is the word of {solver}, which nothing here can check. It is not a proof.",
            _modules(answer),
        )
    second = answer.get("reference") or {}
    both = (second.get("result"), second.get("certificate_sha256")) == ("ACCEPTED", sha256)
    also = " So did the reference, a second checker that shares no code with it." if both else ""
    return Status(
        "ACCEPTED",
        f"The independent checker accepted the certificate.{also}",
        _modules(answer),
    )


def _steps(said: Any) -> Any:
    """The most steps of ranks that an answer speaks of; None if it speaks of none."""
    return said.get("steps", "none") if isinstance(said, Mapping) else said


def _modules(answer: Mapping[str, Any]) -> tuple[str, ...]:
    """The checker's files that were used, by name."""
    return tuple(map(str, answer.get("modules") or ()))


def _checked(kind: str) -> str:
    """The parts that are checked whatever the evidence is."""
    names = {"Lyapunov function": "P", "Equilibrium": "P, the equilibrium", "Domain": "the domain"}
    return ", ".join(names[name] for name, _, _ in words_for(kind).parts if name in CHECKED_ALWAYS)


def is_missed(result: Mapping[str, Any] | None) -> bool:
    """True if the run's reason is about a requested state or level of N, and not about the certificate's set."""
    return result is not None and result.get("stop") in ("path", "beyond")


def missed_of(result: Mapping[str, Any] | None, status: Status) -> str:
    """Name the requested state or level of N that this certificate does not cover; empty if there is none."""
    if result is None or not is_missed(result):
        return ""
    if result.get("stop") == "beyond":
        smaller = " The certificate is about a smaller set." if status.accepted else ""
        return f"An outer set was asked for that is not proved: {result['reason'].rstrip('.')}.{smaller}"
    asked: Mapping[str, str | Sequence[str]] = result.get("reach_from") or {}
    units = {s["name"]: s.get("unit") or "" for s in result.get("states") or ()}
    where = place(asked, [units.get(name, "") for name in asked])
    what = state_or_box(asked)
    proved = f"The certificate is about {{V ≤ c₂}} alone, in which this {what} does not lie." if status.accepted else ""
    return f"The {what} {where} was asked about. It is not shown to converge: {result['reason']}. {proved}".rstrip()
