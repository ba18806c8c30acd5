"""Networks: named functions of vectors, written as steps, and the one interpreter that reads them.

A step makes a vector of vectors before it: vector 0 is the argument, the k-th step makes vector k, the last is the
value. An algebra says what each kind of step does to its vectors; `run` takes an argument through a network in it.
"""

from __future__ import annotations

import hashlib
import struct
from abc import ABC, abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

from .expression import Call, load
from .schema import Array, Value

MAX_NETWORKS, MAX_STEPS, MAX_WIDTH = 64, 256, 2**14
KINDS = ("affine", "map", "clip", "sum", "concat", "product", "observe")  # all but two in wiring.py
FUNCTIONS = (
    *("sin", "cos", "tanh", "exp", "atan", "sqrt"),
    *("relu", "elu", "sigmoid", "silu", "gelu", "softplus", "mish", "softsign"),
)
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
    def kind(self) -> str:
        """The word for it in the file, and the name of an algebra's method."""
        return type(self).__name__.lower()

    @property
    def words(self) -> str:
        """The step but for its numbers, for the hash: FORMAT.md has it."""
        return " ".join([self.kind, *map(str, self.of)]) + "\0"

    def said(self, of: str) -> str:
        """The step for people, of vectors with these names."""
        return f"{self.kind}({of}), {self.size} entries"


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

    @property
    def words(self) -> str:
        return f"{super().words[:-1]} {self.function}\0"

    def said(self, of: str) -> str:
        return f"{self.function}({of})"


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

    @property
    def sizes(self) -> list[int]:
        """The numbers of entries of all vectors, the argument's first."""
        return [self.reads, *(step.size for step in self.steps)]

    @property
    def widest(self) -> int:
        return max(self.sizes)

    @property
    def operations(self) -> int:
        """Operations of all expressions of `observe`."""
        return sum(len(step.tape.operations) for step in self.steps if hasattr(step, "tape"))

    @property
    def is_chain(self) -> bool:
        """True if it is affine and tanh in turn, affine first and last, each of the vector just before."""
        turns = [f"map {k} tanh\0" if k % 2 else f"affine {k}\0" for k in range(len(self.steps))]
        return len(turns) % 2 == 1 and turns == [step.words for step in self.steps]

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
        return "" if self.is_chain else "".join(step.words for step in self.steps)


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


def _step(value: Value, sizes: Sequence[int]) -> Step:
    """A step after vectors of these sizes."""
    kind = value.kind(KINDS)
    if kind not in ("affine", "map"):
        from . import wiring

        return wiring.read(value, sizes)
    _, of, *others = value.keys(f"kind of {'function' if kind == 'map' else 'shape weight bias'}")
    read = vectors_of(of, sizes, 1, 1)
    width = sizes[read[0]]
    if kind == "affine":
        return _affine(read, width, *others)
    function = others[0].choice(*FUNCTIONS)
    load(function)
    return Map(read, width, function)


def vectors_of(of: Value, sizes: Sequence[int], least: int, most: int) -> tuple[int, ...]:
    """The numbers of the vectors that a step reads, after vectors of these sizes."""
    return of.listed(lambda i: i.integer(0, len(sizes) - 1), least, most)


def _affine(of: tuple[int, ...], width: int, shape: Value, weight: Value, bias: Value) -> Affine:
    rows, _ = shape.listed(lambda size: size.integer(1, MAX_WIDTH), 2)
    shape.must(shape.raw[1] == width, f"[out, {width}]")
    return Affine(of, rows, weight.array(rows, width), bias.array(rows))


# --------------------------------------------------------------------------------------------------------- interpreting


class Algebra(ABC, Generic[V]):
    """The meaning of each kind of step for vectors V."""

    @abstractmethod
    def affine(self, step: Affine, v: V) -> V:
        """`W v + b`."""

    @abstractmethod
    def map(self, step: Map, v: V) -> V:
        """The function of each entry."""

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
        """The vector that a step makes, by the method of its kind: here, or in the class that wiring.py has for it."""
        owner: Any = self
        if not hasattr(self, step.kind):
            from .wiring import MEANINGS

            owner = MEANINGS[type(self)](self)
        made: V = getattr(owner, step.kind)(step, *vectors)
        return made


class OnNumbers(Algebra[list[Any]]):
    """Networks on numbers that add, multiply and know functions; a vector is a list of them."""

    def map(self, step: Map, v: list[Any]) -> list[Any]:
        return [x.function(step.function) for x in v]

    def entries(self, call: Call, arguments: list[Any]) -> list[Any]:
        """A call in equations."""
        value = self.run(call.network, arguments)
        return [value[i] for i in call.entries]
