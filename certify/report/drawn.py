"""What is drawn of a certificate's bytes, for whoever has them: the command, and a result in Python."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.certificate import Certificate, parse_certificate

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def page_of(raw: bytes, path: Path, answer: dict[str, Any] | None, data: dict[str, Any] | None) -> str:
    """The report on a certificate's bytes, with the checker's answer about them and what the run says, if there are."""
    from certify.report.page import render_html

    read, sha256 = parse_certificate(raw, str(path)), hashlib.sha256(raw).hexdigest()
    return render_html(read, answer, data, path, sha256=sha256, size=len(raw))


def figure_of(certificate: Certificate, accepted: bool) -> Figure:
    """The certified set as a figure of matplotlib, two columns of a paper wide."""
    from certify.report.figures.paper import PaperOptions, set_figure

    return set_figure(certificate, accepted, PaperOptions(columns=2))
