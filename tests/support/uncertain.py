"""Documents with uncertain quantities: those that they stand for at single values, and what is true of them there.

A claim for every value in a box of ranges is a claim for each of them. With the value written into the equations it is
a document without uncertain quantities, which the oracle can judge that knows of values only.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from flint import arb

from tests.support import claim_oracle
from tests.support.certificates import Document, edited, make

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


def replaced(node: Any, values: Mapping[str, Any]) -> Any:
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


# ------------------------------------------------------------------------------------------------------- random plants

FACTORS = {  # of a range in [1/4, 2]
    "q": "q", "1/q": ["/", "1", "q"], "q^2": ["**", "q", 2], "q^-3": ["**", "q", -3], "tanh": ["tanh", "q"],
    "sqrt": ["sqrt", "q"], "sin": ["sin", "q"], "cos": ["cos", "q"], "exp": ["exp", ["-", "q"]],
    "atan": ["atan", ["*", "2", "q"]], "tan": ["tan", ["/", "q", "2"]],
    "1/(1+q^2)": ["/", "1", ["+", "1", ["**", "q", 2]]],
    "q - q": ["-", ["*", "2", "q"], "q"],
}  # fmt: skip
SHAPES: dict[str, Callable[[Any, Any, Any], Any]] = {  # of a factor g of q, q itself and a state; 0 where the state is
    "linear": lambda g, q, x: ["*", g, x],
    "square": lambda g, q, x: ["*", g, x, x],
    "sin(q x)": lambda g, q, x: ["*", g, ["sin", ["*", q, x]]],
    "tanh(q x)": lambda g, q, x: ["tanh", ["*", q, g, x]],
    "atan(x / q)": lambda g, q, x: ["*", g, ["atan", ["/", x, q]]],
    "x cos(q x)": lambda g, q, x: ["*", g, x, ["cos", ["*", q, x]]],
    "x exp(q x)": lambda g, q, x: ["*", g, x, ["exp", ["*", q, x]]],
    "x / (q + x^2)": lambda g, q, x: ["*", g, ["/", x, ["+", q, ["**", x, 2]]]],
    "x sqrt(q + x^2)": lambda g, q, x: ["*", x, ["sqrt", ["+", g, ["**", x, 2]]]],
}


def random_plant(seed: int, practical: bool = False) -> Document:
    """One or two states under tanh, with terms in one or two uncertain quantities; some decrease for all of their
    values, some for a part, some for none. Under `practical` a disturbance acts."""
    generator = np.random.default_rng(seed)
    n, k = (int(generator.integers(1, 3)) for _ in range(2))
    states, names = ["x", "y"][:n], ["q", "p"][:k]

    def fraction(lo: float, hi: float) -> Fraction:
        return Fraction(int(generator.integers(round(64 * lo), round(64 * hi) + 1)), 64)

    dynamics = []
    for i in range(n):
        terms: list[Any] = [["*", str(-fraction(0.3, 1.5)), states[i]]]
        for _ in range(int(generator.integers(1, 4))):
            q = str(generator.choice(names))
            factor = replaced(FACTORS[str(generator.choice(list(FACTORS)))], {"q": q})
            if k == 2 and generator.random() < 0.4:
                factor = [str(generator.choice(["*", "/"])), factor, names[1 - names.index(q)]]
            shape = SHAPES[str(generator.choice(list(SHAPES)))]
            terms.append(["*", str(fraction(-0.7, 0.7)), shape(factor, q, str(generator.choice(states)))])
        if i == n - 1:
            terms.append("u")
        if practical:
            terms.append(["*", str(fraction(-0.2, 0.2)), str(generator.choice(names)), "w"])
        dynamics.append(["+", *terms])
    uncertain = []
    for name in names:
        lo = fraction(0.3, 1.5)
        uncertain.append((name, str(lo), str(lo + fraction(0.02, 0.4))))
    if practical:
        uncertain.append(("w", "-1/16", "1/8"))
    gain = generator.uniform(0.3, 1.0, n)
    L = np.eye(n) + np.tril(generator.uniform(-0.3, 0.3, (n, n)), -1)
    P = np.round(256 * L @ L.T) / 256
    T = np.round(4096 * np.linalg.inv(np.linalg.cholesky(P)).T) / 4096
    c2 = float(generator.choice([0.02, 0.1, 0.3]))
    c1 = c2 / float(generator.choice([1, 4, 16]))
    return make(
        dynamics, [(gain[None] * 2, [0.0]), ([[0.5]], [0.0])], P, (c1, c2), states=states, domain=[("-3", "3")] * n,
        squash="identity", centre="none", scale=[-1.0], input_bounds=[("-2", "2")], T=T, uncertain=uncertain,
        claim="practical" if practical else "asymptotic", cells=[int(generator.choice([1, 2, 5])) for _ in uncertain],
    )  # fmt: skip


def largest(data: Document, generator: np.random.Generator, count: int = 4000) -> tuple[float, dict[str, Fraction]]:
    """The largest Vdot / V found where the claim says that it is negative, and the values at which it was.

    In binary64 over states of all levels, most of them at an end of the ring; each corner of the ranges, and values
    drawn between."""
    L, (inner, outer) = np.array(claim_oracle.Loop(held(data, {})).P), claim_oracle.ring_of(data)
    n, worst, where = len(L), -np.inf, dict[str, Fraction]()
    L = np.linalg.inv(np.linalg.cholesky(L)).T
    direction = generator.standard_normal((n, count))
    direction /= np.linalg.norm(direction, axis=0)
    least = inner if claim_oracle.is_practical(data) else 1e-8 * outer
    level = np.where(
        generator.random(count) < 0.5,
        outer * (1 - 1e-12),
        np.maximum(least * (1 + 1e-12), outer * generator.random(count) ** 3),
    )
    x = L @ direction * np.sqrt(level)
    for values in [*corners(data), *(drawn(data, generator) for _ in range(8))]:
        V, vdot, _ = claim_oracle.Loop(held(data, values)).sampled(x)
        rate = float(np.max(vdot / V))
        if not rate <= worst:
            worst, where = rate, values
    return worst, where
