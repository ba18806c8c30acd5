"""The reference's verdicts in a word, on documents that were built in Python."""

from __future__ import annotations

import json
from typing import Any

from certify.reference import rules


def judge_bytes(raw: bytes) -> str | None:
    """None if a file is accepted, the name of the first rule that fails, or `TRUSTED`."""
    verdict = rules.judge(raw)
    return None if verdict.result == "ACCEPTED" else verdict.rule or verdict.result


def judge(data: dict[str, Any]) -> str | None:
    return judge_bytes(json.dumps(data).encode())
