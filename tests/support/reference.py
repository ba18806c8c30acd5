"""The reference's verdicts in a word, on documents that were built in Python."""

from __future__ import annotations

from certify.reference import rules
from tests.support.certificates import Document, dump

CONTINUOUS = {"rate": (0.0).hex(), "sample": None, "outer": None}  # of a claim


def judge_bytes(raw: bytes) -> str | None:
    """None if a file is accepted, the name of the first rule that fails, or `TRUSTED`."""
    verdict = rules.judge(raw)
    return None if verdict.result == "ACCEPTED" else verdict.rule or verdict.result


def judge(data: Document) -> str | None:
    return judge_bytes(dump(data))
