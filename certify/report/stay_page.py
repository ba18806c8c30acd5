"""The page of a certificate that a set is never left: shorter than that of a set of attraction, of the same parts."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from certify.certificates import InvariantCertificate
from certify.errors import CertifyError, InputError
from certify.lyapunov import sampled_volume
from certify.lyapunov.neural import Neural
from certify.report.figures.staying import staying_pictures
from certify.report.figures.style import Picture
from certify.report.mathml import identifier, inequality, typeset
from certify.report.sections.not_proved import not_staying_of
from certify.report.sections.numbers import file_rows, run_rows
from certify.report.sections.plant import plant_of
from certify.report.sections.shared import timing_of
from certify.report.sections.status import Status, status_of
from certify.report.sheet import filled
from certify.report.words import network_name, volume_name

TEMPLATE = "certify.report", "stayed.html"
_LONGEST = 200  # letters of an expression that is shown


def render_stayed(
    certificate: InvariantCertificate,
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
    result : `InvariantResult.to_dict()` of the run that made the certificate; None if there is none.
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
    pictures, trouble = _pictures(certificate, status)
    system = certificate.system
    return filled(
        *TEMPLATE,
        one_plane=system.n <= 2,
        status=status,
        replayed=True,
        file=path.name,
        plant=plant_of(certificate),
        timing=timing_of(certificate),
        claim=_claim(certificate),
        pictures=pictures,
        trouble=trouble,
        numbers=_numbers(certificate, answer if status.accepted else None),
        evidence=file_rows(certificate, sha256, size),
        run=run_rows(result),
        provenance=sorted((str(k), str(v)) for k, v in certificate.provenance.items()),
        not_proved=not_staying_of(certificate),
    )


def _claim(certificate: InvariantCertificate) -> dict[str, Any]:
    """The claim in words and formulas, and its parts."""
    outer, keep = certificate.claim.outer, certificate.claim.keep
    parts = [
        ("Boundary of the domain", "N(x) > n₂ there, leaf by leaf of a partition of each face."),
        (
            "Boundary of the set",
            "Where N(x) = n₂, N falls: N′F < 0, by models of N and F on the leaves of a partition.",
        ),
        ("The set", "On all of it N is continuous, F is locally Lipschitz and the input keeps its bounds."),
    ]
    if keep:
        parts.append(("Constraints", "Each of them holds on all of the set."))
    N = outer.function
    words = (
        f"N is a tanh network, {network_name(N.widths)}, which" if isinstance(N, Neural) else "N is an expression that"
    )
    short = not isinstance(N, Neural) and len(str(N.expression)) <= _LONGEST
    return {
        "level": repr(outer.level),
        "function": typeset(identifier("N"), N.expression) if short and not isinstance(N, Neural) else None,
        "words": f"{words} the certificate states.",
        "constraints": [inequality(name, g) for name, g in certificate.constraints.items()],
        "parts": parts,
    }


def _numbers(certificate: InvariantCertificate, answer: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """The level, the size, and the leaves that the checker examined."""
    outer, system = certificate.claim.outer, certificate.system
    size, deviation = sampled_volume(lambda x: outer.function(x) <= outer.level, system.domain)
    rows = [
        ("level n₂", f"{outer.level:.12g}"),
        (volume_name(system.n), f"{size:.4g}, estimated from samples, standard deviation {deviation:.2g}"),
    ]
    if isinstance(outer.function, Neural):
        rows.append(("sha256 of N", outer.function.sha256()))
    found = (answer or {}).get("outer")
    if isinstance(found, Mapping):
        rows.append(
            ("leaves", f"{found.get('leaves', 0):,}, and {found.get('face_leaves', 0):,} on the domain's faces")
        )
    return rows


def _pictures(certificate: InvariantCertificate, status: Status) -> tuple[list[Picture], str]:
    """The pictures, or the reason why there are none."""
    try:
        return staying_pictures(certificate, status.accepted), ""
    except (CertifyError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        if status.accepted:
            raise
        return [], f"There are no figures: {error}"  # a rejected file need not make sense
