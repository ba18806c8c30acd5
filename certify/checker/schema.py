"""What a value of a document may be: readers, from which document.py builds the whole document.

A reader takes a value, its place, and what has been learnt so far (`known`: counts of states, inputs, rows, ...), and
returns what the value means or fails under rule `format`. Numbers arrive as hex floats, exact fractions or raw
little-endian bytes; none passes through decimal.
"""

from __future__ import annotations

import base64
import binascii
import math
import re
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import strict

Known = dict[str, Any]
Read = Callable[[Any, str, Known], Any]


def section(**readers: Read) -> Read:
    """An object with exactly these keys, read in this order."""

    def read(value: Any, at: str, known: Known) -> dict[str, Any]:
        if not isinstance(value, dict) or set(value) != set(readers):
            strict.fail(at, f"must be an object with exactly the keys: {' '.join(readers)}")
        return {key: reader(value[key], f"{at}.{key}".lstrip("."), known) for key, reader in readers.items()}

    return read


def by_kind(**sections: Read) -> Read:
    """An object whose `kind` names the section that it is; a kind `a_b` is written `a-b`."""
    kinds = {name.replace("_", "-"): read for name, read in sections.items()}

    def read(value: Any, at: str, known: Known) -> Any:
        kind = choice(*kinds)(value.get("kind") if isinstance(value, dict) else None, f"{at}.kind", known)
        return kinds[kind](value, at, known)

    return read


def listed(reader: Read, count: int | str = "", least: int = 0, most: int = strict.MAX_VALUES) -> Read:
    """A list; all that are given the same letter as a count have as many entries as the first of them."""

    def read(value: Any, at: str, known: Known) -> tuple[Any, ...]:
        if not isinstance(value, list) or not least <= len(value) <= most:
            strict.fail(at, f"must be a list of {least} to {most} entries")
        wanted = known.setdefault(count, len(value)) if count and isinstance(count, str) else count or len(value)
        if len(value) != wanted:
            strict.fail(at, f"must be a list of {wanted}")
        return tuple(reader(entry, f"{at}[{i}]", known) for i, entry in enumerate(value))

    return read


def then(reader: Read, build: Callable[[Any, str, Known], Any]) -> Read:
    """What `build` makes of what `reader` has read."""
    return lambda value, at, known: build(reader(value, at, known), at, known)


def choice(*words: str) -> Read:
    """One of these words."""

    def read(value: Any, at: str, known: Known) -> str:
        if not isinstance(value, str) or value not in words:
            strict.fail(at, f"must be {' or '.join(map(repr, words))}")
        return value

    return read


def text(pattern: str, what: str) -> Read:
    """A string that matches the whole pattern."""

    def read(value: Any, at: str, known: Known) -> str:
        if not isinstance(value, str) or not re.fullmatch(pattern, value, re.ASCII):
            strict.fail(at, f"must be {what}")
        return value

    return read


name = text(r"[A-Za-z_][A-Za-z0-9_]{0,63}", "an identifier")
word = text(r"[A-Za-z0-9_.+-]{1,80}", "a word of at most 80 letters, digits and _.+-")
rational = then(
    text(r"-?(0|[1-9][0-9]{0,1200})(/[1-9][0-9]{0,1200})?", 'an exact fraction such as "3/20"'),
    lambda value, at, known: Fraction(value),
)
_hex = text(r"-?0x[01]\.[0-9a-f]{1,13}p[+-][0-9]{1,4}", 'a hex float such as "0x1.8000000000000p+1"')


def anything(value: Any, at: str, known: Known) -> Any:
    """Read elsewhere, or by nobody."""
    return value


def mapping(value: Any, at: str, known: Known) -> None:
    """Any object; nothing may depend on what is in it."""
    if not isinstance(value, dict):
        strict.fail(at, "must be an object")


def interval(value: Any, at: str, known: Known) -> tuple[Fraction, Fraction]:
    lo, hi = listed(rational, 2)(value, at, known)
    if not lo < hi:
        strict.fail(at, "must satisfy lo < hi")
    return lo, hi


def binary64(value: Any, at: str, known: Known) -> float:
    """A C99 hex float in canonical form."""
    try:
        number = float.fromhex(_hex(value, at, known))
    except OverflowError:
        strict.fail(at, "is out of range")
    if number.hex() != value:
        strict.fail(at, f"must be written canonically, {number.hex()}")
    return number


def base64_bytes(value: Any, at: str, known: Known) -> bytes:
    """Canonical base64."""
    try:
        raw = base64.b64decode(value.encode("ascii") if isinstance(value, str) else b"?", validate=True)
    except (UnicodeEncodeError, binascii.Error):
        strict.fail(at, "must be base64 text")
    if base64.b64encode(raw).decode("ascii") != value:
        strict.fail(at, "must be canonical base64 text")
    return raw


def array(*axes: str) -> Read:
    """Finite little-endian binary64 in row order, of the shape that `known` tells."""

    def read(value: Any, at: str, known: Known) -> NDArray[np.float64]:
        raw, shape = base64_bytes(value, at, known), tuple(known[axis] for axis in axes)
        if len(raw) != 8 * math.prod(shape):
            strict.fail(at, f"must hold {math.prod(shape)} little-endian binary64 numbers")
        numbers = np.frombuffer(raw, dtype="<f8").astype(np.float64).reshape(shape)
        if not np.all(np.isfinite(numbers)):
            strict.fail(at, "must be finite")
        return numbers

    return read
