"""The operations that squash, centring and clip need; floats, balls and terms of formulas offer them."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, Protocol, TypeVar

V = TypeVar("V", bound=Any)


class Arithmetic(Protocol[V]):
    """Numbers of an arithmetic; its values have `-` and `*`."""

    def number(self, q: Fraction) -> V:
        """An exact number."""

    def atanh(self, q: Fraction) -> V:
        """atanh of an exact number in (-1, 1)."""

    def tanh(self, v: V) -> V:
        """tanh of a value."""

    def clip(self, v: V, lo: Fraction, hi: Fraction) -> V:
        """`min(max(v, lo), hi)` of a value and exact numbers."""
