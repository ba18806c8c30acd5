"""Documents with uncertain quantities: those that they stand for at single values, and what is true of them there.

A claim for every value in a box of ranges is a claim for each of them. With the value written into the equations it is
a document without uncertain quantities, which the oracle can judge that knows of values only.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb

from tests.support import claim_oracle
from tests.support.certificates import Document, edited

Values = Mapping[str, Fraction]


def ranges_of(data: Document) -> dict[str, tuple[Fraction, Fraction]]:
    return {q["name"]: (Fraction(q["range"][0]), Fraction(q["range"][1])) for q in data["plant"]["uncertain"]}


def corners(data: Document) -> Iterator[dict[str, Fraction]]:
    ranges = ranges_of(data)
    for ends in itertools.product(*ranges.values()):
        yield dict(zip(ranges, ends, strict=True))


def drawn(data: Document, generator: np.random.Generator) -> dict[str, Fraction]:
    """Values in the ranges: at an end, next to one, or anywhere between them."""
    result = {}
    for name, (lo, hi) in ranges_of(data).items():
        share = Fraction(float(generator.choice([0.0, 1.0, 2.0**-30, 1 - 2.0**-30, generator.random()])))
        result[name] = lo + (hi - lo) * share
    return result


def held(data: Document, values: Values) -> Document:
    """The document of the same claim for these values alone, which are written where the names stood."""
    result = edited(data, "plant.uncertain", [])
    result["plant"]["dynamics"] = [replaced(tree, values) for tree in data["plant"]["dynamics"]]
    if "cells" in result["evidence"]:
        result["evidence"]["cells"] = []
    return result


def replaced(node: Any, values: Values) -> Any:
    if isinstance(node, str):
        return str(values[node]) if node in values else node
    return [node[0], *(operand if type(operand) is int else replaced(operand, values) for operand in node[1:])]


def refutation(data: Document, more: Sequence[Values] = ()) -> str | None:
    """Why a claim is certainly false at a corner of the ranges or at one of the values, or None."""
    for values in (*corners(data), *more):
        found = claim_oracle.refutation(held(data, values))
        if found:
            return f"{found} where {', '.join(f'{name} = {q}' for name, q in values.items())}"
    return None


def hull(ends: tuple[Fraction, Fraction]) -> arb:
    lo, hi = (arb(q.numerator) / q.denominator for q in ends)
    return lo.union(hi)
