"""Networks: rule `format` for their steps, their part of the hash, and the one loop that runs them.

A network is a list of steps, each of which makes a vector of vectors before it. What a vector is, an algebra says: one
of exact numbers, of affine forms on boxes, of models on boxes or of models on a ball.

Weights stay binary64 numbers in flat arrays until a rule asks for them: a file of the largest size holds millions.
"""

from __future__ import annotations

import json
import struct
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add
from typing import Any, ClassVar, Protocol, TypeVar

from flint import arb, arb_mat

from .balls import absolute, norm, spectral_norm
from .expressions import Equations, equations
from .fields import IDENTIFIER, MAX_NAMES, entries, keys, little_endian, numbers
from .refusal import require
from .table import FUNCTIONS

MAX_NETWORKS, MAX_STEPS, MAX_WIDTH = 64, 256, 2**14
T = TypeVar("T")
MAPS = tuple(name for name in FUNCTIONS if name not in ("1/", "abs"))  # these two are for expressions


@dataclass(frozen=True)
class Step:
    """`size` entries made of the vectors `of`."""

    of: tuple[int, ...]
    size: int
    kind: ClassVar[str]

    def arrays(self) -> Sequence[tuple[tuple[int, ...], array[float]]]:
        """The axes and the numbers of each array to hash."""
        return ()

    def words(self) -> str:
        """The words that are hashed beside its arrays."""
        return f"{self.kind} {' '.join(map(str, self.of))}\0"


@dataclass(frozen=True)
class Affine(Step):
    """`W h + b`: W row by row, all numbers as they stand in the file."""

    columns: int
    weight: array[float]
    bias: array[float]
    kind = "affine"

    @cached_property
    def W(self) -> arb_mat:
        return arb_mat(self.size, self.columns, [arb(w) for w in self.weight])

    @cached_property
    def b(self) -> list[arb]:
        return [arb(b) for b in self.bias]

    @cached_property
    def magnitudes(self) -> arb_mat:
        return absolute(self.W)

    @cached_property
    def row_norms(self) -> list[arb]:
        return [norm(row) for row in self.W.tolist()]

    @cached_property
    def norm(self) -> arb:
        return spectral_norm(self.W)

    def row(self, i: int) -> array[float]:
        return self.weight[i * self.columns : (i + 1) * self.columns]

    def arrays(self) -> Sequence[tuple[tuple[int, ...], array[float]]]:
        return ((self.size, self.columns), self.weight), ((self.size,), self.bias)


@dataclass(frozen=True)
class Map(Step):
    function: str
    kind = "map"

    def words(self) -> str:
        return f"{super().words()[:-1]} {self.function}\0"


@dataclass(frozen=True)
class Clip(Step):
    lo: array[float]
    hi: array[float]
    kind = "clip"

    def arrays(self) -> Sequence[tuple[tuple[int, ...], array[float]]]:
        return ((self.size,), self.lo), ((self.size,), self.hi)


@dataclass(frozen=True)
class Sum(Step):
    kind = "sum"


@dataclass(frozen=True)
class Concat(Step):
    kind = "concat"


@dataclass(frozen=True)
class Product(Step):
    kind = "product"


@dataclass(frozen=True)
class Observe(Step):
    names: tuple[str, ...]
    expressions: Equations
    text: str
    kind = "observe"

    def words(self) -> str:
        return super().words() + "".join(f"{each}\0" for each in (*self.names, self.text))


class Algebra(Protocol):
    """A meaning of vectors: each kind of step makes one of those before it."""

    def affine(self, step: Affine, v: Any, /) -> Any: ...
    def map(self, step: Map, v: Any, /) -> Any: ...
    def clip(self, step: Clip, v: Any, /) -> Any: ...
    def sum(self, step: Sum, *vectors: Any) -> Any: ...
    def concat(self, step: Concat, *vectors: Any) -> Any: ...
    def product(self, step: Product, v: Any, w: Any, /) -> Any: ...
    def observe(self, step: Observe, v: Any, /) -> Any: ...


class OnLists:
    """Steps that are the same wherever a vector is a list of numbers with `+`, `*` and `function(name)`."""

    def map(self, step: Map, v: list[Any]) -> list[Any]:
        return [x.function(step.function) for x in v]

    def sum(self, step: Sum, *vectors: list[Any]) -> list[Any]:
        return [reduce(add, each) for each in zip(*vectors, strict=True)]

    def concat(self, step: Concat, *vectors: list[Any]) -> list[Any]:
        return [x for v in vectors for x in v]

    def product(self, step: Product, v: list[Any], w: list[Any]) -> list[Any]:
        return [x * y for x, y in paired(v, w)]


@dataclass(frozen=True, eq=False)
class Network:
    name: str
    reads: int
    steps: tuple[Step, ...]

    @property
    def size(self) -> int:
        return self.steps[-1].size

    @cached_property
    def sizes(self) -> tuple[int, ...]:
        """The entries of each vector."""
        return (self.reads, *(step.size for step in self.steps))

    @cached_property
    def last_use(self) -> tuple[int, ...]:
        """For each vector the last step that reads it."""
        last = {i: k for k, step in enumerate(self.steps) for i in step.of}
        return tuple(last.get(i, len(self.steps)) for i in range(len(self.sizes)))

    def run(self, algebra: Algebra, first: Any) -> Any:
        """The last vector. Vectors are dropped after their last use: those of many models are large."""
        vectors = {0: first}
        for k, step in enumerate(self.steps):
            vectors[k + 1] = getattr(algebra, step.kind)(step, *(vectors[i] for i in step.of))
            for i in {*step.of, k + 1}:
                if self.last_use[i] == k:
                    del vectors[i]
        return vectors[len(self.steps)]

    @property
    def is_plain(self) -> bool:
        """True if it is affine steps with tanh between them."""
        in_turn = all(
            step.of == (k,) and (step.kind == "affine" if k % 2 == 0 else getattr(step, "function", "") == "tanh")
            for k, step in enumerate(self.steps)
        )
        return in_turn and len(self.steps) % 2 == 1

    def hashed(self) -> Iterator[bytes]:
        """The arrays of all steps; the arrays that the policy has beside them come next, and then `described`."""
        for step in self.steps:
            for axes, values in step.arrays():
                yield packed(axes, values)

    def described(self) -> bytes:
        return b"" if self.is_plain else "".join(step.words() for step in self.steps).encode()


def paired(v: Sequence[T], w: Sequence[T]) -> Iterator[tuple[T, T]]:
    """The entries that a product multiplies: one alone is taken with each of the other vector."""
    count = max(len(v), len(w))
    return zip(list(v) * (count // len(v)), list(w) * (count // len(w)), strict=True)


def packed(axes: Sequence[int], values: array[float]) -> bytes:
    """The number of axes, the axes, and the numbers."""
    return struct.pack(f"<{1 + len(axes)}Q", len(axes), *axes) + little_endian(values)


# ------------------------------------------------------------------------------------------------------ rule `format`


def read_networks(value: Any, at: str) -> dict[str, Network]:
    networks = dict[str, Network]()
    described = entries(value, at)
    require(1 <= len(described) <= MAX_NETWORKS, "format", at, f"1 to {MAX_NETWORKS} networks are allowed")
    for k, each in enumerate(described):
        network = read_network(each, f"{at}.{k}")
        require(network.name not in networks, "format", f"{at}.{k}.name", "two networks have the same name")
        networks[network.name] = network
    return networks


def read_network(value: Any, at: str) -> Network:
    network = keys(value, at, "name", "reads", "steps")
    name, reads = network["name"], network["reads"]
    named = isinstance(name, str) and IDENTIFIER.fullmatch(name) is not None
    require(named, "format", f"{at}.name", "an identifier was expected")
    good = is_integer(reads) and 1 <= reads <= MAX_WIDTH
    require(good, "format", f"{at}.reads", f"an integer from 1 to {MAX_WIDTH} was expected")
    steps, sizes = list[Step](), [reads]
    described = entries(network["steps"], f"{at}.steps")
    require(1 <= len(described) <= MAX_STEPS, "format", f"{at}.steps", f"1 to {MAX_STEPS} steps are allowed")
    for k, each in enumerate(described):
        step = read_step(each, f"{at}.steps.{k}", sizes)
        wide = step.size <= MAX_WIDTH
        require(wide, "format", f"{at}.steps.{k}", f"a vector of more than {MAX_WIDTH} entries")
        steps.append(step)
        sizes.append(step.size)
    read = {i for step in steps for i in step.of}
    require(read == set(range(len(steps))), "format", f"{at}.steps", "a step but the last is read by none")
    return Network(name, reads, tuple(steps))


def is_integer(value: Any) -> bool:
    return type(value) is int  # True is an int to isinstance


def read_step(value: Any, at: str, sizes: Sequence[int]) -> Step:
    """One step, given the sizes of the vectors before it."""
    kind = value.get("kind") if isinstance(value, dict) else None
    known = isinstance(kind, str) and kind in READERS
    require(known, "format", f"{at}.kind", f"one of {', '.join(READERS)} was expected")
    names, read = READERS[str(kind)]
    step = keys(value, at, "kind", "of", *names)
    of, many = entries(step["of"], f"{at}.of"), kind in ("sum", "concat")
    before = all(is_integer(i) and 0 <= i < len(sizes) for i in of)
    require(before, "format", f"{at}.of", "the numbers of vectors before it were expected")
    fits = len(of) >= 2 if many else len(of) == (2 if kind == "product" else 1)
    require(fits, "format", f"{at}.of", "two or more vectors were expected" if many else "another number of vectors")
    made: Step = read(step, at, tuple(of), [sizes[i] for i in of])
    return made


def read_affine(step: Mapping[str, Any], at: str, of: tuple[int, ...], sizes: Sequence[int]) -> Affine:
    out, into = entries(step["shape"], f"{at}.shape", 2)
    fits = is_integer(out) and is_integer(into) and 1 <= out <= MAX_WIDTH and into == sizes[0]
    require(fits, "format", f"{at}.shape", f"[rows, {sizes[0]}] with 1 to {MAX_WIDTH} rows was expected")
    weight, bias = numbers(step["weight"], f"{at}.weight", out * into), numbers(step["bias"], f"{at}.bias", out)
    return Affine(of, out, into, weight, bias)


def read_map(step: Mapping[str, Any], at: str, of: tuple[int, ...], sizes: Sequence[int]) -> Map:
    function = step["function"]
    known = isinstance(function, str) and function in MAPS
    require(known, "format", f"{at}.function", f"one of {', '.join(MAPS)} was expected")
    return Map(of, sizes[0], function)


def read_clip(step: Mapping[str, Any], at: str, of: tuple[int, ...], sizes: Sequence[int]) -> Clip:
    lo, hi = (numbers(step[end], f"{at}.{end}", sizes[0]) for end in ("lo", "hi"))
    require(all(a < b for a, b in zip(lo, hi, strict=True)), "format", at, "lo < hi must hold")
    return Clip(of, sizes[0], lo, hi)


def read_sum(step: Mapping[str, Any], at: str, of: tuple[int, ...], sizes: Sequence[int]) -> Sum:
    require(len(set(sizes)) == 1, "format", f"{at}.of", "vectors of equal length were expected")
    return Sum(of, sizes[0])


def read_concat(step: Mapping[str, Any], at: str, of: tuple[int, ...], sizes: Sequence[int]) -> Concat:
    return Concat(of, sum(sizes))


def read_product(step: Mapping[str, Any], at: str, of: tuple[int, ...], sizes: Sequence[int]) -> Product:
    fits = sizes[0] == sizes[1] or 1 in sizes
    require(fits, "format", f"{at}.of", "vectors of equal length or a single entry were expected")
    return Product(of, max(sizes))


def read_observe(step: Mapping[str, Any], at: str, of: tuple[int, ...], sizes: Sequence[int]) -> Observe:
    few = sizes[0] <= MAX_NAMES
    require(few, "format", f"{at}.of", f"at most {MAX_NAMES} entries can have names")
    names = entries(step["names"], f"{at}.names", sizes[0])
    named = all(isinstance(name, str) and IDENTIFIER.fullmatch(name) is not None for name in names)
    require(named and len(set(names)) == len(names), "format", f"{at}.names", "different identifiers were expected")
    nodes = entries(step["expressions"], f"{at}.expressions")
    require(1 <= len(nodes) <= MAX_NAMES, "format", f"{at}.expressions", f"1 to {MAX_NAMES} expressions are allowed")
    compiled = equations(nodes, set(names), f"{at}.expressions")
    return Observe(of, len(nodes), tuple(names), compiled, json.dumps(nodes, separators=(",", ":")))


READERS: dict[str, tuple[tuple[str, ...], Any]] = {
    "affine": (("shape", "weight", "bias"), read_affine),
    "map": (("function",), read_map),
    "clip": (("lo", "hi"), read_clip),
    "sum": ((), read_sum),
    "concat": ((), read_concat),
    "product": ((), read_product),
    "observe": (("names", "expressions"), read_observe),
}
