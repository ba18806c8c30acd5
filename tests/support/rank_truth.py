"""Trajectories of a document with ranks, in floats: do they do what it claims?

It reads the document alone, by FORMAT.md, and tries corners of leaves, quantities that jump and any periods.
"""

from __future__ import annotations

import base64
import operator
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import reduce
from typing import Any

import numpy as np

from tests.support.ranked import UNRANKED, Document

Array = Any
LITTLE = 1e-9  # what floats may be wrong by
_SUBSTEPS = 6  # of a period
_SINGLE: dict[str, Callable[[Array], Array]] = {
    "sin": np.sin, "cos": np.cos, "tan": np.tan, "tanh": np.tanh, "exp": np.exp, "atan": np.arctan, "sqrt": np.sqrt,
    "abs": np.abs,
}  # fmt: skip
_SEVERAL: dict[str, Callable[[Array, Array], Array]] = {
    "+": operator.add, "*": operator.mul, "min": np.minimum, "max": np.maximum, "/": operator.truediv,
}  # fmt: skip


def numbers(text: str) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f8")


def value(tree: Any, names: dict[str, Array]) -> Array:
    """An expression without calls."""
    if isinstance(tree, str):
        return names[tree] if tree in names else float(Fraction(tree))
    name, *given = tree
    if name == "**":
        return value(given[0], names) ** given[1]
    each = [value(part, names) for part in given]
    if name == "-":
        return -each[0] if len(each) == 1 else each[0] - each[1]
    if name == "clip":
        return np.minimum(np.maximum(each[0], each[1]), each[2])
    return _SINGLE[name](each[0]) if name in _SINGLE else reduce(_SEVERAL[name], each)


class Truth:
    """The loop of a document, and its trajectories from leaves."""

    def __init__(self, data: Document) -> None:
        self.data, self.plant, self.claim = data, data["plant"], data["claim"]
        self.states = self.plant["states"]
        self.ranges = [[float(Fraction(q)) for q in each["range"]] for each in self.plant["uncertain"]]
        self.domain = [[float(Fraction(q)) for q in pair] for pair in self.plant["domain"]]
        self.sample = self.claim["sample"] and [float(Fraction(h)) for h in self.claim["sample"]]

    def policy(self, x: Array) -> Array:
        """The inputs (m, N) of a policy that is not centred."""
        policy, vectors = self.data["policy"], [x]
        (network,) = (net for net in self.data["networks"] if net["name"] == policy["network"])
        for step in network["steps"]:
            given = [vectors[i] for i in step["of"]]
            if step["kind"] == "affine":
                W = numbers(step["weight"]).reshape(step["shape"])
                vectors.append(W @ given[0] + numbers(step["bias"])[:, None])
            elif step["kind"] == "map":
                vectors.append(_SINGLE[step["function"]](given[0]))
            else:
                vectors.append(np.concatenate(given))
        raw = np.tanh(vectors[-1]) if policy["squash"] == "tanh" else vectors[-1]
        return numbers(policy["scale"])[:, None] * raw + numbers(policy["offset"])[:, None]

    def names(self, x: Array, u: Array, q: Array) -> dict[str, Array]:
        others = [each["name"] for each in self.plant["uncertain"]]
        return dict(zip([*self.states, *self.plant["inputs"], *others], [*x, *u, *q], strict=True))

    def f(self, x: Array, u: Array, q: Array) -> Array:
        names = self.names(x, u, q)
        return np.array([value(tree, names) + 0 * x[0] for tree in self.plant["dynamics"]])

    def quantities(self, chance: np.random.Generator, count: int) -> Array:
        found = [chance.choice([a, b, chance.uniform(a, b)], count) for a, b in self.ranges]
        return np.array(found).reshape(len(self.ranges), count)

    def way(self, x: Array, u: Array, chance: np.random.Generator) -> list[tuple[Array, Array]]:
        """States and quantities on the way, in discrete time the first alone, and last where a step ends."""
        q = self.quantities(chance, x.shape[1])
        if not self.sample:
            return [(x, q), (self.f(x, u, q), q)]
        lo, hi = self.sample
        h, found = chance.choice([lo, hi, chance.uniform(lo, hi)], x.shape[1]) / _SUBSTEPS, [(x, q)]
        for _ in range(_SUBSTEPS):
            q = self.quantities(chance, x.shape[1])
            a = self.f(x, u, q)
            b = self.f(x + h / 2 * a, u, q)
            c = self.f(x + h / 2 * b, u, q)
            d = self.f(x + h * c, u, q)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
            found.append((x, q))
        return found

    def worst(self, tree: Any, chance: np.random.Generator) -> float:
        """The largest value of an expression that trajectories have on the way to the target."""
        largest = [-np.inf]
        x, rank = self.starts(chance)
        while x.shape[1]:
            x, rank = self._left(x, rank)
            u = self.policy(x)
            way = self.way(x, u, chance)
            for y, q in way if self.sample else way[:1]:
                largest.append(np.max(value(tree, self.names(y, u, q)) + 0 * y[0], initial=-np.inf))
            x, rank = way[-1][0], rank - 1
        return float(max(largest))

    def starts(self, chance: np.random.Generator) -> tuple[Array, Array]:
        """Corners, middles and other states of leaves of finite rank, (n, N), with the ranks."""
        ranks = self.data["evidence"]["ranks"]
        lo, hi = leaves(base64.b64decode(ranks["tree"]), numbers(ranks["lo"]), numbers(ranks["hi"]))
        rank = np.frombuffer(base64.b64decode(ranks["ranks"]), dtype="<u2").astype(int)
        known = rank != UNRANKED
        n, lo, hi, rank = len(self.states), lo[known], hi[known], rank[known]
        shares = [*np.ndindex(*[2] * n), [0.5] * n, *chance.random((4, n))]
        x = np.concatenate([lo + np.array(share) * (hi - lo) for share in shares])
        return x.T, np.tile(rank, len(shares))

    def beyond(self, x: Array) -> Array:
        """By how much states miss the target."""
        names = dict(zip(self.states, x, strict=True))
        return np.max([value(tree, names) + 0 * x[0] for tree in self.claim["target"]], axis=0)

    def _left(self, x: Array, rank: Array) -> tuple[Array, Array]:
        """Those that have not come to the target and may still move."""
        left = (self.beyond(x) > 0) & (rank > 0)
        return x[:, left], rank[left]

    def lie(self, chance: np.random.Generator) -> str | None:
        """A sentence about a trajectory that does not do what is claimed; None if all that were tried do."""
        x, rank = self.starts(chance)
        while x.shape[1]:
            if np.any((rank == 0) & (self.beyond(x) > LITTLE)):
                return "a trajectory is not in the target in time"
            x, rank = self._left(x, rank)
            u = self.policy(x)
            for (lo, hi), row in zip(self.plant["input_bounds"], u, strict=True):
                if np.any((row < float(Fraction(lo)) - LITTLE) | (row > float(Fraction(hi)) + LITTLE)):
                    return "an input leaves its bounds"
            way = self.way(x, u, chance)
            for y, q in way if self.sample else way[:1]:
                names = self.names(y, u, q)
                if any(np.any(value(g, names) + 0 * y[0] > LITTLE) for g in self.claim.get("keep", ())):
                    return "a constraint is violated"
                for name, (lo, hi), row in zip(self.states, self.domain, y, strict=True):
                    asked = name not in self.claim["ranks"]["angles"]
                    if asked and np.any((row < lo - LITTLE) | (row > hi + LITTLE)):
                        return "a state leaves the domain"
            x, rank = way[-1][0], rank - 1
        return None


def leaves(tree: bytes, lo: Array, hi: Array) -> tuple[Array, Array]:
    """The corners (L, n) of a tree's leaves, in its order."""
    waiting, found = [(lo, hi)], list[tuple[Array, Array]]()
    for axis in tree:
        lo, hi = waiting.pop()
        if axis == 255:
            found.append((lo, hi))
            continue
        below, above = hi.copy(), lo.copy()
        below[axis] = above[axis] = 0.5 * lo[axis] + 0.5 * hi[axis]
        waiting += [(above, hi), (lo, below)]
    return np.array([a for a, _ in found]), np.array([b for _, b in found])


def boxes(tree: bytes, lo: Sequence[float], hi: Sequence[float]) -> list[list[tuple[float, float]]]:
    """The same as lists of intervals."""
    low, high = leaves(tree, np.array(lo), np.array(hi))
    return [list(zip(a, b, strict=True)) for a, b in zip(low.tolist(), high.tolist(), strict=True)]
