"""Verdicts of both checkers on documents with ranks."""

from __future__ import annotations

import json

from certify.checker import document, rules
from certify.checker.errors import Rejected
from certify.reference import rules as reference_rules
from tests.support.ranked import Document, dumped

Verdicts = tuple[str | None, str | None]  # of the checker and of the reference


def by_checker(data: Document) -> str | None:
    """The rule that the checker refuses a document under; None if it accepts."""
    try:
        rules.check(document.certificate(json.loads(dumped(data)), "0" * 64))
    except Rejected as no:
        return no.rule
    return None


def by_reference(data: Document) -> str | None:
    """The rule that the reference refuses it under."""
    found = reference_rules.judge(dumped(data))
    return None if found.result == "ACCEPTED" else str(found.rule)


def verdicts(data: Document) -> Verdicts:
    return by_checker(data), by_reference(data)
