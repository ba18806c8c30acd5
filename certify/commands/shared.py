"""What several commands share: an option, a report on a certificate's bytes, a file written in one step."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

Json = Annotated[bool, typer.Option("--json", help="Print one JSON object instead of text.")]


def page_of(raw: bytes, path: Path, answer: dict[str, Any] | None, data: dict[str, Any] | None) -> str:
    """The report on a certificate's bytes, with the checker's answer about them and what the run says, if there are."""
    import hashlib

    from certify.certificate import parse_certificate
    from certify.report import render_html

    read, sha256 = parse_certificate(raw, str(path)), hashlib.sha256(raw).hexdigest()
    return render_html(read, answer, data, path, sha256=sha256, size=len(raw))


def write(path: Path, text: str) -> None:
    from certify.certificate import write_atomically

    write_atomically(path, text.encode())
