"""Readers of a document's values. Numbers arrive as hex floats, exact fractions or raw little-endian bytes; none
passes through decimal.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from fractions import Fraction
from functools import cache
from typing import Annotated, Any, TypeVar, get_type_hints

import numpy as np
from numpy.typing import NDArray

from . import strict

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Value:
    """A JSON value and its place. Each method returns what the value means, or fails under rule `format`."""

    raw: Any
    at: str = ""

    def must(self, holds: bool, be: str) -> None:
        if not holds:
            strict.fail(self.at, f"must be {be}")

    def entries(self, names: str, maybe: str = "") -> dict[str, Value]:
        """The entries of an object that has exactly these keys, or of others those that may be."""
        keys = names.split()
        keys += [key for key in maybe.split() if isinstance(self.raw, dict) and key in self.raw]
        self.must(
            isinstance(self.raw, dict) and set(self.raw) == set(keys), f"an object with exactly the keys: {names}"
        )
        return {key: Value(self.raw[key], f"{self.at}.{key}".lstrip(".")) for key in keys}

    def keys(self, names: str) -> list[Value]:
        """The entries of an object that has exactly these keys."""
        return list(self.entries(names).values())

    def kind(self, kinds: Sequence[str]) -> str:
        """The entry `kind` of an object, one of these words."""
        known = isinstance(self.raw, dict) and self.raw.get("kind") in kinds
        self.must(known, f"an object of kind {' or '.join(kinds)}")
        return str(self.raw["kind"])

    def listed(self, read: Callable[[Value], T], least: int, most: int | None = None) -> tuple[T, ...]:
        """The entries of a list, each as `read` has it; `least` of them, or up to `most`."""
        most = least if most is None else most
        self.must(isinstance(self.raw, list) and least <= len(self.raw) <= most, f"a list of {least} to {most} entries")
        return tuple(read(Value(entry, f"{self.at}[{i}]")) for i, entry in enumerate(self.raw))

    def text(self, pattern: str, what: str) -> str:
        """A string that matches the whole pattern."""
        self.must(isinstance(self.raw, str) and bool(re.fullmatch(pattern, self.raw, re.ASCII)), what)
        return str(self.raw)

    def choice(self, *words: str) -> str:
        return self.text("|".join(words), " or ".join(words))

    def integer(self, least: int, most: int) -> int:
        """An integer of this range; true and false are none."""
        self.must(type(self.raw) is int and least <= self.raw <= most, f"an integer from {least} to {most}")
        return int(self.raw)

    def name(self) -> str:
        return self.text(r"[A-Za-z_][A-Za-z0-9_]{0,63}", "an identifier")

    def word(self) -> str:
        return self.text(r"[A-Za-z0-9_.+-]{1,80}", "a word of at most 80 letters, digits and _.+-")

    def rational(self) -> Fraction:
        return Fraction(self.text(r"-?(0|[1-9]\d{0,1200})(/[1-9]\d{0,1200})?", 'an exact fraction such as "3/20"'))

    def interval(self) -> tuple[Fraction, Fraction]:
        lo, hi = self.listed(Value.rational, 2)
        self.must(lo < hi, "lower, then upper end")
        return lo, hi

    def binary64(self) -> float:
        """A C99 hex float in canonical form."""
        what = 'a canonical hex float such as "0x1.8000000000000p+1"'
        try:
            number = float.fromhex(self.text(r"-?0x[01]\.[0-9a-f]{1,13}p[+-]\d{1,4}", what))
        except OverflowError:
            number = math.inf
        self.must(number.hex() == self.raw, what)
        return number

    def octets(self) -> bytes:
        """Canonical base64."""
        try:
            raw = base64.b64decode(self.raw, validate=True)
        except (TypeError, ValueError):
            raw = b""
        self.must(base64.b64encode(raw).decode() == self.raw, "canonical base64 text")
        return raw

    def array(self, *shape: int) -> NDArray[np.float64]:
        """Finite little-endian binary64 in row order."""
        raw, count = self.octets(), math.prod(shape)
        self.must(len(raw) == 8 * count, f"{count} little-endian binary64 numbers")
        numbers = np.frombuffer(raw, dtype="<f8").astype(np.float64).reshape(shape)
        self.must(bool(np.all(np.isfinite(numbers))), "finite")
        return numbers


# ------------------------------------------------------------------------------------------------------------ sections

Array = NDArray[np.float64]
Sizes = Mapping[str, int]


def shaped(*axes: str | int) -> Callable[[Value, Sizes], Array]:
    """The reader of an array whose axes are numbers, or names of sizes."""
    return lambda value, sizes: value.array(*(sizes[axis] if isinstance(axis, str) else axis for axis in axes))


Row = Annotated[Array, shaped("n")]
Matrix = Annotated[Array, shaped("n", "n")]
Binary64 = Annotated[float, lambda value, _: value.binary64()]
Octets = Annotated[bytes, lambda value, _: value.octets()]


def section(value: Value, kind: type[T], **sizes: int) -> T:
    """An object as a dataclass whose fields are its keys; one with a default may be missing. Each is read as its
    annotation says, with these sizes."""
    readers: dict[str, Callable[[Value, Sizes], Any]] = _readers(kind)  # type: ignore[arg-type]
    needed = [f.name for f in fields(kind) if f.default is MISSING]  # type: ignore[arg-type]
    entries = value.entries(" ".join(needed), " ".join(readers.keys() - needed))
    return kind(**{name: readers[name](entry, sizes) for name, entry in entries.items()})


@cache
def _readers(kind: type) -> dict[str, Callable[[Value, Sizes], Any]]:
    return {name: hint.__metadata__[0] for name, hint in get_type_hints(kind, include_extras=True).items()}
