"""`certify sweep`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from certify.cli.shared import Json, Quiet
from certify.cli.terminal import say, tell

if TYPE_CHECKING:
    from certify.analysis.studies import Row, Sweep


def sweep(
    study: Annotated[Path, typer.Argument(help="The study: a TOML file with the values to cross.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for table and certificates; default: out/STUDY. Finished cases stay.")
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="Cases at a time, as processes of this machine; default: 1.")] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            help="Dask cluster to run on: a scheduler's address, tcp://HOST:8786, or local:N.", metavar="ADDRESS"
        ),
    ] = None,
    quiet: Quiet = False,
    as_json: Json = False,
) -> None:
    """Certify every case of a study (policies, plants, parameters, candidates, options) and write a table."""
    from certify.analysis.studies import read_study, run_sweep
    from certify.provers.execution.tasks import place_for

    place = place_for(jobs, cluster)
    read = read_study(study)
    folder = out if out is not None else Path("out") / read.name
    found = run_sweep(read, folder, place, (lambda *_: None) if quiet else _tell)
    if "parquet" not in found.files and not quiet:
        tell("no Parquet file is written: it needs pyarrow, `pip install '.[parquet]'` in the project's folder")
    say(json.dumps(found.to_dict()) if as_json else _text(found))
    raise typer.Exit(found.exit_status)


def _tell(row: Row, done: int, cases: int) -> None:
    """A line of progress."""
    from certify.report.words import below, seconds, volume_name

    size = (
        "" if row.volume is None else f"  {volume_name(len(row.states))} {below(row.volume)} {row.volume_unit}".rstrip()
    )
    why = row.error or ("" if row.volume is not None else row.reason)
    said = "could not be run" if row.failed else row.verdict.value
    parts = [f"{done} of {cases}", row.case, said + size, *([why] if why else []), seconds(row.seconds)]
    tell("  ".join(parts))


def _text(found: Sweep) -> str:
    counts = [f"{count} {verdict}" for verdict, count in found.verdicts.items() if count]
    errors = f", {found.errors} of them could not be run" if found.errors else ""
    kept = f", {found.kept} of them done before" if found.kept else ""
    lines = [
        f"cases        {found.cases}{kept}",
        f"verdicts     {', '.join(counts) or 'none'}{errors}",
        f"time         {found.seconds:.1f} s",
        *(f"{kind:<11}  {path}" for kind, path in found.files.items()),
    ]
    return "\n".join(lines)
