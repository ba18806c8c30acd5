"""A rule's refusal."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class Refused(Exception):
    """A rule that does not hold: its name, the place in the file or the region, and why."""

    def __init__(self, rule: str, at: str, detail: str) -> None:
        super().__init__(f"rule={rule} at={at}: {detail}")
        self.rule, self.at, self.detail = rule, at, detail


def require(condition: bool, rule: str, at: str, detail: str) -> None:
    if not condition:
        raise Refused(rule, at, detail)


@contextmanager
def under(rule: str, at: str) -> Iterator[None]:
    """Take the refusals of others over: they become those of this rule, at this place."""
    try:
        yield
    except Refused as no:
        raise Refused(rule, at, no.detail) from None
