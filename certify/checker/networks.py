"""Networks: named functions of vectors, written as steps, and the one interpreter that reads them.

A step makes a vector of vectors before it: vector 0 is the argument, the k-th step makes vector k, the last is the
value. An algebra says what each kind of step does to its vectors; `run` takes an argument through a network in it.
"""

from __future__ import annotations

import hashlib
import json
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import add
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from .expression import Call, Tape, parse
from .schema import Value

MAX_NETWORKS, MAX_STEPS, MAX_WIDTH, MAX_NAMES = 64, 256, 2**14, 64
PLAIN = ("sin", "cos", "tanh", "exp", "atan", "sqrt")
FUNCTIONS = (*PLAIN, "relu", "elu", "sigmoid", "silu", "gelu", "softplus", "mish", "softsign")
Array = NDArray[np.float64]
V = TypeVar("V")


@dataclass(frozen=True, eq=False)
class Step:
    """`of` are the numbers of the vectors that it reads, `size` is that of the vector that it makes."""

    of: tuple[int, ...]
    size: int

    @property
    def arrays(self) -> tuple[Array, ...]:
        """The numbers that the file states."""
        return ()

    @property
    def units(self) -> int:
        """Entries that add something to their tangents on a ball, at most."""
        return 0 if isinstance(self, Affine | Sum | Concat) else self.size


@dataclass(frozen=True, eq=False)
class Affine(Step):
    """`W h + b`."""

    weight: Array
    bias: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        return self.weight, self.bias


@dataclass(frozen=True, eq=False)
class Map(Step):
    """A function of the table, of each entry."""

    function: str


@dataclass(frozen=True, eq=False)
class Clip(Step):
    """`min(max(h, lo), hi)`."""

    lo: Array
    hi: Array

    @property
    def arrays(self) -> tuple[Array, ...]:
        return self.lo, self.hi


class Sum(Step):
    """The sum of vectors, from left to right."""


class Concat(Step):
    """Vectors one behind the other."""


class Product(Step):
    """The product of two vectors, entry by entry; one of a single entry multiplies every entry of the other."""


@dataclass(frozen=True, eq=False)
class Observe(Step):
    """Expressions of the entries, by their names."""

    names: tuple[str, ...]
    tape: Tape


@dataclass(frozen=True, eq=False)
class Network:
    """A function of `reads` numbers."""

    name: str
    reads: int
    steps: tuple[Step, ...]

    @property
    def gives(self) -> int:
        """The number of entries of its value."""
        return self.steps[-1].size

    @cached_property
    def widest(self) -> int:
        """The most entries of a vector, the argument among them."""
        return max(self.reads, *(step.size for step in self.steps))

    @property
    def widths(self) -> list[int]:
        """The sizes of the argument and of each affine step's vector."""
        return [self.reads, *(step.size for step in self.steps if isinstance(step, Affine))]

    @property
    def operations(self) -> int:
        """Operations of all expressions of `observe`."""
        return sum(len(step.tape.operations) for step in self.steps if isinstance(step, Observe))

    @cached_property
    def shapes(self) -> list[tuple[int, int, int]]:
        """For rule `limits`, steps with their rows, columns, and the units before them.

        A step that is not `affine` has its entries as rows, the vectors that it reads as columns. A `map` of what an
        `affine` step has just made is part of that.
        """
        found, before, last = list[tuple[int, int, int]](), 0, None
        for k, step in enumerate(self.steps):
            if isinstance(step, Affine):
                found.append((*step.weight.shape, before))
            elif not (isinstance(step, Map) and isinstance(last, Affine) and step.of == (k,)):
                found.append((step.size, len(step.of), before))
            before, last = before + step.units, step
        return found

    @property
    def kept(self) -> int:
        """The entries of vectors that a step reads which is not the next."""
        sizes = [self.reads, *(step.size for step in self.steps)]
        return sum(sizes[i] for i in {i for k, step in enumerate(self.steps) for i in step.of if i < k})

    @property
    def is_chain(self) -> bool:
        """True if it is affine and tanh in turn, affine first and last, each of the vector just before."""
        return len(self.steps) % 2 == 1 and all(
            step.of == (k,)
            and (isinstance(step, Affine) if k % 2 == 0 else isinstance(step, Map))
            # the only function of a chain is tanh
            and getattr(step, "function", "tanh") == "tanh"
            for k, step in enumerate(self.steps)
        )

    @cached_property
    def readers(self) -> dict[int, list[int]]:
        """The steps that read a vector, by its number: in order, from 1, one that reads it twice stands there twice."""
        found: dict[int, list[int]] = {}
        for k, step in enumerate(self.steps, 1):
            for i in step.of:
                found.setdefault(i, []).append(k)
        return found

    def words(self) -> str:
        """The steps but for their numbers, where they are not those of a chain; FORMAT.md has the hash."""
        text = ""
        for step in () if self.is_chain else self.steps:
            text += " ".join([type(step).__name__.lower(), *map(str, step.of)])
            text += f" {step.function}\0" if isinstance(step, Map) else "\0"
            if isinstance(step, Observe):
                trees = json.dumps(step.tape.trees, separators=(",", ":"))
                text += "".join(f"{name}\0" for name in step.names) + f"{trees}\0"
        return text


def hashed(heading: str, arrays: Iterable[Array], words: str) -> str:
    """sha256 of a heading, of shape and little-endian numbers of each array, and of words (FORMAT.md)."""
    digest = hashlib.sha256(heading.encode())
    for numbers in arrays:
        digest.update(struct.pack(f"<{1 + numbers.ndim}Q", numbers.ndim, *numbers.shape))
        digest.update(numbers.astype("<f8").tobytes())
    digest.update(words.encode())
    return digest.hexdigest()


# ------------------------------------------------------------------------------------------------------------- reading


def read(value: Value) -> dict[str, Network]:
    """The section `networks`, by names."""
    networks = value.listed(_network, 1, MAX_NETWORKS)
    named = {network.name: network for network in networks}
    value.must(len(named) == len(networks), "a list of networks with different names")
    return named


def _network(value: Value) -> Network:
    name, reads, steps = value.keys("name reads steps")
    sizes = [reads.integer(1, MAX_WIDTH)]

    def read_next(step: Value) -> Step:
        made = _step(step, sizes)
        sizes.append(made.size)
        return made

    network = Network(name.name(), sizes[0], steps.listed(read_next, 1, MAX_STEPS))
    steps.must(len(network.readers) == len(network.steps), "steps of which each but the last is read by another")
    return network


KEYS = {
    "affine": "shape weight bias",
    "map": "function",
    "clip": "lo hi",
    "sum": "",
    "concat": "",
    "product": "",
    "observe": "names expressions",
}


def _step(value: Value, sizes: Sequence[int]) -> Step:
    """A step after vectors of these sizes."""
    known = isinstance(value.raw, dict) and isinstance(value.raw.get("kind"), str) and value.raw["kind"] in KEYS
    value.must(known, f"an object of kind {' or '.join(KEYS)}")
    kind = value.raw["kind"]
    _, of, *others = value.keys(f"kind of {KEYS[kind]}")
    least, most = {"sum": (2, MAX_STEPS), "concat": (2, MAX_STEPS), "product": (2, 2)}.get(kind, (1, 1))
    read = of.listed(lambda i: i.integer(0, len(sizes) - 1), least, most)
    width = sizes[read[0]]
    match kind:
        case "affine":
            return _affine(read, width, *others)
        case "map":
            function = others[0].choice(*FUNCTIONS)
            if function not in PLAIN:
                from . import activations

                activations.add()
            return Map(read, width, function)
        case "clip":
            lo, hi = (end.array(width) for end in others)
            value.must(bool(np.all(lo < hi)), "lower, then upper ends")
            return Clip(read, width, lo, hi)
        case "sum":
            of.must(all(sizes[i] == width for i in read), "vectors of equal length")
            return Sum(read, width)
        case "concat":
            size = sum(sizes[i] for i in read)
            of.must(size <= MAX_WIDTH, f"vectors of at most {MAX_WIDTH} entries in all")
            return Concat(read, size)
        case "product":
            size = max(sizes[i] for i in read)
            of.must(all(sizes[i] in (1, size) for i in read), "vectors of equal length, or one of a single entry")
            return Product(read, size)
        case _:
            return _observe(read, width, *others)


def _affine(of: tuple[int, ...], width: int, shape: Value, weight: Value, bias: Value) -> Affine:
    rows, _ = shape.listed(lambda size: size.integer(1, MAX_WIDTH), 2)
    shape.must(shape.raw[1] == width, f"[out, {width}]")
    return Affine(of, rows, weight.array(rows, width), bias.array(rows))


def _observe(of: tuple[int, ...], width: int, names: Value, expressions: Value) -> Observe:
    named = names.listed(Value.name, width, min(width, MAX_NAMES))
    names.must(len(set(named)) == width, "different names")
    trees = expressions.listed(lambda tree: tree.raw, 1, MAX_NAMES)
    return Observe(of, len(trees), named, parse(trees, named, expressions.at))


# --------------------------------------------------------------------------------------------------------- interpreting


class Algebra(ABC, Generic[V]):
    """The meaning of each kind of step for vectors V."""

    @abstractmethod
    def affine(self, step: Affine, v: V) -> V:
        """`W v + b`."""

    @abstractmethod
    def map(self, step: Map, v: V) -> V:
        """The function of each entry."""

    @abstractmethod
    def clip(self, step: Clip, v: V) -> V:
        """`min(max(v, lo), hi)`."""

    @abstractmethod
    def sum(self, step: Sum, vectors: Sequence[V]) -> V:
        """The sum of vectors of equal length."""

    @abstractmethod
    def concat(self, step: Concat, vectors: Sequence[V]) -> V:
        """Vectors one behind the other."""

    @abstractmethod
    def product(self, step: Product, v: V, w: V) -> V:
        """The product of two vectors, of which one may have a single entry."""

    @abstractmethod
    def observe(self, step: Observe, v: V) -> V:
        """Expressions of the entries."""

    def run(self, network: Network, argument: V) -> V:
        """The network's value. A vector is kept no longer than steps read it."""
        vectors: dict[int, Any] = {0: argument}
        for k, step in enumerate(network.steps, 1):
            vectors[k] = self.make(step, [vectors[i] for i in step.of])
            for i in set(step.of):
                if network.readers[i][-1] == k:
                    del vectors[i]
        return vectors[len(network.steps)]  # type: ignore[no-any-return]

    def make(self, step: Step, vectors: Sequence[V]) -> V:
        """The vector that a step makes."""
        match step:
            case Affine():
                return self.affine(step, vectors[0])
            case Map():
                return self.map(step, vectors[0])
            case Clip():
                return self.clip(step, vectors[0])
            case Sum():
                return self.sum(step, vectors)
            case Concat():
                return self.concat(step, vectors)
            case Product():
                return self.product(step, *vectors)
            case Observe():
                return self.observe(step, vectors[0])
        raise TypeError(f"no kind of step: {type(step).__name__}")


class OnNumbers(Algebra[list[Any]]):
    """Networks on numbers that add, multiply and know functions; a vector is a list of them."""

    def map(self, step: Map, v: list[Any]) -> list[Any]:
        return [x.function(step.function) for x in v]

    def sum(self, step: Sum, vectors: Sequence[list[Any]]) -> list[Any]:
        return [reduce(add, entries) for entries in zip(*vectors, strict=True)]

    def concat(self, step: Concat, vectors: Sequence[list[Any]]) -> list[Any]:
        return [x for v in vectors for x in v]

    def product(self, step: Product, v: list[Any], w: list[Any]) -> list[Any]:
        return [v[i % len(v)] * w[i % len(w)] for i in range(step.size)]

    def entries(self, call: Call, arguments: list[Any]) -> list[Any]:
        """A call in equations."""
        value = self.run(call.network, arguments)
        return [value[i] for i in call.entries]
