"""The check of a certificate by `certify check`; it loads nothing that reads options."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

from certify.cli.terminal import say, tell


def checked(
    certificate: Path,
    policy: Path | None = None,
    reference: bool = False,
    jobs: int = 1,
    as_json: bool = False,
) -> int:
    """Check a certificate, print the answer, and return the exit status; the parameters are the command's."""
    from certify.certificates.checking import ask

    wanted = None
    if policy is not None:
        from certify.loop.policies import load_policy

        wanted = load_policy(policy).network.sha256()
    status, answer = ask(certificate, "reference" if reference else "checker", jobs)
    lines = answer.pop("text", [])
    if wanted is not None and "policy_sha256" in answer and answer["policy_sha256"] != wanted:
        detail = f"the certificate is about policy {answer['policy_sha256']}, not about {policy} ({wanted})"
        answer = {"result": "REJECTED", "rule": "policy", "at": "policy.sha256", "detail": detail}
        status, lines = 1, [f"REJECTED rule=policy at=policy.sha256: {detail}"]
    if "error" in answer and not as_json:
        tell(f"certify: {answer['error'].rstrip('.')}.{_next_step(certificate)}")
        return status
    if (answer.get("rule"), answer.get("at")) == ("format", "file") and _is_policy(certificate):
        tell(f"certify: {certificate} is a policy file; certify roa {certificate} writes a certificate about it.")
    if answer.get("at") == "schema" and certificate.is_file():  # a pipe is read once
        from certify.certificates import read_raw
        from certify.certificates.formats import version_in

        old = version_in(read_raw(certificate))
        if old is not None:
            tell(f"certify: {old}")
    say(json.dumps(answer) if as_json else "\n".join(lines))
    return status


def _next_step(path: Path) -> str:
    """A sentence on where the certificate may be, after a path that cannot be read."""
    if path.is_dir():
        return f" Name the certificate in it: {path / 'certificate.json'}."
    return "" if path.exists() else " certify roa writes certificate.json into its folder --out."


def _is_policy(path: Path) -> bool:
    """True if a file's form is that of a policy: an archive, as torch and stable-baselines3 write."""
    return path.is_file() and (zipfile.is_zipfile(path) or path.suffix in (".onnx", ".safetensors"))
