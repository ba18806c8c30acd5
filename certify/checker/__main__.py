"""`python -I -m certify.checker FILE [--json]`: check one certificate.

Exit status: 0 accepted, 1 rejected, 2 usage or unreadable file, 3 trusted (the evidence is a solver's word, which
cannot be checked; what can be was), 70 internal error.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from typing import Any

from . import document, words
from .errors import Rejected, Unreadable


def main(arguments: list[str]) -> int:
    """Print the claim and the verdict, or one JSON object; return the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -I -m certify.checker", description="Check one certificate.", allow_abbrev=False
    )
    parser.add_argument("file", metavar="FILE")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    try:
        options = parser.parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        status, answer, lines = _examine(options.file)
    except Unreadable as error:
        status, answer, lines = 2, {"error": str(error)}, []
    except Rejected as no:
        status, lines = 1, [str(no)]
        answer = {"result": "REJECTED", "rule": no.rule, "at": no.at, "detail": no.detail}
    except Exception as error:
        status, answer, lines = 70, {"error": f"internal error: {type(error).__name__}: {error}"}, []
    answer["text"] = lines
    sys.stdout.write(json.dumps(answer) + "\n" if options.json else "".join(f"{line}\n" for line in lines))
    sys.stderr.write("" if options.json or "error" not in answer else f"{answer['error']}\n")
    return status


def _examine(path: str) -> tuple[int, dict[str, Any], list[str]]:
    """Status, JSON answer and lines of a certificate that no rule refuses."""
    certificate = document.read(path)
    start = time.perf_counter()
    from . import rules  # after parsing: a malformed file needs no tables

    ready = time.perf_counter()
    tally = rules.check(certificate)
    answer: dict[str, Any] = {
        "result": "ACCEPTED",
        "certificate_sha256": certificate.sha256,
        "policy_sha256": certificate.policy.sha256(),
        "claim": certificate.claim,
        "levels": certificate.levels,
        "rules": tally.rules,
        "seconds": {"start": ready - start, "check": time.perf_counter() - ready},
    }
    counts = ", ".join(f"{rule} {count}" for rule, count in tally.rules.items())
    lines = [*words.claim(certificate), f"rules that held: {counts}"]
    inner = "c0" if certificate.claim == "practical" else "c1"
    verdict = f"{inner}={certificate.c1!r} c2={certificate.c2!r} sha256={certificate.sha256}"
    evidence = certificate.evidence
    if isinstance(evidence, document.Trusted):
        answers = [f"{name}: {answer}" for name, answer in evidence.queries]
        answer |= {"result": "TRUSTED", "solver": evidence.solver, "version": evidence.version, "answers": answers}
        lines.append("not checked, the solver's word: " + ", ".join(answers))
        return 3, answer, [*lines, f"TRUSTED {evidence.solver} {evidence.version} {verdict}"]
    answer |= {"leaves": tally.rules["tree"], "ring_leaves": tally.rules["ring"]}
    answer["margins"] = {"local": tally.local_margin, "ring": tally.ring_margin}
    margins = [] if tally.local_margin is None else [f"local {tally.local_margin:.1%}"]
    if tally.ring_margin is not None:
        margins.append(f"smallest bound of -Vdot on a ring's leaf {tally.ring_margin:.3g}")
    return 0, answer, [*lines, f"margins: {'; '.join(margins)}", f"ACCEPTED {verdict}"]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
