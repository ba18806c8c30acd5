"""The parts of a page that only a certificate has by which a set is never left."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from certify.certificates import InvariantCertificate
from certify.errors import CertifyError
from certify.lyapunov import sampled_volume
from certify.lyapunov.neural import Neural
from certify.report.figures.staying import staying_pictures
from certify.report.figures.style import Picture
from certify.report.mathml import identifier, inequality, typeset
from certify.report.sections.not_proved import not_staying_of
from certify.report.sections.status import Status
from certify.report.words import network_name, volume_name

_LONGEST = 200  # letters of an expression that is shown


def stayed_parts(certificate: InvariantCertificate, status: Status, answer: Mapping[str, Any] | None) -> dict[str, Any]:
    """The values of `stayed.html` that pages of other claims do not have, or have otherwise."""
    pictures, trouble = _pictures(certificate, status)
    return {
        "claim": _claim(certificate),
        "pictures": pictures,
        "trouble": trouble,
        "numbers": _numbers(certificate, answer if status.accepted else None),
        "not_proved": not_staying_of(certificate),
    }


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
        "own": "N",
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
