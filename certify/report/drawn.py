"""Draw a certificate's bytes as figures and a page, for the command and for a result in Python."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from certify.certificates import Certificate, parse_any, parse_certificate
from certify.errors import CertifyError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from certify.report.page import Figures


def page_of(
    raw: bytes,
    path: Path,
    answer: dict[str, Any] | None,
    data: dict[str, Any] | None,
    figures: Figures | None = None,
) -> str:
    """The report on a certificate's bytes, with the checker's answer and the run's data where they exist.

    `figures` are those of `figures_if_accepted` for the same bytes.
    """
    from certify.report.page import render_html
    from certify.report.short_page import render_short

    read, sha256 = parse_any(raw, str(path)), hashlib.sha256(raw).hexdigest()
    if not isinstance(read, Certificate):
        return render_short(read, answer, data, path, sha256, len(raw))
    return render_html(read, answer, data, path, sha256=sha256, size=len(raw), figures=figures)


def figures_if_accepted(raw: bytes, path: Path) -> Figures | None:
    """The figures of a page for accepted bytes, drawn before the checker answers; None if there are none."""
    from certify.report.figures import draw

    try:
        return draw(parse_certificate(raw, str(path)), accepted=True)
    except (CertifyError, ValueError, ArithmeticError):  # the page comes upon it again, and says so
        return None


def figure_of(certificate: Certificate, accepted: bool) -> Figure:
    """The proved set as a matplotlib figure, two columns of a paper wide."""
    from certify.report.figures.paper import PaperOptions, set_figure

    return set_figure(certificate, accepted, PaperOptions(columns=2))
