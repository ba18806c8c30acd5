"""A check in parts, each by the checker on a worker of a cluster.

Leaves are independent of each other, and so the time of a check goes down with the workers. But then it is their word:
whoever runs the checker for another may say anything. So a verdict of `certify roa` rests on the checker of this
machine unless one asks for this, and the answer says in how many parts it was given.
"""

from __future__ import annotations

import json
import struct
import tempfile
from pathlib import Path
from typing import Any

from certify.certificates import PartitionTree, join_parts, parse_certificate, read_raw
from certify.certificates.checking import ask
from certify.errors import BackendError
from certify.provers.execution import Jobs, Runner

_JOB = struct.Struct("<QQ")  # K, N
_LEAVES = 5_000  # leaves of a part, so that its checker's start is not the most of it
_EACH = 2  # parts a place
_POLL = 0.5  # seconds
_STATUS = {"PART": 4, "REJECTED": 1}


class Part:
    """The work: the checker's answer about part K of N of a certificate's bytes, with its exit status."""

    def __init__(self, raw: bytes, patient: bool = False) -> None:
        self.raw, self.patient = raw, patient

    def __call__(self, job: bytes) -> bytes:
        """Status and answer as JSON."""
        number, of = _JOB.unpack(job)
        with tempfile.TemporaryDirectory(prefix="certify-") as folder:
            path = Path(folder) / "certificate.json"
            path.write_bytes(self.raw)
            return json.dumps(ask(path, part=(number, of), patient=self.patient)).encode()


def check_in_parts(path: Path, runner: Runner, patient: bool = False) -> tuple[int, dict[str, Any]]:
    """Exit status and answer of the checker about a file, as its parts were checked by a cluster's workers: a refusal
    by one of them, or what all of them together have accepted.

    Raises
    ------
    BackendError : the cluster went away, or the answers are not those of all parts of this file.
    """
    raw = read_raw(path)
    evidence = parse_certificate(raw, str(path)).evidence
    if not isinstance(evidence, PartitionTree):
        return ask(path, patient=patient)
    work = Part(raw, patient)
    with runner.jobs(work) as jobs:
        if jobs is None or not jobs.places:
            return ask(path, patient=patient)
        trees = (evidence.tree, *(() if evidence.outer is None else (evidence.outer.tree, *evidence.outer.faces)))
        leaves = sum(tree.count(b"\xff") for tree in trees)
        of = max(1, min(_EACH * jobs.places, leaves // _LEAVES))
        answers = _gathered(jobs, work, [_JOB.pack(number, of) for number in range(1, of + 1)])
    refused = next((answer for answer in answers if answer["result"] == "REJECTED"), None)
    return (1, refused) if refused is not None else (0, join_parts(raw, answers))


def _gathered(jobs: Jobs, work: Part, wanted: list[bytes]) -> list[dict[str, Any]]:
    """The answers about the parts, in their order; one that nobody could check is checked here."""
    given = {jobs.give(job): k for k, job in enumerate(wanted)}
    found: dict[int, dict[str, Any]] = {}
    while len(found) < len(wanted):
        for number, said in jobs.ended(_POLL):
            if number in given:
                k = given[number]
                found[k] = _read(work(wanted[k]) if said is None else said)
        if not jobs.places:  # nobody is left: the others are checked here
            found |= {k: _read(work(wanted[k])) for k in range(len(wanted)) if k not in found}
    return [found[k] for k in range(len(wanted))]


def _read(said: bytes) -> dict[str, Any]:
    """The answer, which must be one about a part, and be what the exit status says.

    Raises
    ------
    BackendError : it is not, or the worker's checker came to no verdict.
    """
    try:
        status, answer = json.loads(said)
        sound = isinstance(answer, dict) and "error" not in answer and type(status) is int
        if sound and _STATUS.get(answer["result"]) == status:
            return dict(answer)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise BackendError(f"a worker's answer about a part cannot be read: {error!r:.80}.") from error
    raise BackendError(f"a worker's answer about a part must be PART or REJECTED; found {said[:200]!r}.")
