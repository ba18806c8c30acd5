"""The run of a command whose claim has no V: its files, its summary."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from certify.cli.certifying import add_command, finished
from certify.cli.shared import noting, page_of
from certify.cli.terminal import ProgressLine

if TYPE_CHECKING:
    import typer

    from certify.analysis.options import RoaOptions
    from certify.analysis.reaching import ReachOptions
    from certify.analysis.without_v import ResultWithoutV
    from certify.loop.plants import System
    from certify.loop.policies import Policy


def concluded(
    context: typer.Context,
    run: Callable[..., ResultWithoutV],
    summary: Callable[[Mapping[str, Any]], Any],
    policy: Path,
    stored: Policy,
    plant: System,
    options: ReachOptions | RoaOptions,
    out: Path | None,
    start: float,
    quiet: bool,
    as_json: bool,
    asked: str | None = None,
) -> NoReturn:
    """Run, write certificate and report, print the result; ends the command with the verdict's exit status.

    Parameters
    ----------
    run, summary : proves, and says of the result's JSON object what is printed.
    stored, plant : the policy in the file `policy`, and the plant.
    out : folder for the results.
    start : when the command began, by `time.perf_counter`.
    asked : a state or a box, as people write it; the result says if the proved set contains it.
    """
    from certify.analysis.installation import versions

    note, folder = noting(quiet), out if out is not None else Path("out") / policy.stem
    progress, later = None if quiet else ProgressLine(), list[str]()
    try:
        result = run(
            plant,
            stored.network,
            folder,
            options,
            load_seconds=time.perf_counter() - start,
            provenance={"policy": policy.name, **versions()},
            progress=progress,
            tell=later.append,
        )
    finally:
        if progress is not None:
            progress.close()
        for line in later:
            note(line)
    if result.notice is not None:
        note(result.notice)
    data = result.to_dict()
    if isinstance(data["next"], dict):
        add_command(data["next"], context)
    finished(result, data, _page_of, folder, summary, as_json, asked)


def _page_of(raw: bytes, path: Path, answer: dict[str, Any] | None, data: dict[str, Any] | None) -> str:
    """The report; the page of a claim with a V is about the certificate alone."""
    from certify.certificates import Certificate, parse_any

    has_v = isinstance(parse_any(raw, str(path)), Certificate)
    return page_of(raw, path, answer, None if has_v else data)
