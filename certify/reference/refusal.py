"""A rule's refusal."""

from __future__ import annotations


class Refused(Exception):
    """A rule that does not hold: its name, the place in the file or the region, and why."""

    def __init__(self, rule: str, at: str, detail: str) -> None:
        super().__init__(f"rule={rule} at={at}: {detail}")
        self.rule, self.at, self.detail = rule, at, detail


def require(condition: bool, rule: str, at: str, detail: str) -> None:
    if not condition:
        raise Refused(rule, at, detail)
