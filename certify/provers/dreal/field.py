"""Values at two points of a finite field, by which the terms of a sum are told apart."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from fractions import Fraction

from certify.errors import InputError
from certify.provers.dreal.sums import Monomial, Sum

_PRIME = 2**127 - 1


class Residues:
    """The values of variables and atoms at the two points; equal ones may be a constant's."""

    def __init__(self) -> None:
        self._known: dict[str, tuple[int, int]] = {}

    def declare(self, name: str) -> None:
        """Store a random value at each point, for a free variable."""
        self._known[name] = (hashed(name, 1), hashed(name, 2))

    def set(self, name: str, values: Sequence[int]) -> None:
        """Store the values of what is computed from others."""
        self._known[name] = (values[0], values[1])

    def of(self, monomial: Monomial) -> tuple[int, int]:
        """A monomial's values."""
        first = second = 1
        for atom, k in monomial:
            a, b = self._known[atom]
            first, second = first * pow(a, k, _PRIME) % _PRIME, second * pow(b, k, _PRIME) % _PRIME
        return first, second

    def of_sum(self, value: Sum) -> tuple[int, int]:
        """A sum's values."""
        first = second = 0
        for monomial, q in value.items():
            c = residue(q)
            a, b = self.of(monomial)
            first, second = (first + c * a) % _PRIME, (second + c * b) % _PRIME
        return first, second


def residue(q: Fraction) -> int:
    """The value of a rational, the same at both points."""
    return q.numerator * inverted(q.denominator) % _PRIME


def hashed(name: str, value: int) -> int:
    return int.from_bytes(hashlib.sha256(f"{name} {value}".encode()).digest(), "big") % _PRIME


def inverted(residue: int) -> int:
    if residue % _PRIME == 0:
        raise InputError("a query divides by zero.")
    return pow(residue, -1, _PRIME)
