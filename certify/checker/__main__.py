"""`python -I -m certify.checker FILE [--json]`: check one certificate.

Exit status: 0 accepted, 1 rejected, 2 usage or unreadable file, 3 trusted (the evidence is a solver's word, which
cannot be checked; what can be was), 70 internal error.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from typing import Any

from . import document, words
from .errors import Rejected, Unreadable


def main(arguments: list[str]) -> int:
    """Print the claim and the verdict, or one JSON object; return the exit status."""
    parser = argparse.ArgumentParser("python -I -m certify.checker", allow_abbrev=False)
    parser.add_argument("file", metavar="FILE", help="the certificate to check")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    try:
        options = parser.parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        status, answer = _examine(options.file)
    except Rejected as no:
        status, answer = 1, {"result": "REJECTED", "rule": no.rule, "at": no.at, "detail": no.detail, "text": [str(no)]}
    except Unreadable as error:
        status, answer = 2, {"error": str(error), "text": []}
    except Exception as error:
        status, answer = 70, {"error": f"internal error: {type(error).__name__}: {error}", "text": []}
    lines = [json.dumps(answer)] if options.json else answer["text"]
    sys.stdout.write("".join(f"{line}\n" for line in lines))
    sys.stderr.write("" if options.json or "error" not in answer else f"{answer['error']}\n")
    return status


def _examine(path: str) -> tuple[int, dict[str, Any]]:
    """Status and answer of a certificate that no rule refuses."""
    c = document.read(path)
    start = time.perf_counter()
    from . import rules  # after parsing: a malformed file needs no tables
    from .boxes import LEAF

    ready = time.perf_counter()
    tally = rules.check(c)
    seconds = {"start": ready - start, "check": time.perf_counter() - ready}
    answer: dict[str, Any] = {"certificate_sha256": c.sha256, "policy_sha256": c.policy.sha256(), "claim": c.claim}
    sample = None if c.sample is None else [str(h) for h in c.sample]
    answer |= {"rate": c.rate, "sample": sample, "discrete": c.discrete}
    answer |= {"levels": c.levels, "rules": tally.rules, "seconds": seconds}
    if isinstance(c.evidence, document.Trusted):
        answers = [": ".join(pair) for pair in c.evidence.queries]
        answer |= {"solver": c.evidence.solver, "version": c.evidence.version, "answers": answers}
    else:
        margins = {"local": tally.local_margin, "ring": tally.ring_margin, "outer": tally.outer_margin}
        answer |= {"leaves": tally.rules["tree"], "ring_leaves": tally.rules["ring"], "margins": margins}
        if c.outer is not None and c.evidence.outer is not None:
            leaves = {"leaves": c.evidence.outer.tree.count(LEAF), "face_leaves": tally.rules["faces"]}
            answer["outer"] = {"level": c.outer.level, **leaves}
    if c.start is not None:
        centre, longest = None if c.centre is None else c.centre.tolist(), words.duration(c)
        answer |= {"start": c.start.tolist(), "centre": centre, "time": longest if math.isfinite(longest) else None}
    status, result = (3, "TRUSTED") if "solver" in answer else (0, "ACCEPTED")
    answer = {"result": result, **answer}
    return status, answer | {"text": words.report(c, answer)}


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
