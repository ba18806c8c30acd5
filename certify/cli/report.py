"""`certify report`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from certify.cli.shared import Json, page_of, write
from certify.cli.terminal import say


def report(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    out: Annotated[Path | None, typer.Option(help="HTML file; default: report.html beside the certificate.")] = None,
    as_json: Json = False,
) -> None:
    """Check a certificate and draw its report."""
    import tempfile

    from certify.certificates import read_raw, run_checker

    target = out if out is not None else certificate.parent / "report.html"
    raw = read_raw(certificate)
    with tempfile.TemporaryDirectory() as folder:  # the bytes drawn are the bytes checked, whatever happens to the path
        private = Path(folder) / "certificate.json"
        private.write_bytes(raw)
        answer = run_checker(private)
    write(target, page_of(raw, certificate, answer, None))
    stated = {"report": str(target), "result": answer["result"]}
    say(json.dumps(stated) if as_json else f"{answer['result']}  {target}")
    raise typer.Exit({"ACCEPTED": 0, "TRUSTED": 3}.get(answer["result"], 1))
