"""Readers of a document's values. Numbers arrive as hex floats, exact fractions or raw little-endian bytes; none
passes through decimal.
"""

from __future__ import annotations

import base64
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeVar

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

    def keys(self, names: str) -> list[Value]:
        """The entries of an object that has exactly these keys."""
        keys = names.split()
        self.must(
            isinstance(self.raw, dict) and set(self.raw) == set(keys), f"an object with exactly the keys: {names}"
        )
        return [self.entry(key) for key in keys]

    def entry(self, name: str) -> Value:
        """The entry of an object at a key that it has."""
        return Value(self.raw[name], f"{self.at}.{name}".lstrip("."))

    def maybe(self, name: str) -> str:
        """The name, after a space, if the object has such a key: for `keys`."""
        return f" {name}" if isinstance(self.raw, dict) and name in self.raw else ""

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
