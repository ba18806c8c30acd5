"""`certify check`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from certify.cli.checked import checked
from certify.cli.shared import Json


def check(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    policy: Annotated[
        Path | None, typer.Option(help="Policy file that the certificate must be about (by its hash).")
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Use the second checker (fractions, Arb balls): slower, shares no code.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Processes that examine the leaves.")] = 1,
    as_json: Json = False,
) -> None:
    """Check a certificate with the independent checker, in a process of its own."""
    raise typer.Exit(checked(certificate, policy, reference, jobs, as_json))
