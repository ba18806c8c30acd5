"""Rule `format` for single values: objects, lists, and the numbers of a file, none of which passes through decimal."""

from __future__ import annotations

import base64
import binascii
import math
import re
import sys
from array import array
from collections.abc import Sequence
from typing import Any

from flint import fmpq, fmpq_mat

from .refusal import Refused, require

MAX_NAMES = 64
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]{0,63}")


def keys(value: Any, at: str, *names: str, maybe: Sequence[str] = ()) -> dict[str, Any]:
    """An object with these keys, of which those that are `maybe` there may be missing."""
    good = isinstance(value, dict) and set(names) <= set(value) <= {*names, *maybe}
    require(good, "format", at, f"an object with the keys {', '.join(names)} was expected")
    return dict(value)


def entries(value: Any, at: str, count: int | None = None) -> list[Any]:
    good = isinstance(value, list) and count in (None, len(value))
    require(good, "format", at, f"a list{'' if count is None else f' of {count}'} was expected")
    return list(value)


def binary64(text: Any, at: str) -> float:
    try:
        value = float.fromhex(text)
    except (TypeError, ValueError, OverflowError):
        raise Refused("format", at, "a hex float was expected") from None
    canonical = math.isfinite(value) and value.hex() == text
    require(canonical, "format", at, "a canonical finite hex float was expected")
    return value


def decoded(text: Any, at: str) -> bytes:
    try:
        raw = base64.b64decode(text, validate=True) if isinstance(text, str) else b""
    except (binascii.Error, ValueError):
        raise Refused("format", at, "base64 was expected") from None
    canonical = isinstance(text, str) and base64.b64encode(raw).decode() == text
    require(canonical, "format", at, "canonical base64 was expected")
    return raw


def numbers(text: Any, at: str, count: int) -> array[float]:
    raw = decoded(text, at)
    require(len(raw) == 8 * count, "format", at, f"{count} binary64 numbers were expected")
    values = array("d")
    values.frombytes(raw)
    if sys.byteorder == "big":
        values.byteswap()
    require(all(map(math.isfinite, values)), "format", at, "finite numbers were expected")
    return values


def square(text: Any, at: str, n: int) -> fmpq_mat:
    """An array (n, n), exactly."""
    return fmpq_mat(n, n, [exact(v) for v in numbers(text, at, n * n)])


def column(text: Any, at: str, n: int) -> fmpq_mat:
    """An array (n,), exactly, as a matrix of one column."""
    return fmpq_mat(n, 1, [exact(v) for v in numbers(text, at, n)])


def little_endian(values: array[float]) -> bytes:
    if sys.byteorder == "big":
        values = values[:]
        values.byteswap()
    return values.tobytes()


def exact(value: float) -> fmpq:
    return fmpq(*value.as_integer_ratio())
