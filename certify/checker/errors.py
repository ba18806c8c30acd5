"""The checker's two errors: a rejected certificate, and an unreadable file."""

from __future__ import annotations


class Rejected(Exception):
    """The certificate was read and is not valid: a rule failed at a place, for a reason; and maybe at every one of
    these leaves."""

    every: tuple[str, ...] = ()

    def __init__(self, rule: str, at: str, detail: str) -> None:
        super().__init__(rule, at, detail)
        self.rule, self.at, self.detail = rule, at, detail

    def __str__(self) -> str:
        return f"REJECTED rule={self.rule} at={self.at}: {self.detail}"


class Unreadable(Exception):
    """The file cannot be read at all (missing, a directory, no permission)."""
