"""`certify compose`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from certify.cli.shared import Json, page_of, write
from certify.cli.terminal import say


def compose(
    outer: Annotated[Path, typer.Argument(help="Certificate of a practical claim.")],
    inner: Annotated[
        Path,
        typer.Argument(help="Certificate of the asymptotic or nearby claim, about the same loop, that takes over."),
    ],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for the results.")] = Path("out/composed"),
    jobs: Annotated[int | None, typer.Option(min=1, max=64, help="Processes of the checker.")] = None,
    as_json: Json = False,
) -> None:
    """Join two certificates: where a practical claim ends, another about the same loop takes over."""
    from certify.analysis.composing import compose as composed
    from certify.report.handover import summary_lines

    result = composed(outer, inner, out, jobs)
    data = result.to_dict()
    if result.certificate is not None and result.raw is not None:
        write(out / "report.html", page_of(result.raw, result.certificate, dict(result.checker or {}), None))
    if as_json:
        say(json.dumps(data))
    else:
        say("\n".join(summary_lines(data)))
        if result.certificate is not None:
            say(f"certificate  {result.certificate}\nreport       {out / 'report.html'}")
    raise typer.Exit(result.verdict.exit_status)
