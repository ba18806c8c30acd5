"""A period in which inputs are held and what is uncertain jumps: points against which enclosures of its mean are held.

The flow of each piece on which q is constant is integrated in many digits, by midpoints and Richardson's extrapolation:
nothing here is shared with the rules of series that are tested.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from typing import Any

import mpmath
import numpy as np

from tests.support.certificates import Document

DIGITS = 40
FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    name: getattr(mpmath, name) for name in ("sin", "cos", "tan", "tanh", "exp", "atan", "sqrt")
}


def evaluated(node: Any, names: Mapping[str, Any]) -> Any:
    """An expression of the file format at a point."""
    if isinstance(node, str):
        return names[node] if node in names else mpmath.mpf(Fraction(node).numerator) / Fraction(node).denominator
    name, *rest = node
    if name == "**":
        return evaluated(rest[0], names) ** rest[1]
    values = [evaluated(each, names) for each in rest]
    if name in FUNCTIONS:
        return FUNCTIONS[name](values[0])
    result = values[0]
    if len(values) == 1:
        return -result if name == "-" else result
    for v in values[1:]:
        result = {"+": result + v, "-": result - v, "*": result * v}[name] if name != "/" else result / v
    return result


def flow(f: Callable[[Sequence[Any]], list[Any]], x: Sequence[Any], duration: Any, steps: int = 6) -> list[Any]:
    """phi(duration) of x' = f(x): the midpoint rule with Richardson's extrapolation in even powers of the step."""
    table: list[list[list[Any]]] = []
    counts = [2 * (k + 1) for k in range(steps)]
    for i, count in enumerate(counts):
        h = duration / count
        before, now = list(x), [a + h * b for a, b in zip(x, f(x), strict=True)]
        for _ in range(count - 1):
            before, now = now, [a + 2 * h * b for a, b in zip(before, f(now), strict=True)]
        end = [(a + b + h * c) / 2 for a, b, c in zip(now, before, f(now), strict=True)]
        row = [end]
        for k in range(1, i + 1):
            ratio = mpmath.mpf(counts[i]) ** 2 / mpmath.mpf(counts[i - k]) ** 2
            row.append([a + (a - b) / (ratio - 1) for a, b in zip(row[k - 1], table[i - 1][k - 1], strict=True)])
        table.append(row)
    return table[-1][-1]


def mean_change(
    data: Document, x: Sequence[Any], u: Sequence[Any], pieces: Sequence[tuple[Any, Mapping[str, Any]]]
) -> list[Any]:
    """G = (phi(h) - x) / h where q has these values for these times, one after the other; f itself for h = 0."""
    plant = data["plant"]
    inputs = dict(zip(plant["inputs"], u, strict=True))
    with mpmath.workdps(DIGITS):
        now = [mpmath.mpf(v) for v in x]
        for duration, q in pieces:

            def f(state: Sequence[Any], q: Mapping[str, Any] = q) -> list[Any]:
                names = {**dict(zip(plant["states"], state, strict=True)), **inputs, **q}
                return [evaluated(each, names) for each in plant["dynamics"]]

            if sum(duration for duration, _ in pieces) == 0:
                return f(now)
            now = flow(f, now, mpmath.mpf(duration), 8)
        h = sum((mpmath.mpf(duration) for duration, _ in pieces), mpmath.mpf(0))
        return [(a - mpmath.mpf(b)) / h for a, b in zip(now, x, strict=True)]


def switching(data: Document, h: float, generator: np.random.Generator) -> list[tuple[float, dict[str, Fraction]]]:
    """Up to four pieces of a period h; the values of q lie at the ends of their ranges most of the time."""
    count = int(generator.integers(1, 5))
    parts = generator.dirichlet(np.ones(count)) * h
    parts[-1] = h - sum(parts[:-1])
    pieces = []
    for part in parts:
        q = {}
        for each in data["plant"]["uncertain"]:
            lo, hi = (Fraction(end) for end in each["range"])
            share = Fraction(int(generator.integers(0, 2))) if generator.random() < 0.7 else Fraction(1, 3)
            q[each["name"]] = lo + (hi - lo) * share
        pieces.append((float(part), {name: mpmath.mpf(v.numerator) / v.denominator for name, v in q.items()}))
    return pieces
