"""One self-contained HTML page for a certificate: figures inline, no script, nothing loaded from anywhere.

The page states a proof only if the checker's answer says ACCEPTED *and* is about exactly the bytes that the page is
drawn from, by their hash, and also by the policy and the levels (sections/status.py). An answer about anything else is
an error, not a page. Every text from a file passes through jinja2's escaping.

This module has the code for the whole page: its parts and the list of its contents.
`sections/` makes the sections' data, `template.html` their looks.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from certify.certificates import Certificate, PartitionTree
from certify.errors import CertifyError, InputError
from certify.report.figures import Picture, draw
from certify.report.sampling import SimulatedRoa
from certify.report.sections.claim import claim_of
from certify.report.sections.limits import limits_of
from certify.report.sections.not_proved import not_proved_of
from certify.report.sections.numbers import matrices_of, tables_of
from certify.report.sections.plant import plant_of
from certify.report.sections.shared import timing_of, words_of
from certify.report.sections.simulated import drawn_of, simulated_of
from certify.report.sections.status import Status, missed_of, status_of
from certify.report.sheet import filled

Figures = tuple[list[Picture], SimulatedRoa | None]
TEMPLATE = "certify.report", "template.html"


def render_html(
    certificate: Certificate,
    answer: Mapping[str, Any] | None,
    result: Mapping[str, Any] | None,
    certificate_path: Path,
    *,
    sha256: str | None = None,
    size: int | None = None,
    figures: Figures | None = None,
) -> str:
    """The report as one HTML document.

    Read the file once, with `read_raw`; take the certificate from these bytes with `parse_certificate`, their sha256
    and size, and the answer of `certify.certificates.run_checker` about a private file that holds them.

    Parameters
    ----------
    certificate : the certificate to show.
    answer : the checker's answer; None if it was not run.
    result : `RoaResult.to_dict()` of the run that made the certificate; None if there is none.
    certificate_path : the path, for its name only; nothing is read from it.
    sha256, size : hash and size of the bytes that the certificate was parsed from. By default those of the bytes that
        `write_certificate` writes for it: the answer must then be about exactly such a file.
    figures : those that `draw` makes of this certificate as accepted, if they are there already.

    Raises
    ------
    SoundnessError : the answer is not about these bytes.
    InputError : the result is not of the run that made the certificate.
    """
    if sha256 is None:
        raw = certificate.to_json().encode("utf-8")
        sha256, size = hashlib.sha256(raw).hexdigest(), len(raw)
    status = status_of(certificate, sha256, answer)
    beyond = certificate.claim.outer
    if result is not None and (
        result["policy"]["sha256"],
        result["levels"].get("roa"),
        (result.get("outer") or {}).get("level"),
    ) != (certificate.network.sha256(), certificate.roa, None if beyond is None else beyond.level):
        raise InputError("`result` must be of the run that made the certificate; its policy or a level is another.")
    words = words_of(certificate)
    pictures: list[Picture] = []
    roa, trouble = None, ""
    try:
        if figures is None or not status.accepted:
            figures = draw(certificate, status.accepted)
        pictures, roa = figures
    except np.linalg.LinAlgError as error:
        trouble = f"There are no figures: floating point cannot draw them: {error}"
    except (CertifyError, ValueError, ArithmeticError) as error:
        if status.accepted:
            raise
        trouble = f"There are no figures: {error}"  # a rejected file need not make sense
    limits = limits_of(certificate, result)
    return filled(
        *TEMPLATE,
        contents=_contents(status, limits),
        limits=limits,
        one_plane=certificate.system.n <= 2,
        status=status,
        words=words,
        replayed=isinstance(certificate.evidence, PartitionTree),
        pictures=[(legend, list(members)) for legend, members in groupby(pictures, lambda p: p.legend)],
        trouble=trouble,
        claim=claim_of(certificate, answer if status.accepted else None),
        missed=missed_of(result, status),
        plant=plant_of(certificate),
        then=None if certificate.then is None else _then_of(certificate.then),
        tables=tables_of(certificate, status, answer, result, sha256, size),
        matrices=matrices_of(certificate),
        roa=None if roa is None else simulated_of(roa, certificate),
        drawn=drawn_of(result),
        timing=timing_of(certificate),
        provenance=sorted((str(k), str(v)) for k, v in certificate.provenance.items()),
        file=certificate_path.name,
        not_proved=not_proved_of(certificate, words),
    )


def _then_of(certificate: Certificate) -> dict[str, Any]:
    """The claim that takes over, by its names in the template."""
    claim = claim_of(certificate, None)
    return {"level": claim["level"], "statement": claim["statement"], "plant": plant_of(certificate)}


def _contents(status: Status, limits: Mapping[str, Any] | None) -> list[tuple[str, str]]:
    """Targets and titles of the table of contents."""
    found = [
        ("claim", "What was proved" if status.accepted else "What is claimed"),
        ("outside", "What was not proved" if status.accepted else "What lies outside the claim"),
        ("figures", "Figures"),
    ]
    if limits is not None:
        found.append(("limits", "Limit of the set" if limits["binds"] else "Share of the domain"))
    return [*found, ("numbers", "Numbers"), ("check", "How to check")]
