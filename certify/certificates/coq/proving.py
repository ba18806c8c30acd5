"""Prove a certificate again in Coq: state its claim, search for evidence, run Coq.

The checkers do not run: Coq's proof stands alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

from certify.certificates import sole_writer
from certify.certificates.coq.data import read_claim
from certify.certificates.coq.kernel import WRITTEN, compile_apart, find_coqc, theory_files, theory_sha256, write_folder
from certify.certificates.coq.search import Limits, search
from certify.certificates.coq.text import ASSUMPTIONS, PROOF, claim_text, evidence_text
from certify.certificates.verdict import Verdict
from certify.errors import BackendError, OptionError


@dataclass(frozen=True, slots=True)
class CoqOptions:
    """Options of a proof in Coq.

    Parameters
    ----------
    rate : the rate at which V falls; None for one that costs little.
    time_limit : seconds for the search and for Coq together.
    boxes : the most boxes that the search may end with.
    run : True to run Coq; else its files are only written.
    """

    rate: Fraction | None = None
    time_limit: float = 600.0
    boxes: int = 20_000
    run: bool = True

    def __post_init__(self) -> None:
        if self.rate is not None and self.rate <= 0:
            raise OptionError(f"`rate` must be positive; found {self.rate}.")
        if not (self.time_limit > 0 and self.boxes >= 1):
            raise OptionError(
                f"`time_limit` must be positive and `boxes` at least 1; found {self.time_limit} and {self.boxes}."
            )


@dataclass(frozen=True, slots=True)
class CoqResult:
    """The result of a proof in Coq.

    Parameters
    ----------
    verdict : PROVED if Coq accepted the theorem on known axioms alone, else UNKNOWN.
    reason : why it is not proved; empty if it is.
    plant, certificate_sha256, policy_sha256, level : the claim; the hashes and the claim are of the same bytes.
    rate : the rate that the theorem states.
    boxes : the number of boxes of the partition; 0 without one.
    looked_at : the number of boxes that the search examined.
    search_seconds, coq_seconds : the time of each.
    axioms : the axioms that the theorem uses.
    theory_sha256 : the hash of the theory's files in their order.
    coq : Coq's version; None if it was not run.
    folder : the folder of the files; None if there are none.
    """

    verdict: Verdict
    reason: str
    plant: str
    certificate_sha256: str
    policy_sha256: str
    level: float
    rate: Fraction
    boxes: int
    looked_at: int
    search_seconds: float
    theory_sha256: str
    coq_seconds: float = 0.0
    axioms: tuple[str, ...] = ()
    coq: str | None = None
    folder: Path | None = field(default=None)


def prove_in_coq(
    raw: bytes, folder: Path, options: CoqOptions | None = None, tell: Callable[[str], None] | None = None
) -> CoqResult:
    """Prove a certificate's claim in Coq, and leave its files in a folder; Coq compiles exactly these bytes.

    Parameters
    ----------
    raw : the certificate's bytes.
    folder : the folder for Coq's files.
    tell : called with a line before each step.

    Raises
    ------
    CertificateFormatError, InputError : the bytes are no certificate, or Coq's statement cannot express the claim; the
    folder cannot be written, or another run works in it.
    """
    options, tell = options or CoqOptions(), tell or (lambda _: None)
    start = time.monotonic()
    claimed = read_claim(raw)
    theory = theory_files()
    tell("searching a partition")
    found = search(claimed, options.rate, Limits(options.time_limit, options.boxes))

    def result(verdict: Verdict, reason: str, **more: object) -> CoqResult:
        return CoqResult(
            verdict, reason, claimed.name, claimed.sha256, claimed.network.sha256(), claimed.level, found.rate,
            0 if found.evidence is None else found.evidence.leaves, found.boxes, found.seconds, theory_sha256(theory),
            **more,  # type: ignore[arg-type]
        )  # fmt: skip

    if found.evidence is None:
        return result(Verdict.UNKNOWN, f"the search found nothing at the rate {found.rate}: {found.reason}")
    texts = (claim_text(claimed, found.rate), evidence_text(found.evidence), PROOF, ASSUMPTIONS)
    files = theory | {name: text.encode("ascii") for name, text in zip(WRITTEN, texts, strict=True)}
    with sole_writer(folder):
        write_folder(folder, files)
        if not options.run:
            return result(Verdict.UNKNOWN, "Coq was not asked; check.sh in the folder asks it", folder=folder)
        try:
            coqc = find_coqc()
        except BackendError as error:
            said = f"{error} Coq's files are written; check.sh there compiles them"
            return result(Verdict.UNKNOWN, said, folder=folder)
        tell(f"Coq {coqc.version} at work")
        compiled = compile_apart(coqc, files, options.time_limit - (time.monotonic() - start))
    return result(
        Verdict.UNKNOWN if compiled.axioms is None else Verdict.PROVED,
        compiled.reason,
        coq_seconds=compiled.seconds,
        axioms=compiled.axioms or (),
        coq=coqc.version,
        folder=folder,
    )
