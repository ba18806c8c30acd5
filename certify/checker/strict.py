"""Parse bytes into plain JSON data. The limits keep the memory that a file can demand below a gigabyte.

Decimal numbers, NaN, infinities, long integers and duplicate keys are rejected everywhere.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from typing import Any, NoReturn

from .errors import Rejected, Unreadable

MAX_BYTES = 256 * 2**20
MAX_WIDE_BYTES = 2**24  # with a character beyond ASCII: each may take four bytes
MAX_VALUES = 1_000_000  # each takes up to 100 bytes of memory; numbers come as base64, never as lists
MAX_DIGITS = 10


def fail(at: str, detail: str) -> NoReturn:
    """The only place from which rule `format` says no."""
    raise Rejected("format", at or "file", detail)


def load(path: str) -> tuple[Any, str]:
    """The JSON value in the file at `path`, and the sha256 of its bytes; raises `Unreadable` or `Rejected`."""
    try:
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))  # nobody may ever write into a pipe
        with open(descriptor, "rb") as stream:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise Unreadable(f"{path} cannot be read: it is not a regular file")
            raw = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise Unreadable(f"{path} cannot be read: {error.strerror}") from error
    if len(raw) > MAX_BYTES:
        fail("file", f"larger than {MAX_BYTES} bytes")
    if len(raw) > MAX_WIDE_BYTES and not raw.isascii():
        fail("file", f"larger than {MAX_WIDE_BYTES} bytes and not ASCII")
    if sum(map(raw.count, (b",", b"[", b"{"))) > MAX_VALUES:
        fail("file", f"more than {MAX_VALUES} commas and brackets")
    try:
        numbers: dict[str, Any] = dict.fromkeys(("parse_int", "parse_float", "parse_constant"), _integer)
        return json.loads(raw.decode(), object_pairs_hook=_object, **numbers), hashlib.sha256(raw).hexdigest()
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise Rejected("format", "file", f"not a JSON document: {type(error).__name__}") from error


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    result = dict(pairs)
    if len(result) != len(pairs):
        fail("file", "duplicate key")
    return result


def _integer(text: str) -> int:
    if len(text) > MAX_DIGITS or not re.fullmatch("-?[0-9]+", text):
        fail("file", f"number {text[:40]} is not an integer, or too long")
    return int(text)
