"""`python -I -m certify.checker FILE [--json] [--jobs N] [--every]`: check one certificate.

Exit status: 0 accepted, 1 rejected, 2 usage or unreadable file, 3 trusted (the evidence is a solver's answer, which
cannot be checked; all else was), 70 internal error.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from contextlib import suppress
from typing import Any

from .errors import Rejected, Unreadable

_MOST_JOBS = 2**8
_MEMORY = 2**33  # bytes that a process may have


def main(arguments: list[str]) -> int:
    """Print the claim and the verdict, or one JSON object; return the exit status."""
    parser = argparse.ArgumentParser("python -I -m certify.checker", allow_abbrev=False)
    parser.add_argument("file", metavar="FILE", help="the certificate to check")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--jobs", metavar="N", type=_jobs, default=1, help="examine the leaves in N processes")
    parser.add_argument("--every", action="store_true", help="name each leaf that rule ring refuses (with --json)")
    try:
        options = parser.parse_args(arguments)
    except SystemExit as stop:
        return int(stop.code or 0)
    # Threads of several processes would wait for each other. numpy reads this when it is first imported: below.
    os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    try:
        status, answer = _examine(options.file, options.jobs, options.every)
    except Rejected as no:
        status, answer = 1, {"result": "REJECTED", "rule": no.rule, "at": no.at, "detail": no.detail, "text": [str(no)]}
        answer |= {"every": no.every} if no.every else {}
    except Unreadable as error:
        status, answer = 2, {"error": str(error), "text": []}
    except MemoryError:
        status, answer = 70, {"error": "the check needs more memory than there is", "text": []}
    except Exception as error:
        status, answer = 70, {"error": f"internal error of the checker: {type(error).__name__}: {error}", "text": []}
    lines = [json.dumps(answer)] if options.json else answer["text"]
    try:
        sys.stdout.write("".join(f"{line}\n" for line in lines))
        sys.stdout.flush()
    except (AttributeError, OSError, ValueError):  # nobody heard it
        os._exit(70)
    sys.stderr.write("" if options.json or "error" not in answer else f"{answer['error']}\n")
    return status


def _jobs(text: str) -> int:
    jobs = int(text)
    if not 1 <= jobs <= (_MOST_JOBS if hasattr(os, "fork") else 1):
        raise ValueError
    return jobs


def _examine(path: str, jobs: int, every: bool) -> tuple[int, dict[str, Any]]:
    """Status and answer of a certificate that no rule rejects."""
    from . import document, words

    c = document.read(path)
    start = time.perf_counter()
    from . import rules  # after parsing: a malformed file needs no tables

    ready = time.perf_counter()
    tally = rules.check(c, jobs, every)
    seconds = {"start": ready - start, "check": time.perf_counter() - ready}
    answer: dict[str, Any] = {"certificate_sha256": c.sha256, "policy_sha256": c.policy.sha256(), "claim": c.claim}
    sample = None if c.sample is None else [str(h) for h in c.sample]
    answer |= {"rate": c.rate, "sample": sample, "discrete": c.discrete}
    answer["origin"] = None if c.policy.origin is None else c.policy.origin.tolist()  # the hash does not tell
    answer |= {"levels": c.levels, "rules": tally.rules, "modules": _modules(), "seconds": seconds}
    if isinstance(c.evidence, document.Partition):
        answer |= {"leaves": tally.rules["tree"], "ring_leaves": tally.rules["ring"], "margins": tally.margins}
    if words.has_more(c):
        from . import clauses

        answer |= clauses.answers(c, tally)
    status, result = (3, "TRUSTED") if "solver" in answer else (0, "ACCEPTED")
    answer = {"result": result, **answer}
    return status, answer | {"text": words.report(c, answer)}


def _modules() -> list[str]:
    """The files of this program that were loaded, which the answer rests on."""
    return sorted(name.rpartition(".")[2] for name in sys.modules if name.startswith(f"{__package__}."))


def bound_memory() -> None:
    """Keep this process from filling the machine: a small file may ask for much. Some systems have no such limit."""
    with suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, resource.getrlimit(resource.RLIMIT_AS)[1]))


if __name__ == "__main__":
    bound_memory()
    sys.exit(main(sys.argv[1:]))
