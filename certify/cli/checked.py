"""The check of a certificate by `certify check`; it loads nothing that reads options."""

from __future__ import annotations

import hashlib
import json
import zipfile
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

from certify.cli.terminal import say, tell

if TYPE_CHECKING:
    from certify.certificates import AnyCertificate
    from certify.loop.policies import Policy


def checked(
    certificate: Path,
    policy: Path | None = None,
    reference: bool = False,
    jobs: int = 1,
    as_json: bool = False,
) -> int:
    """Check a certificate, print the answer, and return the exit status; the parameters are the command's."""
    from certify.certificates.checking import ask

    stored, wanted = None, None
    if policy is not None:
        from certify.loop.policies import load_policy

        stored = load_policy(policy)
        wanted = stored.network.sha256()
    status, answer = ask(certificate, "reference" if reference else "checker", jobs)
    lines = answer.pop("text", [])
    detail = ""
    if wanted is not None and "policy_sha256" in answer and answer["policy_sha256"] != wanted:
        detail = f"the certificate is about policy {answer['policy_sha256']}, not about {policy} ({wanted})"
    elif stored is not None and answer.get("result") in ("ACCEPTED", "TRUSTED"):
        detail = _beside(stored, certificate, answer["certificate_sha256"])
    if detail:
        at = "policy.sha256" if answer["policy_sha256"] != wanted else "policy"
        answer = {"result": "REJECTED", "rule": "policy", "at": at, "detail": detail}
        status, lines = 1, [f"REJECTED rule=policy at={at}: {detail}"]
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


def _beside(stored: Policy, certificate: Path, sha256: str) -> str:
    """A difference between the certificate, or the one that takes over, and what a policy file says beside its numbers:
    the box in which they are the policy that it was imported from, and the input that it is centred at; empty if there
    is none."""
    if stored.valid is None and stored.beta is None:
        return ""
    from certify.certificates import Certificate, parse_any, read_raw
    from certify.errors import CertifyError

    raw = read_raw(certificate)
    if hashlib.sha256(raw).hexdigest() != sha256:
        raise CertifyError(f"{certificate} was changed while it was checked; check it again.")
    read = parse_any(raw, str(certificate))
    said = _difference(stored, read)
    if said or not isinstance(read, Certificate) or read.then is None:
        return said
    return f"of the claim that takes over, {after}" if (after := _difference(stored, read.then)) else ""


def _difference(stored: Policy, read: AnyCertificate) -> str:
    """The difference from one of a file's claims."""
    from certify.errors import InputError

    system = read.system
    try:
        stored.beta_shift(system.exact_u_eq())
    except InputError as error:
        return f"the certificate's u_eq is not that of {stored.system}'s policy file: {error}".rstrip(".")
    valid, origin = [] if stored.valid is None else stored.valid.tolist(), read.network.origin.tolist()
    for symbol, ends, (lo, hi), at in zip(system.states, system.domain, valid, origin, strict=False):
        if not (ends[0] + Fraction(at) >= lo and ends[1] + Fraction(at) <= hi):
            return (
                f"the certificate's domain of {symbol} must lie in [{lo}, {hi}], where the policy file says "
                "that its numbers are the policy that it was imported from"
            )
    return ""


def _next_step(path: Path) -> str:
    """A sentence on where the certificate may be, after a path that cannot be read."""
    if path.is_dir():
        return f" Name the certificate in it: {path / 'certificate.json'}."
    return "" if path.exists() else " certify roa writes certificate.json into its folder --out."


def _is_policy(path: Path) -> bool:
    """True if a file's form is that of a policy: an archive, as torch and stable-baselines3 write."""
    return path.is_file() and (zipfile.is_zipfile(path) or path.suffix in (".onnx", ".safetensors"))
