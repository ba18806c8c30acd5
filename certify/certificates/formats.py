"""Versions of the file format: the written one, and the programs that read others."""

from __future__ import annotations

import json
import re
from typing import Any

SCHEMA = "certify-certificate/9"
_LAST = {
    1: "1614652",
    2: "31444d7",
    3: "d5911e5",
    4: "2028c3c",
    5: "0ac85b6",
    6: "1a99ced",
    7: "eb6ab75",
    8: "7ddae11",
}
"""The last commit of this repository whose checker reads that version."""


def other_version(schema: object) -> str | None:
    """Who reads a file of another version, and how one of this version is made; None if it names no other version.

    >>> other_version("certify-certificate/9")
    """
    match = re.fullmatch(r"certify-certificate/([1-9]\d{0,5})", schema) if isinstance(schema, str) else None
    if match is None or schema == SCHEMA:
        return None
    number, ours = int(match[1]), int(SCHEMA.rpartition("/")[2])
    if number > ours:
        return f"A later release of certify wrote it: {schema} is newer than {SCHEMA}, which this one reads."
    last = f"commit {_LAST[number]} of certify was the last to read it" if number in _LAST else "an older one reads it"
    return (
        f"An earlier release of certify wrote it: this one reads {SCHEMA}, and {last}. To have a certificate of today, "
        "run certify roa again with its policy and plant."
    )


def version_in(raw: bytes) -> str | None:
    """`other_version` of what a file's bytes say."""
    try:
        data: Any = json.loads(raw)
    except (ValueError, RecursionError):
        return None
    return other_version(data.get("schema")) if isinstance(data, dict) else None
