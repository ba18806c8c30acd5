"""`certify --version`: the version, and the hashes of the programs that a verdict rests on."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from certify.cli.terminal import say


def _version(asked: bool) -> None:
    if not asked:
        return
    from certify import __version__
    from certify.analysis.installation import source_sha256, version_of
    from certify.certificates.formats import SCHEMA
    from certify.loop.policies.file import FORMAT, SECOND

    lines = [
        f"certify {__version__}",
        f"formats    {SCHEMA}; {FORMAT} and {SECOND.rpartition('/')[2]}",
        f"checker    sha256 {source_sha256('checker')}",
        f"reference  sha256 {source_sha256('reference')}",
        f"they run on Python {sys.version.split()[0]}, python-flint {version_of('python-flint')}, "
        f"numpy {version_of('numpy')} (the checker alone)",
    ]
    say("\n".join(lines))
    raise typer.Exit


def certify(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            is_eager=True,
            callback=_version,
            help="Show the version, and the hashes of the programs that a verdict rests on.",
        ),
    ] = False,
) -> None:
    """Regions of attraction of plants controlled by neural networks, proved and independently checked."""
