"""The page of a certificate without V: shorter than that of a set of attraction, of the same parts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from certify.certificates import InvariantCertificate, ReachCertificate, RemainCertificate
from certify.errors import InputError
from certify.report.reach_page import reached_parts
from certify.report.sections.numbers import file_rows, run_rows
from certify.report.sections.plant import plant_of
from certify.report.sections.shared import timing_of
from certify.report.sections.status import status_of
from certify.report.sheet import filled
from certify.report.stay_page import stayed_parts


def render_short(
    certificate: ReachCertificate | RemainCertificate | InvariantCertificate,
    answer: Mapping[str, Any] | None,
    result: Mapping[str, Any] | None,
    path: Path,
    sha256: str,
    size: int,
) -> str:
    """The report as one HTML document.

    Parameters
    ----------
    answer : the checker's answer about these bytes; None if it was not run.
    result : the JSON object of the run that made the certificate; None if there is none.
    path : for its name only; nothing is read from it.
    sha256, size : of the bytes that the certificate was parsed from.

    Raises
    ------
    SoundnessError : the answer is not about these bytes.
    InputError : the result is not of the run that made the certificate.
    """
    status = status_of(certificate, sha256, answer)
    if result is not None and result["certificate_sha256"] != sha256:
        raise InputError("`result` must be of the run that made the certificate; its hash is another.")
    if isinstance(certificate, ReachCertificate):
        file, own = "reached.html", reached_parts(certificate, status, result)
    else:
        file, own = "stayed.html", stayed_parts(certificate, status, answer)
    return filled(
        "certify.report",
        file,
        one_plane=certificate.system.n <= 2,
        status=status,
        replayed=True,
        file=path.name,
        plant=plant_of(certificate),
        timing=timing_of(certificate),
        evidence=file_rows(certificate, sha256, size),
        run=run_rows(result),
        provenance=sorted((str(k), str(v)) for k, v in certificate.provenance.items()),
        **own,
    )
