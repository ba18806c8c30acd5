"""The parts of a page that only a certificate has by which a set is never left."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from certify.certificates import InvariantCertificate, RemainCertificate
from certify.errors import CertifyError
from certify.lyapunov import sampled_volume
from certify.lyapunov.neural import Neural
from certify.report.figures.staying import staying_pictures
from certify.report.figures.style import Picture
from certify.report.mathml import identifier, inequality, typeset
from certify.report.sections.not_proved import not_staying_of
from certify.report.sections.numbers import ranked_rows
from certify.report.sections.shared import timing_of
from certify.report.sections.status import Status
from certify.report.words import listed, network_name, symbol, volume_name

_LONGEST = 200  # letters of an expression that is shown


def stayed_parts(
    certificate: InvariantCertificate | RemainCertificate, status: Status, answer: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The values of `stayed.html` that pages of other claims do not have, or have otherwise."""
    pictures, trouble = _pictures(certificate, status)
    return {
        "claim": {
            **(_of_boxes(certificate) if isinstance(certificate, RemainCertificate) else _claim(certificate)),
            "constraints": [inequality(name, g) for name, g in certificate.constraints.items()],
        },
        "pictures": pictures,
        "trouble": trouble,
        "numbers": ranked_rows(certificate, "from one back into them", "boxes")
        if isinstance(certificate, RemainCertificate)
        else _numbers(certificate, answer if status.accepted else None),
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
        "steps": "",
        "turned": "",
        "level": repr(outer.level),
        "function": typeset(identifier("N"), N.expression) if short and not isinstance(N, Neural) else None,
        "words": f"{words} the certificate states.",
        "parts": parts,
    }


def _of_boxes(certificate: RemainCertificate) -> dict[str, Any]:
    """The claim about boxes, in words, and its parts."""
    claim, timing = certificate.claim, timing_of(certificate)
    angles = listed([symbol(name) for name in claim.ranks.angles])
    steps = "steps" if timing.discrete else "sampling instants"
    inside = f"all states but {angles} are" if angles else "the state is"
    meanwhile = "" if timing.discrete else ", at all times in between too"
    parts = [
        (
            "Boxes",
            f"From every box, after its number of {steps}, every trajectory is in one of the boxes again; before each "
            f"of these {steps} the closed loop is defined, the input keeps its bounds and {inside} strictly inside the "
            f"domain{meanwhile}, leaf by leaf of a partition, by a box that contains all states that a leaf's states "
            "become.",
        )
    ]
    if angles:
        parts.append(("Angles", f"After a full turn of {angles} the closed loop is the same."))
    if claim.keep:
        parts.append(("Constraints", f"Each of them holds before each of these {steps}{meanwhile}."))
    return {
        "own": "boxes",
        "function": None,
        "words": "",
        "steps": f"{claim.ranks.steps:,} {steps if claim.ranks.steps > 1 else steps[:-1]}",
        "inside": inside,
        "turned": angles,
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


def _pictures(certificate: InvariantCertificate | RemainCertificate, status: Status) -> tuple[list[Picture], str]:
    """The pictures, or the reason why there are none."""
    try:
        return staying_pictures(certificate, status.accepted), ""
    except (CertifyError, ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        if status.accepted:
            raise
        return [], f"There are no figures: {error}"  # a rejected file need not make sense
