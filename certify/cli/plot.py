"""`certify plot`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from certify.cli.shared import Json
from certify.cli.terminal import say


def plot(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    out: Annotated[Path, typer.Option(help="Figure to write: FILE.pdf, FILE.svg or FILE.png.")],
    columns: Annotated[int, typer.Option(help="Width: 1 or 2 columns of a paper.")] = 1,
    pairs: Annotated[
        list[str] | None,
        typer.Option(
            help="Two states to draw against each other, as in x,x_dot; repeatable; default: chosen by the equations."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Check a certificate and draw its set for a paper."""
    import tempfile

    from certify.certificates import parse_any, read_raw, run_checker, write_atomically
    from certify.report.figures.paper import PaperOptions, paper_figure

    options = PaperOptions(columns, tuple(pairs or ()), out.suffix.removeprefix(".").lower())  # type: ignore[arg-type]
    raw = read_raw(certificate)
    with tempfile.TemporaryDirectory() as folder:  # the bytes drawn are the bytes checked, whatever happens to the path
        private = Path(folder) / "certificate.json"
        private.write_bytes(raw)
        answer = run_checker(private)
    accepted = answer["result"] == "ACCEPTED"
    write_atomically(out, paper_figure(parse_any(raw, str(certificate)), accepted, options))
    stated = {"figure": str(out), "result": answer["result"]}
    say(json.dumps(stated) if as_json else f"{answer['result']}  {out}")
    raise typer.Exit({"ACCEPTED": 0, "TRUSTED": 3}.get(answer["result"], 1))
