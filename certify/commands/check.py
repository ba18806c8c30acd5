"""`certify check`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from certify.commands.shared import Json
from certify.commands.terminal import say, tell


def check(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    policy: Annotated[
        Path | None, typer.Option(help="Policy file that the certificate must be about (compares hashes).")
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Ask the second checker (fractions and balls): slower, shares no code.")
    ] = False,
    as_json: Json = False,
) -> None:
    """Check a certificate with the independent checker, in a process of its own."""
    from certify.certificate.checking import ask

    wanted = None
    if policy is not None:
        from certify.policies import load_policy

        wanted = load_policy(policy).network.sha256()
    status, answer = ask(certificate, "reference" if reference else "checker")
    lines = answer.pop("text", [])
    if wanted is not None and "policy_sha256" in answer and answer["policy_sha256"] != wanted:
        detail = f"the certificate is about policy {answer['policy_sha256']}, not about {policy} ({wanted})"
        answer = {"result": "REJECTED", "rule": "policy", "at": "policy.sha256", "detail": detail}
        status, lines = 1, [f"REJECTED rule=policy at=policy.sha256: {detail}"]
    if "error" in answer and not as_json:
        tell(f"certify: {answer['error']}")
        raise typer.Exit(status)
    say(json.dumps(answer) if as_json else "\n".join(lines))
    raise typer.Exit(status)
