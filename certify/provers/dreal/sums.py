"""Sums of products of atoms with exact coefficients."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from fractions import Fraction

Monomial = tuple[tuple[str, int], ...]  # atoms with their exponents >= 1, sorted; () is 1
Sum = Mapping[Monomial, Fraction]  # without zeros


def constant(q: Fraction) -> Sum:
    return {(): q} if q else {}


def atom_of(name: str) -> Sum:
    """One atom, once."""
    return {((name, 1),): Fraction(1)}


def scaled(value: Sum, c: Fraction) -> Sum:
    return {m: c * q for m, q in value.items()} if c else {}


def add(a: Sum, b: Sum, sign: int) -> Sum:
    result = dict(a)
    for m, c in b.items():
        result[m] = result.get(m, Fraction(0)) + sign * c
        if not result[m]:
            del result[m]
    return result


def times(a: Monomial, b: Monomial) -> Monomial:
    exponents = Counter(dict(a))
    exponents.update(dict(b))
    return tuple(sorted(exponents.items()))
