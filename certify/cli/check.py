"""`certify check`."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Annotated

import typer

from certify.cli.shared import Json, Patient
from certify.cli.terminal import say, tell


def check(
    certificate: Annotated[Path, typer.Argument(help="Certificate file.")],
    policy: Annotated[
        Path | None, typer.Option(help="Policy file that the certificate must be about (by its hash).")
    ] = None,
    reference: Annotated[
        bool, typer.Option("--reference", help="Use the second checker (fractions, Arb balls): slower, shares no code.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Processes that examine the leaves.")] = 1,
    patient: Patient = False,
    as_json: Json = False,
) -> None:
    """Check a certificate with the independent checker, in a process of its own."""
    from certify.certificates.checking import ask

    wanted = None
    if policy is not None:
        from certify.loop.policies import load_policy

        wanted = load_policy(policy).network.sha256()
    status, answer = ask(certificate, "reference" if reference else "checker", jobs, patient)
    lines = answer.pop("text", [])
    if wanted is not None and "policy_sha256" in answer and answer["policy_sha256"] != wanted:
        detail = f"the certificate is about policy {answer['policy_sha256']}, not about {policy} ({wanted})"
        answer = {"result": "REJECTED", "rule": "policy", "at": "policy.sha256", "detail": detail}
        status, lines = 1, [f"REJECTED rule=policy at=policy.sha256: {detail}"]
    if "error" in answer and not as_json:
        tell(f"certify: {answer['error'].rstrip('.')}.{_next_step(certificate)}")
        raise typer.Exit(status)
    if (answer.get("rule"), answer.get("at")) == ("format", "file") and _is_policy(certificate):
        tell(f"certify: {certificate} is a policy file; certify roa {certificate} writes a certificate about it.")
    if answer.get("at") == "schema" and certificate.is_file():  # a pipe is read once
        from certify.certificates import read_raw
        from certify.certificates.formats import version_in

        old = version_in(read_raw(certificate))
        if old is not None:
            tell(f"certify: {old}")
    say(json.dumps(answer) if as_json else "\n".join(lines))
    raise typer.Exit(status)


def _next_step(path: Path) -> str:
    """A sentence on where the certificate may be, after a path that cannot be read."""
    if path.is_dir():
        return f" Name the certificate in it: {path / 'certificate.json'}."
    return "" if path.exists() else " certify roa writes certificate.json into its folder --out."


def _is_policy(path: Path) -> bool:
    """True if a file's form is that of a policy: an archive, as torch and stable-baselines3 write."""
    return path.is_file() and (zipfile.is_zipfile(path) or path.suffix in (".onnx", ".safetensors"))
